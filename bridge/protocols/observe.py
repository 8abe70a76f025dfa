"""The interface of an observer: a passive listener to a robot's frames, which every protocol has."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from echelon.bridge.protocols.frame import Frame


class Finding(NamedTuple):
    """A frame, or a missing frame, that breaks the protocol or the plan.

    `kind` is a short name by which findings are counted; `text` describes this one."""

    time_ns: int
    can_id: int
    kind: str
    text: str


@dataclass(slots=True)
class WheelReading:
    """The last values of one wheel on the bus; None: none so far."""

    commanded: float | None = None
    """Wheel torque of the last command [N m]"""
    commanded_ns: int | None = None
    """When the last command came [ns]"""
    reported: float | None = None
    """Wheel torque of the last feedback [N m]"""
    reported_ns: int | None = None
    """When the last feedback came [ns]"""
    speed: float | None = None
    """Wheel speed of the last feedback [rad/s]"""
    state: str = ""
    """The drive's last reported state, in the protocol's words"""
    fault: str = ""
    """The drive's last reported fault, in the protocol's words; empty without one"""


class Observer(Protocol):
    """Listens to the frames of one robot, commands and feedback, and checks them against the protocol."""

    wheels: tuple[WheelReading, WheelReading]
    """Right and left"""

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it looks at."""

    @property
    def cyclic(self) -> dict[int, int]:
        """Cyclic identifiers with their periods [ns]."""

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns its findings."""
