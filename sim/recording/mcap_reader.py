"""Reading recordings, and recovering those that are cut off.

A file is read record by record from its start, so the file of a killed recorder can be read up to its end.  Any fault in the
content of a file raises ValueError with a message of one line that begins with the file's path.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from os import SEEK_END, replace
from pathlib import Path
from typing import Final

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from echelon.large_arrays import Rows, RowsInFile
from echelon.messages import STATE_FIELDS, TORQUE_FIELDS
from echelon.messages import Channel as MessageChannel
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.recording import ros
from echelon.sim.recording.mcap_writer import CHUNK_SIZE, MAGIC, METADATA
from echelon.sim.recording.recorder import LINKS, SCENARIO, state_topic, torque_topic
from echelon.sim.recording.ros_definitions import schema_name, schema_text
from echelon.sim.recording.unpacking import LARGEST_CHUNK, room_of, unpack
from echelon.sim.results.trace import Trace

_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_LINK: Final = struct.Struct("<IIB")
_COUNTS: Final = struct.Struct("<6Qd4qQ")
_READERS: Final = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.METADATA: Metadata.read,
    Opcode.SCHEMA: Schema.read,
}


class CutError(ValueError):
    """A recording is cut off: it ends before the end of its data."""


@dataclass(frozen=True, slots=True)
class RecoverResult:
    """The result of a recovery."""

    messages: int
    """Number of recovered messages"""
    until_ns: int | None
    """Run time of the last of these messages [ns]; None if there are none"""
    damaged: int
    """Number of damaged records that were left out; a chunk of messages is one record"""
    complete: bool
    """True if the file was neither cut off nor damaged"""


def read_trace(path: Path, plan: Plan) -> Trace:
    """Returns the robots' states, bit for bit as they were recorded.

    Raises ValueError if the file is cut off, damaged, not a recording, or a recording of another plan."""
    topics = [state_topic(robot.path) for robot in plan.robots]
    with blame(path):
        rows = Rows([plan.duration_ns // robot.period_ns + 1 for robot in plan.robots], len(STATE_FIELDS))
        return Trace(plan, *_by_robot(path, topics, "RobotState", ros.robot_state(), rows))


def read_torques(path: Path, plan: Plan) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Returns the wanted torques of the robots on a closed path: for each robot its instants [ns], (T,), and the values of its
    messages, (T, len(TORQUE_FIELDS)).

    Raises ValueError if the file is cut off, damaged, not a recording, or a recording of another plan."""
    topics = [torque_topic(robot.path) for robot in plan.robots]
    with blame(path):
        rows = Rows([plan.duration_ns // robot.torque_period_ns + 1 for robot in plan.robots], len(TORQUE_FIELDS))
        times_ns, torques, _ = _by_robot(path, topics, "WheelTorque", ros.wheel_torque(), rows)
        return list(zip(times_ns, torques, strict=True))


def _by_robot(
    path: Path, topics: Sequence[str], kind: str, splice: ros.Splice, rows: Rows
) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.float64], ...], RowsInFile | None]:
    """Returns what `rows` builds from the messages on the topics, which are by robot.

    `kind` is the type of the messages in echelon_msgs, and `splice` its encoder."""
    robots = {topic: robot for robot, topic in enumerate(topics)}
    prefix = len(splice.encode(ros.stamp(0), b""))
    size = prefix + 8 * rows.width
    for topic, time_ns, data in _messages(path, robots, f"echelon_msgs/{kind}"):
        if len(data) != size:
            raise ValueError(f"a {kind} of {topic} has {len(data)} bytes, not {size}")
        rows.add(robots[topic], time_ns, data[prefix:])
        if rows.surplus:
            raise ValueError(f"{topic} has more messages than there are instants in the plan")
    return rows.build()


def read_links(path: Path) -> list[tuple[int, LinkCounts]]:
    """Returns the recorded counts of links, each with its run time [ns], in the order of the recording.

    Raises ValueError if the file is cut off, damaged or not a recording."""
    found = []
    with blame(path):
        for _, time_ns, data in _messages(path, {LINKS}, "echelon_msgs/LinkStatistics"):
            source, receiver, channel = _LINK.unpack_from(data, ros.STAMP_SIZE + 8)  # after the empty frame_id
            counts = _COUNTS.unpack(data[-_COUNTS.size :])
            found.append((time_ns, LinkCounts(source, receiver, MessageChannel(channel), *counts)))
    return found


def read_scenario(path: Path) -> str:
    """Returns the effective scenario as TOML, also from a file that is cut off.  Raises ValueError if the file has none."""
    with blame(path):
        for record in records(path):
            if isinstance(record, Attachment) and record.name == SCENARIO:
                return record.data.decode()
        raise ValueError(f"holds no {SCENARIO}")


def read_metadata(path: Path) -> dict[str, str]:
    """Returns the recorder's metadata, also from a file that is cut off.  Raises ValueError if the file has none."""
    with blame(path):
        for record in records(path):
            if isinstance(record, Metadata) and record.name == METADATA:
                return record.metadata
        raise ValueError("holds no metadata of a run")


def is_finished(path: Path) -> bool:
    """Returns whether a file ends with the mark that stands behind the summary of a complete MCAP file.  Raises OSError."""
    with path.open("rb") as file:
        file.seek(-min(len(MAGIC), path.stat().st_size), SEEK_END)
        return file.read() == MAGIC


