"""The content of a recording, its repeatability, and what survives a kill or a full disk."""

import json
import math
import re
import resource
import signal
import struct
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from echelon.bridge.frame_message import TimedFrame
from echelon.bridge.protocols.frame import Frame
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.runtime.link import LinkCounts
from echelon.sim.recording import mcap_reader as recording
from echelon.sim.recording import mcap_writer as chunked
from echelon.sim.recording.recorder import Recorder
from support.invented import METADATA, invented, paper
from support.runs import ROOT

SCENARIO = 'name = "invented"\n'
LINKS = [
    LinkCounts(0, 9, Channel.STATE, 21, 20, 1, 0, 20, 2, 1.5e6, 3_000_000),
    LinkCounts(9, 0, Channel.COMMAND, 21, 21, 0, 0, 21, 0, 0.0, 0),
]
DRIVE_FRAME = Frame(0x102, bytes(range(8)))
RATE = 10_000_000
FIELD = re.compile(r"^(/[\w/]+?)(?:\.([\w.\[\]]+))?$")


def record(path: Path, ticks: int = 21, flush_every: int = 0) -> list[Message]:
    """Records invented messages, a CAN frame per tick and counts of links; returns the messages."""
    messages = list(invented(paper(), ticks))
    with closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
        for number, message in enumerate(messages):
            recorder.record(message)
            if message.source == 0:
                recorder.record_frame(TimedFrame(message.time_ns, 0, 0, DRIVE_FRAME))
            if flush_every and number % flush_every == 0:
                recorder.flush_if_due(number * chunked.FLUSH_NS)
        recorder.record_links(messages[-1].time_ns, LINKS)
    assert recorder.failure is None
    assert recorder.null_messages == 7
    return messages


def topic_of(message: Message) -> str:
    """Returns the topic on which a message must be."""
    path = paper().formation[message.source].path
    name = {Channel.GROUP_STATE: "state"}.get(message.channel, message.channel.name.lower())
    return "/" + "/".join(part for part in (path, name) if part)


def values_of(message: Any) -> list[float]:
    """Returns all numbers of one of our own messages, in order."""
    fields = [name for name in message.__dataclass_fields__ if name not in ("header", "__msgtype__")]
    return [float(number) for name in fields for number in np.atleast_1d(getattr(message, name))]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Message]]:
    """A recording of 21 ms, and what was recorded."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return path, record(path)


@contextmanager
def decoded(path: Path) -> Iterator[Iterator[tuple[str, int, Any]]]:
    """A context that yields topic, time and message of each record of a file, as rosbags reads it by the file's schemas."""
    with AnyReader([path]) as reader:
        yield ((c.topic, time_ns, reader.deserialize(raw, c.msgtype)) for c, time_ns, raw in reader.messages())


def test_every_message_is_there_with_its_values(recorded: tuple[Path, list[Message]]) -> None:
    path, messages = recorded
    expected: dict[str, list[tuple[int, list[float]]]] = {}
    for message in messages:
        null = [float(message.source), float(message.channel), float(message.sequence)]
        topic, values = ("/nulls", null) if message.is_null else (topic_of(message), message.values.tolist())
        expected.setdefault(topic, []).append((message.time_ns, values))
    found: dict[str, list[tuple[int, list[float]]]] = {}
    with decoded(path) as rows:
        for topic, time_ns, message in rows:
            if message.__msgtype__.startswith("echelon_msgs") and topic != "/links":
                stamp = message.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == time_ns
                found.setdefault(topic, []).append((time_ns, values_of(message)))
    assert found == expected
    assert len(found) == 9 + 3 + 3 + 1 + 1


