"""CAN frames as values of a message (channel FRAMES): the time rail of a bus in virtual time, and what recorders get.

Three 64-bit words per frame, whose bits travel as float64: the instant [ns]; identifier (bits 0 to 10), remote (11),
number of data bytes (12 to 15), bus (16 to 23) and node (from 24 on); the data bytes.
"""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from echelon.bridge.protocols.frame import Frame
from echelon.messages import Message, Values

BRIDGE_NODE: Final = 0
"""The bridge's number among the nodes of a bus; drives have those from 1 on."""
NO_BUS: Final = 255
"""Stands for the bus in what the bridge tells drives besides frames: `OFF`, `EMPTIED` or `BACK` of a node."""
OFF: Final = Frame(0)
"""The node's controller is off its bus from now on: it hears nothing."""
EMPTIED: Final = Frame(1)
"""It is still off, and what waited in its queue is lost."""
BACK: Final = Frame(2)
"""It is on its bus again."""


class TimedFrame(NamedTuple):
    """A frame, its instant in run time, which of the plan's buses it is on, and which node sent it."""

    time_ns: int
    bus: int
    node: int
    frame: Frame


def add_words(
    words: list[int], time_ns: int, bus: int, node: int, can_id: int, data: bytes, remote: bool = False
) -> None:
    """Adds a frame's three words."""
    words += (
        time_ns & 0xFFFF_FFFF_FFFF_FFFF,
        can_id | remote << 11 | len(data) << 12 | bus << 16 | node << 24,
        int.from_bytes(data, "little"),
    )


def pack(frames: Iterable[TimedFrame]) -> Values:
    """Returns the values of a message."""
    words: list[int] = []
    for time_ns, bus, node, (can_id, data, remote) in frames:
        add_words(words, time_ns, bus, node, can_id, data, remote)
    return np.array(words, dtype="<u8").view(np.float64)


def frames_of(message: Message) -> list[TimedFrame]:
    """Returns the frames in a message, without what the bridge tells besides."""
    return [timed for timed in unpack(message.values) if timed.bus != NO_BUS]


def unpack(values: Values) -> list[TimedFrame]:
    """Inverse of `pack`; of bytes from outside what is left over is dropped, and a length above eight is eight."""
    words = np.ascontiguousarray(values[: len(values) - len(values) % 3])
    frames = []
    for time_ns, (_, head, data) in zip(
        words.view("<i8")[::3].tolist(), words.view("<u8").reshape(-1, 3).tolist(), strict=True
    ):
        octets = data.to_bytes(8, "little")[: head >> 12 & 15]
        frame = Frame(head & 0x7FF, octets, bool(head >> 11 & 1))
        frames.append(TimedFrame(time_ns, head >> 16 & 0xFF, head >> 24, frame))
    return frames
