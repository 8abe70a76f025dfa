"""Reading logs of CAN frames: our can.log, and what other programs write.

form                                   told by                    channel
candump (bridge.can.candump)           none of the others         the name of the interface
ASC (Vector), BLF (Vector), TRC (PEAK) how the file begins        the number in the file, from 1
CSV of python-can                      its header                 `-`, the file does not name it

Each may be compressed by gzip.  A file may be damaged, or made to do harm: what cannot be read is named, memory is bounded, and
reading ends.
"""

import gzip
import io
import logging
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, Final

import can
from can.io.blf import BLFParseError

from echelon.bridge.can.candump import BACKWARDS, ERRORS, EXTENDED, FLEXIBLE, NOT_READ, LeftOut, Logged, read_line
from echelon.bridge.protocols.frame import Frame

# without a handler, python-can's remarks on damaged lines would go to standard error, one by one
logging.getLogger("can.io").addHandler(logging.NullHandler())

NO_CHANNEL: Final = "-"
"""Channel of the frames of a file that names none"""
REST: Final = "a damaged rest of the file"
LONGEST_LINE: Final = 4096
"""Longer lines are not read [bytes]"""
PATIENCE: Final = 10_000
"""After so many lines in a row that cannot be read, the rest of a file is not read"""
INTERFACES: Final = 64
"""For so many interfaces it is noted which time came last"""
LARGEST_OBJECT: Final = 1 << 24
"""The largest object, and the largest unpacked container, of a BLF file that is read [bytes]"""
_NO_FRAME: Final = re.compile(
    r"\s*(?:$|//|;|x$|date |base |(?:no\s+)?internal events|begin |end |timestamp,|[\d.]+ +start of measurement|.*statistic)",
    re.I,
)
"""Lines of text files that are read and hold no frame"""
_DAMAGE: Final = (
    *(ValueError, LookupError, TypeError, ArithmeticError, AttributeError, NotImplementedError),
    *(struct.error, zlib.error, BLFParseError),
)
"""What python-can's readers raise for damaged content"""
_GZIP: Final = b"\x1f\x8b"
_HEAD: Final = 4096
_BLF_HEADER: Final = struct.Struct("<4sL")
_BLF_OBJECT: Final = struct.Struct("<4sHHLL")
_BLF_CONTAINER: Final = struct.Struct("<H6xL4x")
_CONTAINER: Final = 10


def read_log(path: Path) -> Iterator[Logged | LeftOut]:
    """Yields the classic frames with 11-bit identifiers of a log, and what else it holds.

    Raises OSError if the log cannot be read."""
    with path.open("rb") as file:
        compressed = file.read(2) == _GZIP
        file.seek(0)
        opened = io.BufferedReader(gzip.GzipFile(fileobj=file)) if compressed else file
        try:
            yield from _read(opened)
        except (EOFError, zlib.error, gzip.BadGzipFile):
            yield LeftOut(REST, True)


def frames_in(path: Path) -> Iterator[Logged]:
    """Yields the frames of a log alone.  Raises OSError if the log cannot be read."""
    return (entry for entry in read_log(path) if isinstance(entry, Logged))


def read_lines(lines: Iterable[bytes]) -> Iterator[Logged | LeftOut]:
    """Yields the frames in candump's lines, and what else they hold."""
    for line in lines:
        if (entry := read_line(line)) is not None:
            yield entry


def _read(file: IO[bytes]) -> Iterator[Logged | LeftOut]:
    head = file.peek(_HEAD)[:_HEAD]  # type: ignore[attr-defined]
    if head.startswith(b"LOGG"):
        return _of_blf(file)
    text = head.decode("utf-8", errors="replace").lstrip("\ufeff \r\n")
    if text.startswith(("date ", "base hex", "base dec")):
        return _of_lines(file, can.ASCReader, 1)
    if text.startswith(";"):
        return _of_lines(file, can.TRCReader, 0)
    if text.startswith("timestamp,arbitration_id"):
        return _of_lines(file, can.CSVReader, 0)
    return _of_candump(file)


def _of_candump(file: IO[bytes]) -> Iterator[Logged | LeftOut]:
    unread, whole = 0, True
    shown_ns: dict[str, int] = {}
    while line := file.readline(LONGEST_LINE):
        began, whole = whole, line.endswith(b"\n")
        entry = read_line(line) if began else None
        if b"[" in line and isinstance(entry, Logged):
            if entry.time_ns < shown_ns.get(entry.channel, 0):
                entry = LeftOut(BACKWARDS, True)
            elif len(shown_ns) < INTERFACES or entry.channel in shown_ns:
                shown_ns[entry.channel] = entry.time_ns
        if entry is not None:
            yield entry
        unread = unread + 1 if entry is None or (isinstance(entry, LeftOut) and entry.torn) else 0
        if unread > PATIENCE:
            yield LeftOut(REST, True)
            return


class _Source:
    """What python-can's readers ask of a file beside its content."""

    def write(self, data: bytes) -> int:
        """Nobody writes here; python-can before 4.5 takes only what has this for a file."""
        raise io.UnsupportedOperation

    def close(self) -> None:
        """The file belongs to the caller."""


