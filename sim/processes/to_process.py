"""The supervisor's orders to the processes of a run, over their control pipes."""

from dataclasses import dataclass

from echelon.runtime.link import LinkCounts


@dataclass(frozen=True, slots=True)
class Start:
    """Begin.  On a wall clock, run time 0 is at this instant of the monotonic clock."""

    start_ns: int


@dataclass(frozen=True, slots=True)
class BreakOff:
    """To the referee: the run breaks off, and the bridge stops the wheels, or has stopped them."""


@dataclass(frozen=True, slots=True)
class Finish:
    """To watchers: the run is over.  The numbers of messages are None if messages may be lost."""

    links: tuple[LinkCounts, ...]
    """Counts of all links, to be recorded"""
    robot_messages: int | None
    """Number of messages that the robots sent"""
    messages: int | None
    """Number of messages that all members and the bridge sent"""
    wheels_stopped_ns: int | None = None
    """When the bridge stopped the wheels [ns of run time]; None if it has not said"""


@dataclass(frozen=True, slots=True)
class End:
    """All processes are done: close."""


Told = Start | BreakOff | Finish | End
"""Any order to a process."""
