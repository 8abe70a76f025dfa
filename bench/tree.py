"""The exchange of messages that every peer performs: nine robots, three leaders, one coordinator, each a process, in lockstep.

In a tick the robots send their states to their leaders, the leaders their groups' states to the coordinator; then the
coordinator sends a reference to the leaders, and each leader a command to its robots.  These are 16 messages and 24 deliveries.
Each message depends on all messages that its sender received, so a missing message changes the final values.
"""

from __future__ import annotations

import ctypes
import gc
import json
import multiprocessing
import multiprocessing.connection
import os
import resource
import signal
import struct
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Final, Protocol

GROUPS: Final = 3
ROBOTS: Final = 3
"""Robots in each group"""
HEADER: Final = struct.Struct("<HHIQq")
"""Schema version, channel, source, sequence number, time [ns]"""
CHANNELS: Final = ("state", "group", "reference", "command")
FIELDS: Final = {"state": 10, "group": 30, "reference": 60, "command": 24}
"""Number of float64 values in a message of each channel"""
_BODY: Final = {channel: struct.Struct(f"<{number}d") for channel, number in FIELDS.items()}
_DOUBLE: Final = struct.Struct("<d")
START_TIMEOUT_S: Final = 30.0
RUN_TIMEOUT_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class Role:
    """One process: a robot (group, number), a leader (group, None) or the coordinator (None, None)."""

    group: int | None = None
    number: int | None = None

    @property
    def name(self) -> str:
        """`coordinator`, `g1` or `g1r2`."""
        if self.group is None:
            return "coordinator"
        return f"g{self.group}" if self.number is None else f"g{self.group}r{self.number}"

    @property
    def source(self) -> int:
        """The role's number in headers."""
        if self.group is None:
            return 200
        return 100 + self.group if self.number is None else self.group * ROBOTS + self.number


COORDINATOR: Final = Role()
LEADERS: Final = tuple(Role(group) for group in range(GROUPS))
ROLES: Final = (
    COORDINATOR,
    *LEADERS,
    *(Role(group, number) for group in range(GROUPS) for number in range(ROBOTS)),
)


Play = Generator[str, Sequence[bytes], float]
"""A role that runs: a generator that yields the channel it waits for, receives by `send` this tick's message of each sender,
and returns its final value"""


class Ports(Protocol):
    """How a role sends and receives; only this differs between the peers."""

    def send(self, channel: str, payload: bytes) -> None:
        """Sends a message to every receiver of the channel."""

    def drive(self, play: Play) -> float:
        """Runs a role to its end; returns its final value."""


class BlockingPorts:
    """Ports whose `receive` waits for this tick's message from each sender of a channel."""

    def receive(self, channel: str) -> Sequence[bytes]:
        """Waits for this tick's message from each sender of the channel, and returns them."""
        raise NotImplementedError

    def drive(self, play: Play) -> float:
        """Runs a role to its end; returns its final value."""
        try:
            channel = next(play)
            while True:
                channel = play.send(self.receive(channel))
        except StopIteration as end:
            value: float = end.value
            return value


def pack(channel: str, source: int, tick: int, value: float) -> bytes:
    """Returns a message whose fields are all `value`."""
    head = HEADER.pack(1, CHANNELS.index(channel), source, tick, tick * 10_000_000)
    return head + _BODY[channel].pack(*[value] * FIELDS[channel])


def unpack(payload: bytes, tick: int) -> float:
    """Returns the value in a message: the mean of its first and last field.  Raises ValueError if it is not of this tick."""
    if HEADER.unpack_from(payload)[3] != tick:
        raise ValueError(f"a message of tick {HEADER.unpack_from(payload)[3]} came in tick {tick}")
    first: float = _DOUBLE.unpack_from(payload, HEADER.size)[0]
    last: float = _DOUBLE.unpack_from(payload, len(payload) - 8)[0]
    return (first + last) / 2


def robot_start(role: Role) -> float:
    """Returns the state of a robot at the start."""
    return 1.0 + role.source


