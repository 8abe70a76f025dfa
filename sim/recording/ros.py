"""ROS 2 messages as bytes: encoders (CDR, little endian).

A CDR message is four bytes of encapsulation, then its fields.  A number stands at a multiple of its size, counted from the end
of the encapsulation.  The messages that are written most often have a constant size.  So their bytes are laid out once
(`Layout`), and an encoder only puts the stamp and the float64 values of each message into their places.
"""

import struct
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS
from echelon.runtime.link import LinkCounts

Array = NDArray[np.float64]

ENCAPSULATION: Final = b"\x00\x01\x00\x00"
WORLD: Final = "world"
"""The frame of reference of all positions."""
ARROW, SPHERE, LINE_STRIP = 0, 2, 4


STAMP_SIZE: Final = 12


def stamp(time_ns: int) -> bytes:
    """Returns the beginning of a message with a header: encapsulation and stamp, `STAMP_SIZE` bytes."""
    return ENCAPSULATION + struct.pack("<iI", *divmod(time_ns, 1_000_000_000))


class Layout:
    """The layout of a message, made field by field."""

    def __init__(self) -> None:
        self.body = bytearray()
        """The bytes behind the encapsulation, zero where values are filled in later"""
        self.stamps: list[int] = []
        """Places of the stamps in `body`"""
        self.places: list[int] = []
        """Places of the float64 values that are filled in later, in `body`"""

    def put(self, code: str, *values: float) -> "Layout":
        """Adds numbers of one type, given as a code of `struct`."""
        size = struct.calcsize(f"<{code}")
        self.body += bytes(-len(self.body) % size) + struct.pack(f"<{len(values)}{code}", *values)
        return self

    def string(self, text: str) -> "Layout":
        """Adds a string: its length, its bytes, a zero."""
        data = text.encode() + b"\x00"
        self.put("I", len(data))
        self.body += data
        return self

    def header(self, frame_id: str) -> "Layout":
        """Adds a header, whose stamp is filled in later."""
        self.put("I", 0)
        self.stamps.append(len(self.body) - 4)
        return self.put("I", 0).string(frame_id)

    def hole(self, count: int) -> "Layout":
        """Adds places for `count` float64 values, which are filled in later."""
        self.put("d", *[0.0] * count)
        self.places.extend(range(len(self.body) - 8 * count, len(self.body), 8))
        return self

    def holes(self, count: int) -> "Layout":
        """Adds a sequence with places for `count` float64 values.  An empty sequence has no alignment after its length."""
        self.put("I", count)
        return self.hole(count) if count else self


class Template:
    """An encoder of messages with one layout that puts in all stamps and all float64 values."""

    def __init__(self, layout: Layout) -> None:
        size = 8 + len(layout.body)
        self._bytes = np.zeros(
            size + -size % 8, np.uint8
        )  # four unused bytes and the encapsulation align the body to 8
        self._bytes[4:size] = np.frombuffer(ENCAPSULATION + layout.body, np.uint8)
        self._words, self._doubles = self._bytes.view("<u4"), self._bytes.view("<f8")
        self._message = self._bytes[4:size]
        self._seconds = np.array(layout.stamps, int) // 4 + 2
        self._nanoseconds = self._seconds + 1
        self._places = np.array(layout.places, int) // 8 + 1

    def encode(self, time_ns: int, values: Array) -> bytes:
        """Returns the message; `values` (n,) fill the n places of the layout in their order."""
        self._words[self._seconds], self._words[self._nanoseconds] = divmod(time_ns, 1_000_000_000)
        self._doubles[self._places] = values
        return self._message.tobytes()


class Splice:
    """An encoder of messages with one layout that begins with a header; it takes the float64 values as bytes, in order.

    It is faster than `Template`, since it only joins constant bytes and pieces of the given bytes."""

    def __init__(self, layout: Layout) -> None:
        starts = [at for at in layout.places if at - 8 not in layout.places]
        ends = [at + 8 for at in layout.places if at + 8 not in layout.places]
        body = bytes(layout.body)
        self.size = 8 * len(layout.places)
        """Number of bytes of values in a message"""
        self._first = body[8 : starts[0]]
        self._end = ends[0] - starts[0]
        self._rest: list[tuple[bytes, int, int]] = []
        at = self._end
        for end, start, next_end in zip(ends, [*starts[1:], len(body)], [*ends[1:], len(body)], strict=True):
            if start > end:
                self._rest.append((body[end:start], at, at + next_end - start))
                at += next_end - start
        self._message_size = STAMP_SIZE + len(self._first) + self.size + sum(len(each) for each, _, _ in self._rest)

    def encode(self, head: bytes, values: bytes) -> bytes:
        """Returns the message; `head` is from `stamp`, `values` are `size` bytes."""
        if not self._rest:
            return head + self._first + values
        message = head + self._first + values[: self._end]
        for constant, start, end in self._rest:
            message += constant + values[start:end]
        return message

    def decode(self, message: bytes) -> bytes:
        """Returns the values of a message that `encode` made.  Raises ValueError if its size or a constant part is another."""
        if len(message) != self._message_size:
            raise ValueError(f"has {len(message)} bytes, not {self._message_size}")
        at = STAMP_SIZE + len(self._first)
        values = message[at : at + self._end]
        at += self._end
        for constant, start, end in self._rest:
            if message[at : at + len(constant)] != constant:
                raise ValueError("has an array of another length")
            at += len(constant)
            values += message[at : at + end - start]
            at += end - start
        return values


def robot_state() -> Splice:
    """Returns the encoder of echelon_msgs/RobotState; its values are `STATE_FIELDS`."""
    return Splice(Layout().header(WORLD).hole(len(STATE_FIELDS)))


