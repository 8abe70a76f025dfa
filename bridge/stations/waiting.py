"""What the processes between robots and wheels share on a wall clock: robots' torques as they come, sleeping until there is
something to do, and taking what has come from a bus."""

import os
import select
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, Final

from echelon.bridge.can.bus import Bus, Received
from echelon.messages import TORQUE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.runtime.wire import WireError, count_refusal, decode

PROGRESS_NS: Final = 200_000_000
"""How often a process tells how things stand, and looks whether it is told something."""
AT_ONCE: Final = 256
"""Frames taken from a bus before it is looked at what else there is to do."""


class Mail:
    """Robots' torques as they come, in Zenoh's thread; with `wakes`, `fileno` becomes readable."""

    def __init__(self, plan: Plan, wakes: bool = True) -> None:
        self._robots = len(plan.robots)
        self._messages: deque[Message] = deque()
        self._wakes = wakes
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.refused: dict[str, int] = {}

    def receive(self, payload: bytes) -> None:
        """Takes a payload."""
        try:
            message = decode(payload)
            if message.channel is not Channel.TORQUE or message.source >= self._robots:
                raise WireError("of no robot")
            if message.values.size != len(TORQUE_FIELDS):
                raise WireError("wrong number of values")
        except WireError as error:
            count_refusal(self.refused, error.reason)
            return
        self._messages.append(message)
        if self._wakes:
            os.eventfd_write(self._wake, 1)

    def take(self) -> list[Message]:
        """Returns what has come."""
        if self._wakes:
            try:
                os.eventfd_read(self._wake)
            except BlockingIOError:
                return []
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def fileno(self) -> int:
        """For select."""
        return self._wake


def drained(bus: Bus) -> Iterator[Received]:
    """Yields what has come from a bus, but no more than `AT_ONCE` frames: who babbles must not keep us from all else."""
    for _ in range(AT_ONCE):
        received = bus.recv(0.0)
        if received is None:
            return
        yield received


class RunClock:
    """Run time [ns] on a wall clock; 0 is at `start_ns` of the monotonic clock, now unless given."""

    def __init__(self, start_ns: int | None = None) -> None:
        self._start_ns = time.monotonic_ns() if start_ns is None else start_ns
        self._epoch_ns = time.time_ns() - time.monotonic_ns() + self._start_ns

    def now(self) -> int:
        """Returns the run time."""
        return time.monotonic_ns() - self._start_ns

    def of(self, time_ns: int) -> int:
        """Returns the run time of an instant since 1970, as the kernel stamps what it received."""
        return time_ns - self._epoch_ns


def wait_for(sources: Sequence[Any], left_ns: int) -> None:
    """Sleeps until one of the sources is readable or the time is over."""
    select.select(sources, (), (), min(max(left_ns, 0), PROGRESS_NS) * 1e-9)
