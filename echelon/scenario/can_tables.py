"""The tables of a scenario that concern the CAN bus: drives, envelope, buses and scheduled events."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from echelon.parameters import Finite, Positive
from echelon.scenario.part_fields import ProtocolField
from echelon.scenario.values import (
    Bitrate,
    Constant,
    ConstantOrZero,
    Flag,
    Fraction,
    Limit,
    Name,
    NodeId,
    Seconds,
    SecondsOrZero,
    Table,
    alike,
)


class DriveTable(Table):
    """The drives and motors of a robot's wheels.  Both wheels have the same values."""

    protocol: ProtocolField = None
    """`native` (one frame for both wheels, counter and CRC; the default), `odrive` (CANSimple 0.6; its parameter `control_mode`
    is the mode that is stored in a virtual drive, `position` unless given, or `torque`), `cia402` (cyclic synchronous torque
    over CANopen), or your own"""
    node_ids: tuple[NodeId, NodeId] | None = None
    """Node ids of the right and the left wheel's drive; unless given, the lowest ids whose identifiers are free on the bus"""
    recover_after: Seconds | None = None
    """How long after a fault the bridge clears the fault and enables the drive again [s]; never unless given"""
    torque_limit: Constant | None = None
    """Largest torque of the motor [N m]; the robot's limit unless given"""
    rated_torque: Constant | None = None
    """Torque that the motor can hold without time limit [N m]; CiA 402 states torques in thousandths of it; `torque_limit`
    unless given"""
    torque_slew: Limit | None = None
    """Largest rate of change of the torque [N m/s]; unlimited unless given"""
    lag: ConstantOrZero | None = None
    """Time constant of the current loop [s]; 0 unless given, which means that the torque follows at once"""
    torque_constant: Constant | None = None
    """Torque constant K_t [N m/A]; 0.1 unless given"""
    resistance: ConstantOrZero | None = None
    """Resistance of the winding [Ω], which is heated by its current; 0 unless given"""
    thermal_resistance: Constant | None = None
    """Thermal resistance from winding to ambient [K/W]; 2 unless given"""
    thermal_time: Constant | None = None
    """Time constant of the winding's temperature [s]; 60 unless given"""
    ambient: Finite | None = None
    """Temperature around the motor [°C]; 25 unless given"""
    derating_from: Finite | None = None
    """Winding temperature above which the torque limit falls [°C], linearly to zero at `temperature_limit`; 80 unless given"""
    temperature_limit: Finite | None = None
    """Winding temperature at which the drive raises an over-temperature fault [°C]; 100 unless given"""
    supply_voltage: Constant | None = None
    """Supply voltage without load [V]; 24 unless given"""
    supply_resistance: ConstantOrZero | None = None
    """Resistance of battery and cables [Ω]; 0 unless given"""
    brown_out: ConstantOrZero | None = None
    """Supply voltage below which the drive raises a brown-out fault [V]; 18 unless given"""
    encoder_counts: Annotated[int, Field(strict=True, ge=1, le=1 << 24)] | None = None
    """Encoder counts per revolution of the wheel; 4096 unless given"""
    inertia: Constant | None = None
    """Inertia of a wheel that turns freely on a bench, without a robot (`echelon drives`) [kg m²]; 0.01 unless given"""
    friction: ConstantOrZero | None = None
    """Viscous friction of a wheel on a bench [N m s/rad]; 0.01 unless given"""


class EnvelopeTable(Table):
    """The last gate before the bus.  A command that breaks one of these limits becomes zero torque and is counted."""

    torque_limit: Limit | None = None
    """Largest torque of a wheel [N m]; the robot's limit unless given"""
    rise_limit: Limit | None = None
    """Largest growth of a torque's magnitude from frame to frame [N m]; unlimited unless given"""
    fall_limit: Limit | None = None
    """Largest decrease of a torque's magnitude from frame to frame [N m]; unlimited unless given"""
    window_limit: Limit | None = None
    """Largest difference between two torques within 250 ms [N m]; unlimited unless given"""
    stale_after: Seconds | None = None
    """Largest age at which a robot's torque is still used [s]; `can.watchdog` unless given"""


class Bus(Table):
    """One of several buses."""

    url: str | None = None
    """Address of the bus; `can.url` unless given"""
    bitrate: Bitrate | None = None
    """Bit rate [bit/s]; `can.bitrate` unless given"""