def recover(source: Path, target: Path) -> RecoverResult:
    """Writes the undamaged content of `source` to `target` as a complete file, with attachments and metadata.

    `target` appears only when it is complete.  Raises ValueError if `source` is not an MCAP file, or is `target`, and OSError
    if `target` cannot be written."""
    partial = target.with_name(target.name + ".part")
    with blame(source):
        if target.exists() and target.samefile(source):
            raise ValueError("cannot be mended in place; give another file to write to")
        try:
            with partial.open("wb") as file:
                result = _copy(source, Writer(file, CHUNK_SIZE, CompressionType.ZSTD))
            replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
    return result


def _copy(source: Path, writer: Writer) -> RecoverResult:
    """Copies all undamaged records of a file."""
    schemas, channels = {0: 0}, dict[int, int]()
    messages, until_ns, damaged, complete = 0, None, list[str](), True
    writer.start("ros2", "echelon")
    try:
        for record in records(source, damaged):
            if isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels and record.schema_id in schemas:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                messages, until_ns = messages + 1, max(until_ns or 0, record.log_time)
            elif isinstance(record, Attachment):
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
    except CutError:
        complete = False
    writer.finish()  # type: ignore[no-untyped-call]
    return RecoverResult(messages, until_ns, len(damaged), complete and not damaged)


def _messages(path: Path, topics: "dict[str, int] | set[str]", kind: str) -> Iterator[tuple[str, int, bytes]]:
    """Yields topic, time [ns] and bytes of the messages on `topics`, whose type must be `kind`, for example
    `echelon_msgs/RobotState`.  Raises ValueError if the file has none of these topics, or their type is another one."""
    schemas, wanted = dict[int, Schema](), dict[int, str]()
    for record in records(path):
        if isinstance(record, Message):
            if record.channel_id in wanted:
                yield wanted[record.channel_id], record.log_time, record.data
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel) and record.topic in topics:
            check_type(record.topic, schemas.get(record.schema_id), kind)
            wanted[record.id] = record.topic
    if not wanted:
        raise ValueError(f"holds no {schema_name(kind)} of this plan")


def check_type(topic: str, schema: Schema | None, kind: str) -> None:
    """Raises ValueError unless messages of this schema are of the type `kind` as it is known here."""
    if schema is None or schema.name != schema_name(kind) or schema.data != schema_text(kind).encode():
        raise ValueError(f"{topic} is not of the {schema_name(kind)} known here")


def records(path: Path, damaged: list[str] | None = None) -> Iterator[McapRecord]:
    """Yields schemas, channels, messages, attachments and metadata in the order of the file.

    Raises ValueError for a damaged record, unless `damaged` is given: then the record is skipped, and its error added to
    `damaged`.  Raises CutError where the file is cut off."""
    size = path.stat().st_size
    room = room_of(size)
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("is no MCAP file")
        while len(head := file.read(_RECORD.size)) == _RECORD.size:
            opcode, length = _RECORD.unpack(head)
            if opcode == Opcode.DATA_END:
                return
            if length > size - file.tell():
                break
            reader = _READERS.get(opcode)
            try:
                if opcode == Opcode.MESSAGE:
                    yield _message(file.read(length))
                elif reader is None:
                    file.seek(length, 1)
                else:
                    record = _record(opcode, file.read(length))
                    if isinstance(record, Chunk):
                        left, stated = room, record.uncompressed_size
                        room -= stated if stated <= min(room, LARGEST_CHUNK) else 0  # also if it turns out damaged
                        yield from _records_in(_unpacked(record, left))
                    else:
                        yield record
            except ValueError as error:
                if damaged is None:
                    raise
                damaged.append(str(error))
    raise CutError("is cut short; mend it with `echelon recover`")


def _record(opcode: int, body: bytes) -> McapRecord:
    """Returns the record with this content.  Raises ValueError if it is damaged."""
    try:
        if opcode == Opcode.ATTACHMENT and zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0] != 0:
            raise ValueError("checksum")
        record: McapRecord = _READERS[Opcode(opcode)](ReadDataStream(BytesIO(body)))
        return record
    except Exception as error:  # the parsers raise all kinds of errors for damaged bytes
        raise ValueError(f"is damaged: a {Opcode(opcode).name.lower()} cannot be read") from error


def _unpacked(chunk: Chunk, room: int) -> bytes:
    """Returns the records of a chunk, as bytes.  Raises ValueError if it is damaged or has more than `room` bytes, unpacked."""
    try:
        return unpack(chunk, room)
    except Exception as error:  # the unpackers, too
        raise ValueError("is damaged: a chunk cannot be read") from error


def _records_in(data: bytes) -> list[McapRecord]:
    """Returns the records of an unpacked chunk.  Raises ValueError if it is damaged."""
    records, at = list[McapRecord](), 0
    while at < len(data):
        if at + _RECORD.size > len(data):
            raise ValueError("is damaged: a chunk ends within a record")
        inner, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            raise ValueError("is damaged: a chunk ends within a record")
        inner_body = data[at : at + length]
        if inner == Opcode.MESSAGE:
            records.append(_message(inner_body))
        elif inner in (Opcode.SCHEMA, Opcode.CHANNEL):
            records.append(_record(inner, inner_body))
        at += length
    return records


def _message(body: bytes) -> Message:
    if len(body) < _MESSAGE.size:
        raise ValueError("is damaged: a message is too short")
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
    return Message(channel, log_time, body[_MESSAGE.size :], publish_time, sequence)


@contextmanager
def blame(path: Path) -> Iterator[None]:
    """A context in which errors about the content of a file become ValueError of one line that begins with the file's path."""
    try:
        yield
    except CutError as error:
        raise CutError(f"{path}: {error}") from error
    except (ValueError, struct.error) as error:
        raise ValueError(" ".join(f"{path}: {error}".split())) from error
