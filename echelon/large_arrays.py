"""Arrays that may be larger than memory: small ones are in memory, large ones in a file without a name.

The system keeps of such a file in memory what is used and what there is room for.  It is gone when nothing uses it any more,
also if the process is killed.  It lies in `$TMPDIR`, otherwise in /var/tmp if that exists: /tmp may itself be memory.
"""

import mmap
import os
import tempfile
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

LARGE: Final = 4 << 20
"""Arrays and tables of more bytes are in a file"""
BLOCK: Final = 16 << 10
"""Rows are written to a file when a source has this many bytes of them"""
TIME_BYTES: Final = 8


def large_empty(shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Returns a new array whose content is not defined, in a file if it is large and there is room for it."""
    kind = np.dtype(dtype)
    size = kind.itemsize * (shape if isinstance(shape, int) else prod(shape))
    if size <= LARGE:
        return np.empty(shape, kind)
    try:
        with _unnamed() as file:
            os.posix_fallocate(file.fileno(), 0, size)  # a hole that cannot be filled later would end the process
            return np.frombuffer(mmap.mmap(file.fileno(), size), kind).reshape(shape)
    except OSError:
        return np.empty(shape, kind)


def _unnamed() -> IO[bytes]:
    folder = None if os.environ.get("TMPDIR") or not os.access("/var/tmp", os.W_OK) else "/var/tmp"
    return tempfile.TemporaryFile(dir=folder, buffering=0)


@dataclass(frozen=True, slots=True)
class RowsInFile:
    """Where the rows of some sources are in an open file: how many each source has, and how many it has room for."""

    path: Path
    """Valid as long as the process that wrote the rows keeps its `Rows`"""
    width: int
    counts: tuple[int, ...]
    capacities: tuple[int, ...]

    def read(self) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.float64], ...]]:
        """Returns for each source its instants [ns], (T,), and its rows, (T, width), as views of the file.  Raises OSError."""
        with self.path.open("rb") as file:
            whole = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
        times, rows = [], []
        at = _places(self.capacities, self.width)
        for (times_at, rows_at), count in zip(at, self.counts, strict=True):
            times.append(np.frombuffer(whole, np.int64, count, times_at))
            rows.append(np.frombuffer(whole, np.float64, count * self.width, rows_at).reshape(-1, self.width))
        return tuple(times), tuple(rows)


class Rows:
    """Rows of `width` numbers with an instant each, from several sources.

    `capacities` says how many rows each source can have; a row beyond that is not kept, but counted as `surplus`.  If the file
    cannot be written, no further rows are kept, and `failure` says why."""

    def __init__(self, capacities: Sequence[int], width: int) -> None:
        self._capacities, self.width = tuple(capacities), width
        self._times = [array("q") for _ in capacities]
        self._rows = [bytearray() for _ in capacities]
        self._counts = [0] * len(self._capacities)
        self._bytes = 0  # in memory, as long as there is no file
        self._file: IO[bytes] | None = None
        self._at: list[tuple[int, int]] = []
        self.surplus = 0
        self.failure: str | None = None

    def add(self, source: int, time_ns: int, row: bytes) -> None:
        """Adds a row: `width` float64 of this machine."""
        if self.failure is not None:
            return
        if self._counts[source] >= self._capacities[source]:
            self.surplus += 1
            return
        self._counts[source] += 1
        self._times[source].append(time_ns)
        self._rows[source] += row
        if self._file is not None:
            if len(self._rows[source]) >= BLOCK:
                self._write(source)
            return
        self._bytes += len(row) + TIME_BYTES
        if self._bytes > LARGE:
            self._to_file()

    def last(self) -> list[tuple[int, bytes]] | None:
        """Returns the last row of each source with its instant [ns]; None as long as a source has no row."""
        if not all(self._counts):
            return None
        size = 8 * self.width
        found = []
        for source, times in enumerate(self._times):
            if times:
                found.append((times[-1], bytes(self._rows[source][-size:])))
            else:  # it has just been written
                times_at, rows_at = self._at[source]
                number = self._counts[source] - 1
                time = self._read(times_at + TIME_BYTES * number, TIME_BYTES)
                found.append((int.from_bytes(time, "little"), self._read(rows_at + size * number, size)))
        return found

    def build(self) -> tuple[tuple[NDArray[np.int64], ...], tuple[NDArray[np.float64], ...], RowsInFile | None]:
        """Returns for each source its instants [ns], (T,), and its rows, (T, width); and where these are, if in a file."""
        if self._file is None:
            times = tuple(np.array(times, dtype=np.int64) for times in self._times)
            return times, tuple(np.frombuffer(bytes(rows)).reshape(-1, self.width) for rows in self._rows), None
        for source in range(len(self._rows)):
            self._write(source)
        path = Path(f"/proc/{os.getpid()}/fd/{self._file.fileno()}")
        in_file = RowsInFile(path, self.width, tuple(self._counts), self._capacities)
        return *in_file.read(), in_file

    def _to_file(self) -> None:
        try:
            self._file = _unnamed()
            self._at = _places(self._capacities, self.width)
            os.truncate(self._file.fileno(), _size(self._capacities, self.width))
        except OSError:  # no room, or no such large files there: all stays in memory
            self._file = None
            self._bytes = -1 << 62
            return
        for source in range(len(self._rows)):
            self._write(source)

    def _write(self, source: int) -> None:
        times, rows = self._times[source], self._rows[source]
        first = self._counts[source] - len(times)
        times_at, rows_at = self._at[source]
        try:
            self._put(rows_at + 8 * self.width * first, rows)
            self._put(times_at + TIME_BYTES * first, times.tobytes())
        except OSError as error:
            self._counts[source] = first
            self.failure = self.failure or str(error)
        self._times[source], self._rows[source] = array("q"), bytearray()

    def _put(self, at: int, data: bytes | bytearray) -> None:
        assert self._file is not None
        view = memoryview(data)
        while view:
            written = os.pwrite(self._file.fileno(), view, at)
            view, at = view[written:], at + written

    def _read(self, at: int, size: int) -> bytes:
        assert self._file is not None
        return os.pread(self._file.fileno(), size, at)


def _places(capacities: Sequence[int], width: int) -> list[tuple[int, int]]:
    """Returns where the instants and the rows of each source begin in a file [bytes]."""
    places, at = [], 0
    for capacity in capacities:
        places.append((at, at + TIME_BYTES * capacity))
        at += (TIME_BYTES + 8 * width) * capacity
    return places


def _size(capacities: Sequence[int], width: int) -> int:
    return (TIME_BYTES + 8 * width) * sum(capacities)
