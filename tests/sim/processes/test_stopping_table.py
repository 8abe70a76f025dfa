"""The table of stopping: each process of a run × `kill -9`, signals, standing still × both clocks.

For each of them it says how soon the wheels have no torque, with which exit code the run ends, and what the run says.  An ear
on the bus hears the wheels (`support.stopped`).  Runs go on beside each other, since most of them wait for a clock."""

import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen
from typing import Final, NamedTuple

import pytest

from echelon.bridge.can.log_files import frames_in
from support.late import Lateness, lateness
from support.runs import session_members, summary_of, until
from support.stopped import SCENARIO, Ear, running, whom
from support.stopping_table import AT_ONCE, HITS, KINDS, ON, STALL_S, TABLE, ZERO, Out

pytestmark = pytest.mark.slow
TEAM: Final = (
    SCENARIO.replace("formation.robots", "formation.groups.team.robots")
    .replace("epsilon = [0.5]", "epsilon = [0.5, 0.5]")
    .replace("duration = 1000.0", "duration = 20000.0\nperiods = { acceleration = 0.05, torque = 0.05 }")
)
"""A leader between coordinator and robot; few frames a second, so that runs beside each other do not fill the machine"""
MIRRORED: Final = TEAM.replace('path = "closed", ', "")
CALM_S: Final = 0.2
"""A machine that lets a process wait for longer proves nothing about a run that fails: it is tried again [s]"""
TRIES: Final = 3
STARTING: Final = threading.Semaphore(2)
"""Runs that start beside each other; others would be late"""


class Cell(NamedTuple):
    """A hit: what is done to whom, and what comes of it."""

    who: str
    hit: str
    out: Out

    @property
    def seconds(self) -> float | None:
        """For how long the process stands still; None: for ever."""
        return float(self.hit.split()[1]) if " " in self.hit else None

    @property
    def said(self) -> str:
        """What the run says."""
        who = KINDS.get(self.who, self.who)
        return self.out.said.format(who=who, name=self.who, signal=self.hit)


def trials(clock: str, what: str) -> Iterator[list[Cell]]:
    """Yields what is done in each run: one hit that ends it, or one after the other that do not."""
    for who, outs in TABLE[clock].items():
        alive = []
        for hit, out in zip(HITS, outs, strict=False):
            if out is not None and hit.split()[0] == what:
                cell = Cell(who, hit, out)
                if out.code is None:
                    alive.append(cell)
                else:
                    yield [cell]
        if alive:
            yield alive


@dataclass
class Run:
    """A run that is hit."""

    command: Popen[str]
    ear: Ear
    machine: Lateness
    said: list[str] = field(default_factory=list)
    """The lines of its standard error"""

    def read(self) -> None:
        """Reads what the run says, until it ends."""
        with suppress(ValueError):
            self.said.extend(iter(self.command.stderr.readline, "")) if self.command.stderr is not None else None

    def has_said(self, text: str) -> bool:
        """Returns whether the run has said a text."""
        return any(text in line for line in list(self.said))

    def torque_s(self, who: str) -> float:
        """Returns when wheels had torque last, or were commanded to have it, as far as those who are well can say."""
        reported_s, commanded_s = self.ear.turning_s, self.ear.commanding_s
        return {"drives": commanded_s, "bridge": reported_s}.get(who, max(reported_s, commanded_s))

    def soon(self, at_s: float, then_s: float, bound_s: float, what: str) -> None:
        """Asserts that something came not later than `bound_s` after a hit, and what the machine was late meanwhile."""
        late_s = 2 * sum(self.machine.of(at_s, then_s))
        assert then_s - at_s < bound_s + late_s, f"{what} {then_s - at_s:.2f} s > {bound_s} s + {late_s:.2f} s"


def strike(run: Run, cell: Cell, mirrored: bool) -> None:
    """Hits a run whose wheels have torque, and sees what comes of it."""
    command, ear, (who, hit, out) = run.command, run.ear, cell
    # without drives and their delays a robot on a circle soon needs no torque
    assert until(lambda: mirrored or (ear.torque and ear.commands_torque) or command.poll() is not None)
    number = signal.Signals[f"SIG{hit.split()[0]}"]
    if who.startswith("all"):
        at_s = time.time()
        os.killpg(command.pid, number)
        if who == "all twice":
            os.kill(command.pid, number)
    else:
        pid = whom(command, who)
        handle = os.pidfd_open(pid)
        at_s = time.time()
        os.kill(pid, number)
        try:
            if number == signal.SIGSTOP:
                stand_still(run, cell, at_s)
                if cell.seconds is not None:
                    commands = len(ear.commands)
                    with suppress(ProcessLookupError):
                        signal.pidfd_send_signal(handle, signal.SIGCONT)
                    assert out.code is not None or until(lambda: len(ear.commands) > commands), "the run goes on"
        finally:
            os.close(handle)
    if out.code is not None:
        command.wait(600)
        assert command.returncode == out.code
        if out.zero_s is not None:
            run.soon(at_s, run.torque_s(who), out.zero_s, "torque")


