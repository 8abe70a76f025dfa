"""Users' parts that fail.  They are found before a run if possible.  In a run of any kind the failure is one line, the
recording is kept, and the wheels are at zero."""

import errno
import json
import os
import re
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from echelon.bridge.can.canlog import EPOCH_NS
from echelon.bridge.can.log_files import frames_in
from echelon.bridge.referee.patient import SKEW_NS
from echelon.cli import main
from echelon.cli.judging import judge_run
from echelon.planning.loading import ScenarioError
from echelon.sim.parts.loading import load, parse
from echelon.sim.parts.time_limit import TookTooLong, time_limit
from echelon.sim.recording.mcap_reader import read_trace
from echelon.sim.results.trace import Trace
from support.runs import SCENARIOS, echelon, reasons, start_echelon, summary_of, until

LAW = """
from echelon.controller.laws import Law

class Mine(Law):
    uses = {"gains", "lead"}

    def nu(self, block, t, e, e_dot, feed_forward, state):
        state += 1
        LINE
        return feed_forward - block.K_1 @ e - block.K_2 @ e_dot

    def state_size(self, block):
        return 1
"""
PATH = """
import numpy as np
from echelon.controller.trajectory import Trajectory

class Mine(Trajectory):
    def at(self, t):
        LINE
        return np.array([[0.1 * t, 0.0], [0.1, 0.0], [0.0, 0.0]])
"""
PLANT = """
from echelon.agents.plant import Plant, paper_step

class Mine(Plant):
    def step(self, robot, state, tau_right, tau_left, h):
        LINE
        return paper_step(robot)(state, tau_right, tau_left, h)
"""
TEXTS = {"law": LAW, "path": PATH, "plant": PLANT}
USES = {
    "law": 'law={use="mine.py:Mine",epsilon=[0.5,0.5],lead=0.5,gains=[{k1=0.25,k2=0.5}]}',
    "path": 'trajectory={use="mine.py:Mine"}',
    "plant": 'formation.groups.g2.robots.r5.model="mine.py:Mine"',
}
HANG = "while True: pass"
LATER = {
    # in the 31st period, which the trial before a run does not reach; the trial of a trajectory asks between ticks
    "law": 'if state[0] > 30 and block.name == "g2":',
    "path": "if 0.299 < t < 0.6 and abs(100 * t - round(100 * t)) < 1e-9:",
    "plant": "if state.v > 0.12 and (state.x, state.y) != robot.start:",  # the trial before a run does not leave the start
}
NAMED = {
    "law": "mine.py, line 9: Mine of block g2: nu at t = 0.3 s ",
    "path": "mine.py, line 7: Mine: at(0.3) ",
    "plant": "mine.py, line 6: Mine of g2/r5: step ",
}
RUNS = {"law": "g2", "path": "coordinator", "plant": "g2/r5"}
"""The role that runs each part"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A user's folder with a scenario."""
    shutil.copy(SCENARIOS / "lab.toml", tmp_path / "mine.toml")
    return tmp_path


def write(folder: Path, kind: str, line: str) -> str:
    """Writes a part with a line in it; returns the override that makes the scenario use it."""
    (folder / "mine.py").write_text(TEXTS[kind].replace("LINE", line))
    return USES[kind]


def run(folder: Path, use: str, *arguments: str, timeout: float = 600) -> CompletedProcess[str]:
    return echelon(
        *("run", folder / "mine.toml", "--set", use, "--set", "duration=1.0", "--quiet"),
        *("--no-report", "--out", folder / "run", *arguments),
        timeout=timeout,
    )


