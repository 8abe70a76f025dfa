"""sim.recording.ros: every encoder, compared with bytes written by hand and with rosbags for random values."""

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from echelon.messages import STATE_FIELDS, Channel
from echelon.runtime.link import LinkCounts
from echelon.sim.recording import ros
from echelon.sim.recording.ros_definitions import DEFINITIONS, schema_name, schema_text


def make_typestore() -> Any:
    """Returns a rosbags typestore that knows our schema texts and nothing else."""
    store = get_typestore(Stores.EMPTY)
    for name in DEFINITIONS:
        store.register(get_types_from_msg(schema_text(name), schema_name(name)))
    return store


STORE = make_typestore()
FULL_NAMES = sorted(schema_name(name) for name in DEFINITIONS)


def make(name: str, *values: Any) -> Any:
    """Returns a rosbags message of a type, its fields in order."""
    return STORE.types[schema_name(name)](*values)


def header(time_ns: int, frame_id: str) -> Any:
    """Returns a rosbags header."""
    return make("std_msgs/Header", make("builtin_interfaces/Time", *divmod(time_ns, 10**9)), frame_id)


def serialized(name: str, message: Any) -> bytes:
    """Returns a message as bytes, as rosbags serializes it."""
    return bytes(STORE.serialize_cdr(message, schema_name(name)))


times = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.floats(allow_nan=False)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)


def arrays(size: st.SearchStrategy[int] | int) -> st.SearchStrategy[Any]:
    """Arrays of float64."""
    sizes = st.just(size) if isinstance(size, int) else size
    return sizes.flatmap(lambda n: st.lists(numbers, min_size=n, max_size=n)).map(lambda row: np.array(row, float))


STATE = np.arange(1.0, 17.0)
HEAD = b"\x00\x01\x00\x00" + b"\x07\x00\x00\x00" + b"\x15\xcd\x5b\x07"  # 7.123456789 s
WORLD = b"\x06\x00\x00\x00world\x00"
GOLDEN = [
    ("RobotState", ros.robot_state(), STATE, HEAD + WORLD + bytes(6) + struct.pack("<16d", *STATE)),
    (
        "GroupState",
        ros.group_state(2, 1),
        STATE[:7],
        HEAD
        + WORLD
        + bytes(6)
        + struct.pack("<4d", 1, 2, 3, 4)
        + b"\x02\x00\x00\x00"
        + bytes(4)
        + struct.pack("<2d", 5, 6)
        + b"\x01\x00\x00\x00"
        + bytes(4)
        + struct.pack("<d", 7),
    ),
    (
        "Reference",
        ros.reference(2, 0, 0),
        STATE[:2],
        HEAD + WORLD + bytes(2) + b"\x02\x00\x00\x00" + struct.pack("<2d", 1, 2) + bytes(8),
    ),
    ("Command", ros.command(1), STATE[:1], HEAD + WORLD + bytes(2) + b"\x01\x00\x00\x00" + struct.pack("<d", 1)),
]


@pytest.mark.parametrize(("name", "splice", "values", "golden"), GOLDEN, ids=[case[0] for case in GOLDEN])
def test_golden_bytes_both_ways(name: str, splice: ros.Splice, values: Any, golden: bytes) -> None:
    assert splice.size == values.nbytes
    assert splice.encode(ros.stamp(7_123_456_789), values.tobytes()) == golden
    assert splice.decode(golden) == values.tobytes()
    message = STORE.deserialize_cdr(golden, f"echelon_msgs/msg/{name}")
    fields = [field for field in message.__dataclass_fields__ if field not in ("header", "__msgtype__")]
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (7, 123456789)
    assert message.header.frame_id == "world"
    assert np.array_equal(np.concatenate([np.atleast_1d(getattr(message, field)) for field in fields]), values)


def test_bytes_of_another_size_or_with_other_arrays_are_refused() -> None:
    splice, (_, _, _, golden) = ros.group_state(2, 1), GOLDEN[1]
    for odd in (golden[:-1], golden + b"\0", b""):
        with pytest.raises(ValueError, match=rf"has {len(odd)} bytes, not {len(golden)}"):
            splice.decode(odd)
    with pytest.raises(ValueError, match="has an array of another length"):
        ros.group_state(1, 2).decode(golden)


def test_golden_can_frame() -> None:
    golden = (
        HEAD
        + b"\x01\x00\x00\x00\x00\x00\x00\x00"
        + b"\x23\x01\x00\x00"
        + b"\x00\x00\x00\x03"
        + b"\xaa\xbb\xcc\x00\x00\x00\x00\x00"
    )
    assert ros.can_frame(ros.stamp(7_123_456_789), 0x123, b"\xaa\xbb\xcc", False) == golden
    frame = STORE.deserialize_cdr(golden, "can_msgs/msg/Frame")
    assert (frame.id, frame.is_extended, frame.dlc, bytes(frame.data)) == (0x123, False, 3, b"\xaa\xbb\xcc\0\0\0\0\0")


