"""How the error of a block ended: at rest, falling, growing, oscillating, or with a steady lag.

The last third of the run is looked at, in two halves: the sixth before the last, and the last.  The error *falls* if its
amplitude (`rates`) is smaller in the last sixth than in the one before, and does not rise again in between.  It *grows* if the
root mean square of its amplitude is more than `health.growth` times as large in the last sixth as in the one before, and
larger than what is not judged: `health.floor`; what a moving formation cannot know, its speed times the ages of what it acts
on (`ages`); and σ times what the velocity of the trajectory jumps by.  An error within 5 % of what the block started with may
move from one steady value to another, or begin to tremble, with friction or steps of torque: it grows only if it grew in the
sixth before, too, and would leave those 5 % if it went on like that for as long as the run has lasted.

It is a *steady lag* if it is a constant time times the velocity of the trajectory, a *steady error* if it is constant; to nine
tenths of its mean square, and within the same bound from one sixth to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.results.ages import lag_times, loop_jitter
from echelon.sim.results.block_series import Blocks, BlockSeries
from echelon.sim.results.rates import Fit, amplitude, decay
from echelon.sim.results.settling import ROUNDING, dwell_ns, start_error
from echelon.sim.results.trace import Array

OVER: Final = 1.2
"""So many times its steady lag an error may reach on the way there"""
EXPLAINED: Final = 0.9
"""Share of an error's mean square that a constant explains, if it is one"""
SMALL: Final = 0.05
"""Errors up to this share of what a block started with must grow for longer to count as growing"""
SIXTHS: Final = 6
"""Of a run"""
FALLS: Final = 0.9
"""An error whose amplitude is less than so many times what it was a sixth of the run before falls, if it never rises"""
RISES: Final = 1.25
"""An error rises where it is so many times its lowest before, in the last third of the run"""
WINDOWS: Final = 6
"""Of the last third: what is within a window is a ripple"""
Kind = Literal["at rest", "falls", "grows", "oscillates", "steady lag", "steady error", "not finite", "too short"]


@dataclass(frozen=True, slots=True)
class Ending:
    """How a block's error ended."""

    kind: Kind
    text: str
    """The same in words, with numbers"""
    growth: float | None
    """Amplitude in the last sixth of the run over that in the sixth before; None if the run is too short, or not finite"""
    level: float
    """Root mean square of the amplitude in the last sixth [m]"""
    floor: float
    """What is not judged [m]"""
    fit: Fit | None
    spared: str = ""
    """Why it does not count as growing though it grew by more than `health.growth`; empty where it did not, or counts"""

    @property
    def judged(self) -> bool:
        """False if there is too little to tell how it ended."""
        return self.kind not in ("not finite", "too short")


@dataclass(frozen=True, slots=True)
class _Reference:
    """The trajectory's velocity (T, 2) [m/s], and where its speed is largest, and what it jumps by, in the last third."""

    velocity: Array
    speed: float
    jump: float


def endings(plan: Plan, blocks: Blocks, links: Sequence[LinkCounts]) -> tuple[Ending, ...]:
    """Returns how each block ended, in the order of the plan."""
    times_ns = blocks.times_ns
    if not len(times_ns):
        return tuple(Ending("too short", "was never recorded", None, 0.0, 0.0, None) for _ in blocks.series)
    reference = _reference(blocks)
    jitter, lags = loop_jitter(plan, links), lag_times(plan, links)
    found = []
    for series in blocks.series:
        lag = float(np.linalg.norm(lags[series.block.name]))
        unknown = reference.speed * (OVER * lag + jitter)
        floor = max(plan.health.floor, unknown, series.block.sigma * reference.jump)
        wait_ns = dwell_ns(series.block, plan.health.dwell)
        found.append(_ending(series, times_ns, reference.velocity, floor, lag, plan.health.growth, wait_ns))
    return tuple(found)


def _reference(blocks: Blocks) -> _Reference:
    centroid = blocks.series[-1]
    velocity = centroid.rate - centroid.error_rate
    late = blocks.times_ns >= _part_ns(blocks.times_ns, 4)
    steps = np.diff(velocity[late], axis=0)
    # A jump is what the velocity changes by in one step beyond what it does in the steps beside it.
    jump = 0.0
    if len(steps) > 2:
        sizes = np.linalg.norm(steps, axis=1)
        beside = np.maximum(np.append(sizes[1:], sizes[-1]), np.append(sizes[0], sizes[:-1]))
        jump = float(np.max(sizes - beside, initial=0.0))
    with np.errstate(all="ignore"):
        speed = float(np.nanmax(np.linalg.norm(velocity[late], axis=1), initial=0.0))
    return _Reference(velocity, speed if np.isfinite(speed) else 0.0, jump if np.isfinite(jump) else 0.0)


def _part_ns(times_ns: NDArray[np.int64], sixths: int) -> int:
    """Returns when so many sixths of the run are over."""
    return int(times_ns[0]) + (int(times_ns[-1]) - int(times_ns[0])) * sixths // SIXTHS


def _sixth(times_ns: NDArray[np.int64], number: int) -> NDArray[np.bool_]:
    """Returns which instants are in a sixth of the run, counted from 0."""
    return (times_ns >= _part_ns(times_ns, number)) & (times_ns < _part_ns(times_ns, number + 1))


