"""What is drawn of long lines: no more points than a figure can show, so that neither memory nor files grow with a run."""

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Change = Callable[[Array], Array]
COLUMNS: Final = 500
"""Columns of a picture; lines are thinned to the smallest and the largest value in each column."""
FEW: Final = 4 * COLUMNS
"""Lines of so many points are drawn as they are"""
DRAWABLE: Final = 1e9
"""Larger values are not drawn: otherwise they would hide everything else in the figures of a diverged run."""
PIECE: Final = 8192
"""Instants that are looked at together"""


def pieces(count: int) -> Iterator[slice]:
    """Yields the parts of `count` instants that are looked at together, in order."""
    for start in range(0, count, PIECE):
        yield slice(start, min(start + PIECE, count))


def drawable(values: Array) -> Array:
    """Returns values with NaN in place of those that are not finite or not below `DRAWABLE` in magnitude."""
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < DRAWABLE, values, np.nan)


def span(values: Array) -> tuple[float, float]:
    """Returns the smallest and the largest of values (T,) that can be drawn; NaN if there is none."""
    low = high = np.nan
    for part in pieces(len(values)):
        piece = drawable(values[part])
        with np.errstate(invalid="ignore"):
            low, high = np.fmin(low, np.fmin.reduce(piece)), np.fmax(high, np.fmax.reduce(piece))
    return float(low), float(high)


def thin(times_ns: NDArray[np.int64], values: Array, log: bool, change: Change = drawable) -> tuple[Array, Array]:
    """Returns instants [s] and values of a line, thinned for drawing: the first, smallest and largest value in each of
    `COLUMNS` columns of the picture, in order of time.

    `times_ns`, ascending, and `values` are (T,); `change` makes of values what is drawn, NaN for a gap.  With a logarithmic
    axis (`log`) instants up to 0 are left out."""
    if log:
        after = int(np.searchsorted(times_ns, 0, side="right"))
        times_ns, values = times_ns[after:], values[after:]
    if len(times_ns) <= FEW:
        return times_ns / 1e9, change(values)
    along: Change = np.log if log else np.array
    first, last = along(times_ns[[0, -1]] / 1e9)
    found = []
    for part in pieces(len(times_ns)):
        column = ((along(times_ns[part] / 1e9) - first) / (last - first) * COLUMNS).astype(int)
        column, shown = np.minimum(column, COLUMNS - 1), change(values[part])
        at = _extremes(column, shown)
        found.append((part.start + at, column[at], shown[at]))
    chosen, columns, shown = (np.concatenate(parts) for parts in zip(*found, strict=True))
    at = _extremes(columns, shown)  # a column may be in several pieces
    return times_ns[chosen[at]] / 1e9, shown[at]


def _extremes(column: NDArray[np.int64], values: Array) -> NDArray[np.int64]:
    """Returns where the first, smallest and largest value of each column are, and the last one of all, in order.

    NaN counts as the largest value, so that the line has a gap there."""
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    order = np.lexsort((values, column))
    ends = np.append(starts[1:], len(values)) - 1
    return np.unique(np.concatenate([starts, order[starts], order[ends], [len(values) - 1]]))


class ThinPath:
    """A path in the plane, thinned for drawing: of the points that follow each other within a pixel the first one is kept, and
    of a way from pixel to pixel that is gone several times the first time.

    `low` is the lowest x and y of all points (2,), and `pixel` the size of a pixel [m]."""

    def __init__(self, low: Array, pixel: float) -> None:
        self._low, self._pixel = low, pixel
        self._at = -1  # the pixel of the last point; -1: none
        self._point = np.full(2, np.nan)
        self._fresh = False
        self._ways = np.empty(0, np.int64)  # ascending
        self._kept: list[Array] = []

    def add(self, points: Array) -> None:
        """Adds the next points of the path, (T, 2); a point that is not finite is a gap."""
        finite: NDArray[np.bool_] = np.all(np.isfinite(points), axis=1)
        cells = ((np.where(finite[:, None], points, self._low) - self._low) / self._pixel).astype(np.int64)
        numbers = np.where(finite, (cells[:, 0] << 15) + cells[:, 1], -1)
        before = np.append(self._at, numbers[:-1])
        moves = np.flatnonzero(numbers != before)
        if not moves.size:
            return
        ways = ((before[moves] + 1) << 31) + numbers[moves] + 1
        found, first = np.unique(ways, return_index=True)
        fresh = np.zeros(len(ways), dtype=bool)
        fresh[first[~np.isin(found, self._ways)]] = True
        self._ways = np.union1d(self._ways, found)
        moved = np.where(finite[moves, None], points[moves], np.nan)
        from_there = np.concatenate([self._point[None], moved[:-1]])
        alone = fresh & ~np.append(self._fresh, fresh[:-1])
        rows = np.stack([np.full_like(moved, np.nan), from_there, moved], axis=1)
        self._kept.append(rows[np.stack([alone, alone, fresh], axis=1)])
        self._at, self._point, self._fresh = int(numbers[-1]), moved[-1], bool(fresh[-1])

    @property
    def points(self) -> Array:
        """The points to draw, (N, 2); NaN between parts that do not hang together."""
        return np.concatenate([np.empty((0, 2)), *self._kept])
