"""Distances between robots, between the recorded instants too.

From one instant to the next every robot is taken to move in a straight line at constant speed; of that motion the
closest approach is exact: with the pair's offset r0 at the first instant and its change D up to the next,
|r0 + s D| is least for s = -r0·D / |D|², clipped to [0, 1].  A real path bends between instants by at most |p̈| T²/8.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echelon.sim.results.block_series import POSITION
from echelon.sim.results.trace import Trace

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Encounter:
    """How close two robots (by index) came, and when."""

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
    """`smallest` (T,) [m] is the smallest distance of all pairs from each instant up to the next, NaN where there is
    none; `closest` is the closest encounter; `violations` are ordered by their beginning."""

    times_ns: NDArray[np.int64]
    smallest: Array
    closest: Encounter | None
    violations: tuple[Violation, ...]


def distances(trace: Trace) -> Distances:
    """Returns the distances between robots at the instants at which every robot has a state, and between them.

    Where a position is not finite it has no distance to others.  A violation is a distance of at most the plan's
    avoidance radius r_a, also where avoidance is not enabled."""
    times_ns, states = trace.common()
    x, y = (np.ascontiguousarray(states[:, :, field]) for field in POSITION)
    instants = len(times_ns)
    if instants == 1:  # a single instant is a motion without motion
        times_ns, x, y = np.repeat(times_ns, 2), np.repeat(x, 2, axis=0), np.repeat(y, 2, axis=0)
    smallest = np.full(len(times_ns), np.nan)
    closest: Encounter | None = None
    violations: list[Violation] = []
    radius = trace.plan.avoidance.avoidance_radius
    with np.errstate(all="ignore"):
        for one in range(x.shape[1] - 1 if instants else 0):
            rows = _Pairs.of(x[:, one + 1 :] - x[:, one, None], y[:, one + 1 :] - y[:, one, None])
            np.fmin(smallest[:-1], np.fmin.reduce(rows.least, axis=1), out=smallest[:-1])
            smallest[-1] = np.fmin(smallest[-1], np.fmin.reduce(rows.at[-1]))
            found = rows.closest(one, times_ns)
            if found is not None and (closest is None or found.distance < closest.distance):
                closest = found
            for column in np.flatnonzero((rows.least <= radius).any(axis=0)):
                violations += rows.violations(one, int(column), times_ns, radius)
    violations.sort(key=lambda violation: (violation.first_ns, violation.pair))
    return Distances(times_ns[:instants], smallest[:instants], closest, tuple(violations))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """One robot with all later ones: offsets x, y and distances `at` instants are (T, pairs); `along` (s above) and
    `least` distance between instants are (T - 1, pairs)."""

    x: Array
    y: Array
    at: Array
    along: Array
    least: Array

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
        least, inside = self.least[:, column], self.at[:, column] <= radius
        touched = np.flatnonzero(least <= radius)
        # A new interval begins where the segment before is not touched, or the instant between them lies outside.
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
        """Returns where (s) a segment enters and leaves the circle: the roots of |r0 + s D|² = r_a²."""
        x, y = float(self.x[segment, column]), float(self.y[segment, column])
        dx, dy = float(self.x[segment + 1, column]) - x, float(self.y[segment + 1, column]) - y
        a, b, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - radius * radius
        if not np.isfinite(a) or a == 0.0:
            return 0.0, 0.0 if not np.isfinite(a) else 1.0
        root = max(b * b - a * c, 0.0) ** 0.5
        return min(max((-b - root) / a, 0.0), 1.0), min(max((-b + root) / a, 0.0), 1.0)
