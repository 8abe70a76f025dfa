"""The native frames: both wheels of one robot in one classic CAN frame. Pure: no input or output, no clock.

All frames have 8 bytes, little endian: two values for the wheels, three bytes, and a CRC. An identifier is a base plus the
robot's number, 0 .. 126. So commands win arbitration before feedback, and lower numbers before higher ones.

    command, 0x100 + robot, from the bridge, once per period
    byte 0..1   wanted torque of the right wheel, i16, in the scenario's torque scale [N m per bit]
    byte 2..3   wanted torque of the left wheel, in the same way
    byte 4      flags: bit 0 enable right, bit 1 enable left, bit 2 clear faults, bit 3 clipped (a torque was cut to the range
                of the frame), bit 4 saturated (the robot's own torque limit was reached), bit 5 emergency stop (both wheels
                enter the fault state); bits 6..7 are sent as 0 and ignored
    byte 5      bits 0..3 counter; bits 4..7 are sent as 0 and ignored
    byte 6      sent as 0 and ignored

    feedback, 0x180 + robot, from the drive, once per period
    byte 0..3   mean torque of the right and the left shaft since the last feedback, as in the command
    byte 4      state of the right (bits 0..3) and the left wheel (bits 4..7): 0 disabled, 1 enabled, 2 fault
    byte 5      bits 0..3 counter; bits 4..7 zero
    byte 6      fault of the right (bits 0..3) and the left wheel (bits 4..7): 0 none, 1 over-temperature, 2 encoder lost,
                3 brown-out, 4 watchdog, 5 emergency stop

    status, 0x200 + robot, from the drive, with every tenth feedback
    byte 0..3   speed of the right and the left wheel, i16, 0.01 rad/s per bit
    byte 4      supply voltage, u8, 0.5 V per bit
    byte 5      bits 0..3 counter; bits 4..7 zero
    byte 6      temperature of the hotter winding, u8, 1 °C per bit, 0 is -40 °C

    all frames
    counter     one more with each frame of this identifier, modulo 16
    byte 7      CRC-8 SAE J1850 over the identifier (u16, little endian, not sent) and bytes 0..6

The CRC contains the identifier, so that a robot refuses a frame with a wrong identifier. Wheel values range from -32767 to
32767; -32768 is never sent and is refused. A wheel that a command does not enable gets no torque. Frames that repeat the last
counter are refused. bridge.protocols.cyclic.drive has the states of a wheel.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from math import copysign, isfinite
from typing import NamedTuple

from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.native.counter import COUNTERS
from echelon.bridge.protocols.native.crc import crc8

BASE_ID = 0x100
FEEDBACK_ID = 0x180
STATUS_ID = 0x200
MAX_ROBOTS = 127
LENGTH = 8
RAW_MAX = 32767

ENABLE_RIGHT = 1
ENABLE_LEFT = 2
CLEAR = 4
CLIPPED = 8
SATURATED = 16
ESTOP = 32

SPEED_SCALE = 0.01
"""[rad/s per bit]"""
VOLTAGE_SCALE = 0.5
"""[V per bit]"""
TEMPERATURE_OFFSET = -40.0
"""[°C]"""
STATUS_EVERY = 10
"""Feedback frames per status frame"""

_BYTES = tuple(bytes((value,)) for value in range(256))
_BODY = struct.Struct("<hhBBB")  # bytes 0..6


# the CRC after the identifier, computed once for each identifier
_START = {
    base + robot: crc8(struct.pack("<H", base + robot)) ^ 0xFF
    for base in (BASE_ID, FEEDBACK_ID, STATUS_ID)
    for robot in range(MAX_ROBOTS)
}


class Refusal(StrEnum):
    """Why a frame from the bus is refused."""

    ID = "identifier"
    LENGTH = "length"
    CRC = "crc"
    VALUE = "value"


class FaultCode(IntEnum):
    """Fault of a wheel, as in byte 6 of a feedback."""

    NONE = 0
    OVER_TEMPERATURE = 1
    ENCODER_LOSS = 2
    BROWN_OUT = 3
    WATCHDOG = 4
    ESTOP = 5


# by the value of the nibble, which is a hundred times as fast as to make the enum and catch ValueError
_STATES = (*WheelState, *(None,) * (16 - len(WheelState)))
_FAULTS = (*FaultCode, *(None,) * (16 - len(FaultCode)))


class Torque(NamedTuple):
    """The content of a valid command: wheel torques [N m] of one robot, 0 for a wheel that is not enabled."""

    robot: int
    tau_right: float
    tau_left: float
    enable_right: bool
    enable_left: bool
    clear: bool
    clipped: bool
    saturated: bool
    estop: bool
    counter: int


class Feedback(NamedTuple):
    """The content of a valid feedback: mean torques [N m], states and faults of the right and the left wheel."""

    robot: int
    torques: tuple[float, float]
    states: tuple[WheelState, WheelState]
    faults: tuple[FaultCode, FaultCode]
    counter: int


class Status(NamedTuple):
    """The content of a valid status: speeds of the right and the left wheel [rad/s], supply [V], hotter winding [°C]."""

    robot: int
    speeds: tuple[float, float]
    voltage: float
    temperature: float
    counter: int


@dataclass(frozen=True, slots=True)
class NativeCodec:
    """Encodes and decodes frames; `scale` is the scenario's torque scale [N m per bit].

    Raises ValueError unless the scale is positive and finite."""

    scale: float

    def __post_init__(self) -> None:
        if not (isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"torque scale must be positive and finite, not {self.scale!r}")

    @property
    def limit(self) -> float:
        """The largest torque that a frame can carry [N m]."""
        return RAW_MAX * self.scale

    def encode(
        self,
        robot: int,
        tau_right: float,
        tau_left: float,
        counter: int,
        *,
        enable: tuple[bool, bool] = (True, True),
        saturated: bool = False,
        clear: bool = False,
        estop: bool = False,
    ) -> tuple[bytes, int]:
        """Returns the 8 bytes for these wheel torques [N m], and how many of the two were clipped to ±`limit`.

        The counter is taken modulo 16. `enable` is for the right and the left wheel; without it the torque sent is 0. The
        identifier is `frame_id(robot)`.
        Raises ValueError for a torque that is not finite, or a robot number out of range."""
        if not 0 <= robot < MAX_ROBOTS:
            raise ValueError(f"robot number must be 0 .. {MAX_ROBOTS - 1}, not {robot!r}")
        if not (isfinite(tau_right) and isfinite(tau_left)):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        flags, clipped, right, left, scale = 0, 0, 0.0, 0.0, self.scale
        enable_right, enable_left = enable
        if enable_right:
            flags, right = ENABLE_RIGHT, tau_right / scale
            if not -RAW_MAX <= right <= RAW_MAX:
                # a torque that is less than half a bit too large rounds to the limit and is not clipped
                clipped += abs(right) > RAW_MAX + 0.5
                right = copysign(RAW_MAX, right)
        if enable_left:
            flags, left = flags | ENABLE_LEFT, tau_left / scale
            if not -RAW_MAX <= left <= RAW_MAX:
                clipped += abs(left) > RAW_MAX + 0.5
                left = copysign(RAW_MAX, left)
        if clipped:
            flags |= CLIPPED
        if saturated:
            flags |= SATURATED
        if clear:
            flags |= CLEAR
        if estop:
            flags |= ESTOP
        body = _BODY.pack(round(right), round(left), flags, counter % COUNTERS, 0)
        return body + _BYTES[crc8(body, _START[BASE_ID + robot])], clipped

    def decode(self, can_id: int, data: bytes) -> Torque | Refusal:
        """Returns the content of a command from the bus, or the reason to refuse it. Never raises."""
        parts = _open(BASE_ID, can_id, data)
        if isinstance(parts, Refusal):
            return parts
        right, left, flags, counter, _ = parts
        return Torque(
            can_id - BASE_ID,
            right * self.scale if flags & ENABLE_RIGHT else 0.0,
            left * self.scale if flags & ENABLE_LEFT else 0.0,
            bool(flags & ENABLE_RIGHT),
            bool(flags & ENABLE_LEFT),
            bool(flags & CLEAR),
            bool(flags & CLIPPED),
            bool(flags & SATURATED),
            bool(flags & ESTOP),
            counter % COUNTERS,
        )

    def encode_feedback(self, feedback: Feedback) -> bytes:
        """Returns the 8 bytes of a feedback; torques are cut to the range. Raises ValueError as `encode` does."""
        (right, left), (state_right, state_left) = feedback.torques, feedback.states
        fault_right, fault_left = feedback.faults
        return _seal(
            FEEDBACK_ID,
            feedback.robot,
            right / self.scale,
            left / self.scale,
            state_right | state_left << 4,
            feedback.counter,
            fault_right | fault_left << 4,
        )

    def decode_feedback(self, can_id: int, data: bytes) -> Feedback | Refusal:
        """Returns the content of a feedback from the bus, or the reason to refuse it. Never raises."""
        parts = _open(FEEDBACK_ID, can_id, data)
        if isinstance(parts, Refusal):
            return parts
        right, left, states, counter, faults = parts
        state_right, state_left = _STATES[states & 15], _STATES[states >> 4]
        fault_right, fault_left = _FAULTS[faults & 15], _FAULTS[faults >> 4]
        if state_right is None or state_left is None or fault_right is None or fault_left is None:
            return Refusal.VALUE
        return Feedback(
            can_id - FEEDBACK_ID,
            (right * self.scale, left * self.scale),
            (state_right, state_left),
            (fault_right, fault_left),
            counter % COUNTERS,
        )


def encode_status(status: Status) -> bytes:
    """Returns the 8 bytes of a status; values are cut to the range.

    Raises ValueError for a number that is not finite, or a robot number out of range."""
    right, left = status.speeds
    voltage, temperature = status.voltage / VOLTAGE_SCALE, status.temperature - TEMPERATURE_OFFSET
    if not (isfinite(voltage) and isfinite(temperature)):
        raise ValueError(f"voltage and temperature must be finite, not {status.voltage!r} and {status.temperature!r}")
    return _seal(
        STATUS_ID,
        status.robot,
        right / SPEED_SCALE,
        left / SPEED_SCALE,
        round(max(0.0, min(255.0, voltage))),
        status.counter,
        round(max(0.0, min(255.0, temperature))),
    )


def decode_status(can_id: int, data: bytes) -> Status | Refusal:
    """Returns the content of a status from the bus, or the reason to refuse it. Never raises."""
    parts = _open(STATUS_ID, can_id, data)
    if isinstance(parts, Refusal):
        return parts
    right, left, voltage, counter, temperature = parts
    return Status(
        can_id - STATUS_ID,
        (right * SPEED_SCALE, left * SPEED_SCALE),
        voltage * VOLTAGE_SCALE,
        temperature + TEMPERATURE_OFFSET,
        counter % COUNTERS,
    )


def frame_id(robot: int, base: int = BASE_ID) -> int:
    """Returns the identifier of a robot's frame: of its command, or of the kind with the identifier `base`.

    Raises ValueError for a robot number outside 0 .. 126."""
    if not 0 <= robot < MAX_ROBOTS:
        raise ValueError(f"robot number must be 0 .. {MAX_ROBOTS - 1}, not {robot!r}")
    return base + robot


def _seal(base: int, robot: int, right: float, left: float, byte_4: int, counter: int, byte_6: int) -> bytes:
    start = _START[frame_id(robot, base)]
    if not (isfinite(right) and isfinite(left)):
        raise ValueError(f"wheel numbers must be finite, not {right!r} and {left!r} bits")
    right, left = max(-RAW_MAX, min(RAW_MAX, right)), max(-RAW_MAX, min(RAW_MAX, left))
    body = _BODY.pack(round(right), round(left), byte_4, counter % COUNTERS, byte_6)
    return body + _BYTES[crc8(body, start)]


def _open(base: int, can_id: int, data: bytes) -> tuple[int, int, int, int, int] | Refusal:
    if not 0 <= can_id - base < MAX_ROBOTS:
        return Refusal.ID
    if len(data) != LENGTH:
        return Refusal.LENGTH
    if crc8(data[:7], _START[can_id]) != data[7]:
        return Refusal.CRC
    parts: tuple[int, int, int, int, int] = _BODY.unpack_from(data)
    return Refusal.VALUE if parts[0] < -RAW_MAX or parts[1] < -RAW_MAX else parts
