"""The wire: messages as bytes, and the keys they travel under.

Header, little endian (32 bytes): schema version u16, channel u8, zero u8, source u32, sequence u64, time [ns] i64,
number of values u32, zero u32; then that many float64.  The schema version stands here and in the presence tokens,
never in a data key: a peer of another version is refused by name and not met with silence.
"""

import struct
from typing import Final

import numpy as np

from echelon.messages import Channel, Message

SCHEMA_VERSION: Final = 1
HEADER: Final = struct.Struct("<HBBIQqII")
REASONS: Final = 32
"""Reasons that refusals are counted by."""
_CHANNELS: Final = {int(channel): channel for channel in Channel}
_LENGTH: Final = struct.Struct("<I")
_VERSION: Final = struct.Struct("<H")
_FLOAT64: Final = np.dtype("<f8")
# Bound once, for one message is decoded for every message of every tick.
_HEADER_SIZE: Final = HEADER.size
_unpack: Final = HEADER.unpack_from
_view: Final = np.frombuffer
_channel_of: Final = _CHANNELS.get


class WireError(ValueError):
    """Bytes that are no message of ours; `reason` is short enough to count by."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def count_refusal(counts: dict[str, int], reason: str) -> None:
    """Counts a refusal by its reason; whoever sends garbage makes up no more than `REASONS` reasons."""
    if reason not in counts and len(counts) >= REASONS:
        reason = "other reasons"
    counts[reason] = counts.get(reason, 0) + 1


def encode(message: Message) -> bytes:
    """Returns the message's bytes."""
    values = message.values
    return (
        HEADER.pack(
            SCHEMA_VERSION, message.channel, 0, message.source, message.sequence, message.time_ns, values.size, 0
        )
        + values.tobytes()
    )


def decode(payload: bytes) -> Message:
    """Returns the message; its values are a view of `payload`.  Raises WireError on anything else."""
    size = len(payload)
    if size < _HEADER_SIZE:
        raise _refusal(payload)
    version, number, zero, source, sequence, time_ns, count, zeros = _unpack(payload)
    channel = _channel_of(number)
    if version != SCHEMA_VERSION or channel is None or zero or zeros or size != _HEADER_SIZE + 8 * count:
        raise _refusal(payload)
    return Message(channel, source, sequence, time_ns, _view(payload, _FLOAT64, count, _HEADER_SIZE))


def _refusal(payload: bytes) -> WireError:
    """Returns what is wrong with bytes that are no message; the version first, for it says what the rest may mean."""
    if len(payload) >= _VERSION.size:
        (version,) = _VERSION.unpack_from(payload)
        if version != SCHEMA_VERSION:
            return WireError(f"schema version {version}, here {SCHEMA_VERSION}")
    if len(payload) < _HEADER_SIZE:
        return WireError("too short")
    _, number, zero, _, _, _, _, zeros = _unpack(payload)
    if number not in _CHANNELS:
        return WireError(f"unknown channel {number}")
    return WireError("reserved bytes are not zero" if zero or zeros else "length does not match")


def join(payloads: list[bytes]) -> bytes:
    """Returns several messages as one payload, for those who watch a run and may receive it in portions."""
    return b"".join([part for payload in payloads for part in (_LENGTH.pack(len(payload)), payload)])


def split(batch: bytes) -> list[bytes]:
    """Inverse of `join`.  Raises WireError on a batch that ends early."""
    payloads, at = [], 0
    while at < len(batch):
        if at + _LENGTH.size > len(batch):
            raise WireError("batch cut in a length")
        (length,) = _LENGTH.unpack_from(batch, at)
        at += _LENGTH.size + length
        if at > len(batch):
            raise WireError("batch cut in a message")
        payloads.append(batch[at - length : at])
    return payloads


def data_key(run: str, path: str, channel: Channel) -> str:
    """Returns the key of a member's messages, e.g. `echelon/lab-7f3a/g1/r3/state`; the root's path is empty."""
    return "/".join(chunk for chunk in ("echelon", run, path, channel.name.lower()) if chunk)


def watch_key(run: str, role: str, name: str) -> str:
    """Returns the key under which a member's messages go to those who watch a run, in batches (`join`); `role` and
    `name` may be wildcards."""
    return f"echelon/{run}/@watch/{role}/{name}"


def token_key(run: str, role: str, name: str, boot_id: str) -> str:
    """Returns a presence token: `echelon/<run>/@alive/<version>/<role>/<name>/<boot id>`, always of seven chunks."""
    return f"echelon/{run}/@alive/{SCHEMA_VERSION}/{role}/{name.replace('/', '.')}/{boot_id}"