class Can(Table):
    """The CAN bus, or buses."""

    enabled: Flag = True
    """False: the run makes no CAN frames"""
    url: str = "auto"
    """Address of the bus: `socketcan:vcan0`, `udp_multicast:…` or `virtual`; `auto` is vcan0 if it is up, else udp_multicast"""
    bitrate: Bitrate = 1_000_000
    """Bit rate [bit/s]"""
    buses: dict[Name, Bus] = {}
    """Several buses by name; each may have its own `url` and `bitrate`.  A robot chooses its bus with the key `bus`"""
    torque_scale: Positive = 0.001
    """Torque per bit in frames that hold torques as whole numbers of 16 bits [N m]; the largest is 32767 bits"""
    path: Literal["mirror", "closed"] = "mirror"
    """`mirror`: the plant takes the computed torques, and the bus only shows them.  `closed`: the plant takes the torques that
    the drives report, and the drives take theirs from the frames"""
    timing: Literal["bits", "ideal"] | None = None
    """How long a frame takes on the closed path: as long as on a real bus (`bits`), or no time at all (`ideal`).  In virtual
    time the default is `bits`.  On a wall clock a bus takes its own time unless `bits` is given; then a virtual bus is as slow
    as a real one"""
    virtual_drives: Flag = True
    """False: the closed path uses real drives that are on the bus already, not virtual ones (wall clock only)"""
    watchdog: Seconds = 0.1
    """The torque is taken away after this time without news [s]: by a drive that receives no command, and by the bridge if a
    robot sends nothing"""
    bring_up: Seconds = 1.0
    """How long before run time 0 the bridge begins to enable the drives [s]"""
    queue: Annotated[int, Field(strict=True, ge=1, le=100_000)] = 256
    """How many frames the bridge, and each drive, can hold while they wait for the bus; further frames are lost"""
    restart: SecondsOrZero = 0.1
    """How long a CAN controller waits after it went bus-off before it begins to come back [s]"""

    @model_validator(mode="after")
    def _names(self) -> "Can":
        if (name := alike(self.buses)) is not None:
            raise ValueError(f"buses: {name!r} must differ from other names by more than hyphens and underscores")
        return self


class DriveFault(Table):
    """A fault of drives."""

    kind: Literal["drive_fault"]
    """Kind of this event"""
    at: SecondsOrZero
    """When the fault begins [s of run time]"""
    duration: Seconds | None = None
    """How long the cause of the fault lasts [s]; for ever unless given.  A fault that a drive has latched stays until it is
    cleared, also after its cause is gone"""
    robot: str = "**"
    """The robots whose drives have the fault: a path in the tree, which may hold `*` and `**`"""
    wheel: Literal["right", "left", "both"] = "both"
    """The wheels whose drives have the fault"""
    fault: Literal["over_temperature", "encoder_loss", "brown_out", "stuck_torque", "silent"]
    """The fault: the winding is too hot, the encoder fails, the supply voltage is too low, the torque stays as it is, or the
    drive sends nothing"""


class Estop(Table):
    """An emergency stop.  The drives take the torque away by themselves, each as its protocol prescribes.  They stay disabled
    for ever unless `duration` is given."""

    kind: Literal["estop"]
    """Kind of this event"""
    at: SecondsOrZero
    """When the button is pressed [s of run time]"""
    duration: Seconds | None = None
    """How long the button stays pressed [s]; for ever unless given"""
    robot: str = "**"
    """The robots that stop: a path in the tree, which may hold `*` and `**`"""


class ErrorFrames(Table):
    """A disturbance of a bus.  Attempts to send a frame are destroyed at random, and the frame is sent again (needs the timing
    `bits`)."""

    kind: Literal["error_frames"]
    """Kind of this event"""
    at: SecondsOrZero
    """When the disturbance begins [s of run time]"""
    duration: Seconds | None = None
    """How long the disturbance lasts [s]; for ever unless given"""
    bus: Name | None = None
    """The disturbed bus; all buses unless given"""
    rate: Fraction
    """Probability that an attempt to send a frame is destroyed"""


class BusOff(Table):
    """CAN controllers go bus-off.  They come back after `can.restart` and 128 times 11 idle bits (needs the timing `bits`)."""

    kind: Literal["bus_off"]
    """Kind of this event"""
    at: SecondsOrZero
    """When the controllers go bus-off [s of run time]"""
    bus: Name | None = None
    """The bus of the controllers; all buses unless given"""
    robot: str | None = None
    """The robots whose drives go bus-off: a path in the tree, which may hold `*` and `**`; unless given, the bridge goes
    bus-off"""


CanEvent = DriveFault | Estop | ErrorFrames | BusOff
