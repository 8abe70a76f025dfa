"""The interface of a simulated CAN bus: frames and instants in, frames with the instants of their delivery out.

The buses are in `bridge.timing.arbitration` and `bridge.timing.ideal_bus`.  Pure; instants are integer nanoseconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Protocol

from echelon.bridge.protocols.frame import Frame


class Delivered(NamedTuple):
    """A frame that all other nodes have received.

    `queued_ns` is when its node queued it, `end_ns` the end of its last bit."""

    queued_ns: int
    end_ns: int
    node: int
    frame: Frame


class BusEventKind(StrEnum):
    """What can happen to a node."""

    ERROR = "error"
    """A frame of the node was destroyed; only a bus with `note_errors` has this event"""
    PASSIVE = "error passive"
    ACTIVE = "error active"
    """The node is error active again after it was error passive"""
    OFF = "bus-off"
    RECOVERED = "recovered"
    """The node is no longer bus-off; its error counters are zero"""


class BusEvent(NamedTuple):
    """An event at a node; `can_id` is the identifier of a destroyed frame."""

    time_ns: int
    node: int
    kind: BusEventKind
    can_id: int | None = None


@dataclass(slots=True)
class Traffic:
    """Counts of the frames with one identifier; latency is the time from the queue to the end of the frame."""

    sent: int = 0
    delivered: int = 0
    lost: int = 0
    """Frames that found the queue full, or were removed from it"""
    retransmitted: int = 0
    """Attempts that were destroyed; each is repeated"""
    latency_sum_ns: int = 0
    latency_max_ns: int = 0

    @property
    def pending(self) -> int:
        """Number of frames that wait or are on the bus."""
        return self.sent - self.delivered - self.lost

    @property
    def latency_mean_ns(self) -> float:
        """Mean latency of the delivered frames [ns]; 0 before the first."""
        return self.latency_sum_ns / self.delivered if self.delivered else 0.0

    def expire(self) -> None:
        """Counts a delivered frame as lost instead: it was too old to be of use."""
        self.delivered -= 1
        self.lost += 1

    def deliver(self, latency_ns: int) -> None:
        """Counts a delivered frame."""
        self.delivered += 1
        self.latency_sum_ns += latency_ns
        if latency_ns > self.latency_max_ns:
            self.latency_max_ns = latency_ns


class BusModel(Protocol):
    """A simulated bus.  Time must not run backwards from call to call; the first call may have any time.

    To answer a frame at the instant of its delivery, call `run` for the earlier of `due_ns` and the caller's next instant, then
    `send` the answer."""

    events: list[BusEvent]
    """All events so far, in order of time."""

    @property
    def traffic(self) -> Mapping[int, Traffic]:
        """Counts by identifier."""

    @property
    def due_ns(self) -> int | None:
        """No frame is delivered before this instant unless another frame is sent; None: no frame waits."""

    @property
    def busy_ns(self) -> int:
        """Time for which the bus was occupied so far [ns], interframe spaces and destroyed frames included."""

    @property
    def load(self) -> float:
        """Share of the time since the first call for which the bus was occupied."""

    def duration_ns(self, frame: Frame) -> int:
        """Returns the time from the start of a frame to its delivery [ns].  Raises ValueError for an invalid frame."""

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        """Puts a frame into a node's queue.  Returns False if the queue is full and the frame is lost.

        Raises ValueError for a time before the last call's, and for an invalid frame."""

    def hear(self, time_ns: int, frame: Frame, end_ns: int) -> None:
        """Notes at `time_ns` a frame of another process, which was over at `end_ns` on the real bus.

        The model counts the bus as occupied by it: just before, if the bus was free; otherwise later, by priority.
        Raises ValueError for a time before the last call's, and for an invalid frame."""

    def run(self, until_ns: int) -> list[Delivered]:
        """Returns the frames that were delivered up to `until_ns` and not returned before, in order of `end_ns`.

        An attempt at `until_ns` itself starts with the next call only, so that all frames sent at that instant compete.
        Raises ValueError for a time before the last call's."""

    def set_error_rate(self, rate: float) -> None:
        """Sets the probability that an attempt to send is destroyed, for attempts from the last call's time on.

        Raises ValueError unless 0 <= rate <= 1."""

    def is_off(self, node: int) -> bool:
        """True if a node was off the bus at the last call's time."""

    def clear(self, node: int) -> int:
        """Empties a node's queue, except for a frame on the bus; returns the number of lost frames."""

    def bus_off(self, node: int) -> None:
        """Makes a node bus-off at the last call's time.  A frame of the node that is on the bus is still delivered."""
