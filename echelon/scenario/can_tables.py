"""The part of a scenario that concerns the CAN bus: drives, envelope, buses, and what happens on schedule."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from echelon.scenario.part_fields import ProtocolField
from echelon.scenario.values import (
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
    alike,
)


class DriveTable(Table):
    """The drives of a robot's wheels, and their motors; both wheels have the same."""

    protocol: ProtocolField = None
    """`native` (one frame for both wheels, counter and CRC; the default), `odrive` (CANSimple 0.6), `cia402` (cyclic
    synchronous torque over CANopen), or your own"""
    node_ids: tuple[NodeId, NodeId] | None = None
    """Of the right and the left wheel's drive; unless given, the lowest whose identifiers nobody on the bus uses"""
    recover_after: Seconds | None = None
    """How long after a fault the bridge clears it and enables the drive anew [s]; never unless given"""
    torque_limit: Constant | None = None
    """Largest torque of the motor [N m]; the robot's limit unless given"""
    rated_torque: Constant | None = None
    """Torque that the motor can give for ever [N m], of which CiA 402 counts in thousandths; `torque_limit` unless given"""
    torque_slew: Limit | None = None
    """Largest change of torque [N m/s]; none unless given"""
    lag: ConstantOrZero | None = None
    """Time constant of the current loop [s]; 0 unless given: the torque follows at once"""
    torque_constant: Constant | None = None
    """K_t [N m/A]; 0.1 unless given"""
    resistance: ConstantOrZero | None = None
    """Of the winding, which its current heats [Ω]; 0 unless given"""
    thermal_resistance: Constant | None = None
    """From winding to ambient [K/W]; 2 unless given"""
    thermal_time: Constant | None = None
    """Time constant of the winding's temperature [s]; 60 unless given"""
    ambient: Finite | None = None
    """Temperature around the motor [°C]; 25 unless given"""
    derating_from: Finite | None = None
    """From this temperature on the torque limit falls [°C], linearly, to zero at `temperature_limit`; 80 unless given"""
    temperature_limit: Finite | None = None
    """From this temperature on there is an over-temperature fault [°C]; 100 unless given"""
    supply_voltage: Constant | None = None
    """[V]; 24 unless given"""
    supply_resistance: ConstantOrZero | None = None
    """Of battery and cables [Ω]; 0 unless given"""
    brown_out: ConstantOrZero | None = None
    """Under this voltage the drive gives up [V]; 18 unless given"""
    encoder_counts: Annotated[int, Field(strict=True, ge=1, le=1 << 24)] | None = None
    """Per revolution of the wheel; 4096 unless given"""
    inertia: Constant | None = None
    """Of a wheel on a bench, where no robot turns it (`echelon drives`) [kg m²]; 0.01 unless given"""
    friction: ConstantOrZero | None = None
    """Of that wheel [N m s/rad]; 0.01 unless given"""


class EnvelopeTable(Table):
    """The last gate before the bus: what it does not let pass becomes zero torque, and is counted."""

    torque_limit: Limit | None = None
    """Largest torque of a wheel [N m]; the robot's limit unless given"""
    rise_limit: Limit | None = None
    """Largest growth of a torque's magnitude from frame to frame [N m]; none unless given"""
    fall_limit: Limit | None = None
    """Largest decrease of a torque's magnitude from frame to frame [N m]; none unless given"""
    window_limit: Limit | None = None
    """Largest difference between two torques within 250 ms [N m]; none unless given"""
    stale_after: Seconds | None = None
    """Age from which on a robot's torque is not used any more [s]; `can.watchdog` unless given"""


class Bus(Table):
    """One of several buses."""

    url: str | None = None
    """Where it is; `can.url` unless given"""
    bitrate: Bitrate | None = None
    """[bit/s]; `can.bitrate` unless given"""


class Can(Table):
    """The CAN bus, or buses."""

    enabled: Flag = True
    """False: there are no frames"""
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
    """A drive that hears no command for this time, and a bridge that hears no robot, take the torque away [s]"""
    bring_up: Seconds = 1.0
    """How long before run time 0 the bridge begins to enable the drives [s]"""
    queue: Annotated[int, Field(strict=True, ge=1, le=100_000)] = 256
    """Frames that may wait to be sent, in the bridge and in each drive, before further ones are lost"""
    restart: SecondsOrZero = 0.1
    """How long a controller that went bus-off waits before it tries to come back [s]"""

    @model_validator(mode="after")
    def _names(self) -> "Can":
        if (name := alike(self.buses)) is not None:
            raise ValueError(f"buses: {name!r} must differ from other names by more than hyphens and underscores")
        return self


class DriveFault(Table):
    """A fault of a drive."""

    kind: Literal["drive_fault"]
    """Something breaks in a drive"""
    at: SecondsOrZero
    """When it begins [s of run time]"""
    duration: Seconds | None = None
    """Until its cause goes away [s]; never unless given.  What it latched stays latched until it is cleared"""
    robot: str = "**"
    """Whose drives: a path in the tree, which may hold `*` and `**`"""
    wheel: Literal["right", "left", "both"] = "both"
    """Which of its wheels"""
    fault: Literal["over_temperature", "encoder_loss", "brown_out", "stuck_torque", "silent"]
    """What breaks"""


class Estop(Table):
    """Emergency stop, each protocol's own: drives take the torque away by themselves and stay disabled, for good unless it has
    a `duration`."""

    kind: Literal["estop"]
    """Somebody presses the button"""
    at: SecondsOrZero
    """When [s of run time]"""
    duration: Seconds | None = None
    """How long the button stays pressed [s]; for ever unless given"""
    robot: str = "**"
    """Whose drives: a path in the tree, which may hold `*` and `**`"""


class ErrorFrames(Table):
    """Disturbances on a bus: each attempt to send a frame is destroyed with a probability, and repeated (timing `bits`)."""

    kind: Literal["error_frames"]
    """A bus is disturbed"""
    at: SecondsOrZero
    """When it begins [s of run time]"""
    duration: Seconds | None = None
    """How long it lasts [s]; for ever unless given"""
    bus: Name | None = None
    """Which bus; all unless given"""
    rate: Fraction
    """Probability that an attempt to send a frame is destroyed"""


class BusOff(Table):
    """A CAN controller goes bus-off, and comes back after `can.restart` and 128 times 11 idle bits (timing `bits`)."""

    kind: Literal["bus_off"]
    """A controller leaves the bus"""
    at: SecondsOrZero
    """When [s of run time]"""
    bus: Name | None = None
    """Which bus; all unless given"""
    robot: str | None = None
    """Whose drives' controllers; the bridge's unless given"""


Event = Annotated[DriveFault | Estop | ErrorFrames | BusOff, Field(discriminator="kind")]