def _ending(
    series: BlockSeries,
    times_ns: NDArray[np.int64],
    velocity: Array,
    floor: float,
    lag: float,
    bound: float,
    wait_ns: int,
) -> Ending:
    if not np.isfinite(series.norm).all():
        return Ending("not finite", "is not finite", None, float("nan"), floor, None)
    sizes = amplitude(series)
    sooner, before = (_sixth(times_ns, number) for number in (3, 4))
    last = times_ns >= _part_ns(times_ns, 5)
    with np.errstate(all="ignore"):
        fit = decay(times_ns, sizes, _rms(sizes[last]))
    if int(times_ns[-1]) - int(times_ns[0]) < 3 * wait_ns or not before.any():
        text = f"cannot be judged, for a third of the run is shorter than {wait_ns / 1e9:.4g} s, its dwell time"
        return Ending("too short", text, None, _rms(sizes[last]), floor, fit)
    earlier, level = _rms(sizes[before]), _rms(sizes[last])
    growth = level / earlier if earlier > 0 else 1.0 if level <= ROUNDING else float("inf")

    begun = start_error(series, times_ns) or 0.0
    spared = ""
    if growth > bound:
        spared = _spared(level, earlier, _rms(sizes[sooner]), floor, begun, bound)

    def ended(kind: Kind, text: str) -> Ending:
        why = "" if kind == "grows" or growth <= bound else spared or f"it {text}"
        return Ending(kind, text, growth, level, floor, fit, why)

    end, mean = float(series.norm[-1]), _rms(series.norm[last])
    if end <= ROUNDING and level <= ROUNDING:
        return ended("at rest", "is at rest")
    known = lag * float(np.sqrt(np.square(velocity[last]).sum(axis=1).mean()))
    beside = f", velocity × delay is {known:.3g} m" if known > max(ROUNDING, mean / 10) else ""
    if beside and _constant(series.error, velocity, before, last, bound):
        return ended("steady lag", f"keeps a steady lag of {mean:.3g} m{beside}")
    oscillates = _oscillates(series, times_ns >= _part_ns(times_ns, 3))
    if growth > bound and not spared:
        rate = f", {-fit.rate:+.3g} 1/s" if fit is not None and fit.rate < 0 else ""
        how = "oscillates with growing amplitude" if oscillates else "diverges"
        return ended("grows", f"{how}: {earlier:.3g} m, then {level:.3g} m, {growth:.3g} times as much{rate}")
    third = times_ns >= _part_ns(times_ns, 4)
    if growth < FALLS and not _rises(sizes[third]):
        return ended("falls", f"still falls, to {end:.3g} m")
    if _constant(series.error, None, before, last, bound):
        return ended("steady error", f"keeps a steady error of {mean:.3g} m{beside}")
    if oscillates:
        return ended("oscillates", f"keeps oscillating at about {mean:.3g} m{beside}")
    norm = series.norm[third]
    if _rises(norm) and _rises(norm[::-1]):
        low, high = float(norm.min()), float(norm.max())
        return ended(
            "oscillates", f"goes up and down between {low:.3g} m and {high:.3g} m in the last third of the run{beside}"
        )
    return ended("steady error", f"stays at about {mean:.3g} m{beside}")


def _spared(level: float, earlier: float, sooner: float, floor: float, begun: float, bound: float) -> str:
    """Returns why an error that grew does not count as growing; empty if it counts.  `level`, `earlier` and `sooner` are its
    amplitude in the last three sixths of the run, the last one first."""
    if level <= floor:
        return f"it is within {floor:.3g} m, which is not judged"
    share = SMALL * begun
    if level > share:
        return ""
    within = f"it is within {100 * SMALL:g} % of what it began with, {share:.3g} m"
    if earlier <= bound * sooner:
        return f"{within}, and did not grow before that"
    if level * min(level / earlier, 1e9) ** SIXTHS <= share:
        return f"{within}, and would be for another run of this length"
    return ""


def _constant(
    error: Array, velocity: Array | None, before: NDArray[np.bool_], last: NDArray[np.bool_], bound: float
) -> bool:
    """True if an error is constant in the last third, or a constant time (its own of each variable) times the velocity, and
    does not grow by more than the bound from one sixth to the next.  error (T, size), velocity (T, 2)."""
    both = before | last
    if velocity is None:
        whole, first, second = (error[part].mean(axis=0) for part in (both, before, last))
        missed = error[both] - whole
    else:
        if min(np.square(velocity[part]).sum() for part in (before, last)) <= 0:
            return False
        pairs = error.reshape(len(error), -1, 2)
        whole, first, second = (
            np.einsum("tkx,tx->k", pairs[part], velocity[part]) / np.square(velocity[part]).sum()
            for part in (both, before, last)
        )
        missed = pairs[both] - whole[:, None] * velocity[both][:, None, :]
    total = float(np.square(error[both]).sum())
    if total <= 0 or float(np.square(missed).sum()) > (1 - EXPLAINED) * total:
        return False
    ratio = float(np.linalg.norm(second)) / max(float(np.linalg.norm(first)), 1e-300)
    return FALLS <= ratio <= bound


def _oscillates(series: BlockSeries, part: NDArray[np.bool_]) -> bool:
    """True if the error changes its sign twice or more along the direction in which it is largest."""
    error = series.error[part]
    if not error.size:
        return False
    along = error @ error[int(np.argmax(series.norm[part]))]
    signs = np.sign(along)
    return int(np.count_nonzero(np.diff(signs[signs != 0]))) >= 2


def _rises(values: Array) -> bool:
    """True if values rise again from their lowest: the largest in one of `WINDOWS` is more than `RISES` times what it was in
    one before."""
    peaks = np.array([float(part.max()) for part in np.array_split(values, WINDOWS) if len(part)])
    return bool(len(peaks)) and bool((peaks > RISES * np.minimum.accumulate(peaks)).any())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean())) if len(values) else 0.0
