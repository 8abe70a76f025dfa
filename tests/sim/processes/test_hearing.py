"""What the supervisor hears: it waits as long as it says, whatever has happened before."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing import get_context
from types import SimpleNamespace
from typing import Any

from echelon.sim.processes.children import Child
from echelon.sim.processes.hearing import Hearing
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.pulse import Pulse, Pulses
from support.runs import plan_of

WAIT_S = 0.1


def beats(pulses: Any, number: int) -> None:
    Pulse.received(pulses, number).beat(1, 12345)


def ended_child(number: int) -> Child:
    """Returns a child that was ended by a signal and has said nothing."""
    context = get_context("forkserver")
    control, _ = context.Pipe()
    words, _ = context.Pipe(duplex=False)
    process = context.Process(target=time.sleep, args=(600,), daemon=True)
    process.start()
    assert process.pid is not None
    pulses = Pulses(1)
    spec: Any = SimpleNamespace(name="g1/r1", kind="robot")
    child = Child(spec, process, control, words, 0.0, pulses.of(0), os.pidfd_open(process.pid))
    os.kill(process.pid, number)
    assert child.ends_within(600.0)
    return child


def test_a_signal_and_a_lost_process_end_one_wait_and_no_other() -> None:
    child = ended_child(signal.SIGKILL)
    hearing = Hearing(plan_of("lab"), [child], Progress())
    hearing.wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
    try:
        os.eventfd_write(hearing.wake, 1)
        hearing.serve(600.0)  # the signal ends it
        for _ in range(3):
            begun_s = time.monotonic()
            hearing.serve(WAIT_S)
            if time.monotonic() - begun_s >= WAIT_S:
                return
        raise AssertionError("no wait takes its time")
    finally:
        os.close(hearing.wake)
        child.close()


def test_signals_without_a_name_are_told_by_their_number() -> None:
    child = ended_child(40)
    assert child.ending() == "killed by signal 40"
    assert child.was_killed
    child.close()


def test_pulses_go_through_the_fork_server_and_start_no_thread() -> None:
    import threading

    pulses, before = Pulses(2), threading.active_count()
    process = get_context("forkserver").Process(target=beats, args=(pulses.shared(), 1), daemon=True)
    process.start()
    process.join(600)
    assert process.exitcode == 0
    assert threading.active_count() == before
    assert [pulses.of(number).overdue_ns(12346) for number in range(2)] == [0, 1]
    pulses.close()
