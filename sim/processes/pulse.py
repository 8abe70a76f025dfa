"""The pulses of a run's processes: a few numbers for each, in memory that they share with the supervisor.

A process writes until when it will be at work again.  So the supervisor sees at any time which process stands still, and for
how long, without any message, which a frozen process could not send.  The memory has no name in any file system.
"""

import mmap
import os
import time
from dataclasses import dataclass
from multiprocessing.reduction import DupFd
from typing import Any, Final

NEVER_NS: Final = 1 << 62
_DUE, _LATE, _LATE_AT, _ASKED, _STOPPED = range(5)
_CELLS: Final = 8


class Pulse:
    """The pulse of one process.  Instants are on the monotonic clock [ns]."""

    __slots__ = ("_at", "_cells", "from_ns")

    def __init__(self, cells: memoryview, number: int) -> None:
        self._cells, self._at = cells, number * _CELLS
        self.from_ns = 0
        """Run time 0: what ends before it does not count, since no wheel has torque yet"""

    @classmethod
    def received(cls, fd: int, number: int) -> "Pulse":
        """Returns the pulse of this process, from what became of `Pulses.shared` here."""
        try:
            return cls(memoryview(mmap.mmap(fd, 0)).cast("q"), number)
        finally:
            os.close(fd)

    def beat(self, now_ns: int, due_ns: int) -> None:
        """Says that the process is at work at `now_ns`, and will be again at `due_ns` at the latest."""
        self.late(now_ns)
        self._cells[self._at] = due_ns

    def at_work(self, for_s: float) -> None:
        """Says that the process is at work now, and will be again within `for_s` [s]."""
        now_ns = time.monotonic_ns()
        self.beat(now_ns, now_ns + round(for_s * 1e9))

    def late(self, now_ns: int) -> None:
        """Notes by how much the process is late, if it never was by more."""
        cells, at = self._cells, self._at
        due_ns = cells[at]
        if due_ns and now_ns - due_ns > cells[at + _LATE] and now_ns > self.from_ns:
            cells[at + _LATE], cells[at + _LATE_AT] = now_ns - due_ns, due_ns

    def rest(self) -> None:
        """Says that the process has nothing to do any more."""
        self._cells[self._at] = NEVER_NS

    def ask(self, number: int) -> None:
        """Says that a signal asked the process to end."""
        self._cells[self._at + _ASKED] = number

    def stopped(self) -> None:
        """Says that the process has taken the torque away from all wheels."""
        self._cells[self._at + _STOPPED] = 1

    @property
    def asked_by(self) -> int:
        """The signal that asked the process to end; 0: none."""
        return self._cells[self._at + _ASKED]

    @property
    def has_stopped(self) -> bool:
        """Whether the process has taken the torque away from all wheels."""
        return bool(self._cells[self._at + _STOPPED])

    def overdue_ns(self, now_ns: int) -> int:
        """Returns for how long the process has stood still."""
        due_ns = self._cells[self._at]
        return max(0, now_ns - due_ns) if due_ns else 0

    def standstill(self, now_ns: int) -> "Standstill":
        """Returns the longest time for which the process has stood still, up to `now_ns`."""
        self.late(now_ns)
        return Standstill(self._cells[self._at + _LATE], self._cells[self._at + _LATE_AT])


@dataclass(frozen=True, slots=True)
class Standstill:
    """The longest time for which a process stood still: longer than it had said, from `from_ns` of the monotonic clock on."""

    lasted_ns: int = 0
    from_ns: int = 0


class Shared:
    """The memory with the pulses, for a process that is just starting: pickled while that starts, it goes through the fork
    server.  (At other times multiprocessing would open a server and a thread for it.)"""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def __reduce__(self) -> tuple[Any, ...]:
        return _detached, (DupFd(self._fd),)


def _detached(passed: Any) -> int:
    """Returns the file descriptor that has been passed to this process."""
    fd: int = passed.detach()
    return fd


class Pulses:
    """The memory with the pulses of `count` processes, from the supervisor's side."""

    def __init__(self, count: int) -> None:
        self._fd = os.memfd_create("echelon-pulses", os.MFD_CLOEXEC)
        os.ftruncate(self._fd, count * _CELLS * 8)
        self._cells = memoryview(mmap.mmap(self._fd, 0)).cast("q")

    def of(self, number: int) -> Pulse:
        """Returns the pulse of a process."""
        return Pulse(self._cells, number)

    def shared(self) -> "Shared":
        """Returns what a process that is just starting gets.  There it is a file descriptor, for `Pulse.received`."""
        return Shared(self._fd)

    def close(self) -> None:
        """Closes the file; the memory lives as long as somebody uses it."""
        os.close(self._fd)
