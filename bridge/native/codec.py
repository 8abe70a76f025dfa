"""The native torque frame: both wheels of one robot in one classic CAN frame. Pure: no input or output, no clock.

The identifier is 0x100 + robot number, 0 .. 126, so the lower number wins arbitration. It lies between CANopen's
emergency messages and its first process data objects; only robot 0 shares one, 0x100, with CANopen's time stamp. The 8
bytes are little endian:

    byte 0..1   torque of the right wheel, i16, times the scenario's torque scale [N m per bit]
    byte 2..3   torque of the left wheel, likewise
    byte 4      flags: bit 0 enable, bit 1 clipped (a torque did not fit and was cut to the range of the frame),
                bit 2 saturated (the robot's own torque limit was reached); bits 3..7 are sent as 0 and not looked at
    byte 5      bits 0..3 counter, one more with each frame of the robot, modulo 16; bits 4..7 as bits 3..7 of the flags
    byte 6      likewise
    byte 7      CRC-8 SAE J1850 over the identifier (u16, little endian, not sent) and bytes 0..6

The identifier is part of the CRC so that a frame that reaches the wrong robot is refused there. Torques are -32767 to
32767 bits, symmetric; -32768 is never sent and refused. A frame that does not enable carries no torque, whatever it
says.
"""

import math
import struct
from dataclasses import dataclass
from enum import StrEnum

BASE_ID = 0x100
MAX_ROBOTS = 127
LENGTH = 8
RAW_MAX = 32767

ENABLE = 1
CLIPPED = 2
SATURATED = 4

_COUNTERS = 16
_BODY = struct.Struct("<hhBBB")  # bytes 0..6


def _crc_table() -> bytes:
    table = bytearray()
    for byte in range(256):
        remainder = byte
        for _ in range(8):
            remainder = (remainder << 1) ^ (0x11D if remainder & 0x80 else 0)
        table.append(remainder)
    return bytes(table)


_CRC = _crc_table()
_BYTES = tuple(bytes((value,)) for value in range(256))


def crc8(data: bytes, start: int = 0xFF) -> int:
    """CRC-8 SAE J1850 of `data`: polynomial 0x1D, start 0xFF, inverted at the end.

    To continue after other data, `start` is their CRC, inverted."""
    crc, table = start, _CRC
    for byte in data:
        crc = table[crc ^ byte]
    return crc ^ 0xFF


# Where the CRC of each robot's frames stands after its identifier.
_START = tuple(crc8(struct.pack("<H", BASE_ID + robot)) ^ 0xFF for robot in range(MAX_ROBOTS))


class Refusal(StrEnum):
    """Why bytes from the bus are no torque frame."""

    ID = "identifier"
    LENGTH = "length"
    CRC = "crc"
    VALUE = "value"


@dataclass(frozen=True, slots=True)
class Torque:
    """What a valid frame says: wheel torques [N m] of one robot, both 0 where `enable` is false."""

    robot: int
    tau_right: float
    tau_left: float
    enable: bool
    clipped: bool
    saturated: bool
    counter: int


@dataclass(frozen=True, slots=True)
class NativeCodec:
    """Frames from torques and back; `scale` is the scenario's torque scale [N m per bit].

    Raises ValueError unless the scale is positive and finite."""

    scale: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"torque scale must be positive and finite, not {self.scale!r}")

    @property
    def limit(self) -> float:
        """The largest torque a frame can carry [N m]."""
        return RAW_MAX * self.scale

    def encode(
        self,
        robot: int,
        tau_right: float,
        tau_left: float,
        counter: int,
        *,
        enable: bool = True,
        saturated: bool = False,
    ) -> tuple[bytes, int]:
        """The 8 bytes for these wheel torques [N m], and how many of the two were clipped to +-`limit`.

        The counter is taken modulo 16. With `enable` false the torques sent are 0. The identifier is `frame_id(robot)`.
        Raises ValueError for a torque that is not finite, or a robot number out of range."""
        if not 0 <= robot < MAX_ROBOTS:
            raise ValueError(f"robot number must be 0 .. {MAX_ROBOTS - 1}, not {robot!r}")
        if not (math.isfinite(tau_right) and math.isfinite(tau_left)):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        right, left, clipped = 0.0, 0.0, 0
        if enable:
            right, left = tau_right / self.scale, tau_left / self.scale
            # what is less than half a bit too large still rounds to what it should
            clipped = (abs(right) > RAW_MAX + 0.5) + (abs(left) > RAW_MAX + 0.5)
            right, left = max(-RAW_MAX, min(RAW_MAX, right)), max(-RAW_MAX, min(RAW_MAX, left))
        flags = (ENABLE if enable else 0) | (CLIPPED if clipped else 0) | (SATURATED if saturated else 0)
        body = _BODY.pack(round(right), round(left), flags, counter % _COUNTERS, 0)
        return body + _BYTES[crc8(body, _START[robot])], clipped

    def decode(self, can_id: int, data: bytes) -> Torque | Refusal:
        """The torques of a frame from the bus, or why it is refused. Raises nothing, whatever comes."""
        robot = can_id - BASE_ID
        if not 0 <= robot < MAX_ROBOTS:
            return Refusal.ID
        if len(data) != LENGTH:
            return Refusal.LENGTH
        if crc8(data[:7], _START[robot]) != data[7]:
            return Refusal.CRC
        right, left, flags, counter, _ = _BODY.unpack_from(data)
        if right < -RAW_MAX or left < -RAW_MAX:
            return Refusal.VALUE
        enable = bool(flags & ENABLE)
        scale = self.scale if enable else 0.0
        return Torque(
            robot,
            right * scale,
            left * scale,
            enable,
            bool(flags & CLIPPED),
            bool(flags & SATURATED),
            counter % _COUNTERS,
        )


def frame_id(robot: int) -> int:
    """The identifier of a robot's torque frame. Raises ValueError for a number outside 0 .. 126."""
    if not 0 <= robot < MAX_ROBOTS:
        raise ValueError(f"robot number must be 0 .. {MAX_ROBOTS - 1}, not {robot!r}")
    return BASE_ID + robot


@dataclass(slots=True)
class CounterCheck:
    """Finds frames that are missing, by the counter of one robot's frames in the order they arrived.

    A gap is only known modulo 16: sixteen frames lost in a row look like none, and fifteen like a repeated frame."""

    frames: int = 0
    missed: int = 0
    repeated: int = 0
    _last: int | None = None

    def step(self, counter: int) -> int:
        """Takes the next frame's counter; how many frames are missing before it, or -1 if it repeats the last one."""
        self.frames += 1
        last, self._last = self._last, counter
        if last is None:
            return 0
        gap = (counter - last - 1) % _COUNTERS
        if gap == _COUNTERS - 1:
            self.repeated += 1
            return -1
        self.missed += gap
        return gap
