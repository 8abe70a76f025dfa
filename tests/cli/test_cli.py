"""Commands as a user types them: the files they write, their output, their exit codes."""

import csv
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path

import cantools
import pytest

from echelon.bridge.can.canlog import EPOCH_NS
from echelon.messages import STATE_FIELDS
from echelon.sim.recording.mcap_reader import read_links, read_metadata, read_scenario, read_trace
from support.runs import ROOT, echelon, plan_of, trace_of

QUICK = ("--set", "duration=0.2", "--set", "claims=[]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short run in one process."""
    folder = tmp_path_factory.mktemp("runs") / "short"
    done = echelon("run", "paper", *QUICK, "--engine", "inprocess", "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_a_run_leaves_its_folder(folder: Path) -> None:
    names = {
        ".echelon.json",
        "scenario.toml",
        "run.json",
        "run.mcap",
        "can.log",
        "torque.dbc",
        "summary.json",
        "report.html",
    }
    assert {file.name for file in folder.iterdir()} == names
    plan = plan_of("paper", "duration=0.2")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["trace_digest"] == trace_of(plan).digest() == read_trace(folder / "run.mcap", plan).digest()
    assert summary["verdict"]["word"] == "HEALTHY"
    assert summary["can"]["frames"] == 9 * 200
    facts = summary["run"]
    ago = datetime.now(UTC) - datetime.fromisoformat(facts["date"])
    assert timedelta(0) <= ago < timedelta(hours=1)
    assert facts["date"].endswith("+00:00")
    assert (facts["version"], facts["python"]) == (version("echelon"), platform.python_version())
    assert facts["machine"].startswith(f"{platform.platform()}, ")
    assert facts["machine"].endswith(f", {os.cpu_count()} cores")
    program, *words = shlex.split(facts["command"])
    assert Path(program).parts[-2:] == ("echelon", "__main__.py")
    assert words == ["run", "paper", *QUICK, "--engine", "inprocess", "--out", str(folder)]
    assert read_scenario(folder / "run.mcap") == (folder / "scenario.toml").read_text()
    assert read_metadata(folder / "run.mcap")["engine"] == "inprocess"
    assert len(read_links(folder / "run.mcap")) == 24
    page = (folder / "report.html").read_text()
    assert "<script" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_effective_scenario_runs_again_to_the_same_trace(folder: Path, tmp_path: Path) -> None:
    again = echelon(
        *("run", folder / "scenario.toml", "--engine", "inprocess", "--json", "--quiet", "--no-report"),
        *("--can", "none", "--out", tmp_path / "again"),
    )
    assert again.returncode == 0, again.stderr
    summary = json.loads(again.stdout)
    assert summary["trace_digest"] == json.loads((folder / "summary.json").read_text())["trace_digest"]


def test_can_log_decodes_to_the_torques_of_the_trace(folder: Path) -> None:
    database = cantools.database.load_file(folder / "torque.dbc")
    plan = plan_of("paper", "duration=0.2")
    trace, half_a_bit = read_trace(folder / "run.mcap", plan), plan.can.torque_scale / 2
    lines = (folder / "can.log").read_text().splitlines()
    assert len(lines) == 9 * 200 + 9
    for line in lines[-9:]:  # the wheels are stopped at the end
        identifier, data = line.split()[2].split("#")
        signals = database.decode_message(int(identifier, 16), bytes.fromhex(data))
        assert (signals["tau_right"], signals["tau_left"]) == (0, 0)
    for number, line in enumerate(lines[:-9]):
        stamp, _, frame = line.split()
        identifier, data = frame.split("#")
        tick, robot = divmod(number, 9)
        assert float(stamp.strip("()")) - EPOCH_NS / 1e9 == pytest.approx((tick + 1) / 1000, abs=1e-6)
        signals = database.decode_message(int(identifier, 16), bytes.fromhex(data))
        wanted = trace.states[robot][tick + 1]
        assert signals["tau_right"] == pytest.approx(wanted[9], abs=half_a_bit + 1e-9)
        assert signals["tau_left"] == pytest.approx(wanted[10], abs=half_a_bit + 1e-9)


def test_a_failed_claim_is_exit_code_1(tmp_path: Path) -> None:
    done = echelon("run", "paper", "--set", "duration=0.2", "--engine", "inprocess", "--quiet", "--out", tmp_path)
    assert done.returncode == 1
    assert "FAILS" in done.stdout
    assert "centroid" in done.stdout


def test_a_diverged_run_says_so_and_its_summary_is_json(tmp_path: Path) -> None:
    links = 'links=[{source="**",receiver="*",channel="state",delay=0.02}]'
    done = echelon(
        *(
            "run",
            "paper",
            "--set",
            "duration=1.5",
            "--set",
            links,
            "--engine",
            "inprocess",
            "--quiet",
            "--out",
            tmp_path,
        )
    )
    assert done.returncode == 1, done.stderr
    assert re.search(
        r"because  whole: the run was stopped at .* has diverged: at .* from where the trajectory", done.stdout
    )
    json.loads((tmp_path / "summary.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert (tmp_path / "report.html").exists()


def test_plain_lines_where_there_is_no_terminal(tmp_path: Path) -> None:
    done = echelon("run", "lab", "--set", "duration=3", "--clock", "wall", "--engine", "inprocess", "--out", tmp_path)
    assert "real time" in done.stderr
    assert "\x1b" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("run", "nosuch"),
            "nosuch: no such file, and no shipped scenario; those are crossing, drives, integral, lab,",
        ),
        (("validate", "no/such.toml"), "no/such.toml: No such file"),
        (("run", "paper", "--set", "law.epsilon=[0.1]"), "law.epsilon"),
        (("run", "paper", "--set", "duratoin=3"), "did you mean 'duration'"),
        (("run", "paper", "--set", "duration"), "key=value"),
        (("run", "paper", "--can", "serial:1"), "serial"),
        (("run", "paper", "--can", "socketcan:nope"), "no network interface nope that is up"),
        (("run", "paper", "--out", "pyproject.toml"), "--out pyproject.toml: is a file, and must be a folder"),
        (("run", "paper", "--out", "/proc/nowhere"), "--out /proc/nowhere"),
        (("report", "no-such-run"), "no-such-run"),
        (("export", "no-such-run", "--csv", "x"), "no-such-run"),
        (("recover", "no-such-file"), "no-such-file"),
        (("dbc", "nosuch"), "nosuch"),
        (("run", "lab", "--set", "can.path=closed", "--can", "none"), "--can none: the closed torque path"),
        (("run", "lab", "--set", "can.timing=bits"), "can.timing = 'bits': needs can.path = 'closed'"),
        (("run", "lab", "--stall-timeout", "-1"), "'-1' is no duration in seconds"),
        (("drives", "lab", "--seconds", "nan"), "'nan' is no duration in seconds"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments: tuple[str, ...], says: str) -> None:
    done = echelon(*arguments)
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not done.stdout


def test_a_folder_may_have_any_name_and_a_run_a_single_tick(tmp_path: Path) -> None:
    folder = tmp_path / "a#b*?$c @"
    options = ("--set", "duration=0.001", "--set", "claims=[]", "--can", "virtual", "--quiet", "--json")
    done = echelon("run", "paper", *options, "--out", folder)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert json.loads(done.stdout)["trace_digest"] == trace_of(plan_of("paper", "duration=0.001")).digest()
    assert (folder / "report.html").exists()


def test_no_room_for_the_first_file_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "echelon", "run", "paper", *QUICK, "--can", "none", "--quiet", "--json"]
    limited = f"ulimit -f 1; exec {shlex.join(command)} --out {shlex.quote(str(tmp_path))}"
    done = subprocess.run(["bash", "-c", limited], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 3
    assert done.stderr.splitlines() == [f"echelon: {tmp_path}/scenario.toml: File too large"]
    assert not done.stdout
    assert [path.name for path in tmp_path.iterdir()] == [".echelon.json"]


def test_a_bus_that_cannot_be_had_is_one_line(tmp_path: Path) -> None:
    options = (
        "--can",
        "socketcan:lo",
        "--quiet",
        "--json",
        "--out",
        tmp_path,
    )  # lo is not a CAN interface
    refused = echelon("run", "paper", *QUICK, *options)
    assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
    assert "--real-bus" in refused.stderr
    done = echelon("run", "paper", *QUICK, *options, "--real-bus")
    assert done.returncode == 3
    assert len(done.stderr.splitlines()) == 1
    assert "bridge cannot start: cannot open CAN bus socketcan:lo" in done.stderr
    assert json.loads(done.stdout)["verdict"]["word"] == "FAILS"


def test_a_default_folder_that_cannot_be_made_is_named() -> None:
    done = echelon("run", "paper", *QUICK, "--engine", "inprocess", "--quiet", cwd=Path("/proc"))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("echelon: runs")
    assert done.stderr.endswith("; give a folder with --out\n")
    assert "None" not in done.stderr


def test_recover_refuses_what_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "not.mcap").write_text("hello")
    done = echelon("recover", tmp_path / "not.mcap")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"echelon: {tmp_path}/not.mcap: is no MCAP file\n"


def test_what_is_wrong_with_a_runs_folder_names_the_file_once(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    (run / "run.mcap").write_bytes((folder / "run.mcap").read_bytes()[:50_000])
    for command in ("report", "export"):
        done = echelon(command, run)
        assert done.returncode == 2
        assert done.stderr == f"echelon: {run}/run.mcap: is cut short; `echelon recover {run}` mends it\n"
    (run / "summary.json").write_text("{")
    done = echelon("report", run)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith(f"echelon: {run}/summary.json: is no summary that can be read: ")


def test_recover_mends_a_cut_recording(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    done = echelon("recover", tmp_path / "cut.mcap")
    assert done.returncode == 0, done.stderr
    assert "messages, up to t =" in done.stdout
    read_trace(tmp_path / "cut-recovered.mcap", plan_of("paper", "duration=0.2"))
    facts = json.loads(echelon("recover", tmp_path / "cut.mcap", "--out", tmp_path / "x.mcap", "--json").stdout)
    assert facts["file"] == str(tmp_path / "x.mcap")
    assert (facts["messages"] > 100, 0 < facts["until"] < 0.2, facts["complete"]) == (True, True, False)
    assert (tmp_path / "x.mcap").read_bytes() == (tmp_path / "cut-recovered.mcap").read_bytes()


def test_export_writes_tables(folder: Path, tmp_path: Path) -> None:
    assert echelon("export", folder, "--csv", tmp_path).returncode == 0
    trace = read_trace(folder / "run.mcap", plan_of("paper", "duration=0.2"))
    with (tmp_path / "robots.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["t", "robot", *STATE_FIELDS, "x_desired", "y_desired"]
    assert len(rows) == 9 * 201
    last = next(row for row in reversed(rows) if row["robot"] == "g1/r2")
    assert float(last["x"]) == trace.states[0][-1][0]
    assert (tmp_path / "blocks.csv").read_text().startswith("t,block,component,value,desired,error,rate,error_rate\n")
    assert (tmp_path / "links.csv").exists()


def test_export_goes_into_the_runs_folder_and_says_so(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    done = echelon("export", run)
    assert (done.returncode, done.stdout) == (0, f"{run}/csv: robots.csv, blocks.csv, links.csv, frames.csv\n"), (
        done.stderr
    )
    written = sorted(path.name for path in (run / "csv").iterdir())
    assert written == ["blocks.csv", "frames.csv", "links.csv", "robots.csv"]
    other, parquet = tmp_path / "tables", tmp_path / "parquet"
    facts = json.loads(echelon("export", run, "--csv", other, "--parquet", parquet, "--json").stdout)
    assert (facts["run"], sorted(facts["files"])) == (str(run), sorted(map(str, (other, parquet))))
    for folder, files in facts["files"].items():
        assert sorted(path.name for path in Path(folder).iterdir()) == sorted(files)
        assert len(files) == 4
    refused = echelon("export", run, "--csv", run / "run.mcap")
    assert refused.stderr == f"echelon: --csv {run}/run.mcap: File exists\n"


def test_export_overwrites_tables_only_where_it_is_told_to(folder: Path, tmp_path: Path) -> None:
    run, tables = tmp_path / "run", tmp_path / "tables"
    shutil.copytree(folder, run)
    tables.mkdir()
    (tables / "links.csv").write_text("mine")
    says = "holds links.csv already; give another folder, or --replace to overwrite\n"
    for arguments in (("--csv", tables), ("--parquet", tmp_path / "parquet", "--csv", tables)):
        done = echelon("export", run, *arguments)
        assert (done.returncode, done.stdout, done.stderr) == (2, "", f"echelon: --csv {tables}: {says}")
    assert [path.name for path in tables.iterdir()] == ["links.csv"]
    assert (tables / "links.csv").read_text() == "mine"
    assert not (tmp_path / "parquet").exists()
    assert echelon("export", run, "--csv", tables, "--replace").returncode == 0
    assert (tables / "links.csv").read_text().startswith("source,")
    assert echelon("export", run).returncode == 0
    again = echelon("export", run)  # the same holds for the default folder
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr.startswith(f"echelon: {run}/csv: holds robots.csv, blocks.csv, ")


def test_report_of_two_runs(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "both.html"
    done = echelon("report", folder, folder, "--out", page, "--json")
    assert done.returncode == 0, done.stderr
    assert page.stat().st_size > 10_000
    assert json.loads(done.stdout) == {"report": str(page), "figures": [], "runs": [str(folder), str(folder)]}


def test_figures_are_files_of_the_formats_that_are_asked_for(folder: Path, tmp_path: Path) -> None:
    figures, before = tmp_path / "figures", (folder / "report.html").read_bytes()
    done = echelon("report", folder, "--figures", figures, "--format", "svg", "--format", "pdf", "--format", "png")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        str(figures / f"{name}.{kind}")
        for name in ("trajectories", "blocks", "errors", "distance", "torques")
        for kind in ("svg", "pdf", "png")
    ]
    for kind, begins in (("svg", b"<svg "), ("pdf", b"%PDF-"), ("png", b"\x89PNG")):
        assert all(path.read_bytes().startswith(begins) for path in figures.glob(f"*.{kind}"))
    assert (folder / "report.html").read_bytes() == before
    facts = json.loads(echelon("report", folder, folder, "--figures", figures, "--json").stdout)
    assert facts["report"] is None
    names = {Path(path).name for path in facts["figures"]}
    assert {"compared-errors.svg", "short (1)-errors.svg", "short (2)-errors.svg"} <= names
    assert len(names) == 4 + 5 + 5
    says = "echelon: --format pdf: needs --figures DIR, which writes the figures as files\n"
    assert echelon("report", folder, "--format", "pdf").stderr == says


def test_a_report_overwrites_reports_alone_unless_it_is_told_to(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text("<html>mine</html>")
    done = echelon("report", folder, folder, cwd=tmp_path)
    says = "echelon: report.html: exists, and is no report of echelon; give another file with --out\n"
    assert (done.returncode, done.stderr) == (2, says)
    assert page.read_text() == "<html>mine</html>"
    for arguments in (("--out", "report.html"), ()):
        assert echelon("report", folder, folder, *arguments, cwd=tmp_path).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.parametrize("command", ["report", "export"])
def test_a_full_disk_leaves_no_half_of_a_file(command: str, folder: Path, tmp_path: Path) -> None:
    flag = {"report": "--out page.html", "export": "--csv ."}[command]
    words = shlex.join([sys.executable, "-m", "echelon", command, str(folder)])
    limited = ["bash", "-c", f"ulimit -f 20; exec {words} {flag}"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLCONFIGDIR": str(folder.parent)}
    done = subprocess.run(limited, cwd=tmp_path, capture_output=True, text=True, timeout=600, env=environment)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr
    assert done.stderr.endswith("File too large\n")
    assert not list(tmp_path.iterdir())


def test_a_report_is_called_after_the_runs_folder_wherever_one_stands(folder: Path, tmp_path: Path) -> None:
    assert echelon("report", ".", "--out", tmp_path / "page.html", cwd=folder).returncode == 0
    assert "<title>paper: short</title>" in (tmp_path / "page.html").read_text()


def test_validate_explains_and_speaks_json() -> None:
    done = echelon("validate", "paper", "--json")
    assert done.returncode == 0
    facts = json.loads(done.stdout)
    assert facts["robots"] == 9
    assert any("does not fit" in line for line in facts["can"])
    assert "can0 fits" in json.loads(echelon("validate", "lab", "--json").stdout)["can"][0]


def test_dbc_is_what_candump_and_cantools_need() -> None:
    done = echelon("dbc", "lab")
    database = cantools.database.load_string(done.stdout, "dbc")
    assert [m.name for m in database.messages if m.name.startswith("torque_")] == [
        f"torque_g{1 + r // 3}_r{r + 1}" for r in range(9)
    ]
    signal = database.get_message_by_name("torque_g1_r3").get_signal_by_name("tau_right")
    assert (signal.unit, signal.scale) == ("Nm", 0.001)


def test_help_teaches() -> None:
    done = echelon("--help")
    assert done.returncode == 0
    assert "echelon run paper" in done.stdout
    assert "exit codes" in done.stdout


def test_a_closed_pipe_is_no_error() -> None:
    command = f"{sys.executable} -m echelon dbc paper | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0
    assert not done.stderr