class _Lines(_Source):
    """The lines of a text file, for a reader of python-can.  It notes those that the reader makes no frame of."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._line: str | None = None
        self._resumed = self.ended = False
        self.unread = 0
        """Lines since the last frame of which the reader made none"""
        self.since = 0
        """Lines since the last frame"""

    def __iter__(self) -> "_Lines":
        return self

    def __next__(self) -> str:
        if self._resumed:
            self._resumed = False
            return "x\n"
        self.drop()
        line = self._file.readline(LONGEST_LINE)
        self.since += 1
        self.ended = not line
        if not line or len(line) == LONGEST_LINE or self.since > PATIENCE:
            raise StopIteration
        self._line = line.decode("utf-8", errors="replace")
        return self._line

    def take(self) -> int:
        """Notes that the reader has made a frame of the last line; returns how many lines before it were not read."""
        unread, self.unread, self.since, self._line = self.unread, 0, 0, None
        return unread

    def drop(self) -> None:
        """Notes that the reader has made no frame of the last line."""
        if self._line is not None and not _NO_FRAME.match(self._line):
            self.unread += 1
        self._line = None

    def resume(self) -> None:
        """Lets a reader begin anew behind the last line; it takes the next line that it gets for one before the first frame."""
        self.drop()
        self.since += 1  # so that it ends where the reader fails before it has read a line
        self._resumed = True

    def read(self, size: int = -1) -> str:
        """Part of the interface of files; the readers iterate."""
        raise io.UnsupportedOperation


def _of_lines(file: IO[bytes], open_reader: Any, first: int) -> Iterator[Logged | LeftOut]:
    lines = _Lines(file)
    try:
        reader = open_reader(lines)
        while not lines.ended and lines.since <= PATIENCE:
            try:
                for message in reader:
                    yield from [LeftOut(NOT_READ, True)] * lines.take()
                    yield _entry(message, first)
                break
            except _DAMAGE:
                lines.resume()
    finally:
        lines.drop()
    yield from [LeftOut(NOT_READ, True)] * lines.take()
    if not lines.ended:
        yield LeftOut(REST, True)


def _of_blf(file: IO[bytes]) -> Iterator[Logged | LeftOut]:
    try:
        for message in can.BLFReader(_CheckedBlf(file)):  # type: ignore[arg-type]
            yield _entry(message, 1)
    except _DAMAGE:
        yield LeftOut(REST, True)


def _entry(message: can.Message, first: int) -> Logged | LeftOut:
    if message.is_error_frame:
        return LeftOut(ERRORS)
    if message.is_fd:
        return LeftOut(FLEXIBLE)
    if message.is_extended_id:
        return LeftOut(EXTENDED)
    remote, data, channel = message.is_remote_frame, bytes(message.data), message.channel
    if not (0 <= message.arbitration_id <= 0x7FF and -1e12 < message.timestamp < 1e12 and len(data) <= 8):
        return LeftOut(NOT_READ, True)
    if not remote and len(data) != message.dlc:
        return LeftOut(NOT_READ, True)
    name = NO_CHANNEL if channel is None else str(channel + first if isinstance(channel, int) else channel)
    frame = Frame(message.arbitration_id, b"" if remote else data, remote)
    return Logged(round(message.timestamp * 1e9), name, frame)


class _CheckedBlf(_Source):
    """A BLF file whose containers are unpacked, with a bound, and whose objects have sizes that fit.

    An object of size 0 would keep python-can's reader busy for ever, and a container of a few kilobytes may hold gigabytes."""

    def __init__(self, file: IO[bytes]) -> None:
        self._parts = _blf_parts(file)
        self._rest = b""

    def read(self, size: int = -1) -> bytes:
        """Returns the next bytes.  Raises ValueError where the file is damaged."""
        while len(self._rest) < size and (part := next(self._parts, b"")):
            self._rest += part
        data, self._rest = self._rest[:size], self._rest[size:]
        return data


def _blf_parts(file: IO[bytes]) -> Iterator[bytes]:
    header = file.read(_BLF_HEADER.size)
    _, length = _BLF_HEADER.unpack(header)
    if not _BLF_HEADER.size <= length <= LARGEST_OBJECT:
        raise ValueError("size of the header")
    yield header + file.read(length - len(header))
    tail, cut = b"", False
    while head := file.read(_BLF_OBJECT.size):
        mark, _, _, size, kind = _BLF_OBJECT.unpack(head)
        if mark != b"LOBJ" or not _BLF_OBJECT.size <= size <= LARGEST_OBJECT:
            raise ValueError("an object")
        body = file.read(size - len(head))
        cut = len(body) < size - len(head)
        file.read(size % 4)
        if kind != _CONTAINER:
            continue  # nothing else holds frames
        method, _ = _BLF_CONTAINER.unpack_from(body)
        data = body[_BLF_CONTAINER.size :]
        if method:
            unpacker = zlib.decompressobj()
            data = unpacker.decompress(data, LARGEST_OBJECT)
            if unpacker.unconsumed_tail:
                raise ValueError("a container that is too large")
            cut = cut or not unpacker.eof
        tail = _checked(tail + data)
        size = _BLF_OBJECT.size + _BLF_CONTAINER.size + len(data)
        yield (
            _BLF_OBJECT.pack(b"LOBJ", 16, 1, size, _CONTAINER)
            + _BLF_CONTAINER.pack(0, len(data))
            + data
            + bytes(size % 4)
        )
        if cut:  # the frames before the cut have been read
            raise ValueError("a container that is cut off")


def _checked(data: bytes) -> bytes:
    """Returns the rest of some objects, which ends within one.  Raises ValueError for an object whose size cannot be."""
    at = 0
    while (begin := data.find(b"LOBJ", at, at + 8)) >= 0 and begin + _BLF_OBJECT.size <= len(data):
        size = _BLF_OBJECT.unpack_from(data, begin)[3]
        if not _BLF_OBJECT.size <= size <= LARGEST_OBJECT:
            raise ValueError("an object")
        if begin + size > len(data):
            at = begin
            break
        at = begin + size
    else:
        if begin < 0 and len(data) - at >= 8:
            raise ValueError("an object")
    return data[at:]
