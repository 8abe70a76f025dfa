"""What all drive protocols share: the frame, and what a virtual drive, its host and a bus's master are to those who run them.

All are plain objects: frames and the time in, frames out.  They never wait, read no clock and send nothing themselves.
What comes from the bus is checked, counted in `refused`, and dropped; it never raises.
"""

from collections import Counter
from typing import Final, NamedTuple, Protocol

from echelon.bridge.protocols.motor import Fault, Motor
from echelon.plan.can_plan import DrivePlan

WHEELS: Final = ("right", "left")
"""The wheels of a robot, in the order of all pairs"""


class Frame(NamedTuple):
    """A classic CAN frame with an 11-bit identifier; a remote frame (RTR) has no data."""

    can_id: int
    data: bytes = b""
    remote: bool = False


def recovers_after_ns(plan: DrivePlan, time_ns: int) -> int | None:
    """Returns how long after a fault a host clears it; None: never.

    Before run time 0, when drives are brought up, at once: they may be as an earlier run left them."""
    return 0 if time_ns < 0 else plan.recover_ns


class Drive(Protocol):
    """A virtual drive: what answers on the bus, with the motor of one wheel or of both.

    Time never runs backwards; before a frame is handed over, `advance` is called for its time.
    """

    motors: tuple[Motor, ...]
    refused: Counter[str]
    """Frames that were refused, by reason."""

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it listens to."""

    @property
    def due_ns(self) -> int:
        """When it next has something to do on its own."""

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a frame; returns what it answers at once."""

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns what it sends on its own until then, what is due at `time_ns` included."""

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault happen at one wheel (0 right, 1 left), on demand."""

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Takes the cause of a fault away; what it latched stays latched until it is cleared over the bus."""


class Host(Protocol):
    """What commands a robot's drives: the bridge's side of a protocol, for both wheels of one robot.

    A cycle is `poll`, then `command`, once per period, and `receive` for each frame that comes in between.
    """

    refused: Counter[str]
    """Frames that were refused, by reason."""
    clipped: int
    """Torques that were cut to what a frame can carry."""

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it listens to."""

    @property
    def torque(self) -> tuple[float, float]:
        """Torque of the right and left wheel as the drives last reported it [N m]; zeros before the first report."""

    @property
    def torque_ns(self) -> int | None:
        """When that report came; None before the first."""

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, as far as their drives said."""

    @property
    def fault(self) -> str:
        """What a drive reports to be wrong, in words; empty if nothing is."""

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns what is due besides torques: to bring drives up, keep them alive, or clear a fault and enable anew."""

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m], finite ones; zeros are sent while a drive is not enabled."""

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives; they stay so until `start`."""

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the protocol's own emergency stop: drives take the torque away by themselves; they stay so until `start`.

        `poll` and `command` repeat it where it seems to be lost."""

    def start(self) -> None:
        """Lets `poll` enable the drives (again), whatever was wrong until then.  A new host is started."""

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the frames that carry wheel torques [N m], finite ones, and nothing else, whatever drives say: those of a
        mirrored torque path, where nobody answers.  Unless `enable`, they ask for no torque."""


class Master(Protocol):
    """What a bus has one of, whatever the number of robots on it: who keeps its time."""

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns what is due; to be called once per period, early or late by less than half of it."""

    def sync(self) -> Frame | None:
        """Returns the frame whose end is the end of a period, if there is one: drives sample then what they report."""
