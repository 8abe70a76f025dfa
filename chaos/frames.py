"""Frames on python-can's multicast bus, and the native frames of a robot's drives, read from their description.

The layout is the one that `echelon dbc` prints; the tests hold the two against each other.
"""

import struct
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import msgpack

COMMAND_ID: Final = 0x100
FEEDBACK_ID: Final = 0x180
STATUS_ID: Final = 0x200
ENABLE: Final = 3
"""The flags that enable both wheels"""
_BODY: Final = struct.Struct("<hhBBB")


class Frame(NamedTuple):
    """A classic CAN frame that was heard: when [ns since 1970], from which address and port, identifier and data."""

    time_ns: int
    sender: tuple[str, int]
    can_id: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Command:
    """A torque command: of both wheels as whole numbers, and whether any wheel is enabled."""

    right: int
    left: int
    enabled: bool

    @property
    def moves(self) -> bool:
        """True: it turns a wheel."""
        return self.enabled and (self.right != 0 or self.left != 0)


def crc8(data: bytes) -> int:
    """Returns the CRC-8 SAE J1850: polynomial 0x1D, begun with 0xFF, inverted."""
    value = 0xFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x1D if value & 0x80 else value << 1) & 0xFF
    return value ^ 0xFF


def is_whole(can_id: int, data: bytes) -> bool:
    """Returns whether the checksum of a native frame is right."""
    return len(data) == 8 and crc8(can_id.to_bytes(2, "little") + data[:7]) == data[7]


def command(frame: Frame) -> Command | None:
    """Returns a torque command; None if the frame is none."""
    if not COMMAND_ID <= frame.can_id < FEEDBACK_ID or not is_whole(frame.can_id, frame.data):
        return None
    right, left, flags, _, _ = _BODY.unpack_from(frame.data)
    return Command(right if flags & 1 else 0, left if flags & 2 else 0, bool(flags & ENABLE))


def feedback(frame: Frame) -> tuple[int, int] | None:
    """Returns the torques of both wheels that a drive reports, as whole numbers; None if the frame is no feedback."""
    if not FEEDBACK_ID <= frame.can_id < STATUS_ID or not is_whole(frame.can_id, frame.data):
        return None
    right, left, _, _, _ = _BODY.unpack_from(frame.data)
    return right, left


def torque_frame(can_id: int, right: int, left: int, byte_4: int, counter: int) -> bytes:
    """Returns the data of a native command (`byte_4`: flags) or feedback (`byte_4`: states of the wheels)."""
    body = _BODY.pack(right, left, byte_4, counter % 16, 0)
    return body + bytes((crc8(can_id.to_bytes(2, "little") + body),))


def pack(can_id: int, data: bytes) -> bytes:
    """Returns the datagram of a frame on the multicast bus."""
    flags = dict.fromkeys(("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch"), False)
    told: dict[str, Any] = {"timestamp": 0.0, "arbitration_id": can_id, "channel": None, "dlc": len(data), "data": data}
    packed = msgpack.packb(told | flags | {"error_state_indicator": False})
    assert isinstance(packed, bytes)
    return packed


def unpack(time_ns: int, sender: tuple[str, int], datagram: bytes) -> Frame | None:
    """Returns the frame of a datagram; None if it holds no classic frame with an 11-bit identifier."""
    try:
        told = msgpack.unpackb(datagram)
        can_id, data = told["arbitration_id"], told["data"]
        odd = told["is_extended_id"] or told["is_error_frame"] or told["is_remote_frame"] or told["is_fd"]
    except Exception:  # msgpack raises many kinds of them for bytes of others
        return None
    if odd or type(can_id) is not int or not 0 <= can_id < 0x800 or type(data) is not bytes or len(data) > 8:
        return None
    return Frame(time_ns, sender, can_id, data)
