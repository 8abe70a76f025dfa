"""What the supervisor of a run says to its processes, over their control pipes."""

from dataclasses import dataclass

from echelon.runtime.link import LinkCounts


@dataclass(frozen=True, slots=True)
class Start:
    """Begin; run time 0 is at this instant of the monotonic clock (wall clock)."""

    start_ns: int


@dataclass(frozen=True, slots=True)
class Finish:
    """For those who watch a run: it is over.  What they still have to expect, None where messages may be lost."""

    links: tuple[LinkCounts, ...]
    """Of all members, to be recorded"""
    robot_messages: int | None
    """All that the robots said"""
    messages: int | None
    """All that the members and the bridge said"""


@dataclass(frozen=True, slots=True)
class End:
    """All are done: close."""


Told = Start | Finish | End
"""All that a process may be told."""