def stand_still(run: Run, cell: Cell, at_s: float) -> None:
    """Waits for as long as a process stands still, and sees what the others do."""
    out, seconds = cell.out, cell.seconds
    if out.code is not None:
        assert until(lambda: run.command.poll() is not None or (seconds is not None and time.time() - at_s > seconds))
        return
    if seconds is not None:
        time.sleep(seconds)
    assert until(lambda: run.has_said(cell.said) or run.command.poll() is not None)
    assert run.has_said(cell.said)
    if out.zero_s is not None:
        assert until(lambda: not run.ear.torque and not run.ear.commands_torque)
        run.soon(at_s, run.torque_s(cell.who), out.zero_s, "torque")
    if out.silent:
        run.soon(at_s, run.ear.last_s, AT_ONCE, "frames")


def end(run: Run, last: Cell) -> None:
    """Ends a run that goes on, though somebody may stand still."""
    command, at_s = run.command, time.time()
    if last == ("supervisor", "STOP", ON):
        os.killpg(command.pid, signal.SIGTERM)  # the bridge needs nobody to stop the wheels
        assert until(lambda: not run.ear.enabled)
        os.kill(command.pid, signal.SIGKILL)
    else:
        os.kill(command.pid, signal.SIGTERM)
    command.wait(600)
    assert command.returncode == (-signal.SIGKILL if last == ("supervisor", "STOP", ON) else 3)
    run.soon(at_s, run.torque_s(last.who), AT_ONCE, "torque at the end")


def attempt(folder: Path, clock: str, cells: Sequence[Cell], machine: Lateness) -> None:
    """Makes one run, and sees what comes of each hit."""
    *_, last = cells
    mirrored, virtual = "mirrored" in clock, "virtual" in clock
    options = ["--clock", "virtual" if virtual else "wall", "--observe"]
    if virtual and last.hit == "STOP":
        options += ["--stall-timeout", f"{STALL_S:g}"]
    folder.mkdir()
    with ExitStack() as stack:
        with STARTING:
            text = MIRRORED if mirrored else TEAM
            command, ear = stack.enter_context(running(folder, *options, text=text))
        run = Run(command, ear, machine)
        reader = threading.Thread(target=run.read)
        reader.start()
        for cell in cells:
            with about(cell, run):
                strike(run, cell, mirrored)
        with about(last, run):
            if last.out.code is None:
                end(run, last)
            assert until(lambda: not session_members(command.pid)), session_members(command.pid)
            reader.join()
            heard_no_end = last.hit in ("KILL", "STOP", "STOP 2", "STOP 20")
            if mirrored and virtual and heard_no_end:
                # frames come as fast as they are made, which who listens may miss; the log has them all
                assert last.hit == "KILL" or disables(folder / "run" / "can.log")
            elif (last.who, last.hit) != ("bridge", "KILL"):
                assert until(lambda: not ear.enabled and not ear.commands_torque, 30)
            if not (heard_no_end and last.who == "drives"):
                assert until(lambda: not ear.torque, 30)
            assert not run.has_said("Traceback")
            assert run.has_said(last.said) or not last.said
            if last.out.code is None and last.who != "supervisor":
                assert run.has_said("echelon: interrupted")
            if last.who != "supervisor":  # whoever ends, what was on the bus is told
                summary = summary_of(folder / "run")
                logged = (folder / "run" / "can.log").read_bytes().count(b"\n")
                told = 0 if summary["can"] is None else summary["can"]["frames"]
                # a killed bridge may not have written any yet; the mirrored path does not count the frames of its stop
                assert 0 <= logged - told <= mirrored
                assert told or (last.who, last.hit) == ("bridge", "KILL")
            if last.out == ZERO:
                checks = {each["name"]: each for each in summary["verdict"]["checks"]}
                assert checks["standstill"]["outcome"] == "failed"
                assert f"{last.who} for " in checks["standstill"]["text"]


def disables(log: Path) -> bool:
    """Returns whether the last frame of a log with one robot's mirrored frames has no torque and disables its drives."""
    *_, (_, _, frame) = frames_in(log)
    return frame.data[:5] == bytes(5)


@contextmanager
def about(cell: Cell, run: Run) -> Iterator[None]:
    """A context in which failures name a cell of the table and have what the run said."""
    try:
        yield
    except BaseException as error:
        error.add_note(f"{cell.hit} to {cell.who}; the run said: {''.join(run.said) or 'nothing'}")
        raise


def trial(folder: Path, clock: str, cells: Sequence[Cell], machine: Lateness) -> None:
    """Does the same as `attempt`, again if the machine was busy when it failed."""
    for number in range(1, TRIES + 1):
        begun_s = time.time()
        try:
            return attempt(
                folder / f"{cells[-1].hit} {cells[-1].who.replace('/', ' ')} {number}", clock, cells, machine
            )
        except Exception as error:  # also where a process is gone already
            error.add_note(f"{clock}, try {number}")
            if number == TRIES or max(machine.of(begun_s, time.time()), default=0.0) < CALM_S:
                raise


@pytest.mark.parametrize("clock", TABLE)
@pytest.mark.parametrize("what", ["KILL", "TERM", "HUP", "INT", "STOP"])
def test_the_wheels_stop_as_the_table_says(clock: str, what: str, tmp_path: Path) -> None:
    with lateness(tmp_path / "late") as machine, ThreadPoolExecutor(9 if what == "STOP" else 4) as pool:
        runs = [pool.submit(trial, tmp_path, clock, cells, machine) for cells in trials(clock, what)]
    failed = [error for run in runs if isinstance(error := run.exception(), Exception)]
    if failed:
        raise ExceptionGroup("cells of the table", failed)