def test_times_sequences_and_statistics_by_the_mcap_reader(recorded: tuple[Path, list[Message]]) -> None:
    with recorded[0].open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        counts, previous = Counter[int](), 0
        for _schema, channel, message in reader.iter_messages():
            assert message.log_time == message.publish_time >= previous
            previous = message.log_time
            counts[channel.id] += 1
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.channel_message_counts == counts
        assert summary.statistics.message_count == counts.total()
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (0, 20_000_000)
        states = [message for _, _, message in reader.iter_messages("/g2/r5/state")]
        assert [message.sequence for message in states] == list(range(21))
        assert [message.log_time for message in states] == [1_000_000 * tick for tick in range(21)]
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.data) == ("scenario.toml", SCENARIO.encode())
        (metadata,) = reader.iter_metadata()
        assert (metadata.name, metadata.metadata) == ("echelon", METADATA)
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}


def test_the_summary_has_the_checksum_of_the_format(recorded: tuple[Path, list[Message]]) -> None:
    data = recorded[0].read_bytes()
    assert data[:8] == data[-8:] == b"\x89MCAP0\r\n"
    opcode, length, start, _offsets, checksum = struct.unpack("<BQQQI", data[-37:-8])
    assert (opcode, length, checksum) == (2, 20, zlib.crc32(data[start:-12]))


def test_what_is_shown_is_the_state(recorded: tuple[Path, list[Message]]) -> None:
    path, messages = recorded
    plan, instants = paper(), [0, 10_000_000, 20_000_000]
    states = [message for message in messages if message.channel is Channel.STATE]
    latest = {(m.time_ns, m.source): dict(zip(STATE_FIELDS, m.values.tolist(), strict=True)) for m in states}
    shown: dict[str, list[Any]] = {}
    with decoded(path) as rows:
        for topic, time_ns, message in rows:
            shown.setdefault(topic, []).append((time_ns, message))
    for topic in ("/tf", "/markers", "/joint_states", "/g1/r2/odom"):
        assert [time_ns for time_ns, _ in shown[topic]] == instants
    for at, time_ns in enumerate(instants):
        transforms = shown["/tf"][at][1].transforms
        markers = {(marker.ns, marker.id): marker for marker in shown["/markers"][at][1].markers}
        joints = shown["/joint_states"][at][1]
        assert [transform.child_frame_id for transform in transforms] == [robot.path for robot in plan.robots]
        for robot, transform in zip(plan.robots, transforms, strict=True):
            state = latest[time_ns, robot.index]
            x, y, theta = state["x"], state["y"], state["theta"]
            assert transform.header.frame_id == "world"
            assert (transform.transform.translation.x, transform.transform.translation.y) == (x, y)
            turn = transform.transform.rotation
            assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0, 0, math.sin(theta / 2), math.cos(theta / 2)))
            arrow = markers["robots", robot.index].pose.position
            assert arrow.x == pytest.approx(x - robot.offset * math.cos(theta))
            assert arrow.y == pytest.approx(y - robot.offset * math.sin(theta))
            odometry = shown[f"/{robot.path}/odom"][at][1]
            assert odometry.child_frame_id == robot.path
            assert odometry.pose.pose.position.x == x
            speed = odometry.twist.twist.linear
            back = complex(speed.x, speed.y) * complex(math.cos(theta), math.sin(theta))
            assert (back.real, back.imag) == pytest.approx((state["vx"], state["vy"]))
            assert odometry.twist.twist.angular.z == state["omega"]
            right, left = 2 * robot.index, 2 * robot.index + 1
            assert joints.name[right : left + 1] == [f"{robot.path}/right", f"{robot.path}/left"]
            assert (joints.effort[right], joints.effort[left]) == (state["tau_right"], state["tau_left"])
            wheels = robot.wheel_radius * joints.velocity[right : left + 1]
            assert wheels.mean() == pytest.approx(state["v"])
            assert (wheels[0] - wheels[1]) / (2 * robot.arm) == pytest.approx(state["omega"])
        for node in plan.nodes:
            below = range(node.first_robot, node.first_robot + node.robots)
            centroid = markers["centroids", node.index].pose.position
            assert centroid.x == pytest.approx(np.mean([latest[time_ns, robot]["x"] for robot in below]))
            assert centroid.y == pytest.approx(np.mean([latest[time_ns, robot]["y"] for robot in below]))
        colors = [(c.r, c.g, c.b) for c in (markers["robots", robot.index].color for robot in plan.robots)]
        assert colors[0] == colors[2] != colors[3] == colors[5] != colors[6]
    ((time_ns, line),) = shown["/desired"]
    assert time_ns == 0
    assert (line.markers[0].points[-1].x, line.markers[0].points[-1].y) == pytest.approx((12, 30 * math.sin(1.2)))