def test_frame_of_more_than_eight_bytes_is_refused() -> None:
    with pytest.raises(ValueError, match="0x123 holds 9 bytes"):
        ros.can_frame(ros.stamp(0), 0x123, bytes(9), False)


@pytest.mark.parametrize("name", FULL_NAMES)
def test_standard_types_are_the_standard(name: str) -> None:
    """The type hashes are those of the ROS distribution, so ROS programs accept the messages."""
    standard = get_typestore(Stores.ROS2_HUMBLE)
    if name in standard.fielddefs:
        assert STORE.hash_rihs01(name) == standard.hash_rihs01(name)
        assert STORE.generate_msgdef(name, ros_version=2) == standard.generate_msgdef(name, ros_version=2)
    else:
        assert name.startswith("echelon_msgs") or name == "can_msgs/msg/Frame"


def test_can_frame_type_is_that_of_ros_canopen() -> None:
    assert STORE.hash_rihs01("can_msgs/msg/Frame").startswith("RIHS01_0cdc7d15")


@given(times, arrays(len(STATE_FIELDS)))
def test_robot_state(time_ns: int, values: Any) -> None:
    message = make("echelon_msgs/RobotState", header(time_ns, "world"), *values.tolist())
    assert ros.robot_state().encode(ros.stamp(time_ns), values.tobytes()) == serialized(
        "echelon_msgs/RobotState", message
    )


@given(times, arrays(4), arrays(st.integers(0, 3)), arrays(st.integers(0, 3)))
def test_group_state(time_ns: int, centroid: Any, rates: Any, positions: Any) -> None:
    message = make("echelon_msgs/GroupState", header(time_ns, "world"), *centroid.tolist(), rates, positions)
    values = np.concatenate([centroid, rates, positions])
    splice = ros.group_state(len(rates), len(positions))
    encoded = splice.encode(ros.stamp(time_ns), values.tobytes())
    assert encoded == serialized("echelon_msgs/GroupState", message)
    assert splice.decode(encoded) == values.tobytes()


@given(times, arrays(st.integers(1, 3)), arrays(st.integers(0, 3)), arrays(st.integers(0, 3)))
def test_reference_and_command(time_ns: int, accelerations: Any, rates: Any, forces: Any) -> None:
    head, values = ros.stamp(time_ns), np.concatenate([accelerations, rates, forces]).tobytes()
    message = make("echelon_msgs/Reference", header(time_ns, "world"), accelerations, rates, forces)
    splice = ros.reference(len(accelerations), len(rates), len(forces))
    assert splice.encode(head, values) == serialized("echelon_msgs/Reference", message)
    assert splice.decode(splice.encode(head, values)) == values
    message = make("echelon_msgs/Command", header(time_ns, "world"), accelerations)
    encoded = ros.command(len(accelerations)).encode(head, accelerations.tobytes())
    assert encoded == serialized("echelon_msgs/Command", message)


@given(times, st.lists(st.tuples(names, arrays(4)), min_size=1, max_size=4))
def test_transforms(time_ns: int, robots: list[tuple[str, Any]]) -> None:
    transforms = []
    for frame, (x, y, q_z, q_w) in robots:
        turn = make("geometry_msgs/Quaternion", 0.0, 0.0, float(q_z), float(q_w))
        shift = make("geometry_msgs/Vector3", float(x), float(y), 0.0)
        transform = make("geometry_msgs/Transform", shift, turn)
        transforms.append(make("geometry_msgs/TransformStamped", header(time_ns, "world"), frame, transform))
    message = make("tf2_msgs/TFMessage", transforms)
    template = ros.transforms([frame for frame, _ in robots])
    template.encode(time_ns // 2, np.ones(4 * len(robots)))  # nothing of an earlier message may remain
    encoded = template.encode(time_ns, np.concatenate([values for _, values in robots]))
    assert encoded == serialized("tf2_msgs/TFMessage", message)


@given(times, names, arrays(7))
def test_odometry(time_ns: int, frame: str, values: Any) -> None:
    x, y, q_z, q_w, forward, lateral, omega = values.tolist()
    pose = make(
        "geometry_msgs/Pose",
        make("geometry_msgs/Point", x, y, 0.0),
        make("geometry_msgs/Quaternion", 0.0, 0.0, q_z, q_w),
    )
    twist = make(
        "geometry_msgs/Twist",
        make("geometry_msgs/Vector3", forward, lateral, 0.0),
        make("geometry_msgs/Vector3", 0.0, 0.0, omega),
    )
    message = make(
        "nav_msgs/Odometry",
        header(time_ns, "world"),
        frame,
        make("geometry_msgs/PoseWithCovariance", pose, np.zeros(36)),
        make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
    )
    assert ros.odometry(frame).encode(time_ns, values) == serialized("nav_msgs/Odometry", message)


@given(times, st.lists(names, min_size=1, max_size=5), st.data())
def test_joint_state(time_ns: int, joints: list[str], data: st.DataObject) -> None:
    velocity, effort = data.draw(arrays(len(joints))), data.draw(arrays(len(joints)))
    message = make("sensor_msgs/JointState", header(time_ns, ""), joints, np.empty(0), velocity, effort)
    encoded = ros.joint_state(joints).encode(time_ns, np.concatenate([velocity, effort]))
    assert encoded == serialized("sensor_msgs/JointState", message)


@given(times, st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 2**64 - 1))
def test_null_message(time_ns: int, source: int, channel: int, sequence: int) -> None:
    message = make("echelon_msgs/NullMessage", header(time_ns, ""), source, channel, sequence)
    encoded = ros.null_message(ros.stamp(time_ns), source, channel, sequence)
    assert encoded == serialized("echelon_msgs/NullMessage", message)


