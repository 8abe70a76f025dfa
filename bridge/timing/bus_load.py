"""The exact lengths of classic CAN frames in bits, and the load that they make on a bus. Pure.

A data frame with an 11-bit identifier and n data bytes (ISO 11898-1):

part                                                 bits
start of frame                                       1
identifier, RTR, IDE, r0                             11, 1, 1, 1
length code, data, CRC                               4, 8 n, 15
CRC delimiter, acknowledge slot and its delimiter    1, 1, 1
end of frame, interframe space                       7, 3

From the start of frame to the end of the CRC the sender inserts a stuff bit of opposite value after five equal bits. A stuff
bit counts as the first bit of the next run.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_TAIL = 13  # bits after the CRC, which are never stuffed
_BLOCK = 1024
_POLYNOMIAL = 0x4599  # CRC-15: x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (0x8000 | _POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc)
    return tuple(table)


def _stuff_bit(state: int, bit: int) -> tuple[int, int]:
    """Returns the next state and the number of stuff bits (0 or 1) after `bit`; a state is 8 * last bit + length of its run."""
    last, run = divmod(state, 8)
    run = run + 1 if bit == last else 1
    return ((1 - bit) * 8 + 1, 1) if run == 5 else (bit * 8 + run, 0)


def _stuff_table() -> dict[int, tuple[tuple[int, int], ...]]:
    """Returns for each state and each byte that is sent next: the state after it, and its number of stuff bits."""
    table = {}
    for state in [last * 8 + run for last in (0, 1) for run in (1, 2, 3, 4)]:
        row = []
        for byte in range(256):
            after, added = state, 0
            for shift in range(7, -1, -1):
                after, more = _stuff_bit(after, byte >> shift & 1)
                added += more
            row.append((after, added))
        table[state] = tuple(row)
    return table


_CRC = _crc_table()
_STUFF = _stuff_table()
_CRC_ARRAY = np.array(_CRC)
_AFTER, _ADDED = np.zeros((2, 16, 256), dtype=np.int64)
for _state, _row in _STUFF.items():
    _AFTER[_state], _ADDED[_state] = np.array(_row).T


def check_frame(can_id: int, data: bytes, remote: bool = False) -> None:
    """Raises ValueError for an identifier of more than 11 bits, more than 8 bytes, or a remote frame with data."""
    if not 0 <= can_id < 0x800:
        raise ValueError(f"identifier must have 11 bits, not {can_id:#x}")
    _check_length(len(data))
    if remote and data:
        raise ValueError(f"a remote frame has no data, not {len(data)} bytes")


def _check_length(length: int) -> None:
    if not 0 <= length <= 8:
        raise ValueError(f"a classic CAN frame has 0 .. 8 bytes, not {length}")


def frame_bits(can_id: int, data: bytes, remote: bool = False) -> int:
    """Returns the bits that exactly this frame takes on the bus, its stuff bits and the interframe space included.

    A remote frame has the RTR bit set, no data, and a length code of 0.  Raises ValueError as `check_frame` does."""
    check_frame(can_id, data, remote)
    # Start of frame (0), identifier, RTR, IDE and r0 (0) and length code are 19 bits. Five zeros in front make them three
    # bytes; they do not change a CRC that starts with zero.
    start = can_id << 7 | remote << 6 | len(data)
    head = start.to_bytes(3, "big")
    crc = 0
    for byte in head + data:
        crc = (crc << 8 & 0x7FFF) ^ _CRC[crc >> 7 ^ byte]
    # 34 + 8 n bits are stuffed: two bits, then whole bytes
    length = 34 + 8 * len(data)
    bits = start << (length - 19) | int.from_bytes(data, "big") << 15 | crc
    # the two bits are the start of frame (0) and the highest bit of the identifier: a run of one 1, or a run of two 0
    state = 8 + 1 if bits >> (length - 2) else 2
    total = length + _TAIL
    table = _STUFF
    for byte in (bits & (1 << (length - 2)) - 1).to_bytes((length - 2) // 8, "big"):
        state, added = table[state][byte]
        total += added
    return total


def many_frame_bits(can_ids: Sequence[int], data: bytes) -> NDArray[np.int64]:
    """Returns `frame_bits` of n frames with eight bytes each, shape (n,); `data` is the 8 n bytes of all of them in a row.

    Raises ValueError for an identifier of more than 11 bits, or data of another length."""
    identifiers = np.array(can_ids, dtype=np.int64)
    if len(data) != 8 * len(identifiers) or (
        identifiers.size and not 0 <= identifiers.min() <= identifiers.max() < 0x800
    ):
        raise ValueError(f"{len(identifiers)} identifiers of 11 bits with 8 bytes each, not {len(data)} bytes in all")
    octets = np.frombuffer(data, np.uint8).reshape(-1, 8).T.astype(np.int64)
    head = identifiers << 7 | 8
    crc = np.zeros_like(head)
    for octet in (head >> 16, head >> 8 & 0xFF, head & 0xFF, *octets):
        crc = (crc << 8 & 0x7FFF) ^ _CRC_ARRAY[crc >> 7 ^ octet]
    # the 96 bits after the first two, as 12 bytes: 17 bits of the head, 64 of data, 15 of the CRC
    parts = (
        head >> 9 & 0xFF,
        head >> 1 & 0xFF,
        *(((before & 1) << 7 | octet >> 1) for before, octet in zip((head, *octets), (*octets, crc >> 7), strict=True)),
        crc & 0xFF,
    )
    state = np.where(head >> 17 & 1, 8 + 1, 2)
    total = np.full_like(head, 34 + 64 + _TAIL)
    for part in parts:
        total += _ADDED[state, part]
        state = _AFTER[state, part]
    return total


class BitCount:
    """The sum of the bits of many frames.  Frames with eight bytes are counted in blocks, which is ten times as fast."""

    __slots__ = ("_bits", "_data", "_ids")

    def __init__(self) -> None:
        self._bits = 0
        self._ids: list[int] = []
        self._data = bytearray()

    def add(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Adds a frame.  Raises ValueError as `check_frame` does."""
        if len(data) != 8 or remote:
            self._bits += frame_bits(can_id, data, remote)
            return
        self._ids.append(can_id)
        self._data += data
        if len(self._ids) >= _BLOCK:
            self._count()

    @property
    def bits(self) -> int:
        """The bits of all frames so far, stuff bits and interframe spaces included."""
        self._count()
        return self._bits

    def _count(self) -> None:
        self._bits += int(many_frame_bits(self._ids, bytes(self._data)).sum())
        self._ids.clear()
        self._data.clear()


def worst_case_bits(length: int = 8) -> int:
    """Returns the bits of the longest frame with `length` data bytes: stuff bits after the first five, then every four bits.

    Raises ValueError unless 0 <= length <= 8."""
    _check_length(length)
    stuffed = 34 + 8 * length
    return stuffed + _TAIL + (stuffed - 1) // 4


def bus_load(frames_per_second: float, bitrate: float, bits_per_frame: float = worst_case_bits(8)) -> float:
    """Returns the share of a bus of `bitrate` [bit/s] that the frames take: 1 is a full bus, more does not fit.

    Raises ValueError unless the bit rate is positive."""
    if not bitrate > 0:
        raise ValueError(f"bit rate must be positive, not {bitrate!r}")
    return frames_per_second * bits_per_frame / bitrate
