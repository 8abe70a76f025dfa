"""Shared parts of bridge and drives: a mailbox for the robots' torques, reading from a bus, the clock of a run, sleeping until
something comes, and the lock of who sends."""

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

from echelon.bridge.can.bus import Bus, Received
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.runtime.admission import EARLY_NS, Admission, Refusals
from echelon.runtime.admission_rules import admissions_into

PROGRESS_NS: Final = 200_000_000
"""How often a process reports its progress and reads its orders; the longest sleep of `wait_for`."""
AT_ONCE: Final = 256
"""The largest number of frames that are read from a bus at once."""
FLOOD: Final = 100 * AT_ONCE
"""The same in virtual time, which waits: the frames that matter may be behind a flood"""

LAST_S: Final = 0.5
"""How long who stops the wheels waits for another thread that is sending [s]"""
SET_NS: Final = 1_000_000
"""By how much the kernel's clock must have changed against the monotonic clock to count as set [ns]"""


class Mail:
    """A mailbox for the robots' torques.

    Zenoh's thread calls the `doors`, the bridge's or drives' thread calls `take`.  With `wakes`, `fileno` is readable while
    messages are there.  `refusals` counts what was refused."""

    def __init__(self, plan: Plan, receiver: int, wakes: bool = True) -> None:
        self.refusals = Refusals()
        self.now: Callable[[], int] = lambda: EARLY_NS
        """Returns the run time; to be replaced when the start of the run is known"""
        self._admissions = [
            each
            for each in admissions_into(plan, receiver, self.refusals, virtual=False)
            if each.channel is Channel.TORQUE
        ]
        self._messages: deque[Message] = deque()
        self._wakes = wakes
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def doors(self) -> dict[int, Callable[[bytes], None]]:
        """Returns for each robot (by index) the function that takes its payloads."""
        return {each.source: partial(self._receive, each) for each in self._admissions}

    def _receive(self, admission: Admission, payload: bytes) -> None:
        message = admission.admit(payload, self.now())
        if message is None:
            return
        self._messages.append(message)
        if self._wakes:
            os.eventfd_write(self._wake, 1)

    def take(self) -> list[Message]:
        """Returns the messages that have come since the last call."""
        if self._wakes:
            try:
                os.eventfd_read(self._wake)
            except BlockingIOError:
                return []
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def fileno(self) -> int:
        """The file descriptor to wait for with `select`."""
        return self._wake


def drained(bus: Bus, most: int = AT_ONCE) -> Iterator[Received]:
    """Yields the frames that have come from a bus, but not more than `most`: a node that floods the bus must not block the
    caller."""
    for _ in range(most):
        received = bus.recv(0.0)
        if received is None:
            return
        yield received


class RunClock:
    """Run time [ns] on a wall clock.  Run time 0 is at `start_ns` of the monotonic clock; None means now.

    The kernel stamps frames by a clock that somebody may set while a run goes on.  A stamp that lies in the future, or long
    before the stamp before it, shows that; then the two clocks are compared anew.  Stamps from before the clock was set may
    still be to come."""

    def __init__(self, start_ns: int | None = None) -> None:
        self._start_ns = time.monotonic_ns() if start_ns is None else start_ns
        self._epoch_ns = self._before_ns = _epoch_of_monotonic_clock() + self._start_ns
        self._last_ns = self.now()

    def now(self) -> int:
        """Returns the present run time."""
        return time.monotonic_ns() - self._start_ns

    def of(self, time_ns: int) -> int:
        """Returns the run time of a time stamp of the kernel [ns since 1970]."""
        found_ns, now_ns = time_ns - self._epoch_ns, self.now()
        if not self._likely(found_ns, now_ns):
            epoch_ns = _epoch_of_monotonic_clock() + self._start_ns
            if abs(epoch_ns - self._epoch_ns) > SET_NS:
                self._epoch_ns, self._before_ns = epoch_ns, self._epoch_ns
                found_ns = time_ns - epoch_ns
            if not self._likely(found_ns, now_ns) and self._likely(time_ns - self._before_ns, now_ns):
                found_ns = time_ns - self._before_ns
        self._last_ns = max(self._last_ns, min(found_ns, now_ns))
        return found_ns

    def _likely(self, found_ns: int, now_ns: int) -> bool:
        """Returns whether a frame may have come at a run time: not in the future, and not long before the one before it."""
        return self._last_ns - SET_NS <= found_ns <= now_ns + SET_NS


def _epoch_of_monotonic_clock() -> int:
    """Returns when the monotonic clock was 0 [ns since 1970].

    The two clocks are read one after the other, and this process may lose its processor in between: the shortest of some tries
    counts."""
    tries = []
    for _ in range(5):
        before_ns, now_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        tries.append((after_ns - before_ns, now_ns - (before_ns + after_ns) // 2))
    return min(tries)[1]


def wait_for(sources: Sequence[Any], left_ns: int) -> None:
    """Sleeps until one of the sources is readable, or for `left_ns`, but not longer than `PROGRESS_NS`."""
    select.select(sources, (), (), min(max(left_ns, 0), PROGRESS_NS) * 1e-9)


@contextmanager
def last_to_send(sending: threading.RLock) -> Iterator[None]:
    """The context in which a station sends the frames that stop the wheels, perhaps in another thread than that of its torques.

    A station holds `sending` while it sends frames and writes them into can.log.  Whoever stops the wheels first says that
    nothing else is to be sent, and then waits here until what is being sent is on the bus and in the log.  So no torque comes
    after the frames that stop.  The wait has a limit, since a disk may block the other thread."""
    locked = sending.acquire(timeout=LAST_S)
    try:
        yield
    finally:
        if locked:
            sending.release()
