"""The frame, and the interfaces of virtual drive, host and master, which all drive protocols share.

All of them are plain objects: frames and the time in, frames out.  They never wait, read no clock and send nothing themselves.
Frames from the bus never raise: an invalid frame is counted in `refused` by its reason and dropped.
"""

from collections import Counter
from typing import Final, NamedTuple, Protocol

from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.motor import Motor
from echelon.plan.can_plan import DrivePlan

WHEELS: Final = ("right", "left")
"""The wheels of a robot; all pairs of wheel values have this order"""


class Frame(NamedTuple):
    """A classic CAN frame with an 11-bit identifier; a remote frame (RTR) has no data."""

    can_id: int
    data: bytes = b""
    remote: bool = False


def recovers_after_ns(plan: DrivePlan, time_ns: int) -> int | None:
    """Returns how long after a fault a host clears it [ns]; None: never.

    Before run time 0 it clears faults at once: they may be left over from an earlier run."""
    return 0 if time_ns < 0 else plan.recover_ns


class Drive(Protocol):
    """A virtual drive: a node on the bus with the motor of one wheel or of both wheels.

    Time never runs backwards.  The caller calls `advance` for the time of a frame before it calls `receive`.
    """

    motors: tuple[Motor, ...]
    refused: Counter[str]
    """Refused frames, by reason."""

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""

    @property
    def due_ns(self) -> int:
        """When `advance` must be called next."""

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a frame; returns the immediate answers."""

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns the frames that the drive sends by itself up to and including `time_ns`."""

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault happen at one wheel (0 right, 1 left); returns the frames that are due."""

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Takes the cause of a fault away.  A latched fault stays until it is cleared over the bus."""


class Host(Protocol):
    """The bridge's side of a protocol: it commands the drives of both wheels of one robot.

    In each period the caller calls `poll` and then `command`, and `receive` for each frame that comes in between.
    """

    refused: Counter[str]
    """Refused frames, by reason."""
    clipped: int
    """Number of torques that were cut to the range of a frame."""

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""

    @property
    def torque(self) -> tuple[float, float]:
        """The last reported torques of the right and the left wheel [N m]; zeros before the first report."""

    @property
    def torque_ns(self) -> int | None:
        """When that report came [ns]; None before the first.  With a drive per wheel it is the older of both."""

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, by what their drives reported."""

    @property
    def fault(self) -> str:
        """The present fault of the drives in words; empty without one."""

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns all due frames except torques: they bring drives up, keep them alive, clear faults and enable again."""

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for finite wheel torques [N m].  It sends zeros until both wheels are enabled."""

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives.  They stay disabled until `start`."""

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the protocol's own emergency stop, by which drives take the torque away themselves, until `start`.

        `poll` and `command` repeat it if it seems to be lost."""

    def start(self) -> None:
        """Lets `poll` enable the drives (again), whatever was wrong before.  A new host is started already."""

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the frames for finite wheel torques [N m] on the mirrored path, where no drive answers.

        They do not depend on what drives reported.  Without `enable` they command zero torque."""


class Master(Protocol):
    """The frames that a bus needs once, whatever the number of robots on it: SYNC and the host's heartbeat."""

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns the due frames; must be called once per period, early or late by less than half a period."""

    def sync(self) -> Frame | None:
        """Returns the frame that must end with a period, since drives sample their feedback then; None: there is none."""