def test_can_frames_and_links(recorded: tuple[Path, list[Message]]) -> None:
    with decoded(recorded[0]) as rows:
        found = [(topic, message) for topic, _, message in rows if topic in ("/can/frames", "/links")]
    frames = [message for topic, message in found if topic == "/can/frames"]
    links = [message for topic, message in found if topic == "/links"]
    assert len(frames) == 21
    assert (frames[0].id, frames[0].is_extended, bytes(frames[0].data)) == (DRIVE_FRAME.can_id, False, DRIVE_FRAME.data)
    assert [(link.name, link.sent, link.lost) for link in links] == [("g1/r2 to g1", 21, 1), ("g1 to g1/r2", 21, 0)]


def test_before_a_robot_speaks_it_stands_at_its_start(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path / "run.mcap", paper(), SCENARIO, METADATA)) as recorder:
        recorder.record(Message(Channel.STATE, 0, 0, 0, np.zeros(len(STATE_FIELDS))))
    with decoded(tmp_path / "run.mcap") as rows:
        (message,) = [message for topic, _, message in rows if topic == "/tf"]
    positions = [(row.transform.translation.x, row.transform.translation.y) for row in message.transforms]
    assert positions == [(0.0, 0.0), *[robot.start for robot in paper().robots[1:]]]


def test_the_same_run_gives_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bytes do not depend on the times of provisional writes."""
    monkeypatch.setattr(chunked, "CHUNK_SIZE", 20_000)
    contents = set()
    for flush_every in (0, 1, 7, 100):
        path = tmp_path / f"run-{flush_every}.mcap"
        record(path, flush_every=flush_every)
        contents.add(path.read_bytes())
    assert len(contents) == 1


def test_avoidance_adds_positions_and_forces(tmp_path: Path) -> None:
    plan = replace(paper(), avoidance=replace(paper().avoidance, enabled=True))
    with closing(Recorder(tmp_path / "run.mcap", plan, SCENARIO, METADATA)) as recorder:
        recorder.record(Message(Channel.GROUP_STATE, 9, 0, 0, np.arange(4.0 + 4 + 6)))
        recorder.record(Message(Channel.REFERENCE, 12, 0, 0, np.arange(6.0 + 18 + 18)))
    with decoded(tmp_path / "run.mcap") as rows:
        found = {topic: message for topic, _, message in rows}
    assert found["/g1/state"].error_rates.tolist() == [4.0, 5.0, 6.0, 7.0]
    assert found["/g1/state"].positions.tolist() == [8.0, 9.0, 10.0, 11.0, 12.0, 13.0]
    sizes = [found["/reference"].accelerations.size, found["/reference"].error_rates.size]
    assert (sizes, found["/reference"].forces.tolist()) == ([6, 18], list(np.arange(24.0, 42.0)))


def test_a_message_of_the_wrong_size_is_refused_by_name(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", paper(), SCENARIO, METADATA)
    with closing(recorder), pytest.raises(ValueError, match=r"STATE of g1/r2 has 3 values; it must have 16"):
        recorder.record(Message(Channel.STATE, 0, 0, 0, np.zeros(3)))


def test_a_place_that_does_not_exist_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(tmp_path / "no" / "run.mcap", paper(), SCENARIO, METADATA)


def test_at_no_instant_more_than_a_fifth_of_a_second_is_missing_on_disk(tmp_path: Path) -> None:
    """With a simulated clock and a chunk that is never full, only provisional writes bring messages to the disk."""
    path, tick_ns = tmp_path / "run.mcap", 9_000_000
    with closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
        for tick in range(100):
            recorder.record(Message(Channel.STATE, 0, tick, tick * tick_ns, np.full(len(STATE_FIELDS), float(tick))))
            recorder.flush_if_due(77 + tick * tick_ns)
            result = recording.recover(path, tmp_path / "mended.mcap")
            assert result.until_ns is not None
            assert tick * tick_ns - result.until_ns <= 200_000_000


def test_a_chunk_shorter_than_what_stood_there_provisionally(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No bytes of the longer provisional chunk remain."""
    poor = iter([True])
    good = zstandard.ZstdCompressor(level=chunked.LEVEL)

    class Improving:
        def compress(self, data: bytes) -> bytes:
            return data if next(poor, False) else good.compress(data)

    contents = []
    for flush in (False, True):
        path = tmp_path / f"run-{flush}.mcap"
        with closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
            if flush:
                monkeypatch.setattr(recorder._file, "_compressor", Improving())
            for tick in range(900):
                recorder.record(Message(Channel.STATE, 0, tick, tick, np.zeros(len(STATE_FIELDS))))
            if flush:
                recorder.flush_if_due(0)
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]