singles = st.floats(0, 1, width=32)
points = st.lists(st.tuples(numbers, numbers), max_size=3)


@given(times, st.lists(st.tuples(names, points, arrays(4), st.tuples(singles, singles, singles, singles)), max_size=3))
def test_markers(time_ns: int, rows: list[Any]) -> None:
    layout = ros.markers(len(rows))
    markers: list[Any] = []
    values: list[float] = []
    for number, (namespace, line, pose, color) in enumerate(rows):
        kind = ros.LINE_STRIP if line else ros.ARROW
        ros.add_marker(layout, namespace, number, kind, (1.0, 2.0, 3.0), color, line)
        x, y, q_z, q_w = (0.0, 0.0, 0.0, 1.0) if line else pose.tolist()
        values.extend([] if line else pose.tolist())
        image = make("sensor_msgs/CompressedImage", header(0, ""), "", np.empty(0, np.uint8))
        markers.append(
            make(
                "visualization_msgs/Marker",
                header(time_ns, "world"),
                namespace,
                number,
                kind,
                0,
                make(
                    "geometry_msgs/Pose",
                    make("geometry_msgs/Point", x, y, 0.0),
                    make("geometry_msgs/Quaternion", 0.0, 0.0, q_z, q_w),
                ),
                make("geometry_msgs/Vector3", 1.0, 2.0, 3.0),
                make("std_msgs/ColorRGBA", *color),
                make("builtin_interfaces/Duration", 0, 0),
                False,
                [make("geometry_msgs/Point", float(x), float(y), 0.0) for x, y in line],
                [],
                "",
                image,
                [],
                "",
                "",
                make("visualization_msgs/MeshFile", "", np.empty(0, np.uint8)),
                False,
            )
        )
    encoded = ros.Template(layout).encode(time_ns, np.array(values))
    assert encoded == serialized("visualization_msgs/MarkerArray", make("visualization_msgs/MarkerArray", markers))


@given(times, st.integers(0, 2**29 - 1), st.binary(max_size=8), st.booleans())
def test_can_frame(time_ns: int, can_id: int, data: bytes, remote: bool) -> None:
    padded = np.frombuffer(data.ljust(8, b"\0"), np.uint8)
    message = make("can_msgs/Frame", header(time_ns, ""), can_id, remote, can_id > 0x7FF, False, len(data), padded)
    assert ros.can_frame(ros.stamp(time_ns), can_id, data, remote) == serialized("can_msgs/Frame", message)


@given(
    times,
    names,
    st.tuples(*[st.integers(0, 2**63)] * 6),
    numbers,
    st.tuples(*[st.integers(0, 2**62)] * 4),
    st.integers(0, 2**63),
)
def test_link_statistics(
    time_ns: int,
    name: str,
    counts: tuple[int, int, int, int, int, int],
    mean: float,
    ages: tuple[int, int, int, int],
    duplicates: int,
) -> None:
    values = *counts, mean, *ages, duplicates
    message = make("echelon_msgs/LinkStatistics", header(time_ns, ""), 3, 4, int(Channel.COMMAND), name, *values)
    encoded = ros.link_statistics(time_ns, LinkCounts(3, 4, Channel.COMMAND, *values), name)
    assert encoded == serialized("echelon_msgs/LinkStatistics", message)