def one_line(err: str) -> str:
    """Returns the text of standard error, which must be one line without a traceback."""
    notes = re.compile(r".* (stands still, for .*|goes on)")  # on a busy machine
    lines = [line for line in err.strip().splitlines() if not notes.fullmatch(line)]
    assert len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("raise KeyError('w')", "raised KeyError: 'w'"),
        ("__import__('sys').exit()", "raised SystemExit"),
        ("raise ValueError('first\\nsecond')", "raised ValueError: first\\nsecond"),
        ("return None", {"plant": "must return a RobotState", "path": "has the shape ()", "law": "returned nothing"}),
        ("return [1.0]", {"plant": "must return a RobotState", "path": "has the shape (1,)", "law": "has the shape (1,)"}),
        (HANG, "takes longer than 0.5 s"),
        ("while True:\n            try:\n                pass\n            except Exception:\n                pass", "longer"),
    ],
    ids=["raises", "exits", "two lines", "nothing", "shape", "hangs", "hangs and swallows"],
)  # fmt: skip
def test_a_part_that_fails_at_once_is_a_mistake_in_the_scenario(
    folder: Path, kind: str, line: str, says: str | dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("echelon.sim.parts.probe.PATIENCE_S", 0.5)
    use = write(folder, kind, line)
    begun = time.process_time()
    with pytest.raises(ScenarioError) as caught:
        load(folder / "mine.toml", [use])
    text = str(caught.value)
    assert time.process_time() - begun < 4  # of the processor, which a part that hangs keeps busy
    assert re.match(
        rf"{re.escape(str(folder / 'mine.toml'))}: mine\.py(:|, line \d+: )Mine(: at\(0\)| of block g1: nu| of g2/r5: step)",
        text,
    )
    assert (says if isinstance(says, str) else says[kind]) in text
    assert len(text.splitlines()) == 1
    parse((folder / "mine.toml").read_text(), "mine.toml", [use], folder, trial=False)  # as for a run's folder


@pytest.mark.parametrize(
    ("kind", "line", "says"),
    [
        ("law", "if not e.any(): return e / abs(e).sum()", "is not finite: [nan, nan, nan, nan]"),
        ("law", "if block.name == 'inter': return 1 / 0", "mine.py, line 9: Mine of block inter: nu at t = 0 s raised Zero"),
        ("path", "if t > 0.9: return 1 / 0", "mine.py, line 7: Mine: at(40) raised ZeroDivisionError"),
        ("plant", "if state.v > 0: return 1 / 0", "mine.py, line 6: Mine of g2/r5: step raised ZeroDivisionError"),
    ],
)  # fmt: skip
def test_each_block_robot_and_time_is_tried(folder: Path, kind: str, line: str, says: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load(folder / "mine.toml", [write(folder, kind, line)])
    assert says in str(caught.value)


SLOPES = """
import numpy as np
from echelon import Trajectory

class Circle(Trajectory):
    factor: float = 1.0
    rate: float = 0.4

    def at(self, t):
        k, turn = self.rate, np.array([0.0, np.pi / 2])
        return np.array([np.sin(k * t + turn), self.factor * k * np.cos(k * t + turn), -k * k * np.sin(k * t + turn)])

class Shake(Trajectory):
    def at(self, t):
        k = np.array([3.0, 40.0])
        return np.array([1000 + np.sin(k * t), k * np.cos(k * t), -(k**2) * np.sin(k * t)])

class Slow(Trajectory):
    def at(self, t):
        return np.array([[1e-5 * t**2, 0.0], [2e-5 * t, 0.0], [2e-5, 0.0]])

class Corners(Trajectory):
    every: float

    def at(self, t):
        leg, s = divmod(t, self.every)
        even = leg % 2 == 0
        x, v = (s, 1.0) if even else (self.every - s, -1.0)
        return np.array([[x, 0.0], [v, 0.0], [0.0, 0.0]])

class Table(Circle):
    step: float

    def at(self, t):
        number, part = divmod(t, self.step)
        before, after = (super(Table, self).at(at * self.step) for at in (number, number + 1))
        return before + part / self.step * (after - before)

class Tight(Circle):
    share: float

    def at(self, t):
        return super().at(t) * np.array([[1.0], [1.0], [self.share]])

class Flat(Circle):
    def at(self, t):
        return super().at(t) * np.array([[1.0], [1.0], [0.0]])
"""


def uses_slope(folder: Path, name: str, parameters: str = "") -> str:
    (folder / "mine.py").write_text(SLOPES)
    return f'trajectory={{use="mine.py:{name}",parameters={{{parameters}}}}}'


@pytest.mark.parametrize(
    ("name", "parameters", "says"),
    [
        ("Circle", "factor=4.0", "Circle: at t = 0.611 s: velocity is not the derivative of position (in x 1.55 against"),
        ("Circle", "factor=0.0", "Circle: at t = 0.611 s: velocity is not the derivative of position (in x 0 against"),
        ("Circle", "factor=1.01", "Circle: at t = 0.611 s: velocity is not the derivative of position (in x 0.392 against"),
        ("Circle", "factor=0.98,rate=17.6", "velocity is not the derivative of position"),  # as over steps of 0.1 s
        ("Circle", "factor=0.98", "velocity is not the derivative of position"),
        ("Table", "factor=1.02,step=0.1", "velocity is not the derivative of position"),
        ("Tight", "share=0.95", "acceleration is not the derivative of velocity"),
        ("Flat", "", "acceleration is not the derivative of velocity (in y 0 against -0.155 m/s²)"),
    ],
)  # fmt: skip
def test_a_velocity_that_is_no_derivative_is_a_mistake(folder: Path, name: str, parameters: str, says: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load(folder / "mine.toml", [uses_slope(folder, name, parameters)])
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("Circle", ""),
        ("Circle", "factor=1.001"),
        ("Shake", ""),
        ("Slow", ""),
        ("Table", "step=0.1"),
        ("Table", "step=0.02"),
        *(("Corners", f"every={every}") for every in (0.05, 0.1, 1.0, 7.0)),
    ],
)
def test_honest_trajectories_may_be_fast_slow_from_a_table_and_have_corners(
    folder: Path, name: str, parameters: str
) -> None:
    load(folder / "mine.toml", [uses_slope(folder, name, parameters)])


@pytest.mark.parametrize("command", ["run", "validate"])
def test_a_mistake_found_by_trying_ends_a_command_with_2(folder: Path, command: str) -> None:
    done = echelon(command, folder / "mine.toml", "--set", write(folder, "law", "1 / 0"))
    assert done.returncode == 2
    assert "mine.py, line 9: Mine of block g1: nu at t = 0 s raised ZeroDivisionError" in one_line(done.stderr)


def test_a_file_that_never_ends_is_a_mistake_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echelon.sim.parts.loading.LOAD_PATIENCE_S", 0.3)
    use = write(folder, "law", "pass")
    (folder / "mine.py").write_text("while True: pass\n")
    with pytest.raises(ScenarioError) as caught:
        load(folder / "mine.toml", [use])
    assert "law.use = 'mine.py:Mine': mine.py" in str(caught.value)
    assert "more than 0.3 s" in str(caught.value)


PACED = ("--clock", "wall", "--set", "duration=3.0", "--set", "periods={acceleration=0.05,torque=0.01}")
"""Arguments of a run on a wall clock that is slow enough for a busy machine"""
WAYS = {
    "in process": ("--engine", "inprocess"),
    "in process, closed": ("--engine", "inprocess", "--set", "can.path=closed"),
    "in process, wall clock": ("--engine", "inprocess", *PACED),
    "processes": (),
    "processes, closed": ("--set", "can.path=closed"),
    "processes, wall clock": PACED,
    "processes, wall clock, closed": (*PACED, "--set", "can.path=closed", "--set", "can.watchdog=2.0"),
}


def wheels_are_at_zero(folder: Path, way: str) -> None:
    """Checks that the last torque frame of each robot in can.log commands zero torque and disables the drives.

    All robots have frames, but for a mirroring bridge as a process: it may still be behind when the run breaks off."""
    import cantools

    database = cantools.database.load_file(folder / "torque.dbc")
    last: dict[str, dict[str, object]] = {}
    for _, _, (can_id, data, _) in frames_in(folder / "can.log"):
        message = database.get_message_by_frame_id(can_id)
        if message.name.startswith("torque_"):
            last[message.name] = message.decode(data)
    if "closed" in way or "in process" in way:
        assert len(last) == 9
    for name, signals in last.items():
        assert signals["tau_right"] == signals["tau_left"] == 0, name
        assert signals["enable_right"] == signals["enable_left"] == 0, name


def the_stop_is_no_finding(folder: Path, way: str) -> None:
    """Checks that the run judged the frames before its own stop of the wheels, and no later ones, as `echelon referee` does."""
    can = summary_of(folder)["can"]
    assert can is not None, "the bridge has reported"
    stop_ns, until_s = round(can["wheels_stopped"] * 1e9), can["referee"]["until"]
    times_ns = [time_ns - EPOCH_NS for time_ns, _, _ in frames_in(folder / "can.log")]
    source = can["referee"]["source"]
    assert source == "can.log" or "processes, wall clock" in way  # which a referee that was busy leaves to can.log, too
    plan = parse((folder / "scenario.toml").read_text(), "scenario.toml", (), folder)[1]
    again = judge_run(plan, folder)
    assert again.until == until_s
    assert "silent" not in {**again.kinds, **can["referee"]["kinds"]}
    assert all(row["time"] <= until_s for row in can["referee"]["findings"])
    if source == "bus":  # its times are not those of the log
        assert until_s == pytest.approx((stop_ns - SKEW_NS) / 1e9)
        return
    assert (again.kinds, again.later) == (can["referee"]["kinds"], can["referee"]["later"])
    assert again.later == sum(time_ns >= stop_ns // 1000 * 1000 for time_ns in times_ns)


def broken_off(folder: Path, said: str) -> Trace:
    """Checks that the summary of a run names what ended it, and agrees with the recording; returns what was recorded."""
    summary, failure = summary_of(folder), said.removeprefix("echelon: ")
    assert summary["verdict"]["word"] == "FAILS"
    assert any(reason.startswith(failure) for reason in reasons(summary))
    assert summary["run"]["failure"] == failure
    plan = parse((folder / "scenario.toml").read_text(), "scenario.toml", (), folder)[1]
    trace = read_trace(folder / "run.mcap", plan)
    assert trace.digest() == summary["trace_digest"]
    assert len(trace.common_ns()) == summary["instants"]
    return trace


@pytest.mark.parametrize(
    ("kind", "way"),
    [("law", way) for way in WAYS]
    + [
        (kind, way)
        for kind in ("path", "plant")
        for way in ("in process", "processes", "processes, wall clock, closed")
    ],
)
def test_a_part_that_fails_in_a_run_ends_it_by_name(folder: Path, kind: str, way: str) -> None:
    use = write(folder, kind, f"{LATER[kind]} raise KeyError('w')")
    done = run(folder, use, *WAYS[way])
    assert done.returncode == 3, done.stderr
    said = one_line(done.stderr)
    if "wall" in way:  # a node that hears from a robot too late skips that period
        assert re.sub(r"\d\.\d+", "0.3", said) == f"echelon: {NAMED[kind]}raised KeyError: 'w'"
    else:
        assert said == f"echelon: {NAMED[kind]}raised KeyError: 'w'"
    assert len(broken_off(folder / "run", said).common_ns()) > 5
    assert echelon("report", folder / "run").returncode == 0
    wheels_are_at_zero(folder / "run", way)
    the_stop_is_no_finding(folder / "run", way)


def test_why_a_run_broke_off_is_said_though_its_summary_cannot_be_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(summary: object, path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("echelon.sim.run.write_summary", full)
    use = write(folder, "law", f"{LATER['law']} raise KeyError('w')")
    sets, options = ("--set", use, "--set", "duration=1.0"), ("--quiet", "--no-report", "--engine", "inprocess")
    assert main(["run", str(folder / "mine.toml"), *sets, *options, "--out", str(folder / "run")]) == 3
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"echelon: {NAMED['law']}raised KeyError: 'w'"
    assert second == f"echelon: {folder / 'run' / 'summary.json'}: No space left on device"


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("way", ["in process", "processes"])
def test_a_part_that_exits_in_a_run_fails_by_name(folder: Path, kind: str, way: str) -> None:
    done = run(folder, write(folder, kind, f"{LATER[kind]} exit(0)"), *WAYS[way])
    assert done.returncode == 3
    assert one_line(done.stderr) == f"echelon: {NAMED[kind]}raised SystemExit: 0"


@pytest.mark.parametrize("way", ["in process", "processes"])
def test_what_a_part_prints_goes_to_standard_error(folder: Path, way: str) -> None:
    use = write(folder, "law", "print(f'state of {block.name}:', state[0])")
    done = run(folder, use, *WAYS[way], "--json")
    assert done.returncode in (0, 1), done.stderr
    assert json.loads(done.stdout)["parts"][0]["use"] == "mine.py:Mine"
    said = done.stderr.splitlines()
    assert "state of g2: 31.0" in said
    assert "state of centroid: 31.0" in said


def test_a_part_that_fails_in_a_simulation_is_an_error_of_the_user(folder: Path) -> None:
    import echelon as package

    (folder / "mine.py").write_text(LAW.replace("LINE", f"{LATER['law']} raise KeyError('w')"))
    changes = {"law": {"use": "mine.py:Mine", "epsilon": [0.5, 0.5], "lead": 0.5, "gains": [{"k1": 0.25, "k2": 0.5}]}}
    simulation = package.Simulation(folder / "mine.toml", changes)
    with pytest.raises(
        package.UserError, match=r"mine\.py, line 9: Mine of block g2: nu at t = 0\.3 s raised KeyError"
    ):
        simulation.run_until(1.0)


def test_debug_shows_the_traceback_of_a_part(folder: Path) -> None:
    done = echelon("validate", folder / "mine.toml", "--set", write(folder, "law", "1 / 0"), "--debug")
    assert done.returncode == 2
    assert 'File "mine.py", line 9, in nu' in done.stderr
    assert done.stderr.splitlines()[-1].endswith("nu at t = 0 s raised ZeroDivisionError: division by zero")


SHORT, NAN = "has the shape (1,), not (4,)", "is not finite: [nan, nan, nan, nan]"
LAST_S = {"law": 0.3, "path": 0.3, "plant": 0.78}
"""The instant at which each part of `LATER` fails; the states of this instant are recorded"""


@pytest.mark.parametrize(
    ("kind", "line", "says", "way"),
    [
        ("law", "return e[:1]", SHORT, "in process, closed"),
        ("law", "return e[:1]", SHORT, "processes, closed"),
        ("law", "return e * float('nan')", NAN, "in process"),
        ("law", "return e * float('nan')", NAN, "processes"),
        ("path", "return np.zeros((3, 3))", "has the shape (3, 3), not (3, 2)", "in process, closed"),
        ("path", "return np.full((3, 2), np.nan)", "is not finite: [[nan, nan], [", "processes, closed"),
        ("plant", "return [state]", "must return a RobotState (state_at), not [Ro", "processes, closed"),
        ("plant", "return state._replace(v=float('nan'))", "is not finite: RobotState(x=", "in process, closed"),
    ],
)
def test_nonsense_in_a_run_is_named_too(folder: Path, kind: str, line: str, says: str, way: str) -> None:
    done = run(folder, write(folder, kind, f"{LATER[kind]} {line}"), *WAYS[way])
    assert done.returncode == 3, done.stderr
    said = one_line(done.stderr)
    assert said.startswith(f"echelon: {re.sub(', line [0-9]+: ', ':', NAMED[kind])}{says}")
    assert broken_off(folder / "run", said).common_ns()[-1] / 1e9 == LAST_S[kind]
    wheels_are_at_zero(folder / "run", way)


@pytest.mark.parametrize(
    ("kind", "way"),
    [("law", way) for way in ("in process", "in process, wall clock", "processes", "processes, closed")]
    + [(kind, way) for kind in ("path", "plant") for way in ("in process", "processes")],
)
def test_a_part_that_hangs_is_found_and_named(folder: Path, kind: str, way: str) -> None:
    use = write(folder, kind, f"{LATER[kind]}\n            {HANG}")
    done = run(folder, use, *WAYS[way], "--stall-timeout", "5")
    assert done.returncode == 3, done.stderr
    said = done.stderr.strip().splitlines()[-1]  # the lines before say which processes wait for which
    assert re.match(r"echelon: stalled for 5 s at t = [0-9.]+ s: everyone waits for ", said)
    assert f" {RUNS[kind]}" in said
    assert "which runs mine.py:Mine" in said
    assert "Traceback" not in done.stderr
    assert ", running, which runs mine.py:Mine" in said or "processes" not in way
    summary = summary_of(folder / "run")
    assert summary["instants"] > 5
    (reason,) = (reason for reason in reasons(summary) if reason.startswith("stalled"))
    assert reason == said.removeprefix("echelon: ")  # the text says only once at which time it was
    if "processes" in way:
        assert f" at t = {summary['simulated']:g} s: " in said
    wheels_are_at_zero(folder / "run", way)


def test_a_part_that_hangs_on_a_wall_clock_stops_its_robots_alone_and_ends_the_run_after_the_stall_timeout(
    folder: Path,
) -> None:
    use = write(folder, "law", f"{LATER['law']}\n            {HANG}")
    options = ("--set", "can.watchdog=0.1", "--set", "duration=1000", "--stall-timeout", "2")
    done = run(folder, use, *WAYS["processes, wall clock, closed"], *options)
    assert done.returncode == 3
    named = [line for line in done.stderr.splitlines() if "leader g2 stands still, for " in line]
    assert all("which runs mine.py:Mine)" in line for line in named)
    assert len(named) > 1  # soon, and at the end
    assert done.stderr.strip().endswith(": longer than the stall timeout of 2 s")
    wheels_are_at_zero(folder / "run", "closed")
    summary = summary_of(folder / "run")
    assert summary["simulated"] < 500
    assert summary["can"]["robots"]["g2/r5"]["stopped"]["no command"] > 10


def test_a_part_that_cannot_be_made_ends_a_run_in_a_line(folder: Path) -> None:
    """The part can be made in the trial, but not in the run."""
    text = PLANT.replace("LINE", "pass") + (
        "\n    def step_of(self, robot):\n        made.append(1)\n"
        "        if len(made) > 1 or __import__('sys').argv[0] == '-c': 1 / 0\n        return super().step_of(robot)\n"
        "\nmade = []\n"
    )
    (folder / "mine.py").write_text(text)
    done = run(folder, USES["plant"], *WAYS["in process"])
    assert done.returncode == 3
    assert (
        one_line(done.stderr)
        == "echelon: mine.py, line 11: Mine of g2/r5: step_of raised ZeroDivisionError: division by zero"
    )


def test_ctrl_c_in_process_still_interrupts(folder: Path) -> None:
    use = write(folder, "law", "pass")
    command = start_echelon(
        *(
            "run",
            folder / "mine.toml",
            "--set",
            use,
            "--set",
            "duration=1000",
            "--engine",
            "inprocess",
            "--can",
            "none",
        ),
        *("--quiet", "--no-report", "--out", folder / "run"),
    )
    recording = folder / "run" / "run.mcap"
    while not (recording.exists() and recording.stat().st_size > 200_000):
        time.sleep(0.05)
        assert command.poll() is None, command.communicate()
    command.send_signal(2)
    _, err = command.communicate(timeout=600)
    assert command.returncode == 3
    assert one_line(err) == "echelon: interrupted"


def _endless() -> None:
    while True:
        pass


def _deaf() -> None:
    while True:
        try:
            _endless()
        except BaseException:  # even this does not stop the limit
            raise


@pytest.mark.parametrize("code", [_endless, _deaf])
def test_a_time_limit_ends_what_would_not_end(code: Callable[[], None]) -> None:
    begun, busy = time.monotonic(), time.process_time()
    with pytest.raises(TookTooLong, match=r"more than 0\.2 s"), time_limit(0.2):
        code()
    assert time.monotonic() - begun > 0.15
    assert time.process_time() - busy < 1


def _within_an_endless_one() -> None:
    with pytest.raises(TookTooLong, match=r"more than 0\.1 s"), time_limit(0.1):
        _endless()
    _endless()


def test_limits_are_nested_and_the_outer_one_goes_on() -> None:
    timer, handler = left_s(), signal.getsignal(signal.SIGALRM)  # those of the limit of this test, if it has one
    begun, busy = time.monotonic(), time.process_time()
    with pytest.raises(TookTooLong, match=r"more than 0\.5 s"), time_limit(0.5):
        _within_an_endless_one()
    took = time.monotonic() - begun
    assert took > 0.4
    assert time.process_time() - busy < 1
    assert left_s() == 0 if timer == 0 else timer - 60 < left_s() < timer - took + 0.1
    assert signal.getsignal(signal.SIGALRM) is handler


def left_s() -> float:
    """Returns the time until the timer of limits rings [s]; 0 if it is not set."""
    return signal.getitimer(signal.ITIMER_REAL)[0]


def _endless_from_anew() -> None:
    with time_limit(0.1) as limit:
        limit.renew()
        _endless()


def test_a_limit_can_begin_anew() -> None:
    with time_limit(60.0) as limit:
        for _ in range(2):
            assert until(lambda: left_s() < 59.8)
            begun = time.monotonic()
            limit.renew()
            left = left_s()
            assert 59.99 - (time.monotonic() - begun) < left < 60.01
    with pytest.raises(TookTooLong):
        _endless_from_anew()


def test_the_summary_of_a_broken_run_fits_its_schema(folder: Path) -> None:
    from echelon.sim.results.rendering import read_summary

    run(folder, write(folder, "path", f"{LATER['path']} 1 / 0"), *WAYS["in process"])
    summary = read_summary(folder / "run" / "summary.json")
    assert summary.parts[0].use == "mine.py:Mine"
    assert json.loads((folder / "run" / "summary.json").read_text())["parts"][0]["file"] == "mine.py"
