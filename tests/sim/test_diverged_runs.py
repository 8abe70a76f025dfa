"""Runs that diverge stop, and runs that are interrupted end between two instants.  Both leave a folder that says so."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from echelon.bridge.can.canlog import EPOCH_NS
from echelon.cli import main
from echelon.cli.showing import show_growing
from echelon.sim.interruption import SIGNALS, Raises, interruption
from echelon.sim.processes.watchers import RunRecorder
from echelon.sim.recording.mcap_reader import read_trace
from echelon.sim.run_folder import open_run
from echelon.sim.run_state import goes_on, read_state
from support.runs import echelon, kill_session, plan_of, start_echelon, summary_of, until

DIVERGING = ("--set", "claims=[]", "--set", "links=[{channel='state', delay=0.007}]", "--set", "duration=2.0")
"""A delay with which the paper's formation does not settle: it tolerates up to 6 ms (`echelon analyse paper`)"""
QUIET = ("--can", "none", "--quiet", "--no-report")
CLOSED = ("--set", "can.path=closed", "--set", "claims=[]", "--quiet", "--no-report")


def ran(engine: str, folder: Path, *options: str) -> dict[str, Any]:
    done = echelon("run", "paper", "--engine", engine, *DIVERGING, *QUIET, "--out", folder, *options)
    assert done.returncode == 1, done.stderr  # the run did not fail, but its verdict does
    assert not [line for line in done.stderr.splitlines() if "Warning" in line]
    return summary_of(folder)


