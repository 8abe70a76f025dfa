"""The part of a plan that concerns the CAN bus: motors, drives, envelopes, buses, events, and the roles bridge and drives."""

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol

from echelon.plugins import Part

NEVER_NS = 1 << 62
"""An instant later than any instant of a run [ns]"""


@dataclass(frozen=True, slots=True)
class MotorPlan:
    """The motor of a wheel and its power stage, in SI units; temperatures in °C."""

    torque_limit: float
    """Largest shaft torque [N m]"""
    rated_torque: float
    """Torque that the motor can hold without time limit [N m]"""
    torque_slew: float
    """Largest rate of change of the setpoint [N m/s]"""
    lag: float
    """Time constant of the current loop [s]; 0: the torque follows at once"""
    torque_constant: float
    """Torque constant K_t [N m/A]"""
    resistance: float
    """Resistance of the winding [Ω]; it is heated by resistance · current²"""
    thermal_resistance: float
    """Thermal resistance from winding to ambient [K/W]"""
    thermal_time: float
    """Time constant of the winding's temperature [s]"""
    ambient: float
    """Temperature around the motor [°C]"""
    derating_from: float
    """Winding temperature from which the torque limit falls, linearly to zero at `temperature_limit` [°C]"""
    temperature_limit: float
    """Winding temperature at which the drive raises an over-temperature fault [°C]"""
    supply_voltage: float
    """Supply voltage without load [V]"""
    supply_resistance: float
    """Resistance of battery and cables [Ω]; the supply voltage falls with the current that the motor draws"""
    brown_out: float
    """Supply voltage below which the drive raises a brown-out fault [V]"""
    encoder_counts: int
    """Encoder counts per revolution of the wheel"""
    inertia: float
    """Inertia of a wheel that turns freely on a bench, without a robot [kg m²]"""
    friction: float
    """Viscous friction of a wheel on a bench [N m s/rad]"""


class Addressing(Protocol):
    """The part of a drive protocol (bridge.protocols.protocol.DriveProtocol) that planning uses: its use of identifiers."""

    wheels: ClassVar[tuple[tuple[int, ...], ...]]
    """The wheels (0 right, 1 left) of each drive of a robot"""
    nodes: ClassVar[range]
    """Node ids that a drive may have"""
    by_number: ClassVar[bool]
    """True if the node id of a robot's drives is the robot's number and cannot be chosen"""

    def identifiers(self, node: int) -> frozenset[int]:
        """Returns the identifiers of the frames that only this node sends or receives."""

    def shared_identifiers(self) -> frozenset[int]:
        """Returns the identifiers that all drives of the protocol on a bus share."""

    def refuses(self, motor: MotorPlan) -> str:
        """Returns why the protocol cannot be used with a motor, beginning with the key; an empty string if it can."""


@dataclass(frozen=True, slots=True)
class DrivePlan:
    """The drives of a robot's wheels.  The motors of both wheels are alike."""

    protocol: Part[Any]
    """A bridge.protocols.protocol.DriveProtocol"""
    bus: int
    """Number of the bus in the plan"""
    node_ids: tuple[int, int]
    """Node ids of the right and the left wheel's drive; the same number twice if one drive has both wheels"""
    period_ns: int
    """Time between two torque frames, and between two feedback frames [ns]"""
    watchdog_ns: int
    """A drive that receives no command for this time takes the torque away and latches a fault [ns]"""
    torque_scale: float
    """Torque per bit in frames that hold torques as whole numbers [N m]"""
    recover_ns: int | None
    """Time after a fault at which the host clears it and enables the drive again [ns]; None: never"""
    motor: MotorPlan


@dataclass(frozen=True, slots=True)
class EnvelopePlan:
    """Limits of the last gate before the bus, for each wheel."""

    torque_limit: float
    """Largest magnitude of a torque [N m]"""
    rise_limit: float
    """Largest growth of a torque's magnitude from frame to frame [N m]"""
    fall_limit: float
    """Largest decrease of a torque's magnitude from frame to frame [N m]"""
    window_limit: float
    """Largest difference between two torques within 250 ms [N m]"""
    stale_ns: int
    """Largest age of a command that may still become a frame [ns]"""


@dataclass(frozen=True, slots=True)
class BusPlan:
    """A CAN bus: its name, its address, its bit rate [bit/s]."""

    name: str
    url: str
    bitrate: int


@dataclass(frozen=True, slots=True)
class CanPlan:
    """The buses, and the path of the torques.

    `path` is `mirror` or `closed`.  `timing` is `bits` (frames take time as on a real bus) or `ideal` (they take none).  The
    other fields are those of the scenario's table `can` (echelon.scenario.can_tables), times in nanoseconds."""

    enabled: bool
    buses: tuple[BusPlan, ...]
    torque_scale: float
    path: str
    timing: str
    paced: bool
    """True if frames take as long as `timing` says on a wall clock as well; otherwise the bus takes its own time there"""
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
"""Kinds of events that disturb a bus"""


@dataclass(frozen=True, slots=True)
class EventPlan:
    """A scheduled event from `at_ns` until `until_ns`.  Its kinds, and the fields that each needs, are in
    echelon.scenario.can_tables."""

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
    """Run time at which it begins [ns]; negative, because the drives are brought up before run time 0"""

    @property
    def name(self) -> str:
        """Its name in texts: the role."""
        return self.role

    @property
    def path(self) -> str:
        """Its place in the keys of messages; no group can have this path."""
        return f"@{self.role}"
