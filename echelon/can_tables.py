"""The part of a scenario that concerns the CAN bus: drives, envelope, buses, and what happens on schedule."""

from typing import Annotated, Literal

from pydantic import Field

from echelon.part_fields import ProtocolField
from echelon.values import (
    Bitrate,
    Constant,
    ConstantOrZero,
    Finite,
    Flag,
    Fraction,
    Limit,
    Name,
    NodeId,
    Positive,
    Seconds,
    SecondsOrZero,
    Table,
)


class DriveTable(Table):
    """The drives of a robot's wheels, and their motors; both wheels have the same."""

    protocol: ProtocolField = None
    """By its name, as a table with `use` and `parameters`, or as "file.py:Class" (echelon.plugins)"""
    node_ids: tuple[NodeId, NodeId] | None = None
    """Of the right and the left wheel's drive; unless given, the lowest whose identifiers nobody on the bus uses"""
    recover_after: Seconds | None = None
    """So long after a fault the bridge clears it and enables the drive anew [s]; never unless given"""
    torque_limit: Constant | None = None
    """Largest torque of the motor [N m]; the robot's limit unless given"""
    rated_torque: Constant | None = None
    """Torque that the motor can give for ever [N m]"""
    torque_slew: Limit | None = None
    """Largest change of torque [N m/s]"""
    lag: ConstantOrZero | None = None
    """Time constant of the current loop [s]"""
    torque_constant: Constant | None = None
    """K_t [N m/A]"""
    resistance: ConstantOrZero | None = None
    """Of the winding, which its current heats [Ω]"""
    thermal_resistance: Constant | None = None
    """From winding to ambient [K/W]"""
    thermal_time: Constant | None = None
    """Time constant of the winding's temperature [s]"""
    ambient: Finite | None = None
    """[°C]"""
    derating_from: Finite | None = None
    """From this temperature on the torque limit falls [°C], linearly, to zero at `temperature_limit`"""
    temperature_limit: Finite | None = None
    """Over-temperature fault from here on [°C]"""
    supply_voltage: Constant | None = None
    """[V]"""
    supply_resistance: ConstantOrZero | None = None
    """Of battery and cables [Ω]"""
    brown_out: ConstantOrZero | None = None
    """Under this voltage the drive gives up [V]"""
    encoder_counts: Annotated[int, Field(strict=True, ge=1, le=1 << 24)] | None = None
    """Per revolution of the wheel"""
    inertia: Constant | None = None
    """Of a wheel on a bench, where no robot turns it [kg m²]"""
    friction: ConstantOrZero | None = None
    """Of that wheel [N m s/rad]"""


class EnvelopeTable(Table):
    """The last gate before the bus: what it does not let pass becomes zero torque, and is counted."""

    torque_limit: Limit | None = None
    """Largest torque of a wheel [N m]"""
    rise_limit: Limit | None = None
    """Largest growth of a torque's magnitude from frame to frame [N m]"""
    fall_limit: Limit | None = None
    """Largest decrease of a torque's magnitude from frame to frame [N m]"""
    window_limit: Limit | None = None
    """Largest difference between two torques within 250 ms [N m]"""
    stale_after: Seconds | None = None
    """Age from which on a robot's torque is not used any more [s]; `can.watchdog` unless given"""


class Bus(Table):
    """One of several buses."""

    url: str | None = None
    bitrate: Bitrate | None = None


class Can(Table):
    """The CAN bus, or buses."""

    enabled: Flag = True
    url: str = "auto"
    """`socketcan:vcan0`, `udp_multicast:…`, `virtual`; `auto` takes vcan0 where it is up, else udp_multicast"""
    bitrate: Bitrate = 1_000_000
    """[bit/s]"""
    buses: dict[Name, Bus] = {}
    """Several buses by name, each with a `url` and a `bitrate` of its own if need be; robots say theirs with `bus`"""
    torque_scale: Positive = 0.001
    """Newton metres per bit where a frame has torques as whole numbers; ±32767 bits fit"""
    path: Literal["mirror", "closed"] = "mirror"
    """`mirror`: the plant takes the computed torque, the bus shows it.  `closed`: the plant takes what the drives report,
    which is what they decoded from the frames"""
    timing: Literal["bits", "ideal"] | None = None
    """How long frames take on the closed path: as on a real bus (`bits`), or no time at all (`ideal`).  In virtual time `bits`
    unless given; on a wall clock a bus takes its own time unless `bits` is given, which makes a virtual one as slow as a
    real one"""
    virtual_drives: Flag = True
    """On the closed path: False leaves the bus to drives that are there already (wall clock only)"""
    watchdog: Seconds = 0.1
    """A drive that hears no torque, and a bridge that hears no robot, for so long take the torque away [s]"""
    bring_up: Seconds = 1.0
    """How long before run time 0 the bridge begins to enable the drives [s]"""
    queue: Annotated[int, Field(strict=True, ge=1, le=100_000)] = 256
    """Frames that may wait to be sent, in the bridge and in each drive, before further ones are lost"""
    restart: SecondsOrZero = 0.1
    """How long a controller that went bus-off waits before it tries to come back [s]"""


class DriveFault(Table):
    """A fault of a drive."""

    kind: Literal["drive_fault"]
    at: SecondsOrZero
    """[s]"""
    duration: Seconds | None = None
    """Until its cause goes away [s]; never unless given.  What it latched stays latched until it is cleared"""
    robot: str = "**"
    """A path in the tree, which may hold `*` and `**`"""
    wheel: Literal["right", "left", "both"] = "both"
    fault: Literal["over_temperature", "encoder_loss", "brown_out", "stuck_torque", "silent"]


class Estop(Table):
    """Emergency stop, each protocol's own: drives take the torque away by themselves and stay disabled, for good unless it has
    a `duration`."""

    kind: Literal["estop"]
    at: SecondsOrZero
    duration: Seconds | None = None
    robot: str = "**"


class ErrorFrames(Table):
    """Disturbances on a bus: each attempt to send a frame is destroyed with a probability, and repeated (timing `bits`)."""

    kind: Literal["error_frames"]
    at: SecondsOrZero
    duration: Seconds | None = None
    bus: Name | None = None
    """All buses unless given"""
    rate: Fraction


class BusOff(Table):
    """A CAN controller goes bus-off, and comes back after `can.restart` and 128 times 11 idle bits (timing `bits`)."""

    kind: Literal["bus_off"]
    at: SecondsOrZero
    bus: Name | None = None
    robot: str | None = None
    """Whose drives' controllers; the bridge's unless given"""


Event = Annotated[DriveFault | Estop | ErrorFrames | BusOff, Field(discriminator="kind")]