def group_state(error_rates: int, positions: int) -> Splice:
    """Returns the encoder of echelon_msgs/GroupState; its values are `GROUP_FIELDS`, error rates, positions."""
    return Splice(Layout().header(WORLD).hole(len(GROUP_FIELDS)).holes(error_rates).holes(positions))


def reference(accelerations: int, error_rates: int, forces: int) -> Splice:
    """Returns the encoder of echelon_msgs/Reference; its values are accelerations, error rates, forces."""
    return Splice(Layout().header(WORLD).holes(accelerations).holes(error_rates).holes(forces))


def command(accelerations: int) -> Splice:
    """Returns the encoder of echelon_msgs/Command; its values are accelerations."""
    return Splice(Layout().header(WORLD).holes(accelerations))


def wheel_torque() -> Splice:
    """Returns the encoder of echelon_msgs/WheelTorque; its values are `TORQUE_FIELDS`."""
    return Splice(Layout().header("").hole(len(TORQUE_FIELDS)))


def wheels(torques: int) -> Splice:
    """Returns the encoder of echelon_msgs/Wheels; its values are torques, two for each robot."""
    return Splice(Layout().header("").holes(torques))


def transforms(frames: Sequence[str]) -> Template:
    """Returns the encoder of tf2_msgs/TFMessage, from the world to `frames`; values of each frame: x, y, q_z, q_w."""
    layout = Layout().put("I", len(frames))
    for frame in frames:
        layout.header(WORLD).string(frame).hole(2).put("d", 0.0, 0.0, 0.0).hole(2)
    return Template(layout)


def odometry(frame: str) -> Template:
    """Returns the encoder of nav_msgs/Odometry of a robot.

    Values: x, y, q_z, q_w, then forward speed, lateral speed and yaw rate in the robot's frame.  Covariances are zero, which
    means unknown."""
    layout = Layout().header(WORLD).string(frame).hole(2).put("d", 0.0, 0.0, 0.0).hole(2).put("d", *[0.0] * 36)
    return Template(layout.hole(2).put("d", 0.0, 0.0, 0.0).hole(1).put("d", *[0.0] * 36))


def joint_state(names: Sequence[str]) -> Template:
    """Returns the encoder of sensor_msgs/JointState; values: the velocities of all joints, then their efforts."""
    layout = Layout().header("").put("I", len(names))
    for name in names:
        layout.string(name)
    return Template(layout.put("I", 0).holes(len(names)).holes(len(names)))


def markers(count: int) -> Layout:
    """Returns the beginning of the layout of a visualization_msgs/MarkerArray.  `add_marker` must then be called `count`
    times."""
    return Layout().put("I", count)


def add_marker(
    layout: Layout,
    namespace: str,
    number: int,
    kind: int,
    scale: tuple[float, float, float],
    color: tuple[float, float, float, float],
    points: Sequence[tuple[float, float]] = (),
) -> None:
    """Adds a marker in the frame `WORLD`.  Its values are x, y, q_z, q_w; a marker with points [m] has no values.

    `number` tells it apart from others in the namespace; `kind` is `ARROW`, `SPHERE` or `LINE_STRIP`; `scale` is in metres,
    `color` is red, green, blue, opacity from 0 to 1."""
    layout.header(WORLD).string(namespace).put("i", number, kind, 0)
    if points:
        layout.put("d", *[0.0] * 6, 1.0)
    else:
        layout.hole(2).put("d", 0.0, 0.0, 0.0).hole(2)
    layout.put("d", *scale).put("f", *color).put("i", 0, 0).put("B", 0).put("I", len(points))
    if points:
        layout.put("d", *[number for x, y in points for number in (x, y, 0.0)])
    layout.put("I", 0).string("")  # colours of points, texture_resource
    layout.put("I", 0, 0).string("").string("").put("I", 0).put("I", 0)  # texture, uv_coordinates
    layout.string("").string("").string("").put("I", 0).put("B", 0)  # text, mesh_resource, mesh_file


_FRAME: Final = struct.Struct("<I4xIBBBB8s")  # an empty frame_id, padded to a multiple of four; then the CAN frame


def can_frame(head: bytes, can_id: int, data: bytes, remote: bool = False) -> bytes:
    """Returns a can_msgs/Frame; with an identifier of more than 11 bits it is an extended frame.  `head` is from `stamp`.

    Raises ValueError if `data` is longer than eight bytes."""
    if len(data) > 8:
        raise ValueError(f"CAN frame {can_id:#x} holds {len(data)} bytes; can_msgs/Frame takes at most 8")
    return head + _FRAME.pack(1, can_id, remote, can_id > 0x7FF, False, len(data), data)


NULL_MESSAGE: Final = struct.Struct("<I4xIB3xQ")
"""Of an echelon_msgs/NullMessage what follows the stamp: an empty frame_id, padded to a multiple of four; source, channel,
sequence number"""


def null_message(head: bytes, source: int, channel: int, sequence: int) -> bytes:
    """Returns an echelon_msgs/NullMessage.  `head` is from `stamp`."""
    return head + NULL_MESSAGE.pack(1, source, channel, sequence)


def link_statistics(time_ns: int, counts: LinkCounts, name: str) -> bytes:
    """Returns an echelon_msgs/LinkStatistics; `name` says which link it is, for people."""
    layout = Layout().header("").put("I", counts.source, counts.receiver).put("B", counts.channel).string(name)
    layout.put("Q", counts.sent, counts.delivered, counts.lost, counts.in_flight, counts.used, counts.held)
    layout.put("d", counts.age_mean_ns)
    layout.put("q", counts.age_max_ns, counts.age_p50_ns, counts.age_p95_ns, counts.age_p99_ns)
    layout.put("Q", counts.duplicates)
    return stamp(time_ns) + bytes(layout.body[8:])
