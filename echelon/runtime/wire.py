"""Messages as bytes, and the keys under which they are sent (docs/architecture.md, 3.7).

A payload is a header of 32 bytes, little endian, and then the values as float64.  The header is: schema version u16, channel
u8, zero u8, source u32, sequence u64, time [ns] i64, number of values u32, zero u32.  The schema version is in the header
and in the presence tokens, but not in the keys of data.  So data of another version arrive and are refused with a reason;
with the version in the key they would not arrive at all.
"""

import struct
from typing import Final

import numpy as np

from echelon.messages import Channel, Message

SCHEMA_VERSION: Final = 1
HEADER: Final = struct.Struct("<HBBIQqII")
_CHANNELS: Final = {int(channel): channel for channel in Channel}
_LENGTH: Final = struct.Struct("<I")
_VERSION: Final = struct.Struct("<H")
_FLOAT64: Final = np.dtype("<f8")
# Looked up once here, because `decode` runs for every message of every tick.
_HEADER_SIZE: Final = HEADER.size
_unpack: Final = HEADER.unpack_from
_view: Final = np.frombuffer
_channel_of: Final = _CHANNELS.get


class WireError(ValueError):
    """A payload is not a valid message.  `reason` is short; refusals are counted by it (`echelon.runtime.admission`)."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def encode(message: Message) -> bytes:
    """Returns a message as bytes."""
    values = message.values
    return (
        HEADER.pack(
            SCHEMA_VERSION, message.channel, 0, message.source, message.sequence, message.time_ns, values.size, 0
        )
        + values.tobytes()
    )


def decode(payload: bytes) -> Message:
    """Returns the message of a payload; its values are a view of `payload`.  Raises WireError if it is not a valid message."""
    size = len(payload)
    if size < _HEADER_SIZE:
        raise _refusal(payload)
    version, number, zero, source, sequence, time_ns, count, zeros = _unpack(payload)
    channel = _channel_of(number)
    if version != SCHEMA_VERSION or channel is None or zero or zeros or size != _HEADER_SIZE + 8 * count:
        raise _refusal(payload)
    return Message(channel, source, sequence, time_ns, _view(payload, _FLOAT64, count, _HEADER_SIZE))


def _refusal(payload: bytes) -> WireError:
    """Returns the error for a payload that is not a valid message.  The version is checked first, because the meaning of the
    other bytes depends on it."""
    if len(payload) >= _VERSION.size:
        (version,) = _VERSION.unpack_from(payload)
        if version != SCHEMA_VERSION:
            return WireError("another schema version")
    if len(payload) < _HEADER_SIZE:
        return WireError("too short")
    _, number, zero, _, _, _, _, zeros = _unpack(payload)
    if number not in _CHANNELS:
        return WireError("unknown channel")
    return WireError("reserved bytes are not zero" if zero or zeros else "length does not match")


def join(payloads: list[bytes]) -> bytes:
    """Returns a batch: several payloads as one, each after its length.  The recorder and other observers receive batches."""
    return b"".join([part for payload in payloads for part in (_LENGTH.pack(len(payload)), payload)])


def split(batch: bytes) -> list[bytes]:
    """Returns the payloads of a batch, the inverse of `join`.  Raises WireError if the batch ends within a payload."""
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


def run_keys(run: str) -> tuple[str, ...]:
    """Returns key expressions that together cover all keys of a run.

    In Zenoh a wildcard does not match a chunk that begins with `@`."""
    return tuple(f"echelon/{run}/{part}**" for part in ("", "@alive/", "@watch/", "@bridge/", "@drives/"))


def data_key(run: str, path: str, channel: Channel) -> str:
    """Returns the key of a member's messages on a channel, e.g. `echelon/lab-7f3a/g1/r3/state`; the root's path is empty."""
    return "/".join(chunk for chunk in ("echelon", run, path, channel.name.lower()) if chunk)


def watch_key(run: str, role: str, name: str) -> str:
    """Returns the key under which copies of a member's messages are sent in batches (`join`) to the recorder and other
    observers.  `role` and `name` may be wildcards."""
    return f"echelon/{run}/@watch/{role}/{name}"


def token_key(run: str, role: str, name: str, boot_id: str) -> str:
    """Returns the key of a presence token: `echelon/<run>/@alive/<version>/<role>/<name>/<boot id>`, always seven chunks."""
    return f"echelon/{run}/@alive/{SCHEMA_VERSION}/{role}/{name.replace('/', '.')}/{boot_id}"
