"""The wire: messages as bytes, and the keys they travel under.

Header, little endian (32 bytes): schema version u16, channel u8, zero u8, source u32, sequence u64, time [ns] i64,
number of values u32, zero u32; then that many float64.  The schema version stands here and in the presence tokens, never
in a data key: a peer of another version is refused by name and not met with silence.
"""

import struct
from typing import Final

import numpy as np

from echelon.messages import Channel, Message

SCHEMA_VERSION: Final = 1
HEADER: Final = struct.Struct("<HBBIQqII")
_CHANNELS: Final = {int(channel): channel for channel in Channel}
_LENGTH: Final = struct.Struct("<I")
_FLOAT64: Final = np.dtype("<f8")


class WireError(ValueError):
    """Bytes that are no message of ours; `reason` is short enough to count by."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


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
    if len(payload) < HEADER.size:
        raise WireError("too short")
    version, channel, _, source, sequence, time_ns, count, _ = HEADER.unpack_from(payload)
    if version != SCHEMA_VERSION:
        raise WireError(f"schema version {version}, here {SCHEMA_VERSION}")
    if channel not in _CHANNELS:
        raise WireError(f"unknown channel {channel}")
    if len(payload) != HEADER.size + 8 * count:
        raise WireError("length does not match")
    values = np.frombuffer(payload, _FLOAT64, count, HEADER.size)
    return Message(_CHANNELS[channel], source, sequence, time_ns, values)


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


def watch_key(run: str, name: str) -> str:
    """Returns the key under which a member's messages go to those who watch a run, in batches (`join`)."""
    return f"echelon/{run}/@watch/{name}"


def token_key(run: str, role: str, name: str, boot_id: str) -> str:
    """Returns a presence token: `echelon/<run>/@alive/<version>/<role>/<name>/<boot id>`, always of seven chunks."""
    return f"echelon/{run}/@alive/{SCHEMA_VERSION}/{role}/{name.replace('/', '.')}/{boot_id}"
