"""Writing an MCAP file: the same messages give the same bytes, and a killed recorder loses little (docs/architecture.md, 6.2).

A chunk ends when it is full, never because of wall time, so the bytes do not depend on the speed of the run.  At short
intervals of wall time the unfinished chunk is written provisionally, behind the last finished chunk; each later write
overwrites it.  If the recorder is killed during such a write, the unfinished chunk may be lost.  A write takes some
microseconds, ten times a second.
"""

import fcntl
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from echelon.sim.recording.ros_definitions import schema_name, schema_text

MAGIC: Final = b"\x89MCAP0\r\n"
LIBRARY: Final = "echelon"
METADATA: Final = "echelon"
"""The name of a run's metadata record."""
CHUNK_SIZE: Final = 256 * 1024
"""Size of a chunk before compression [bytes]: one second of nine robots at 100 Hz, a tenth of a second at 1 kHz."""
FLUSH_NS: Final = 100_000_000
"""Wall time between two provisional writes.  If `flush_if_due` is called as often, a kill costs at most 0.2 s."""
LEVEL: Final = 1
"""Level of zstd: 0.40 of the size at 0.33 µs per message.  lz4 gives 0.46 at 0.20 µs, zstd's level 3 gives 0.40 at 0.49 µs."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_INDEX: Final = struct.Struct("<BQHI")


class ChunkedFile:
    """An MCAP file being written: definitions, then chunks of messages, then a summary.

    Once it is open, no method raises OSError.  After an error nothing more is written, and `failure` says why; the file then
    ends like that of a killed recorder."""

    def __init__(
        self, path: Path, attachments: dict[str, bytes], metadata: dict[str, str], topics: dict[str, str]
    ) -> None:
        """Creates the file and writes its beginning.  Raises OSError if it cannot be created: also if there is one.

        `topics` maps topics to types; channels are numbered from 1 in this order."""
        self.failure: str | None = None
        self._path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        # the lock tells other processes that the file is being written, until this process ends
        with suppress(OSError):
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._position = 0
        self._tail = b""
        self._buffer = bytearray()
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)
        self._index: list[list[int]] = [[] for _ in range(len(topics) + 1)]
        self._counts = [0] * (len(topics) + 1)
        self._provisional = 0
        self._flushed_ns: int | None = None
        self._chunks: list[ChunkIndex] = []
        self._first_ns = self._last_ns = 0

        types = list(dict.fromkeys(topics.values()))
        self._schemas = [
            Schema(id=number, name=schema_name(name), encoding="ros2msg", data=schema_text(name).encode())
            for number, name in enumerate(types, 1)
        ]
        self._channels = [
            Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=types.index(name) + 1)
            for number, (topic, name) in enumerate(topics.items(), 1)
        ]
        start, self._indexes = MAGIC + _records(Header("ros2", LIBRARY)), list[McapRecord]()
        for name, data in attachments.items():
            suffix = name.rpartition(".")[2]
            media_type = {"py": "text/x-python", "toml": "application/toml"}.get(suffix, "text/plain")
            record = _records(Attachment(0, 0, name, media_type, data))
            self._indexes.append(AttachmentIndex(len(start), len(record), 0, 0, len(data), name, media_type))
            start += record
        record = _records(Metadata(METADATA, metadata))
        self._indexes.append(MetadataIndex(len(start), len(record), METADATA))
        self._append(start + record + _records(*self._schemas, *self._channels))

    def add(self, channel: int, sequence: int, time_ns: int, data: bytes) -> None:
        """Adds a message on a channel at run time `time_ns`; `data` is the encoded message.  `sequence` is taken modulo
        2^32."""
        buffer, entries = self._buffer, self._index[channel]
        entries.append(time_ns)
        entries.append(len(buffer))
        buffer += _MESSAGE.pack(Opcode.MESSAGE, 22 + len(data), channel, sequence & 0xFFFFFFFF, time_ns, time_ns)
        buffer += data
        if len(buffer) >= CHUNK_SIZE:
            self._finish_chunk()

    def flush_if_due(self, monotonic_ns: int) -> None:
        """Writes the unfinished chunk provisionally if `FLUSH_NS` have passed since the last time; `monotonic_ns` is wall
        time."""
        if self._flushed_ns is not None and monotonic_ns - self._flushed_ns < FLUSH_NS:
            return
        self._flushed_ns = monotonic_ns
        if self.failure is None and len(self._buffer) != self._provisional:
            self._provisional = len(self._buffer)
            tail = _records(self._chunk())
            if self._write(tail):
                self._tail = tail

    def close(self) -> None:
        """Writes the last chunk and the summary, and closes the file.  It is then complete, unless there was a `failure`."""
        if self._file < 0:
            return
        self._finish_chunk()
        self._append(_records(DataEnd(0)))
        self._append(self._summary())
        with suppress(OSError):
            os.close(self._file)
        self._file = -1

    def _chunk(self) -> Chunk:
        """Returns the unfinished chunk."""
        times = [time for entries in self._index for time in (entries[:1] + entries[-2:-1])]
        return Chunk(
            "zstd",
            self._compressor.compress(self._buffer),
            max(times),
            min(times),
            zlib.crc32(self._buffer),
            len(self._buffer),
        )

    def _finish_chunk(self) -> None:
        """Writes the unfinished chunk for the last time, with the index of its messages, and begins the next chunk."""
        if self.failure is None and self._buffer:
            chunk = self._chunk()
            data, offsets = _records(chunk), {}
            length = len(data)
            for channel, entries in enumerate(self._index):
                if entries:
                    offsets[channel] = self._position + len(data)
                    size = 8 * len(entries)
                    data += _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size)
                    data += struct.pack(f"<{len(entries)}Q", *entries)
            position = self._position
            if self._append(data):
                start, end = chunk.message_start_time, chunk.message_end_time
                self._first_ns = min(self._first_ns, start) if self._chunks else start
                self._last_ns = max(self._last_ns, end)
                self._counts = [n + len(entries) // 2 for n, entries in zip(self._counts, self._index, strict=True)]
                self._chunks.append(
                    ChunkIndex(
                        length,
                        position,
                        chunk.compression,
                        len(chunk.data),
                        end,
                        len(data) - length,
                        offsets,
                        start,
                        chunk.uncompressed_size,
                    )
                )
        self._buffer.clear()
        self._provisional = 0
        for entries in self._index:
            entries.clear()

    def _append(self, data: bytes) -> bool:
        """Writes data that will not be overwritten; returns whether it succeeded."""
        if self.failure is not None or not self._write(data):
            return False
        self._position += len(data)
        self._tail = b""
        return True

    def _write(self, data: bytes) -> bool:
        """Writes data behind the finished data, over a provisional chunk; returns whether it succeeded.

        If it fails, the provisional chunk that stood there is restored as far as possible."""
        try:
            _write_at(self._file, data, self._position)
            if len(data) < len(self._tail):
                os.ftruncate(self._file, self._position + len(data))
        except OSError as error:
            self.failure = f"{self._path}: {error.strerror}; the recording ends early"
            with suppress(OSError):
                os.ftruncate(self._file, self._position)
                _write_at(self._file, self._tail, self._position)
            return False
        return True

    def _summary(self) -> bytes:
        """Returns the summary section, the footer and the mark at the end of the file."""
        counts = {channel: count for channel, count in enumerate(self._counts) if count}
        statistics = Statistics(
            attachment_count=sum(isinstance(index, AttachmentIndex) for index in self._indexes),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns,
            metadata_count=sum(isinstance(index, MetadataIndex) for index in self._indexes),
            schema_count=len(self._schemas),
        )
        summary, offsets = b"", list[McapRecord]()
        groups: list[list[McapRecord]] = [[*self._schemas], [*self._channels], [statistics], [*self._chunks]]
        for group in [*groups, *([index] for index in self._indexes)]:
            if group:
                data = _records(*group)
                offsets.append(SummaryOffset(data[0], self._position + len(summary), len(data)))
                summary += data
        offset_start = self._position + len(summary)
        summary += _records(*offsets)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, self._position, offset_start)
        return summary + _records(Footer(self._position, offset_start, zlib.crc32(summary + footer))) + MAGIC


def _records(*records: McapRecord) -> bytes:
    """Returns records as bytes."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def _write_at(file: int, data: bytes, at: int) -> None:
    """Writes all data at a place of a file.  Raises OSError."""
    rest = memoryview(data)
    while rest:
        written = os.pwrite(file, rest, at)
        rest, at = rest[written:], at + written
