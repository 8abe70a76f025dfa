"""What the supervisor hears: it waits as long as it says, whatever has happened before."""

from __future__ import annotations

import os
import pickle
import random
import signal
import threading
import time
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from enum import EnumType
from itertools import chain, cycle, islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import SimpleNamespace, UnionType
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.reports import BridgeProgress, CanReport, DrivesReport
from echelon.messages import STATE_FIELDS
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.runtime.runner import RunnerCounts
from echelon.sim.processes.children import Child
from echelon.sim.processes.hearing import NOT_UNDERSTOOD, Hearing
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.pulse import Pulse, Pulses
from echelon.sim.processes.to_process import End, Finish, Start
from echelon.sim.processes.to_supervisor import (
    Done,
    Failed,
    LinksProgress,
    Lost,
    PartFailed,
    Ready,
    RecorderProgress,
    RecorderReport,
    Waiting,
)
from echelon.sim.processes.understood import understood
from echelon.sim.results.trace import Trace
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


def whole(kind: Any) -> Any:
    """Returns a value that a field of a record may have."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return whole(parts[0])
    if is_dataclass(kind):
        types = get_type_hints(kind)
        return cast(type, kind)(**{field.name: whole(types[field.name]) for field in fields(kind)})
    if kind in (int, float, str, bool):
        return kind(1)
    if isinstance(kind, EnumType):
        return next(iter(kind))
    return () if origin is tuple else {}


def spoilt(said: Any, luck: random.Random) -> Any:
    """Returns a message with a value of another type, or a number that is too large, somewhere in it."""
    name = luck.choice([field.name for field in fields(said) if field.name != "plan"])
    inside = getattr(said, name)
    wrong: Any = luck.choice([object, 1j, b"1", 1 << 70, [[1]] * 5, {1: 2}, ((),), Ready(), range(3)])
    if is_dataclass(inside) and luck.random() < 0.8:
        wrong = spoilt(inside, luck)
    elif isinstance(inside, tuple) and luck.random() < 0.8:
        wrong = (*inside, wrong)
    elif isinstance(inside, dict) and luck.random() < 0.8:
        wrong = {**inside, "x": wrong}
    return replace(said, **{name: wrong})


def hostile(child: Child, plan: Plan, count: int) -> Iterator[bytes]:
    """Yields what a process may not say over its pipe: noise, damaged messages, other objects, and its messages with values
    that are wrong, or those of another process."""
    luck = random.Random(child.name)
    nan, huge = float("nan"), "x" * 200_000
    states = np.zeros((len(plan.robots), len(STATE_FIELDS)))
    progress = RecorderProgress(1, 1, 1, states, None)
    report = {"bridge": whole(CanReport), "drives": whole(DrivesReport), "referee": whole(RefereeReport)}
    unused = cast(Plan, None)  # the supervisor has its own plan
    trace = Trace(unused, (np.zeros(1, np.int64),) * len(plan.robots), (states[:1],) * len(plan.robots))
    report["recorder"] = RecorderReport(trace, 1, 0, None)
    done = Done(child.name, 1.0, 1, whole(RunnerCounts), (whole(LinkCounts),), report.get(child.spec.kind))
    right = [Waiting(0, (1,)), LinksProgress((whole(LinkCounts),)), Failed("x"), PartFailed("x"), done]
    right += {"bridge": [BridgeProgress()], "drives": [BridgeProgress()], "recorder": [progress]}.get(
        child.spec.kind, []
    )
    assert all(understood(each, child.spec, plan) for each in right)
    link = right[1].links[0]
    fixed: list[Any] = [
        None,
        1,
        "Ready",
        Ready,
        nan,
        [Ready()] * 1000,
        {"name": child.name},
        Start(0),
        Finish((), 0, 0),
        End(),
    ]
    fixed += [
        Waiting(0, (-1,)),
        Waiting(0, (10**6,)),
        Waiting(0, (0,) * 10_000),
        Waiting(cast(int, nan), ()),
        Failed(huge),
    ]
    fixed += [
        LinksProgress((link,) * 100_000),
        LinksProgress((replace(link, source=10**6),)),
        replace(done, name="somebody"),
    ]
    if child.spec.kind == "bridge":
        fixed += [replace(done, report=replace(done.report, wheels_stopped=at)) for at in (nan, float("inf"), -1e12)]
    fixed += [replace(progress, lost=Lost(10**6, 0)), replace(progress, states=states[:1]), BridgeProgress(load=nan)]
    fixed += [replace(done, report=each) for kind, each in report.items() if kind != child.spec.kind]
    fixed += [
        replace(progress, states=np.zeros(3, "U5")),
        BridgeProgress(faults=(huge,)),
        replace(progress, failure=huge),
    ]
    fixed += [b"", b"\x80", *([progress] if child.spec.kind != "recorder" else [])]
    rare = [pickle.dumps(each) if not isinstance(each, bytes) else each for each in fixed]
    rare += [pickle.dumps(Waiting(0, (1,)))[:-at] for at in range(1, 20)] + [b"cbuiltins\nnobody\n.", b"(" * 5000]
    noise = [luck.randbytes(luck.randrange(60)) for _ in range(1000)]
    often = [*noise, *(pickle.dumps(spoilt(luck.choice(right), luck)) for _ in range(1000))]
    yield from islice(chain(rare, cycle(often)), count)


KINDS = ("robot", "leader", "coordinator", "bridge", "drives", "referee", "recorder", "observers")


def test_nothing_that_a_process_says_spoils_the_supervisor() -> None:
    """100,000 messages that are none, over the pipes of processes of each kind.  After them a right one is still heard."""
    plan, progress, each = plan_of("lab"), Progress(phase="running"), 100_000 // len(KINDS)
    context = get_context("forkserver")
    pulses, children, pipes = Pulses(len(KINDS)), list[Child](), list[Connection]()
    for number, kind in enumerate(KINDS):
        (control, pipe), (words, _) = context.Pipe(), context.Pipe(duplex=False)
        spec: Any = SimpleNamespace(name=f"one {kind}", kind=kind)
        process: Any = None
        children.append(Child(spec, process, control, words, 0.0, pulses.of(number), os.pidfd_open(os.getpid())))
        pipes.append(pipe)
    hearing = Hearing(plan, children, progress)
    hearing.wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
    before, said = deepcopy(progress), [list(hostile(child, plan, each)) for child in children]

    def speak() -> None:
        for messages in zip(*said, strict=True):
            for pipe, message in zip(pipes, messages, strict=True):
                pipe.send_bytes(message)
        for pipe in pipes:
            pipe.send(Ready())

    speaker = threading.Thread(target=speak, daemon=True)
    speaker.start()
    try:
        while not all(child.ready for child in children):
            hearing.serve(20.0)
            assert all(not child.control.closed for child in children)
    finally:
        os.close(hearing.wake)
        for child in children:
            child.close()
        pulses.close()
    assert hearing.refusals.by_source() == {child.name: {NOT_UNDERSTOOD: each} for child in children}
    assert progress == before
    assert all((child.done, child.waiting_for, child.waiting_ns) == (None, [], -1) for child in children)


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