@pytest.fixture(scope="module")
def in_process(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("diverged") / "run"
    return ran("inprocess", folder), folder


def test_a_diverged_run_stops_at_the_first_state_beyond_all_bounds(in_process: tuple[dict[str, Any], Path]) -> None:
    summary, folder = in_process
    checks = {check["name"]: check for check in summary["verdict"]["checks"]}
    assert checks["whole"]["outcome"] == checks["finite"]["outcome"] == "failed"
    stop = f"the run was stopped at {summary['simulated']:g} s of 2 s: {summary['run']['stopped']}"
    assert checks["whole"]["text"] == stop
    assert summary["simulated"] < 1
    assert f"is beyond all bounds from {summary['simulated']:g} s on" in summary["run"]["stopped"]
    assert summary["run"]["failure"] is None
    assert open_run(folder).trace.digest() == summary["trace_digest"]


def test_processes_stop_with_the_same_states(in_process: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    summary = ran("processes", tmp_path / "run")
    assert summary["trace_digest"] == in_process[0]["trace_digest"]
    assert summary["run"]["stopped"] == in_process[0]["run"]["stopped"]
    assert min(row["sent"] for row in summary["links"]) > 0  # the counts of links are kept although the run stopped


def test_an_error_that_limits_keep_from_growing_exponentially_stops_a_run_at_the_same_instant_in_both_engines(
    tmp_path: Path,
) -> None:
    summaries = []
    for engine in ("inprocess", "processes"):
        folder = tmp_path / engine
        options = ("--set", "law.epsilon=[0.02,0.02]", "--set", "duration=30", *QUIET)
        done = echelon("run", "lab", "--engine", engine, *options, "--out", folder)
        assert done.returncode == 1, done.stderr
        summaries.append(summary_of(folder))
    one, other = summaries
    stopped = one["run"]["stopped"]
    assert f" has diverged: at {one['simulated']:g} s it is " in stopped
    assert "more than 2 times as far as its start, its place in the formation and the trajectory ask" in stopped
    assert one["simulated"] < 10
    assert other["run"]["stopped"] == stopped
    assert other["trace_digest"] == one["trace_digest"]
    outcomes = {check["name"]: check["outcome"] for check in one["verdict"]["checks"]}
    assert (outcomes["whole"], outcomes["finite"]) == ("failed", "passed")


@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_the_bus_of_a_stopped_run_is_judged_up_to_the_stop_and_the_cause_is_told_first(
    engine: str, tmp_path: Path
) -> None:
    """When a run stops, some processes are further ahead than others.  Frames that are therefore missing are no findings."""
    folder = tmp_path / "run"
    delay = ("--set", "duration=2", "--set", "links=[{channel='state', delay=0.1}]")
    done = echelon("run", "paper", "--engine", engine, *delay, "--no-report", "--out", folder)
    assert done.returncode == 1, done.stderr
    summary = summary_of(folder)
    checks = {check["name"]: check for check in summary["verdict"]["checks"]}
    assert checks["referee"]["outcome"] == "passed", checks["referee"]
    stop = f"up to {summary['simulated']:g} s, where the run was stopped"
    assert checks["referee"]["text"].endswith(stop)
    assert summary["can"]["referee"]["until"] == summary["simulated"]
    times_s = [
        float(line.partition(")")[0][1:]) - EPOCH_NS / 1e9 for line in (folder / "can.log").read_text().splitlines()
    ]
    later = sum(time_s > summary["simulated"] for time_s in times_s)
    assert summary["can"]["referee"]["later"] == later == len(times_s) - summary["can"]["referee"]["frames"] > 0
    assert f"can.log and the numbers of the buses include {later} later frames, which are not judged" in done.stdout
    said = [line.split(maxsplit=2)[1] for line in done.stdout.splitlines() if line.startswith("  because  ")]
    assert said[:2] == ["whole:", "finite:"]
    assert main(["referee", str(folder)]) == 0  # a second judgement has no findings, either


def test_keep_going_goes_on(in_process: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    summary = ran("inprocess", tmp_path / "run", "--keep-going")
    assert summary["simulated"] == 2.0
    assert summary["run"]["stopped"] is None
    outcomes = {check["name"]: check["outcome"] for check in summary["verdict"]["checks"]}
    assert (outcomes["whole"], outcomes["finite"]) == ("passed", "failed")


def interrupted(folder: Path, scenario: str, *options: str) -> dict[str, Any]:
    """Interrupts a run in one process after it has written some hundred frames; returns its summary."""
    run = ("--engine", "inprocess", "--set", "duration=1000", *options)
    command = start_echelon("run", scenario, *run, *CLOSED, "--out", folder)
    log = folder / "can.log"
    assert until(lambda: log.exists() and log.stat().st_size > 400_000), command.communicate(timeout=5)
    command.send_signal(signal.SIGINT)
    _, err = command.communicate(timeout=600)
    assert command.returncode == 3
    assert err.splitlines()[-1] == "echelon: interrupted"
    return summary_of(folder)


def test_signals_while_a_run_in_one_process_ends_cost_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    close, calls = RunRecorder.close, list[int]()

    def signalled(self: RunRecorder, *links: Any) -> None:
        for _ in range(3):
            calls.append(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        close(self, *links)

    monkeypatch.setattr(RunRecorder, "close", signalled)
    monkeypatch.setattr("echelon.sim.interruption.SAME_S", 0.0)
    run = ("--engine", "inprocess", "--set", "duration=0.5", "--set", "claims=[]", "--quiet", "--no-report")
    assert main(["run", "lab", *run, "--out", str(tmp_path / "run")]) in (0, 1, 3)
    assert len(calls) == 3
    assert summary_of(tmp_path / "run")["simulated"] == 0.5
    assert len(read_trace(tmp_path / "run" / "run.mcap", plan_of("lab", "duration=0.5")).times_ns[0]) > 40


@pytest.mark.parametrize("scenario", ["lab", "drives"])
def test_the_frames_of_our_own_stop_are_no_findings(scenario: str, tmp_path: Path) -> None:
    summary = interrupted(tmp_path / "run", scenario)
    outcomes = {check["name"]: check for check in summary["verdict"]["checks"]}
    assert outcomes["referee"]["outcome"] == "passed", outcomes["referee"]
    assert outcomes["recording"]["outcome"] == "passed", outcomes["recording"]
    assert [check["name"] for check in summary["verdict"]["checks"] if check["outcome"] == "failed"] == ["whole"]
    assert outcomes["whole"]["text"] == f"interrupted (at {summary['simulated']:g} s of 1000 s)"
    assert main(["referee", str(tmp_path / "run")]) == 0  # a second judgement has no findings, either


def test_an_interruption_is_noted_first_and_raised_the_second_time(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    before = [signal.getsignal(number) for number in SIGNALS]
    with interruption() as noted, noted.during(Raises.SECOND, lambda: calls.append(1)):
        assert not noted.asked
        signal.raise_signal(signal.SIGINT)
        assert (noted.asked, calls) == (True, [1])
        signal.raise_signal(signal.SIGTERM)  # the same request: a wrapper passes on what its group has got
        assert calls == [1, 1]
        monkeypatch.setattr("echelon.sim.interruption.SAME_S", 0.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGHUP)
        with noted.during(Raises.NONE):
            signal.raise_signal(signal.SIGINT)
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_a_signal_that_the_caller_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruption() as noted:
            signal.raise_signal(signal.SIGHUP)
        assert not noted.asked
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_run_goes_on_when_all_its_processes_get_a_signal_that_the_caller_ignores(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does; the command inherits it
    try:
        command = start_echelon("run", "lab", "--set", "duration=6", "--can", "auto", *CLOSED, "--out", folder)
    finally:
        signal.signal(signal.SIGHUP, before)
    try:
        log = folder / "can.log"
        assert until(lambda: log.exists() and log.stat().st_size > 20_000), command.communicate(timeout=5)
        os.killpg(command.pid, signal.SIGHUP)
        assert goes_on(folder)
        assert not (folder / "summary.json").exists()
        said = command.communicate(timeout=600)
    finally:
        kill_session(command.pid)
    assert command.returncode == 0, said
    summary = summary_of(folder)
    assert (summary["simulated"], summary["run"]["failure"]) == (6.0, None)
    assert open_run(folder).trace.digest() == summary["trace_digest"]


def test_a_run_says_where_its_buses_are_and_can_be_looked_at_while_it_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    command = start_echelon("run", "lab", "--set", "duration=12", "--can", "auto", *CLOSED, "--out", folder)
    try:
        log = folder / "can.log"
        assert until(lambda: log.exists() and log.stat().st_size > 100_000), command.communicate(timeout=5)
        assert goes_on(folder)
        state = read_state(folder)
        assert state is not None
        assert (state.pid, state.engine, state.clock) == (command.pid, "processes", "virtual")
        assert state.buses.keys() == {"can0"}
        assert state.buses["can0"].partition(":")[0] in ("udp_multicast", "socketcan")
        assert main(["referee", str(folder)]) == 0
        so_far = capsys.readouterr()
        assert "the run goes on" in so_far.err
        assert so_far.out.endswith(" frames of 27 identifiers: no findings\n")
        assert main(["can", str(folder), "--json", "--seconds", "0.5"]) == 0
        first = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert first["frames"] > 0
        show_growing(
            plan_of("lab", "can.path=closed", "duration=12"), folder, None, as_json=True
        )  # to the end of the run
        shown = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert shown[-1]["frames"] > first["frames"]
        assert shown[-1]["kinds"] == {}
        command.communicate(timeout=600)
    finally:
        command.kill()
    assert not goes_on(folder)
    assert shown[-1]["frames"] == summary_of(folder)["can"]["frames"]


def test_a_killed_run_does_not_go_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = start_echelon("run", "lab", "--engine", "inprocess", "--set", "duration=1000", *CLOSED, "--out", folder)
    assert until(lambda: (folder / "can.log").exists()), command.communicate(timeout=5)
    assert goes_on(folder)
    command.kill()
    command.wait()
    assert not goes_on(folder)
    assert not goes_on(tmp_path)