CHILD = """
import sys, time
from pathlib import Path
from support.invented import METADATA, invented, paper
from echelon.sim.recording.recorder import Recorder

recorder = Recorder(Path(sys.argv[1]), paper(), "", METADATA)
begin = time.monotonic_ns()
tick, now = None, 0
for message in invented(paper(), 10**9):
    if message.sequence != tick:
        tick = message.sequence
        recorder.flush_if_due(begin + now)
        print(now, flush=True)
        time.sleep(0.005)
        now = time.monotonic_ns() - begin
    recorder.record(type(message)(message.channel, message.source, message.sequence, now, message.values))
"""


def test_kill_costs_at_most_a_fifth_of_a_second(tmp_path: Path) -> None:
    """The child's run time is wall time, and slow enough that no chunk is filled before the kill."""
    path, mended = tmp_path / "run.mcap", tmp_path / "mended.mcap"
    environment = {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    child = subprocess.Popen([sys.executable, "-c", CHILD, path], stdout=subprocess.PIPE, text=True, env=environment)
    assert child.stdout is not None
    said = 0
    while said < 500_000_000:
        said = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    said = [said, *[int(line) for line in child.stdout.read().split()]][-1]
    assert child.wait() == -signal.SIGKILL
    child.stdout.close()
    result = recording.recover(path, mended)
    assert not result.complete
    assert result.damaged == 0
    assert result.until_ns is not None
    assert 0 <= said - result.until_ns <= 200_000_000
    assert recording.read_scenario(mended) == ""
    trace = recording.read_trace(mended, paper())
    assert trace.times_ns[0][-1] == result.until_ns


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Lets no file grow beyond a size."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("flush_every", [0, 50])
@pytest.mark.parametrize("size", [61_111, 90_000])
def test_a_full_disk_ends_the_recording_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int, flush_every: int
) -> None:
    monkeypatch.setattr(chunked, "CHUNK_SIZE", 20_000)
    path, mended = tmp_path / "run.mcap", tmp_path / "mended.mcap"
    messages = list(invented(paper(), 100))
    with disk_of(size), closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
        for number, message in enumerate(messages):
            recorder.record(message)
            if flush_every and number % flush_every == 0:
                recorder.flush_if_due(number * chunked.FLUSH_NS)
        recorder.record_frame(TimedFrame(0, 0, 0, DRIVE_FRAME))
        recorder.record_links(0, LINKS)
    assert recorder.failure is not None
    assert recorder.failure.startswith(f"{path}: File too large")
    assert path.stat().st_size <= size
    result = recording.recover(path, mended)
    assert result.until_ns is not None
    trace = recording.read_trace(mended, paper())
    for robot, states in enumerate(trace.states):
        given = [message.values for message in messages if message.channel is Channel.STATE and message.source == robot]
        assert len(states) > 10
        assert np.array_equal(states, given[: len(states)])


