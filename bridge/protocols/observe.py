"""What a passive listener makes of a robot's frames: the interface that every protocol fills, and checks they share."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from echelon.bridge.protocols.frame import Frame


class Finding(NamedTuple):
    """Something on the bus that must not be: when, which identifier, what kind (short, to count by), and in words."""

    time_ns: int
    can_id: int
    kind: str
    text: str


@dataclass(slots=True)
class WheelReading:
    """What the bus last said of one wheel; None is: not yet."""

    commanded: float | None = None
    """Wheel torque of the last command [N m]"""
    commanded_ns: int | None = None
    reported: float | None = None
    """Wheel torque of the last feedback [N m]"""
    reported_ns: int | None = None
    speed: float | None = None
    """Wheel speed of the last feedback [rad/s]"""
    state: str = ""
    """The drive's state as it says, in the protocol's words"""
    fault: str = ""
    """What it says is wrong, in the protocol's words; empty if nothing"""


class Observer(Protocol):
    """Listens to the frames of one robot, commands and feedback, and holds them against the protocol."""

    wheels: tuple[WheelReading, WheelReading]
    """Right and left"""

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it looks at."""

    @property
    def cyclic(self) -> dict[int, int]:
        """Identifiers that must come regularly, with their periods [ns]."""

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns what is wrong with it."""