def robot_law(state: float, command: float) -> float:
    """Returns the next state of a robot."""
    return 0.5 * state + command


def sum_law(values: Sequence[float]) -> float:
    """Returns the sum of children's values for a leader or the coordinator; it does not depend on their order."""
    return sum(sorted(values))


def command_law(reference: float, group: int) -> float:
    """Returns the command of a leader."""
    return 0.001 * reference + group


def play(role: Role, send: Callable[[str, bytes], None], ticks: int) -> Play:
    """Runs a role for `ticks` ticks; `send` takes channel and message."""
    source = role.source
    value = robot_start(role)
    for tick in range(ticks):
        if role.number is not None:
            send("state", pack("state", source, tick, value))
            value = robot_law(value, *[unpack(payload, tick) for payload in (yield "command")])
        elif role.group is not None:
            value = sum_law([unpack(payload, tick) for payload in (yield "state")])
            send("group", pack("group", source, tick, value))
            (reference,) = [unpack(payload, tick) for payload in (yield "reference")]
            send("command", pack("command", source, tick, command_law(reference, role.group)))
        else:
            value = sum_law([unpack(payload, tick) for payload in (yield "group")])
            send("reference", pack("reference", source, tick, value))
    return value


class Meter:
    """Measures what a process uses between `start` and `report`."""

    def start(self) -> None:
        """Begins to measure."""
        gc.collect()
        gc.freeze()
        self._before = resource.getrusage(resource.RUSAGE_SELF)
        self._start = time.monotonic()

    def report(self, folder: Path, name: str, value: float | None) -> None:
        """Writes what was used since `start` into a file of the folder, with the final value of a role, if the process has
        one."""
        end, after, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF), self._before
        found = {
            "value": value,
            "start": self._start,
            "end": end,
            "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            "switches": after.ru_nvcsw + after.ru_nivcsw - before.ru_nvcsw - before.ru_nivcsw,
        }
        (folder / f"{name}.json").write_text(json.dumps(found))


def die_with_parent() -> None:
    """Makes the kernel end this process when its parent process ends."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    if os.getppid() == 1:
        os._exit(1)


Connect = Callable[[Role, Path], "Iterator[Ports]"]
"""A generator function that yields the ports of a role when they are ready for the first message, and is resumed after the
last"""


def run_roles(connect: Connect, ticks: int, folder: Path) -> None:
    """Runs every role in a forked process; the processes wait for each other before the first tick and after the last."""
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(len(ROLES))
    children = [
        context.Process(target=_child, args=(connect, role, ticks, folder, barrier), daemon=True) for role in ROLES
    ]
    run_processes(children)


def run_processes(children: Sequence[multiprocessing.process.BaseProcess]) -> None:
    """Starts processes and waits until all have ended.  Raises RuntimeError if one fails or takes too long; then all are
    ended."""
    try:
        for child in children:
            child.start()
        waiting = list(children)
        deadline = time.monotonic() + RUN_TIMEOUT_S
        while waiting:
            left = deadline - time.monotonic()
            if left <= 0:
                raise RuntimeError(f"{', '.join(child.name for child in waiting)} did not end in {RUN_TIMEOUT_S:.0f} s")
            multiprocessing.connection.wait([child.sentinel for child in waiting], left)
            for child in [child for child in waiting if child.exitcode is not None]:
                if child.exitcode:
                    raise RuntimeError(f"process {child.name} ended with {child.exitcode}")
                waiting.remove(child)
    finally:
        for child in children:
            if child.pid is not None and child.is_alive():
                child.kill()
            if child.pid is not None:
                child.join()


def _child(connect: Connect, role: Role, ticks: int, folder: Path, barrier: Barrier) -> None:
    die_with_parent()
    with contextmanager(connect)(role, folder) as ports:
        meter = Meter()
        barrier.wait(START_TIMEOUT_S)
        meter.start()
        value = ports.drive(play(role, ports.send, ticks))
        meter.report(folder, role.name, value)
        barrier.wait(START_TIMEOUT_S)