def test_what_was_written_provisionally_survives_a_full_disk(tmp_path: Path) -> None:
    """The disk fills up while a provisional chunk is being replaced by a longer one."""
    path = tmp_path / "run.mcap"
    messages = list(invented(paper(), 40))
    with closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
        for message in messages[:300]:
            recorder.record(message)
        recorder.flush_if_due(0)
        before = path.read_bytes()
        for message in messages[300:]:
            recorder.record(message)
        with disk_of(len(before) + 100):
            recorder.flush_if_due(chunked.FLUSH_NS)
    assert recorder.failure is not None
    assert path.read_bytes() == before


def test_a_finished_chunk_is_not_written_again_when_the_disk_fills_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunked, "CHUNK_SIZE", 40_000)
    path = tmp_path / "run.mcap"
    messages = [message for message in invented(paper(), 100) if message.channel is Channel.STATE]
    with closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
        for message in messages[:20]:
            recorder.record(message)
        recorder.flush_if_due(0)
        for message in messages[20:300]:
            recorder.record(message)
        with disk_of(path.stat().st_size + 15_000):
            for message in messages[300:]:
                recorder.record(message)
    assert recorder.failure is not None
    recording.recover(path, tmp_path / "mended.mcap")
    times = recording.read_trace(tmp_path / "mended.mcap", paper()).times_ns[0].tolist()
    assert times == [1_000_000 * tick for tick in range(len(times))]


def test_a_disk_that_is_full_from_the_start(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with disk_of(0), closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
        for message in invented(paper(), 3):
            recorder.record(message)
    assert recorder.failure is not None
    assert recorder.failure.startswith(f"{path}: ")
    assert recorder.failure.endswith("; the recording ends early")


@pytest.mark.parametrize("there", ["file", "link"])
def test_what_is_there_already_is_never_written_over(there: str, tmp_path: Path) -> None:
    path, kept = tmp_path / "run.mcap", tmp_path / "kept"
    kept.write_text("kept")
    path.write_text("kept") if there == "file" else path.symlink_to(kept)
    with pytest.raises(FileExistsError):
        Recorder(path, paper(), SCENARIO, METADATA)
    assert path.read_text() == kept.read_text() == "kept"


def test_close_twice(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", paper(), SCENARIO, METADATA)
    recorder.close()
    content = (tmp_path / "run.mcap").read_bytes()
    recorder.close()
    assert (tmp_path / "run.mcap").read_bytes() == content
    assert recorder.failure is None


def layout_paths(layout: dict[str, Any]) -> list[str]:
    """Returns every topic and message path in a layout."""
    found = []
    for panel in layout["configById"].values():
        found += [path["value"] for path in panel.get("paths", [])]
        found += [panel["topicPath"]] if "topicPath" in panel else []
        found += list(panel.get("topics", {}))
    return found


def test_everything_in_the_layout_is_in_a_recording(recorded: tuple[Path, list[Message]]) -> None:
    layout = json.loads((ROOT / "deploy/lichtblick-layout.json").read_text())
    with decoded(recorded[0]) as rows:
        found = {topic: message for topic, _, message in rows}
    paths = layout_paths(layout)
    assert {"/tf", "/markers", "/desired", "/can/frames", "/joint_states.effort[17]", "/g1/state.x"} <= set(paths)
    for path in paths:
        match = FIELD.match(path)
        assert match, path
        topic, field = match.groups()
        value: Any = found[topic]
        for name, _, index in re.findall(r"(\w+)(\[(\d+)\])?", field or ""):
            value = getattr(value, name)
            if index:
                value = value[int(index)]
        assert not field or isinstance(value, float), path
    panels = set(layout["configById"])
    assert panels == set(re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"])))
    view = layout["configById"]["3D!formation"]
    assert view["followTf"] == found["/tf"].transforms[0].header.frame_id
