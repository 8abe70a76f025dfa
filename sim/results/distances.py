"""Distances between robots, at the recorded instants and between them.

Between two instants every robot is taken to move in a straight line at constant speed.  For this motion the closest approach of
a pair is exact: with the pair's offset r0 at the first instant and the change D of the offset up to the next one, |r0 + s D| is
least at s = -r0·D / |D|², clipped to [0, 1].  A real path differs from the straight line by at most |p̈| T²/8.
"""

from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from echelon.large_arrays import large_empty
from echelon.sim.results.block_series import POSITION
from echelon.sim.results.trace import Trace

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Encounter:
    """The closest approach of two robots (by index): their distance [m] and the instant."""

    pair: tuple[int, int]
    distance: float
    time_ns: int


@dataclass(frozen=True, slots=True)
class Violation:
    """An unbroken interval in which a pair (by index) was not farther apart than the avoidance radius; `smallest` [m]
    is the smallest distance in it.  Its ends are interpolated, rounded to nanoseconds."""

    pair: tuple[int, int]
    first_ns: int
    last_ns: int
    smallest: float


@dataclass(frozen=True, slots=True)
class Distances:
    """The distances of all pairs of robots at T instants, and between them."""

    times_ns: NDArray[np.int64]
    """(T,)"""
    smallest: Array
    """The smallest distance of all pairs from each instant up to the next [m], (T,); NaN where no pair has a finite distance"""
    closest: Encounter | None
    """The closest encounter of the run; None where no pair has a finite distance"""
    violations: tuple[Violation, ...]
    """In order of their beginning"""


def distances(trace: Trace) -> Distances:
    """Returns the distances between robots at the instants at which every robot has a state, and between them.

    A robot whose position is not finite has no distance to other robots.  A violation is a distance of at most the plan's
    avoidance radius r_a, also where avoidance is not enabled."""
    times_ns = trace.common_ns()
    smallest = large_empty(len(times_ns))
    smallest[:] = np.nan
    closest: Encounter | None = None
    violations: dict[tuple[int, int], list[Violation]] = {}
    radius = trace.plan.avoidance.avoidance_radius
    for part, places in trace.windows(POSITION, overlap=1):
        part_ns, (x, y) = times_ns[part], np.ascontiguousarray(places.transpose(2, 0, 1))
        if len(part_ns) == 1:  # a single instant counts as a motion of length zero
            part_ns, x, y = np.repeat(part_ns, 2), np.repeat(x, 2, axis=0), np.repeat(y, 2, axis=0)
        least = smallest[part]
        with np.errstate(all="ignore"):
            for one in range(x.shape[1] - 1):
                rows = _Pairs.of(x[:, one + 1 :] - x[:, one, None], y[:, one + 1 :] - y[:, one, None])
                np.fmin(least[:-1], np.fmin.reduce(rows.least, axis=1)[: len(least) - 1], out=least[:-1])
                if part.stop == len(times_ns):
                    least[-1] = np.fmin(least[-1], np.fmin.reduce(rows.at[-1]))
                found = rows.closest(one, part_ns)
                if found is not None and (closest is None or found.distance < closest.distance):
                    closest = found
                for column in np.flatnonzero((rows.least <= radius).any(axis=0)).tolist():
                    earlier = violations.setdefault((one, one + 1 + column), [])
                    _extend(earlier, rows.violations(one, column, part_ns, radius), rows.at[0, column] <= radius)
    in_order = sorted(chain.from_iterable(violations.values()), key=lambda found: (found.first_ns, found.pair))
    return Distances(times_ns, smallest, closest, tuple(in_order))


def _extend(violations: list[Violation], later: list[Violation], is_inside: bool) -> None:
    """Adds the violations of a pair in the next piece of a trace.

    With `is_inside` the pair is within the radius where the pieces meet; a violation that ends there goes on."""
    if violations and is_inside and violations[-1].last_ns == later[0].first_ns:
        before, after = violations.pop(), later[0]
        smallest = min(before.smallest, after.smallest)
        later = [Violation(before.pair, before.first_ns, after.last_ns, smallest), *later[1:]]
    violations += later


