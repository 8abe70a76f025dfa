"""`echelon replay` and `echelon diff` as a user types them: runs of either engine, changed laws, mistakes in one line."""

import json
import shutil
from pathlib import Path

import pytest

from echelon.sim.recording.recorder import Recorder
from support.recordings import LOSSY
from support.runs import EXAMPLES, SCENARIOS, echelon, plan_of

QUICK = ("--set", "duration=0.4", "--set", "claims=[]", "--quiet", "--no-report")


def run(out: Path, scenario: str | Path, *options: str) -> Path:
    """Runs a scenario into a folder; returns the folder."""
    done = echelon("run", scenario, *QUICK, *options, "--out", out)
    assert done.returncode in (0, 1), done.stderr
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same scenario, with links that lose and delay, in one process and as processes."""
    folder = tmp_path_factory.mktemp("runs")
    return (
        run(folder / "inprocess", "lab", "--set", LOSSY, "--engine", "inprocess"),
        run(folder / "processes", "lab", "--set", LOSSY),
    )


def test_a_run_of_either_engine_is_replayed_to_what_it_said(runs: tuple[Path, Path]) -> None:
    for folder in runs:
        done = echelon("replay", folder)
        assert (done.returncode, done.stderr) == (0, "")
        lines = done.stdout.splitlines()
        assert lines[0] == f"{folder}: 13 roles fed; what they say compared exactly with the recording, up to t = 0.4 s"
        assert lines[-1] == "equal: these roles say what was recorded"
        assert len(lines) == 1 + 1 + 16 + 1


def test_runs_of_the_two_engines_are_equal(runs: tuple[Path, Path]) -> None:
    done = echelon("diff", *runs)
    assert (done.returncode, done.stderr) == (0, "")
    assert "  run: engine: A inprocess, B processes" in done.stdout.splitlines()
    facts = json.loads(echelon("diff", *runs, "--json").stdout)
    assert (facts["equal"], facts["first_difference"], facts["until"]) == (True, None, 0.4)
    assert facts["scenario"] == {"run: engine": ["inprocess", "processes"]}
    assert all(channel["compared"] == channel["equal"] > 0 for channel in facts["channels"])


def test_a_closed_torque_path_as_processes(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", "drives")
    done = echelon("replay", folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "bridge and drives are not replayed" in done.stdout


def test_a_changed_law_differs_first_at_the_start_with_the_coordinator(runs: tuple[Path, Path]) -> None:
    change = ("--set", "law.epsilon=[0.3,0.6]")
    done = echelon("replay", runs[1], *change)
    assert done.returncode == 1
    assert done.stdout.splitlines()[-1].startswith("outputs differ first at t = ")
    facts = json.loads(echelon("replay", runs[1], *change, "--only", "g2", "--json").stdout)
    assert facts["roles"] == ["g2/r4", "g2/r5", "g2/r6", "g2"]
    assert (facts["first_difference"]["member"], facts["first_difference"]["channel"]) == ("g2", "command")
    assert facts["first_difference"]["recorded"] != facts["first_difference"]["computed"]
    (command,) = [channel for channel in facts["channels"] if channel["channel"] == "command"]
    assert command["largest"]["difference"] > 0
    assert command["first_difference"] == facts["first_difference"]
    assert echelon("replay", runs[1], *change, "--only", "g2", "--tolerance", "1e6").returncode == 0


def test_a_law_that_is_changed_in_the_runs_own_scenario_is_judged_and_told(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(runs[0], tmp_path / "run")
    scenario = folder / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("lead = 0.5", "lead = 0.25"))
    done = echelon("replay", folder)
    assert (done.returncode, done.stderr) == (1, "")
    assert f"  {scenario} is not the scenario that the run used" in done.stdout.splitlines()
    assert done.stdout == echelon("replay", folder, "--scenario", runs[0], "--set", "law.lead=0.25").stdout
    assert echelon("diff", runs[0], folder).returncode == 0  # the recordings are the same


def test_a_recording_that_another_version_wrote_and_nobody_reads_is_told_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    toml = (SCENARIOS / "lab.toml").read_text().replace("seed =", "sede =")
    Recorder(path, plan_of("lab"), toml, {"echelon": "0.0.1"}).close()
    done = echelon("replay", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    says = f"echelon: {path}: sede: unknown key; did you mean 'seed'? (recorded by echelon 0.0.1, this is 0.1.0)"
    assert done.stderr == f"{says}\n"


def test_what_is_whole_of_a_killed_run_is_compared(runs: tuple[Path, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(runs[1], tmp_path / "killed")
    (folder / "summary.json").unlink()
    data = (folder / "run.mcap").read_bytes()
    messages_end = data.index(b"\x0f\x04\0\0\0\0\0\0\0\0\0\0\0")
    (folder / "run.mcap").write_bytes(data[: messages_end * 3 // 4])
    replayed, compared = echelon("replay", folder), echelon("diff", runs[0], folder)
    for done in (replayed, compared):
        assert (done.returncode, done.stderr) == (0, "")
        assert "is cut off" in done.stdout
    assert echelon("recover", folder).returncode == 0
    assert echelon("replay", folder).returncode == 0


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a wall clock; its state links have a delay, too."""
    links = 'links=[{name="up",channel="state",delay=0.003,policy="hold_then_stop",timeout=0.05}]'
    events = 'events=[{kind="blackout",at=0.2,duration=0.02,link="up"}]'
    options = ("--clock", "wall", "--can", "none", "--set", links, "--set", events)
    return run(tmp_path_factory.mktemp("real") / "run", "lab", *options)


