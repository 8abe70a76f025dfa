"""Writes `can.log`, the record of all frames of a run, in the format of `candump -l`:

    (1700000000.010000) vcan0 101#E80324FA010700F3

which log2asc, canplayer, `cantools decode` and python-can's LogReader read.
"""

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from echelon.bridge.protocols.frame import Frame

FLUSH_NS = 100_000_000  # what a killed process may lose, at most twice this while frames come
_MAX_LINES = 4096
_LINE = re.compile(r"\((\d+)\.(\d{6})\) (\S+) ([0-9A-F]{3})#(?:(R)[0-8]?|((?:[0-9A-F]{2}){0,8}))(?: [RT])?")


@dataclass(slots=True)
class LogCounts:
    """Lines handed to the operating system, and lines lost because it did not take them."""

    written: int = 0
    lost: int = 0


class CanLog:
    """A log file. Nothing raises after it is open: a full disk is counted in `counts.lost` and told by `error`.

    Lines that did not fit are dropped whole, and writing goes on when there is room again.

    Parameters: the file (overwritten), the name of the channel to note, and the wall-clock time [ns since 1970] of the
    run's time zero. Raises OSError if the file cannot be opened, ValueError if the channel is no single word."""

    __slots__ = ("_channel", "_epoch_ns", "_fd", "_flushed_ns", "_lines", "_size", "counts", "error")

    def __init__(self, path: Path, channel: str, epoch_ns: int) -> None:
        if channel.split() != [channel]:
            raise ValueError(f"the channel must be one word, not {channel!r}")
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
        self._channel = channel
        self._epoch_ns = epoch_ns
        self._lines: list[str] = []
        self._flushed_ns: int | None = None
        self._size = 0  # of the file, in whole lines
        self.counts = LogCounts()
        self.error: OSError | None = None  # the last one

    def write(
        self, time_ns: int, can_id: int, data: bytes, wall_ns: int, channel: str = "", remote: bool = False
    ) -> None:
        """Notes a frame at `time_ns` of the run; `channel` is the bus if it is not the log's only one.

        `wall_ns` is any monotonic clock now: what is older than 0.1 s by it, or more than 4096 lines, goes to the file.
        When frames stop coming, call `flush`."""
        micros = (time_ns + self._epoch_ns) // 1000
        seconds, micros = divmod(micros, 1_000_000)
        content = "R" if remote else data.hex().upper()
        self._lines.append(f"({seconds:010d}.{micros:06d}) {channel or self._channel} {can_id:03X}#{content}\n")
        if self._flushed_ns is None:
            self._flushed_ns = wall_ns
        elif wall_ns - self._flushed_ns >= FLUSH_NS or len(self._lines) >= _MAX_LINES:
            self._flushed_ns = wall_ns
            self.flush()

    def flush(self) -> None:
        """Hands all lines to the operating system, where they survive this process."""
        if not self._lines:
            return
        lines, self._lines = self._lines, []
        rest = memoryview("".join(lines).encode())
        total = len(rest)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError as error:
            self._repair(lines, total - len(rest), error)
        else:
            self._size += total
            self.counts.written += len(lines)

    def _repair(self, lines: list[str], taken: int, error: OSError) -> None:
        """Cuts the file after the last whole line of those `taken` bytes, and counts the others as lost."""
        self.error = error
        whole = 0
        for line in lines:
            if taken < len(line):
                break
            taken -= len(line)
            self._size += len(line)
            whole += 1
        self.counts.written += whole
        self.counts.lost += len(lines) - whole
        if taken:
            try:
                os.ftruncate(self._fd, self._size)
                os.lseek(self._fd, self._size, os.SEEK_SET)
            except OSError:
                pass  # a pipe, say: one line is broken, which readers skip

    def close(self) -> None:
        """Flushes and closes the file; does nothing the second time."""
        if self._fd < 0:
            return
        self.flush()
        try:
            os.close(self._fd)  # on a network file system this is where a full disk may show
        except OSError as error:
            self.error = error
        self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Logged(NamedTuple):
    """A frame in a log: time [ns], the bus's name, the frame."""

    time_ns: int
    channel: str
    frame: Frame


def read_log(path: Path) -> Iterator[Logged]:
    """Yields the classic frames with 11-bit identifiers of a log as candump writes it; other lines are passed over.

    Raises OSError if the log cannot be read."""
    with path.open(encoding="ascii", errors="replace") as lines:
        yield from read_lines(lines)


def read_lines(lines: Iterable[str]) -> Iterator[Logged]:
    """Yields the frames of lines of a log, as `read_log` does."""
    for line in lines:
        if match := _LINE.fullmatch(line.strip()):
            seconds, micros, channel, identifier, remote, data = match.groups()
            time_ns = int(seconds) * 1_000_000_000 + int(micros) * 1000
            frame = Frame(int(identifier, 16) & 0x7FF, bytes.fromhex(data or ""), remote is not None)
            yield Logged(time_ns, channel, frame)
