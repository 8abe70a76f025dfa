"""What a simulated CAN bus is to those who run it: frames and times in, frames with the instants they come at out.

`bridge.timing.arbitration` and `bridge.timing.ideal_bus` have the buses.  Pure; instants are integer nanoseconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Protocol

from echelon.bridge.protocols.frame import Frame


class Delivered(NamedTuple):
    """A frame that all others have: when it was put into its node's queue, and when its last bit was over."""

    queued_ns: int
    end_ns: int
    node: int
    frame: Frame


class BusEventKind(StrEnum):
    """What can happen to a node."""

    ERROR = "error"
    """A frame of the node was destroyed; noted only where a bus is asked to"""
    PASSIVE = "error passive"
    ACTIVE = "error active"
    """Error passive no longer"""
    OFF = "bus-off"
    RECOVERED = "recovered"
    """Bus-off no longer; error counters at zero"""


class BusEvent(NamedTuple):
    """What happened to a node, and when; the identifier is of the frame that was destroyed."""

    time_ns: int
    node: int
    kind: BusEventKind
    can_id: int | None = None


@dataclass(slots=True)
class Traffic:
    """What became of the frames of one identifier; latency is from the queue to the end of the frame."""

    sent: int = 0
    delivered: int = 0
    lost: int = 0
    """Did not fit into the queue"""
    retransmitted: int = 0
    """Attempts that were destroyed"""
    latency_sum_ns: int = 0
    latency_max_ns: int = 0

    @property
    def pending(self) -> int:
        """Waiting, or on the bus."""
        return self.sent - self.delivered - self.lost

    @property
    def latency_mean_ns(self) -> float:
        """Mean latency of what was delivered; 0 before."""
        return self.latency_sum_ns / self.delivered if self.delivered else 0.0

    def expire(self) -> None:
        """One that was delivered was too old to be of use: it counts as lost."""
        self.delivered -= 1
        self.lost += 1

    def deliver(self, latency_ns: int) -> None:
        """Counts one that was delivered."""
        self.delivered += 1
        self.latency_sum_ns += latency_ns
        if latency_ns > self.latency_max_ns:
            self.latency_max_ns = latency_ns


class BusModel(Protocol):
    """A bus to simulate with.  Time never runs backwards over all calls; the first may have any time.

    To answer frames at the instant they come: run to the earliest of `due_ns` and what else is due, and send then."""

    events: list[BusEvent]
    """What happened so far, in order of time."""

    @property
    def traffic(self) -> Mapping[int, Traffic]:
        """By identifier."""

    @property
    def due_ns(self) -> int | None:
        """Nothing is delivered earlier than this unless something is sent; None: nothing waits."""

    @property
    def busy_ns(self) -> int:
        """How long the bus was occupied so far, interframe spaces and destroyed frames included."""

    @property
    def load(self) -> float:
        """The share of the time since the first call that the bus was occupied."""

    def duration_ns(self, frame: Frame) -> int:
        """From the start of a frame to its delivery.  Raises ValueError for a frame that is none."""

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        """Puts a frame into a node's queue; False: the queue is full, the frame is lost.

        Raises ValueError for a time before the last call's, and for a frame that is none."""

    def hear(self, time_ns: int, frame: Frame, end_ns: int) -> None:
        """Takes note, at `time_ns`, of a frame of a node that is not in this model, which was over at `end_ns`: the bus was
        taken then, or will be taken before frames of lower priority.

        Raises ValueError for a time before the last call's, and for a frame that is none."""

    def run(self, until_ns: int) -> list[Delivered]:
        """Returns what was delivered up to `until_ns` and not returned before, in order of `end_ns`.

        What starts at `until_ns` itself is decided by the next call: frames sent at one instant compete together.
        Raises ValueError for a time before the last call's."""

    def set_error_rate(self, rate: float) -> None:
        """Sets the probability that an attempt to send is destroyed, for attempts from the last call's time on.

        Raises ValueError unless 0 <= rate <= 1."""

    def is_off(self, node: int) -> bool:
        """True if a node was off the bus at the last call's time."""

    def clear(self, node: int) -> int:
        """Loses what waits in a node's queue, but not a frame that is on the bus; returns how many frames that were."""

    def bus_off(self, node: int) -> None:
        """Takes a node off the bus at the last call's time; a frame of its own that is on the bus still gets through."""