def test_a_run_on_a_wall_clock_is_replayed_exactly(real: Path, tmp_path: Path) -> None:
    done = echelon("replay", real)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert done.stdout.splitlines()[-1] == "equal: these roles say what was recorded"
    facts = json.loads(echelon("replay", real, "--json").stdout)
    assert sum(channel["equal"] for channel in facts["channels"]) >= 9 * 20
    changed = json.loads(echelon("replay", real, "--json", "--set", "law.lead=0.25").stdout)
    assert {channel["member"] for channel in changed["channels"] if channel["first_difference"]} <= {
        "g1", "g2", "g3", "coordinator",
    }  # fmt: skip
    assert not changed["equal"]
    old = shutil.copytree(real, tmp_path / "old")
    (old / "arrivals.bin").unlink()
    done = echelon("replay", old)
    assert (done.returncode, done.stderr) == (1, "")
    assert "on a wall clock: when each message arrived is not recorded" in done.stdout


def test_of_a_wall_clock_the_outputs_are_compared_as_far_as_arrivals_are_known(real: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(real, tmp_path / "cut")
    data = (folder / "arrivals.bin").read_bytes()
    (folder / "arrivals.bin").write_bytes(data[: len(data) // 48 * 24])
    done = echelon("replay", folder)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert "not all that roles heard is known: of " in done.stdout
    assert "and of 12 more not to the end either" in done.stdout
    damaged = bytearray(data)
    damaged[len(data) // 48 * 24] ^= 0xFF
    (folder / "arrivals.bin").write_bytes(damaged)
    done = echelon("replay", folder)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert f"  {folder}/arrivals.bin: is damaged; what stands behind the damage is left out" in done.stdout.splitlines()


def test_virtual_time_with_the_latencies_of_a_run_is_that_run(real: Path, tmp_path: Path) -> None:
    done = echelon("latencies", real)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0] == f"{real}: one-way latencies of 24 links [ms]"
    scenario = real / "latencies" / "scenario.toml"
    assert lines[-1] == f"written: 24 traces, and a scenario with them: echelon run {scenario}"
    again = run(tmp_path / "again", scenario, "--can", "none", "--engine", "inprocess")
    done = echelon("diff", real, again)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert done.stdout.splitlines()[-1] == "equal: over this time both runs say the same"
    ideal = run(
        tmp_path / "ideal", real, "--set", "links=[]", "--set", "events=[]", "--can", "none", "--engine", "inprocess"
    )
    assert echelon("diff", real, ideal).returncode == 1
    facts = json.loads(echelon("latencies", real, "--json", "--out", tmp_path / "traces").stdout)
    assert len(facts["files"]) == 25
    assert facts["files"][0] == f"{tmp_path}/traces/scenario.toml"
    state = next(link for link in facts["links"] if (link["source"], link["receiver"]) == ("g1/r1", "g1"))
    assert state["latency_p50"] >= 0.003
    assert state["lost"] >= 2  # in the blackout
    assert (state["sent"], state["sent"]) == (41, state["delivered"] + state["lost"] + state["in_flight"])


def test_files_in_the_way_of_traces_are_not_overwritten(real: Path, tmp_path: Path) -> None:
    out = tmp_path / "traces"
    assert echelon("latencies", real, "--out", out).returncode == 0
    assert echelon("latencies", real, "--out", out).returncode == 0  # the same once more
    (out / "g1.r1-g1-state.csv").write_text("0.1\n")
    done = echelon("latencies", real, "--out", out)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"echelon: {out}/g1.r1-g1-state.csv: exists with other content")
    assert (out / "g1.r1-g1-state.csv").read_text() == "0.1\n"
    assert echelon("latencies", real, "--out", out, "--replace").returncode == 0


@pytest.fixture
def own_law(tmp_path: Path) -> Path:
    """A run with a law of the user's, which lies beside the scenario."""
    shutil.copy(EXAMPLES / "my_laws.py", tmp_path)
    shutil.copy(SCENARIOS / "lab.toml", tmp_path / "mine.toml")
    law = 'law={use="my_laws.py:SlidingMode",epsilon=[0.5,0.5]}'
    return run(tmp_path / "run", tmp_path / "mine.toml", "--set", law, "--engine", "inprocess")


def test_a_changed_law_of_the_users_is_judged_beside_its_scenario_or_in_the_folder(own_law: Path) -> None:
    theirs, kept = own_law.parent / "my_laws.py", own_law / "my_laws.py"
    theirs.write_text(theirs.read_text().replace("/ self.width, -1, 1", "/ self.width, -1, 1.5"))
    scenario = own_law.parent / "own.toml"
    scenario.write_text((own_law / "scenario.toml").read_text())
    assert echelon("replay", own_law).returncode == 0  # with the copy in the folder
    changed = echelon("replay", own_law, "--scenario", scenario)
    assert changed.returncode == 1, changed.stdout
    assert "is not the file that the run used" not in changed.stdout
    kept.write_text(theirs.read_text())
    edited = echelon("replay", own_law)
    assert edited.returncode == 1
    assert f"  {kept} is not the file that the run used" in edited.stdout.splitlines()


@pytest.mark.parametrize(("what", "says"), [("raise ValueError('hm')", "ValueError: hm"), ("while t: pass", "stalled")])
def test_a_law_that_fails_in_between_ends_the_replay(
    what: str, says: str, own_law: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from echelon.cli import main
    from echelon.sim import recorded_runs

    monkeypatch.setattr(recorded_runs, "PATIENCE_S", 0.5)
    kept = own_law / "my_laws.py"
    kept.write_text(
        kept.read_text().replace(
            "        s = e + ", f"        if 0.3 < t < 0.305:\n            {what}\n        s = e + "
        )
    )
    said: list[str] = []
    monkeypatch.setattr("sys.stderr.write", said.append)
    assert main(["replay", str(own_law)]) == 3
    (line,) = "".join(said).splitlines()
    assert says in line


def test_mistakes_are_one_line(runs: tuple[Path, Path], tmp_path: Path) -> None:
    folder, _ = runs
    empty = tmp_path / "empty"
    empty.mkdir()
    damaged = shutil.copytree(folder, tmp_path / "damaged")
    data = bytearray((damaged / "run.mcap").read_bytes())
    data[data.index(b"\x06", len(data) // 8)] ^= 0xFF
    (damaged / "run.mcap").write_bytes(data)
    bare = shutil.copytree(folder, tmp_path / "bare")
    (bare / "run.mcap").unlink()
    for arguments, says in [
        (("replay", "nowhere"), "echelon: nowhere: is not the folder of a run"),
        (("replay", empty), f"echelon: {empty}/run.mcap: No such file or directory"),
        (("replay", bare), f"echelon: {bare}/run.mcap: No such file or directory"),
        (("replay", damaged), f"echelon: {damaged}/run.mcap: is damaged"),
        (("replay", folder, "--only", "g9"), "echelon: g9: no robot and no node of this run"),
        (("replay", folder, "--set", "law.lead=x"), f"echelon: {folder}/scenario.toml with --set law.lead=x"),
        (("replay", folder, "--scenario", "unequal"), "echelon: the scenario has pair/p1, the recording does not"),
        (("replay", folder, "--scenario", "labb"), "echelon: labb: no such file, and no shipped scenario"),
        (("replay", folder, "--tolerance", "x"), "echelon replay: argument --tolerance: 'x' is no number"),
        (("replay", folder, "--tolerance=-1"), "echelon: tolerance -1: must be 0 or more"),
        (("latencies", "nowhere"), "echelon: nowhere/run.mcap: No such file or directory"),
        (("latencies", folder), f"echelon: {folder}: a run in virtual time; its latencies are those that its scenario"),
        (("latencies", bare), f"echelon: {bare}/run.mcap: No such file or directory"),
        (("diff", folder), "echelon diff: the following arguments are required: RUN"),
        (("diff", folder, "nowhere"), "echelon: nowhere: is not the folder of a run"),
        (("diff", folder, damaged), f"echelon: {damaged}/run.mcap: is damaged"),
        (("diff", folder, folder, "--tolerance", "nan"), "echelon: tolerance nan: must be 0 or more"),
    ]:
        done = echelon(*arguments)
        assert (done.returncode, done.stdout) == (2, ""), done.stdout
        assert done.stderr.startswith(says), done.stderr
        assert len(done.stderr.splitlines()) == 1