@dataclass(frozen=True, slots=True)
class _Pairs:
    """The pairs of one robot with all robots of a higher index; between two instants there is a segment."""

    x: Array
    """Offset in x at the instants [m], (T, pairs)"""
    y: Array
    at: Array
    """Distance at the instants [m], (T, pairs)"""
    along: Array
    """Where in each segment the pair is closest (s in the module's docstring, 0 to 1), (T - 1, pairs)"""
    least: Array
    """Smallest distance in each segment [m], (T - 1, pairs)"""

    @classmethod
    def of(cls, x: Array, y: Array) -> "_Pairs":
        dx, dy = np.diff(x, axis=0), np.diff(y, axis=0)
        square = dx * dx + dy * dy
        along = np.where(square > 0, np.clip(-(x[:-1] * dx + y[:-1] * dy) / square, 0.0, 1.0), 0.0)
        at = np.hypot(x, y)
        between = np.hypot(x[:-1] + along * dx, y[:-1] + along * dy)
        # The ends count too: rounding must not let a segment miss an end that is inside, nor a NaN hide one.
        return cls(x, y, at, along, np.fmin(between, np.fmin(at[:-1], at[1:])))

    def closest(self, one: int, times_ns: NDArray[np.int64]) -> Encounter | None:
        """Returns the closest encounter of robot `one` with a robot of a higher index; None without a finite distance."""
        if np.isnan(self.least).all():
            return None
        segment, column = np.unravel_index(np.nanargmin(self.least), self.least.shape)
        step = int(times_ns[segment + 1] - times_ns[segment])
        along = float(self.along[segment, column])
        if np.isnan(along):
            along = float(np.isnan(self.at[segment, column]))
        time_ns = int(times_ns[segment]) + round(along * step)
        return Encounter((one, one + 1 + int(column)), float(self.least[segment, column]), time_ns)

    def violations(self, one: int, column: int, times_ns: NDArray[np.int64], radius: float) -> list[Violation]:
        """Returns the violations of one pair, in order of time."""
        least, inside = self.least[:, column], self.at[:, column] <= radius
        touched = np.flatnonzero(least <= radius)
        # A new interval begins where the segment before is not touched, or the pair is outside at the instant between them.
        fresh = np.ones(len(touched), dtype=bool)
        fresh[1:] = (np.diff(touched) > 1) | ~inside[touched[1:]]
        starts = np.flatnonzero(fresh)
        ends = np.append(starts[1:], len(touched)) - 1
        found = []
        for start, end in zip(starts, ends, strict=True):
            first, last = int(touched[start]), int(touched[end])
            begin = 0.0 if inside[first] else self._crossings(first, column, radius)[0]
            finish = 1.0 if inside[last + 1] else self._crossings(last, column, radius)[1]
            found.append(
                Violation(
                    (one, one + 1 + column),
                    int(times_ns[first]) + round(begin * int(times_ns[first + 1] - times_ns[first])),
                    int(times_ns[last]) + round(finish * int(times_ns[last + 1] - times_ns[last])),
                    float(least[first : last + 1].min()),
                )
            )
        return found

    def _crossings(self, segment: int, column: int, radius: float) -> tuple[float, float]:
        """Returns at which s the pair enters and leaves the radius in a segment: the roots of |r0 + s D|² = r_a², within 0 to
        1."""
        x, y = float(self.x[segment, column]), float(self.y[segment, column])
        dx, dy = float(self.x[segment + 1, column]) - x, float(self.y[segment + 1, column]) - y
        a, b, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - radius * radius
        if not np.isfinite(a) or a == 0.0:
            return 0.0, 0.0 if not np.isfinite(a) else 1.0
        root = max(b * b - a * c, 0.0) ** 0.5
        return min(max((-b - root) / a, 0.0), 1.0), min(max((-b + root) / a, 0.0), 1.0)
