"""sim.recording.mcap_reader: states are read bit for bit, cut-off files are recovered, garbage raises ValueError."""

from contextlib import closing
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from echelon.messages import Channel, Message
from echelon.runtime.link import LinkCounts
from echelon.sim.recording import mcap_writer as chunked
from echelon.sim.recording.mcap_reader import CutError, read_links, read_metadata, read_scenario, read_trace, recover
from echelon.sim.recording.recorder import Recorder
from echelon.sim.results.trace import TraceBuilder
from support.invented import METADATA, invented, paper

SCENARIO = 'name = "µ"\r\n'
LINKS = [LinkCounts(0, 9, Channel.STATE, 21, 20, 1, 0, 20, 2, 1.5e6 / 7, 3_000_000, 1, 2, 3, 4)]
TICKS = 60


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of several chunks."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunked, "CHUNK_SIZE", 30_000)
        with closing(Recorder(path, paper(), SCENARIO, METADATA)) as recorder:
            for message in invented(paper(), TICKS):
                recorder.record(message)
            recorder.record_links(1_000_000, LINKS)
            recorder.record_links(2_000_000, LINKS)
    return path


def contents(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Returns topic, time, sequence and bytes of every message, as the mcap reader finds them."""
    with path.open("rb") as file:
        rows = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.sequence, message.data) for _, channel, message in rows]


def test_states_come_back_bit_for_bit(whole: Path) -> None:
    builder = TraceBuilder(paper())
    for message in invented(paper(), TICKS):
        builder.add(message)
    expected, trace = builder.build(), read_trace(whole, paper())
    assert trace.digest() == expected.digest()
    assert all(np.array_equal(a, b) for a, b in zip(trace.times_ns, expected.times_ns, strict=True))
    assert trace.times_ns[0].dtype == np.int64
    assert trace.plan is paper()


@pytest.mark.parametrize("value", [np.nan, -0.0, np.inf, 5e-324, 0.1 + 0.2])
def test_odd_numbers_come_back(tmp_path: Path, value: float) -> None:
    values = np.full(16, value)
    with closing(Recorder(tmp_path / "run.mcap", paper(), "", {})) as recorder:
        recorder.record(Message(Channel.STATE, 3, 0, 7, values))
    trace = read_trace(tmp_path / "run.mcap", paper())
    assert trace.states[3].tobytes() == values.tobytes()
    assert trace.times_ns[3].tolist() == [7]
    assert trace.states[0].shape == (0, 16)


def test_scenario_metadata_and_links_come_back(whole: Path) -> None:
    assert read_scenario(whole) == SCENARIO
    assert read_metadata(whole) == METADATA
    assert read_links(whole) == [(1_000_000, LINKS[0]), (2_000_000, LINKS[0])]


@pytest.mark.slow
def test_cut_anywhere_it_is_mended(whole: Path, tmp_path: Path) -> None:
    data, everything = whole.read_bytes(), contents(whole)
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    end = data.index(b"\x0f\x04\0\0\0\0\0\0\0\0\0\0\0")  # the end of the messages; behind it is the summary
    saved = 0
    positions = [*range(8, len(data), len(data) // 150), *range(end - 12, end + 14), len(data) - 1]
    for at in sorted(positions):
        cut.write_bytes(data[:at])
        result = recover(cut, mended)
        found = contents(mended)
        assert found == everything[: len(found)]
        assert (result.messages, result.damaged) == (len(found), 0)
        assert result.until_ns == max([row[1] for row in found], default=None)
        assert result.messages >= saved
        saved = result.messages
        if at > end + 9:
            assert result.complete
        elif at < end:
            assert not result.complete
            with pytest.raises(CutError, match=r"cut.mcap: is cut short; mend it with `echelon recover`"):
                read_trace(cut, paper())
        if found:
            assert read_scenario(mended) == read_scenario(cut) == SCENARIO
            assert read_metadata(mended) == read_metadata(cut) == METADATA
            states = read_trace(mended, paper()).states[0]
            assert np.array_equal(states, read_trace(whole, paper()).states[0][: len(states)])
    assert saved == len(everything) > 1000
    assert sorted(tmp_path.iterdir()) == [cut, mended]


def test_damage_in_the_middle_costs_its_chunk_only(whole: Path, tmp_path: Path) -> None:
    data, everything = bytearray(whole.read_bytes()), contents(whole)
    data[len(data) // 2] ^= 0xFF
    damaged, mended = tmp_path / "damaged.mcap", tmp_path / "mended.mcap"
    damaged.write_bytes(data)
    with pytest.raises(ValueError, match=r"damaged.mcap: is damaged: a chunk cannot be read"):
        read_trace(damaged, paper())
    result = recover(damaged, mended)
    found = contents(mended)
    assert (result.damaged, result.complete, result.messages) == (1, False, len(found))
    assert found[-1] == everything[-1]
    assert len(everything) // 2 < len(found) < len(everything)


def test_recover_of_a_whole_file_loses_nothing(whole: Path, tmp_path: Path) -> None:
    result = recover(whole, tmp_path / "mended.mcap")
    assert result.complete
    assert contents(tmp_path / "mended.mcap") == contents(whole)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0", b"not a recording at all", b"\x89PNG\r\n\x1a\n" + bytes(99)])
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    for refuse in (lambda: recover(path, tmp_path / "mended"), lambda: read_scenario(path)):
        with pytest.raises(ValueError, match=r"other: is no MCAP file$"):
            refuse()
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_not_mended_in_place(whole: Path) -> None:
    before = whole.read_bytes()
    with pytest.raises(ValueError, match="cannot be mended in place"):
        recover(whole, whole)
    assert whole.read_bytes() == before


def test_a_recording_of_another_plan_is_refused(whole: Path) -> None:
    robots = tuple(replace(robot, path=f"other/{robot.path}") for robot in paper().robots)
    with pytest.raises(ValueError, match=r"run.mcap: holds no echelon_msgs/msg/RobotState of this plan"):
        read_trace(whole, replace(paper(), robots=robots))


def test_a_foreign_recording_is_refused_but_mended(tmp_path: Path) -> None:
    """The recording has other schemas, no compression and no chunks."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, use_chunking=False)
        writer.start()
        schema = writer.register_schema("echelon_msgs/msg/RobotState", "ros2msg", b"float64 x")
        channel = writer.register_channel("/g1/r2/state", "cdr", schema)
        writer.add_message(channel, 5, b"abc", 6, 7)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(ValueError, match=r"/g1/r2/state is not of the echelon_msgs/msg/RobotState known here"):
        read_trace(path, paper())
    for read in (read_scenario, read_metadata, read_links):
        with pytest.raises(ValueError, match=r"foreign.mcap: holds no "):
            read(path)
    assert recover(path, tmp_path / "mended.mcap").messages == 1
    assert contents(tmp_path / "mended.mcap") == [("/g1/r2/state", 5, 7, b"abc")]


def survives(path: Path) -> None:
    """Reads a file with every function; each may only raise ValueError with one line that names the file."""
    readers = (lambda: read_trace(path, paper()), lambda: read_scenario(path), lambda: read_metadata(path))
    for read in (*readers, lambda: read_links(path), lambda: recover(path, path.with_name("mended"))):
        try:
            read()
        except ValueError as error:
            text = str(error)
            assert text.startswith(f"{path}: ")
            assert "\n" not in text


fuzz = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


@fuzz
@given(st.binary(max_size=200))
def test_garbage(tmp_path: Path, garbage: bytes) -> None:
    path = tmp_path / "garbage"
    path.write_bytes(b"\x89MCAP0\r\n" + garbage)
    survives(path)


@fuzz
@given(st.lists(st.tuples(st.integers(1, 12), st.binary(max_size=60)), max_size=6))
def test_records_of_garbage(tmp_path: Path, records: list[tuple[int, bytes]]) -> None:
    """The records have correct lengths, so that their content is parsed."""
    path = tmp_path / "garbage"
    framed = [bytes([opcode]) + len(body).to_bytes(8, "little") + body for opcode, body in records]
    path.write_bytes(b"\x89MCAP0\r\n" + b"".join(framed))
    survives(path)


@fuzz
@given(st.lists(st.tuples(st.integers(0, 2**40), st.integers(0, 255)), min_size=1, max_size=4))
def test_damaged_bytes(whole: Path, tmp_path: Path, changes: list[tuple[int, int]]) -> None:
    data = bytearray(whole.read_bytes()[:20_000])
    for at, value in changes:
        data[at % len(data)] = value
    path = tmp_path / "damaged"
    path.write_bytes(data)
    survives(path)


def test_a_chunk_that_claims_to_be_enormous(tmp_path: Path) -> None:
    body = BytesIO()
    writer = Writer(body, compression=CompressionType.NONE)
    writer.start()
    writer.add_message(writer.register_channel("/a", "cdr", 0), 0, b"abc", 0)
    writer.finish()  # type: ignore[no-untyped-call]
    data = bytearray(body.getvalue())
    at = data.index(b"\x06") + 9 + 8 + 8
    for claim in (2**32, 2**62, 2**64 - 1):
        data[at : at + 8] = claim.to_bytes(8, "little")
        (tmp_path / "claim").write_bytes(data)
        survives(tmp_path / "claim")
