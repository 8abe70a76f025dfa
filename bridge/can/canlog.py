"""`can.log`, the record of all frames of a run: writing it.  `bridge.can.log_files` reads logs.

The format is that of `candump -l`, which log2asc, canplayer, `cantools decode` and python-can's LogReader read:

    (1000000000.010000) can0 101#E80324FA010700F3
"""

import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

EPOCH_NS: Final = 1_000_000_000 * 1_000_000_000
"""Run time 0 on the clock of can.log [ns]: 9 September 2001, 01:46:40 UTC.  The last digits are run time.  The clock does not
begin at 0, since log2asc takes the first second of 1970 for no time at all."""
FLUSH_NS = 100_000_000  # how old lines get before they are written; a killed process loses at most twice this
_MAX_LINES = 4096


@dataclass(slots=True)
class LogCounts:
    """Counts of lines."""

    written: int = 0
    """Lines handed to the operating system"""
    lost: int = 0
    """Lines that the operating system did not take"""


class CanLog:
    """A log file that is written during a run.

    After it is open, no method raises. On a full disk, whole lines are dropped: `counts.lost` counts them and `error` holds
    the last error. Writing goes on when there is room again.

    Parameters: `path` of the file, which must not exist; `channel`, the name of the bus; `epoch_ns`, the wall-clock time of
    run time zero [ns since 1970]. Raises OSError if the file cannot be opened, ValueError if the channel is not one word."""

    __slots__ = ("_channel", "_epoch_ns", "_fd", "_flushed_ns", "_lines", "_size", "counts", "error")

    def __init__(self, path: Path, channel: str, epoch_ns: int = EPOCH_NS) -> None:
        if channel.split() != [channel]:
            raise ValueError(f"the channel must be one word, not {channel!r}")
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self._channel = channel
        self._epoch_ns = epoch_ns
        self._lines: list[str] = []
        self._flushed_ns: int | None = None
        self._size = 0  # size of the file up to its last whole line
        self.counts = LogCounts()
        self.error: OSError | None = None

    def write(
        self, time_ns: int, can_id: int, data: bytes, wall_ns: int, channel: str = "", remote: bool = False
    ) -> None:
        """Adds the line of a frame at run time `time_ns`; `channel` is the bus, unless it is the log's own.

        `wall_ns` is the present reading of a monotonic clock. Lines are written to the file when the oldest is more than 0.1 s
        old, or when there are 4096. Call `flush` when no more frames come."""
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
        """Hands all lines to the operating system; they then survive this process."""
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
                pass  # a pipe, for example, cannot be cut: one line is broken, and readers skip it

    def close(self) -> None:
        """Flushes and closes the file.  A second call does nothing."""
        if self._fd < 0:
            return
        self.flush()
        try:
            os.close(self._fd)  # on a network file system a full disk may show only here
        except OSError as error:
            self.error = error
        self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
