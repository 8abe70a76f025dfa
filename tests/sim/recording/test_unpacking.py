"""Chunks that unpack to more than a recording can hold are refused, and cost neither memory nor time."""

import struct
import time
import zlib
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from echelon.sim.recording.mcap_reader import read_trace, records, recover
from echelon.sim.recording.mcap_writer import MAGIC
from echelon.sim.recording.unpacking import LARGEST_CHUNK, TOTAL, room_of, unpack
from support.invented import paper
from support.memory import memory_below

ZEROS = bytes(64 << 20)
MESSAGE = struct.pack("<BQHIQQ", 5, 22 + 100, 1, 0, 0, 0) + bytes(100)


def chunk_of(data: bytes, size: int, kind: str) -> Chunk:
    """Returns a chunk with some content that says it has some size."""
    return Chunk(kind, data, 0, 0, 0, size)


def file_of(path: Path, *chunks: Chunk) -> Path:
    builder = RecordBuilder()
    for chunk in chunks:
        chunk.write(builder)
    path.write_bytes(MAGIC + builder.end())  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [len(ZEROS), 1000, 0, 1 << 60])
def test_a_chunk_is_bounded_whatever_size_it_says(kind: str, said: int) -> None:
    packed = zstandard.ZstdCompressor().compress(ZEROS) if kind == "zstd" else lz4.frame.compress(ZEROS)
    with memory_below(2 * LARGEST_CHUNK), pytest.raises(ValueError, match=r"large|size"):
        unpack(chunk_of(packed, said, kind), room_of(len(packed)))


@pytest.mark.parametrize("kind", ["", "zstd", "lz4"])
def test_a_chunk_within_bounds_is_unpacked(kind: str) -> None:
    data = MESSAGE * 1000
    packed = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress}.get(kind, bytes)(data)
    chunk = Chunk(kind, packed, 0, 0, zlib.crc32(data), len(data))
    assert unpack(chunk, room_of(0)) == data
    with pytest.raises(ValueError, match="large"):
        unpack(chunk, len(data) - 1)
    chunk.uncompressed_crc ^= 1
    with pytest.raises(ValueError, match="checksum"):
        unpack(chunk, room_of(0))


@pytest.mark.slow
def test_many_chunks_are_bounded_together(tmp_path: Path) -> None:
    data = MESSAGE * (LARGEST_CHUNK // len(MESSAGE))
    packed = zstandard.ZstdCompressor().compress(data)
    path = file_of(tmp_path / "bomb.mcap", *[chunk_of(packed, len(data), "zstd")] * 40)
    assert path.stat().st_size < 200_000
    begun_s, damaged = time.process_time(), list[str]()
    with pytest.raises(ValueError, match="cut short"):
        deque(records(path, damaged), maxlen=0)
    assert 40 - len(damaged) <= (TOTAL + 200 * path.stat().st_size) // len(data)
    assert len(damaged) > 30
    assert time.process_time() - begun_s < 30
    with pytest.raises(ValueError, match="damaged: a chunk cannot be read"):
        read_trace(path, paper())
    result = recover(path, tmp_path / "mended.mcap")
    assert (result.complete, result.damaged) == (False, len(damaged))


@pytest.mark.slow
def test_chunks_with_wrong_checksums_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chunk takes of the bound what it says, also if it turns out damaged."""
    data, checked = MESSAGE * (LARGEST_CHUNK // len(MESSAGE)), list[int]()
    chunk = chunk_of(zstandard.ZstdCompressor().compress(data), len(data), "zstd")
    chunk.uncompressed_crc = 123
    path = file_of(tmp_path / "bomb.mcap", *[chunk] * 40)
    monkeypatch.setattr(
        "echelon.sim.recording.unpacking.zlib", SimpleNamespace(crc32=lambda data: checked.append(len(data)) or 0)
    )
    damaged = list[str]()
    with pytest.raises(ValueError, match="cut short"):
        deque(records(path, damaged), maxlen=0)
    assert len(damaged) == 40
    assert sum(checked) <= room_of(path.stat().st_size)


def test_a_recording_of_another_program_is_one_line(tmp_path: Path) -> None:
    """The topics are those of the plan, their type is not."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start("ros2", "another program")
        schema = writer.register_schema("echelon_msgs/msg/RobotState", "ros2msg", b"int8 x\n")
        channel = writer.register_channel("/g1/r1/state", "cdr", schema)
        writer.add_message(channel, 0, b"\0\1\0\0\7", 0)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(ValueError, match=r"is not of the .* known here") as said:
        read_trace(path, paper())
    assert "\n" not in str(said.value)
