"""Who stands still on a wall clock is told, and the bridge of a closed path ends the run, but not before run time 0."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace
from typing import Any

import pytest

from echelon.sim.processes.failures import RunError
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.stalls import StandstillWatch
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
