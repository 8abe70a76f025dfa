"""The part of a plan that concerns the CAN bus: motors, drives, envelopes, buses, events, and who is in between."""

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol

from echelon.plugins import Part

NEVER_NS = 1 << 62
"""Later than any instant of a run."""


@dataclass(frozen=True, slots=True)
class MotorPlan:
    """The motor of a wheel and its power stage, SI units, temperatures in °C."""

    torque_limit: float
    """Largest shaft torque [N m]"""
    rated_torque: float
    """Torque it can give for ever [N m]"""
    torque_slew: float
    """Largest change of the setpoint [N m/s]"""
    lag: float
    """Time constant of the current loop [s]; 0: the torque follows at once"""
    torque_constant: float
    """K_t [N m/A]"""
    resistance: float
    """Of the winding [Ω]: it is heated by resistance · current²"""
    thermal_resistance: float
    """Winding to ambient [K/W]"""
    thermal_time: float
    """Time constant of the winding's temperature [s]"""
    ambient: float
    derating_from: float
    """The torque limit falls linearly to zero from here to `temperature_limit`"""
    temperature_limit: float
    """Over-temperature fault from here on"""
    supply_voltage: float
    supply_resistance: float
    """Of battery and cables [Ω]: the bus voltage falls with the current that the motor draws"""
    brown_out: float
    """Under this bus voltage the drive gives up [V]"""
    encoder_counts: int
    """Per revolution of the wheel"""
    inertia: float
    """What the motor turns where no robot does [kg m²]: a wheel on a bench"""
    friction: float
    """The same wheel's friction [N m s/rad]"""


class Addressing(Protocol):
    """What planning asks of a drive protocol (bridge.protocols.protocol.DriveProtocol): where drives are on a bus."""

    wheels: ClassVar[tuple[tuple[int, ...], ...]]
    """The wheels (0 right, 1 left) of each drive of a robot"""
    nodes: ClassVar[range]
    """Node ids that a drive may have"""
    by_number: ClassVar[bool]
    """A robot's number is the node id of its drives, which cannot be chosen"""

    def identifiers(self, node: int) -> frozenset[int]:
        """Returns the identifiers of the frames that a node alone sends or is sent."""

    def shared_identifiers(self) -> frozenset[int]:
        """Returns the identifiers that all drives of the protocol on a bus share."""

    def refuses(self, motor: MotorPlan) -> str:
        """Returns what the protocol cannot say of a motor, beginning with the key; empty if it can say all."""


@dataclass(frozen=True, slots=True)
class DrivePlan:
    """The drives of a robot's wheels: their protocol, their place on the bus, their motor (both wheels have the same)."""

    protocol: Part[Any]
    """A bridge.protocols.protocol.DriveProtocol"""
    bus: int
    """Which of the plan's buses"""
    node_ids: tuple[int, int]
    """Of the right and the left wheel's drive; twice the same where one drive has both wheels"""
    period_ns: int
    """Between two torque frames, and between two feedback frames"""
    watchdog_ns: int
    """A drive that hears no command for so long stops, and stays stopped"""
    torque_scale: float
    """Of frames with torques in whole numbers [N m per bit]"""
    recover_ns: int | None
    """So long after a fault the host clears it and enables the drive anew; None: never"""
    motor: MotorPlan


@dataclass(frozen=True, slots=True)
class EnvelopePlan:
    """What the last gate before the bus lets pass, for each wheel."""

    torque_limit: float
    """[N m]"""
    rise_limit: float
    """Largest growth of a torque's magnitude from frame to frame [N m]"""
    fall_limit: float
    """Largest decrease of a torque's magnitude from frame to frame [N m]"""
    window_limit: float
    """Largest difference between two torques within 250 ms [N m]"""
    stale_ns: int
    """Oldest command that may still become a frame"""


@dataclass(frozen=True, slots=True)
class BusPlan:
    """A CAN bus: its name, where it is, how fast [bit/s]."""

    name: str
    url: str
    bitrate: int


@dataclass(frozen=True, slots=True)
class CanPlan:
    """The buses, and the way of the torques: `mirror` or `closed`, frames taking time as on a real bus (`bits`) or none."""

    enabled: bool
    buses: tuple[BusPlan, ...]
    torque_scale: float
    path: str
    timing: str
    paced: bool
    """On a wall clock, too, frames take as long as `timing` says; otherwise the bus takes its own time"""
    virtual_drives: bool
    watchdog_ns: int
    bring_up_ns: int
    queue: int
    restart_ns: int

    @property
    def closed(self) -> bool:
        """True if the plant takes its torque from the drives."""
        return self.path == "closed"


DISTURBANCES: Final = ("error_frames", "bus_off")
"""Kinds of events that buses suffer."""


@dataclass(frozen=True, slots=True)
class EventPlan:
    """Something that happens from `at_ns` until `until_ns`: a kind and what it needs (echelon.scenario.can_tables)."""

    kind: str
    at_ns: int
    until_ns: int
    robots: tuple[int, ...] = ()
    wheels: tuple[int, ...] = (0, 1)
    fault: str = ""
    buses: tuple[int, ...] = ()
    rate: float = 0.0


@dataclass(frozen=True, slots=True)
class BusRolePlan:
    """A role between robots and their wheels, on the closed torque path: the bridge, or the virtual drives."""

    index: int
    role: str
    period_ns: int
    first_ns: int
    """When it begins, before the run: drives are brought up until 0"""

    @property
    def name(self) -> str:
        """What people call it."""
        return self.role

    @property
    def path(self) -> str:
        """Its place among the keys, which no group can have."""
        return f"@{self.role}"
