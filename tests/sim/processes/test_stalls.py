"""Who stands still on a wall clock is told, and the bridge of a closed path ends the run, but not before run time 0."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace
from typing import Any

import pytest

from echelon.sim.processes.failures import RunError, StallError
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.pulse import Pulse
from echelon.sim.processes.stalls import StallWatch, StandstillWatch
from support.runs import plan_of

S = 1_000_000_000


def watch(starts_in_s: float, kind: str = "bridge", member: bool = False) -> tuple[StandstillWatch, int]:
    """Returns a watch over a process that is late by 1.5 s, and the present instant; the run begins in some seconds.

    The stall timeout is 2 s."""
    now_ns = time.monotonic_ns()
    process: Any = SimpleNamespace(
        name=kind,
        kind_and_name=kind,
        spec=SimpleNamespace(kind=kind),
        is_member=member,
        done=None,
        pulse=SimpleNamespace(overdue_ns=lambda at_ns: max(0, at_ns - now_ns + 3 * S // 2)),
        process=SimpleNamespace(pid=os.getpid()),
        state=lambda: "stopped",
        runs=lambda: ", which runs mine.py:Mine",
    )
    progress = Progress(phase="running", started_s=now_ns / 1e9 + starts_in_s)
    found = StandstillWatch(plan_of("lab", "can.path=closed", "claims=[]"), [process], progress, 2.0)
    found.check(now_ns)  # the first look: the machine may have been asleep before
    return found, now_ns


def test_a_bridge_that_stands_still_in_the_run_ends_it() -> None:
    found, now_ns = watch(-10.0)
    with pytest.raises(RunError, match="bridge stands still"):
        found.check(now_ns + S // 10)


def test_before_run_time_0_no_wheel_has_torque_and_nothing_is_said() -> None:
    found, now_ns = watch(10.0)
    found.check(now_ns + S // 10)
    assert found._progress.note == ""


def test_a_member_that_stands_still_ends_the_run_after_the_stall_timeout_by_name() -> None:
    found, now_ns = watch(-10.0, "coordinator", member=True)
    found.check(now_ns + 2 * S // 5)  # for 1.9 s
    assert "coordinator stands still, for 1.9 s" in found._progress.note
    with pytest.raises(RunError, match=r"coordinator stands still, for 2.2 s .*Mine.*than the stall timeout of 2 s$"):
        found.check(now_ns + 7 * S // 10)


def test_a_watcher_that_stands_still_is_named_and_the_run_goes_on() -> None:
    found, now_ns = watch(-10.0, "recorder")
    for tenths in range(1, 100):
        found.check(now_ns + tenths * S // 10)
    assert "recorder stands still, for " in found._progress.note


def stalled(beats: bool, state: str) -> str:
    """Returns why a run in virtual time is given up whose recorder has this state, and all of whose members are at work."""
    now_s = time.monotonic()
    pulse = Pulse(memoryview(bytearray(8 * 8)).cast("q"), 0)
    if beats:
        pulse.at_work(0.1)
    spec = SimpleNamespace(index=0)
    common = {"spec": spec, "waiting_ns": -1, "waiting_for": (), "waiting_s": 0.0, "done": None, "runs": str}
    process = SimpleNamespace(pid=os.getpid())
    recorder: Any = SimpleNamespace(
        name="recorder", is_member=False, heard_s=now_s, pulse=pulse, state=lambda: state, process=process, **common
    )
    robot: Any = SimpleNamespace(
        name="r1", is_member=True, heard_s=now_s + 100, pulse=pulse, state=lambda: "sleeping", process=process, **common
    )
    watch = StallWatch(plan_of("lab"), [recorder, robot], Progress(phase="running", started_s=now_s), 4.0)
    watch.check(now_s)
    with pytest.raises(StallError) as error:
        watch.check(now_s + 20.0)
    return str(error.value)


def test_a_watcher_in_virtual_time_is_named_by_its_pulse() -> None:
    assert "everyone waits for recorder" in stalled(beats=True, state="sleeping")


def test_a_watcher_that_was_stopped_before_its_pulse_began_is_named_too() -> None:
    assert "everyone waits for recorder" in stalled(beats=False, state="stopped")
