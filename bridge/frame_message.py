"""CAN frames as the values of a message on the channel FRAMES (docs/architecture.md, 3.1 and 5.2).

A frame takes three 64-bit words, whose bits travel as float64:

word    content
0       instant [ns]
1       bits 0 to 10 identifier, 11 remote, 12 to 15 number of data bytes, 16 to 23 bus, from 24 on node
2       data bytes
"""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from echelon.bridge.protocols.frame import Frame
from echelon.messages import Message, Values
from echelon.plan.plan import Plan

BRIDGE_NODE: Final = 0
"""The node number of the bridge; drives have the numbers from 1 on"""
NO_BUS: Final = 255
"""The bus number of a mark: not a frame, but news of a node's controller, which the bridge sends to the drives.  Marks are
`OFF`, `EMPTIED` and `BACK`."""
OFF: Final = Frame(0)
"""Mark: the node is bus-off from now on and hears nothing"""
EMPTIED: Final = Frame(1)
"""Mark: the node is still bus-off; the frames in its queue are lost"""
BACK: Final = Frame(2)
"""Mark: the node is on its bus again"""
BACKWARD_NS: Final = 60_000_000_000
"""A frame of a message may be older than the bring-up of the drives by this much [ns]: what lay in a socket"""


class TimedFrame(NamedTuple):
    """A frame with its instant in run time, the number of its bus in the plan, and the node that sent it."""

    time_ns: int
    bus: int
    node: int
    frame: Frame


def add_words(
    words: list[int], time_ns: int, bus: int, node: int, can_id: int, data: bytes, remote: bool = False
) -> None:
    """Appends the three words of a frame to `words`."""
    words += (
        time_ns & 0xFFFF_FFFF_FFFF_FFFF,
        can_id | remote << 11 | len(data) << 12 | bus << 16 | node << 24,
        int.from_bytes(data, "little"),
    )


def pack(frames: Iterable[TimedFrame]) -> Values:
    """Returns the values of a message with these frames."""
    words: list[int] = []
    for time_ns, bus, node, (can_id, data, remote) in frames:
        add_words(words, time_ns, bus, node, can_id, data, remote)
    return np.array(words, dtype="<u8").view(np.float64)


def frames_of(message: Message) -> list[TimedFrame]:
    """Returns the frames in a message, without the marks."""
    return [timed for timed in unpack(message.values) if timed.bus != NO_BUS]


class FrameBounds:
    """The bounds of the values of a plan's messages with frames, for `echelon.runtime.admission`."""

    def __init__(self, plan: Plan) -> None:
        nodes = 2 * len(plan.robots) + 1  # the bridge, and at most a drive for each wheel
        buses = [*range(len(plan.can.buses)), NO_BUS]
        self._known = np.zeros(nodes << 8, bool)
        self._known[[node << 8 | bus for bus in buses for node in range(nodes)]] = True
        self._first_ns = -plan.can.bring_up_ns - BACKWARD_NS
        self._ahead_ns = 0 if plan.bridge is None else plan.bridge.period_ns

    def __call__(self, values: Values, time_ns: int) -> bool:
        """Returns whether the values are whole frames with at most eight data bytes, of buses and nodes that there are, each at
        most a period later than its message."""
        if values.size % 3:
            return False
        words = values.view("<u8").reshape(-1, 3)
        instants, heads = words[:, 0].view("<i8"), words[:, 1]
        if not (self._first_ns <= int(instants.min()) and int(instants.max()) <= time_ns + self._ahead_ns):
            return False
        places = heads >> 16
        if int(places.max()) >= self._known.size or not self._known[places].all():
            return False
        return int((heads >> 12 & 15).max()) <= 8


def unpack(values: Values) -> list[TimedFrame]:
    """Returns the frames and marks in the values of a message: the inverse of `pack`.

    Never raises: an incomplete frame at the end is dropped, and a length above eight counts as eight."""
    words = np.ascontiguousarray(values[: len(values) - len(values) % 3])
    frames = []
    for time_ns, (_, head, data) in zip(
        words.view("<i8")[::3].tolist(), words.view("<u8").reshape(-1, 3).tolist(), strict=True
    ):
        octets = data.to_bytes(8, "little")[: head >> 12 & 15]
        frame = Frame(head & 0x7FF, octets, bool(head >> 11 & 1))
        frames.append(TimedFrame(time_ns, head >> 16 & 0xFF, head >> 24, frame))
    return frames
