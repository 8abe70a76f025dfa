"""Folders of runs that were killed with all their processes are rebuilt from what was recorded."""

import json
import os
import shutil
import signal
from contextlib import closing
from pathlib import Path

import pytest

from echelon.bridge.can.log_files import frames_in
from echelon.planning.loading import effective_toml
from echelon.sim.parts.loading import load
from echelon.sim.recording.mcap_reader import CutError, read_trace
from echelon.sim.recording.mcap_writer import MAGIC
from echelon.sim.recording.recorder import Recorder
from echelon.sim.run_folder import open_run
from support.runs import SCENARIOS, echelon, kill_session, plan_of, session_members, start_echelon, summary_of, until

ENOUGH = 300_000
"""Size of a recording that holds many states [bytes]"""


def killed(folder: Path, *arguments: str) -> Path:
    """Starts a long run, and kills all its processes at the same time while it is recording."""
    command = start_echelon("run", *arguments, "--quiet", "--out", folder)
    recording = folder / "run.mcap"
    try:
        assert until(lambda: recording.exists() and recording.stat().st_size > ENOUGH), command.stderr
        refused = echelon("recover", folder)
        assert (refused.returncode, refused.stderr) == (2, f"echelon: {folder}: a run is going on there\n")
    finally:
        for pid in session_members(command.pid):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        command.communicate(timeout=600)
        kill_session(command.pid)
    return folder


@pytest.fixture(scope="module", params=["processes", "inprocess"])
def left(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a killed run."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    return killed(folder, "lab", "--engine", request.param, "--set", "duration=3000.0")


def test_what_was_killed_is_rebuilt_in_place(left: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(left, folder)
    cut = (folder / "run.mcap").read_bytes()
    with pytest.raises(CutError):
        read_trace(folder / "run.mcap", plan_of("lab", "duration=3000.0"))
    for command in ("report", "export"):
        refused = echelon(command, folder)
        assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
        assert refused.stderr.endswith(f"; `echelon recover {folder}` rebuilds what a killed run left\n")
    done = echelon("recover", folder, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    facts = json.loads(done.stdout)
    assert facts["files"] == ["run.mcap", "run.mcap.cut", "summary.json", "report.html"]
    assert (folder / "run.mcap.cut").read_bytes() == cut

    run = open_run(folder)
    summary = run.summary
    assert summary.verdict.fails
    assert summary.run.failure is not None
    assert summary.run.failure.startswith("broken off: the recording ends at ")
    assert summary.run.failure.endswith("of 3000 s; this summary is rebuilt from it; counts of links were not recorded")
    assert any(reason.startswith(f"whole: {summary.run.failure} (at ") for reason in summary.verdict.reasons)
    assert (summary.links, summary.run.wall_time, summary.run.clock) == ((), None, "virtual")
    assert summary.run.engine == left.parent.name.rstrip("0123456789")
    assert summary.simulated == pytest.approx(facts["until"], abs=0.02)
    assert summary.trace_digest == run.trace.digest()
    assert summary.can is not None
    assert summary.can.frames == len(list(frames_in(folder / "can.log"))) > 100
    assert summary.can.referee is not None
    assert not summary.can.referee.kinds
    assert 0.1 < summary.can.load_mean < 0.4
    assert "broken off" in (folder / "report.html").read_text()
    for command in ("report", "export"):
        assert echelon(command, folder).returncode == 0
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    again = echelon("recover", folder)
    assert (again.returncode, again.stdout) == (0, f"{folder}: nothing is missing, nothing was changed\n")
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


def test_files_that_are_missing_or_torn_are_made_anew(left: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(left, folder)
    scenario = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text("")
    (folder / "torque.dbc").unlink()
    log = (folder / "can.log").read_bytes()
    whole = log[: log.rindex(b"\n") + 1]
    (folder / "can.log").write_bytes(
        whole + whole.splitlines()[-1][:-6]
    )  # half a frame, which looks like a frame with less data
    os.replace(folder / "run.mcap", folder / "run.mcap.cut")  # as if an earlier recovery had been killed
    (folder / "summary.json").write_text("{")
    done = echelon("recover", folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith(
        "written: run.mcap, run.mcap.cut, scenario.toml, torque.dbc, summary.json, report.html\n"
    )
    assert (folder / "scenario.toml").read_text() == scenario
    assert (folder / "can.log").read_bytes() == whole
    assert open_run(folder).summary.can is not None
    assert "BO_ " in (folder / "torque.dbc").read_text()


@pytest.mark.parametrize("torn", ["summary.json", "run.mcap"])
def test_of_a_run_that_was_recorded_to_its_end_only_what_is_torn_is_mended(torn: str, tmp_path: Path) -> None:
    quick = ("--set", "duration=0.2", "--set", "claims=[]", "--engine", "inprocess", "--quiet", "--out", tmp_path)
    assert echelon("run", "lab", *quick).returncode == 0
    before, content = summary_of(tmp_path), (tmp_path / torn).read_bytes()
    (tmp_path / torn).write_bytes(content[:-20])
    done = echelon("recover", tmp_path)
    assert done.returncode == 0
    after = summary_of(tmp_path)
    if torn == "run.mcap":
        assert done.stdout.endswith("written: run.mcap, run.mcap.cut\n")
        assert after == before
        assert (tmp_path / "run.mcap").read_bytes().endswith(MAGIC)
    else:
        assert done.stdout.endswith("written: summary.json, report.html\n")
        assert (after["trace_digest"], after["links"]) == (before["trace_digest"], before["links"])
        (reason,) = open_run(tmp_path).summary.verdict.reasons
        assert reason.startswith("whole: broken off before its summary was written")


def test_where_nothing_was_recorded_it_says_so(tmp_path: Path) -> None:
    done = echelon("recover", tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith(f"echelon: {tmp_path}/run.mcap: not found; a run cannot be rebuilt without it")
    (tmp_path / "run.mcap").write_text("hello")
    done = echelon("recover", tmp_path)
    assert (done.returncode, done.stderr) == (2, f"echelon: {tmp_path}/run.mcap: is no MCAP file\n")
    done = echelon("recover", tmp_path, "--out", tmp_path / "x.mcap")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith(f"echelon: --out {tmp_path}/x.mcap: the folder of a run is mended in place")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_run_killed_before_its_first_state_fails_and_says_why(tmp_path: Path) -> None:
    scenario, plan = load(SCENARIOS / "lab.toml")
    metadata = {"engine": "processes", "clock": "virtual"}
    with closing(Recorder(tmp_path / "run.mcap", plan, effective_toml(scenario), metadata)):
        pass
    assert echelon("recover", tmp_path).returncode == 0
    summary = open_run(tmp_path).summary
    assert "whole: broken off: no state of a robot was recorded (before it began)" in summary.verdict.reasons
    assert summary.can is None
