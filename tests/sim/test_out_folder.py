"""Folders that runs write into: files of earlier runs are deleted, all other files stay."""

import json
import os
import shutil
from pathlib import Path

import pytest

import echelon as api
from echelon.errors import UsageError
from echelon.files import lock
from echelon.sim.out_folder import NOTE, out_folder, run_files
from support.runs import EXAMPLES, echelon, kill_session, plan_of, start_echelon, until

QUICK = ("--set", "duration=0.1", "--set", "claims=[]", "--engine", "inprocess", "--quiet", "--no-report")


def run(out: Path | str, scenario: str | Path = "lab", *arguments: str, cwd: Path | None = None) -> tuple[int, str]:
    options = {} if cwd is None else {"cwd": cwd}
    done = echelon("run", scenario, *QUICK, *arguments, "--out", out, **options)
    return done.returncode, done.stderr


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run."""
    folder = tmp_path_factory.mktemp("runs") / "lab"
    assert run(folder) == (0, "")
    return folder


@pytest.fixture
def left(lab: Path, tmp_path: Path) -> Path:
    """A folder with a finished run."""
    return Path(shutil.copytree(lab, tmp_path / "run"))


def test_of_an_earlier_run_of_the_same_scenario_nothing_stays(left: Path) -> None:
    note = json.loads((left / NOTE).read_text())
    note["files"] |= dict.fromkeys(("run.mcap.cut", "can.log"))  # as a run leaves it that was killed
    (left / NOTE).write_text(json.dumps(note))
    (left / "run.mcap.cut").write_text("of a run that was killed")
    assert run(left, "lab", "--can", "none") == (0, "")
    assert set(files(left)) == {NOTE, "scenario.toml", "run.json", "run.mcap", "summary.json"}


def test_the_run_of_another_scenario_stays_unless_the_user_says_so(left: Path) -> None:
    before = files(left)
    says = f"echelon: --out {left}: holds a run of the scenario lab, not paper; give another folder, or --replace to "
    assert run(left, "paper") == (2, f"{says}delete that run\n")
    assert files(left) == before
    assert run(left, "paper", "--replace") == (0, "")
    assert json.loads((left / "summary.json").read_text())["scenario"] == "paper"
    assert (left / "torque.dbc").read_bytes() != before["torque.dbc"]


@pytest.mark.parametrize("replace", [False, True])
@pytest.mark.parametrize("name", run_files(plan_of("drives"), bus=True))
def test_a_file_in_the_way_stays_as_it_is(name: str, replace: bool, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(UsageError, match=f"{name} exists"), out_folder("drives", tmp_path, [name], replace):
        pass
    assert files(tmp_path) == {name: b"mine"}


def test_a_scenario_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text("mine")
    says = (
        "scenario.toml exists, and .echelon.json does not say that a run wrote it; move it away, or give another folder"
    )
    assert run(".", "lab", "--replace", cwd=tmp_path) == (2, f"echelon: --out .: {says}\n")
    assert files(tmp_path) == {"scenario.toml": b"mine"}


def test_a_link_in_the_way_is_a_file_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "can.log").symlink_to(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"can\.log exists"), out_folder("lab", tmp_path, ["can.log"]):
        pass


def test_a_project_keeps_its_files(tmp_path: Path) -> None:
    mine = {"my.toml": b'name = "my"', "torque-other.dbc": b"mine", "can.blf": b"mine", "notes.txt": b"mine"}
    for name, content in mine.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "latencies").mkdir()  # traces of an earlier run on a wall clock
    says = ".: holds files of other runs, which stay: can.blf, latencies, torque-other.dbc\n"
    assert run(".", cwd=tmp_path) == (0, says)
    assert mine.items() <= files(tmp_path).items()
    assert run(".", cwd=tmp_path) == (0, says)
    assert mine.items() <= files(tmp_path).items()


@pytest.mark.parametrize("name", ["scenario.toml", "run.json", "run.mcap", "summary.json", "can.log", "torque.dbc"])
def test_a_file_that_was_edited_since_its_run_is_the_users(left: Path, name: str) -> None:
    assert run(left) == (0, "")
    with (left / name).open("ab") as file:
        file.write(b" ")
    before = files(left)
    says = f"echelon: --out {left}: {name} was changed after its run; move it away, or give another folder\n"
    assert run(left, "lab") == run(left, "lab", "--replace") == (2, says)
    assert files(left) == before


def test_a_file_that_is_not_needed_stays_if_it_was_edited(left: Path) -> None:
    for name in ("can.log", "torque.dbc"):
        (left / name).write_text("mine")
    assert run(left, "lab", "--can", "none")[0] == 0
    assert (left / "can.log").read_text() == (left / "torque.dbc").read_text() == "mine"


def test_what_report_and_recover_write_is_of_the_run(left: Path) -> None:
    assert echelon("report", left).returncode == 0
    assert run(left) == (0, "")
    (left / "summary.json").unlink()
    assert echelon("recover", left).returncode == 0
    assert run(left) == (0, "")
    assert not (left / "report.html").exists()
    assert echelon("report", left).returncode == 0
    (left / "report.html").write_text("mine")
    assert "report.html was changed after its run" in run(left)[1]


def test_a_copy_without_the_note_stays_as_it_is(left: Path) -> None:
    (left / NOTE).unlink()
    before = files(left)
    assert (
        "scenario.toml exists, and .echelon.json does not say that a run wrote it" in run(left, "lab", "--replace")[1]
    )
    assert files(left) == before


def test_copies_of_parts_go_with_their_run_unless_they_were_edited(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert run(out, EXAMPLES / "mine.toml")[0] == 0
    parts = {name for name in files(out) if name.endswith(".py")}
    assert parts
    edited = min(parts)
    (out / edited).write_text("# mine\n")
    assert run(out, "lab", "--replace")[0] == 0
    assert {name for name in files(out) if name.endswith(".py")} == {edited}
    assert (out / edited).read_text() == "# mine\n"


@pytest.mark.parametrize("note", ["{", "[]", '{"scenario": "lab", "files": {"../mine.txt": null}}'])
def test_a_note_that_is_wrong_deletes_nothing(note: str, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / NOTE).write_text(note)
    with out_folder("lab", folder, ["run.mcap"]):
        pass
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first = start_echelon("run", "lab", "--set", "duration=1000.0", "--can", "none", "--quiet", "--out", folder)
    try:
        assert until((folder / "run.mcap").exists)
        before = (folder / "scenario.toml").read_bytes()
        says = f"echelon: --out {folder}: a run is going on there; give another folder\n"
        assert run(folder) == run(folder, "paper", "--replace") == (2, says)
        assert (folder / "scenario.toml").read_bytes() == before
    finally:
        kill_session(first.pid)
        first.communicate(timeout=600)
    assert run(folder) == (0, "")


def test_a_recorder_that_is_left_of_a_killed_run_keeps_others_out(left: Path) -> None:
    held = lock(left / "run.mcap")
    try:
        assert "a run is going on there" in run(left)[1]
    finally:
        os.close(held)
    assert run(left) == (0, "")


def test_a_script_may_run_into_the_same_folder_again(tmp_path: Path) -> None:
    changes = {"duration": 0.1, "claims": []}
    for scenario, replace in (("lab", False), ("lab", False), ("paper", True)):
        done = api.run(scenario, changes, engine="inprocess", out=tmp_path / "run", quiet=True, replace=replace)
        assert done.scenario == scenario
    with pytest.raises(UsageError, match="or replace=True to delete that run"):
        api.run("lab", changes, engine="inprocess", out=tmp_path / "run", quiet=True)


def test_the_note_of_a_killed_run_covers_names_of_runs_alone(tmp_path: Path) -> None:
    """Whoever writes the note, or leaves a link, takes no file of the user's with it."""
    (tmp_path / ".echelon.json").write_text('{"scenario": "any", "files": {"thesis.tex": null, "run.mcap": null}}')
    (tmp_path / "thesis.tex").write_text("of the user")
    with out_folder("any", tmp_path, ["run.mcap"]):
        pass
    assert (tmp_path / "thesis.tex").read_text() == "of the user"
    (tmp_path / ".echelon.json").write_text('{"scenario": "any", "files": {"run.mcap": null}}')
    (tmp_path / "run.mcap").symlink_to(tmp_path / "thesis.tex")
    with pytest.raises(UsageError, match=r"run\.mcap"), out_folder("any", tmp_path, ["run.mcap"]):
        pass
    assert (tmp_path / "run.mcap").is_symlink()
