"""How the error of a block ended, judged by the last third of the run.

The last third has two parts: the sixth before the last, and the last sixth.  `amplitude` is that of `results.rates`, and its
size in a sixth is its root mean square there.  The first ending in this table that fits is the result:

ending         when
not finite     some |e| is not finite
too short      a third of the run is shorter than the block's dwell time
at rest        e is zero but for rounding, at the end and in the last sixth
steady lag     e is a constant time times the velocity of the trajectory, and velocity × delay is more than a tenth of |e|
grows          the amplitude in the last sixth is more than `health.growth` times that in the sixth before, and e is not spared
falls          the amplitude in the last sixth is less than 0.9 times that in the sixth before, and does not rise in between
steady error   e is constant
oscillates     e changes its sign at least twice in the last half of the run, or |e| goes up and down in the last third
steady error   otherwise: |e| neither grows nor falls, nor goes up and down

*Constant* means: the constant explains 90 % of the mean square of e, and its size changes from one sixth to the next by a
factor between 0.9 and `health.growth`.

*Spared* is a growing error that is too small to be judged.  The amplitude in the last sixth is at most the floor: the largest
of `health.floor`, of the steady error and its variation that the ages of messages explain (`results.ages`), and of σ times a
jump in the velocity of the trajectory.  Or it is at most 5 % of the error that the block started with, and either did not grow
in the sixth before, or would still be within these 5 % after another run of this length.  For with friction or with steps of
torque a small error may move from one steady value to another, or begin to tremble.
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
"""Factor by which an error may exceed its steady lag on the way there"""
EXPLAINED: Final = 0.9
"""Share of an error's mean square that a constant must explain for the error to count as constant"""
SMALL: Final = 0.05
"""Share of the error at the start; smaller errors must grow for longer to count as growing"""
SIXTHS: Final = 6
"""Parts of a run"""
FALLS: Final = 0.9
"""An error falls if its amplitude in the last sixth is less than this multiple of that in the sixth before"""
RISES: Final = 1.25
"""Values rise again if they exceed this multiple of the lowest value before"""
WINDOWS: Final = 6
"""Number of windows in which the last third is searched for rises; ups and downs within a window are ripple and do not count"""
Kind = Literal["at rest", "falls", "grows", "oscillates", "steady lag", "steady error", "not finite", "too short"]


@dataclass(frozen=True, slots=True)
class Ending:
    """How a block's error ended."""

    kind: Kind
    text: str
    """The same in words, with numbers"""
    growth: float | None
    """Amplitude in the last sixth of the run over that in the sixth before; None if the run is too short, or an error is not
    finite"""
    level: float
    """Root mean square of the amplitude in the last sixth [m]"""
    floor: float
    """Amplitudes up to this are not judged [m]"""
    fit: Fit | None
    spared: str = ""
    """Why the error does not count as growing though it grew by more than `health.growth`; empty if it did not, or counts"""

    @property
    def judged(self) -> bool:
        """False if nothing can be said: an error is not finite, or the run is too short."""
        return self.kind not in ("not finite", "too short")


@dataclass(frozen=True, slots=True)
class Reference:
    """The velocity of the desired trajectory."""

    velocity: Array
    """(T, 2) [m/s]"""
    speed: float
    """Largest speed in the last third of the run [m/s]"""
    jump: float
    """Largest jump of the velocity in the last third of the run [m/s]"""


def endings(plan: Plan, blocks: Blocks, links: Sequence[LinkCounts]) -> tuple[Ending, ...]:
    """Returns how the error of each block ended, in the order of the plan."""
    times_ns = blocks.times_ns
    if not len(times_ns):
        return tuple(Ending("too short", "was never recorded", None, 0.0, 0.0, None) for _ in blocks.series)
    centroid = blocks.series[-1]
    reference = reference_of(centroid.rate - centroid.error_rate, times_ns)
    lags, floors = lag_times(plan, links), floors_of(plan, reference, links)
    found = []
    for series in blocks.series:
        lag = float(np.linalg.norm(lags[series.block.name]))
        floor = floors[series.block.name]
        wait_ns = dwell_ns(series.block, plan.health.dwell)
        found.append(_ending(series, times_ns, reference.velocity, floor, lag, plan.health.growth, wait_ns))
    return tuple(found)


def floors_of(plan: Plan, reference: Reference, links: Sequence[LinkCounts]) -> dict[str, float]:
    """Returns for each block the amplitude up to which it is not judged [m]."""
    jitter, lags = loop_jitter(plan, links), lag_times(plan, links)
    floors = {}
    for block in plan.blocks:
        unknown = reference.speed * (OVER * float(np.linalg.norm(lags[block.name])) + jitter)
        floors[block.name] = max(plan.health.floor, unknown, block.sigma * reference.jump)
    return floors


def is_too_short(times_ns: NDArray[np.int64], wait_ns: int) -> bool:
    """Returns whether a run is too short to judge a block with this dwell time."""
    return int(times_ns[-1]) - int(times_ns[0]) < 3 * wait_ns or not _sixth(times_ns, 4).any()


def levels(sizes: Array, times_ns: NDArray[np.int64]) -> tuple[float, float, float]:
    """Returns the root mean square of amplitudes, both (T,), in the last three sixths of the run, in their order."""
    with np.errstate(all="ignore"):
        sooner, earlier = (_rms(sizes[_sixth(times_ns, number)]) for number in (3, 4))
        return sooner, earlier, _rms(sizes[times_ns >= _part_ns(times_ns, 5)])


def growth_of(level: float, earlier: float) -> float:
    """Returns the ratio of two amplitudes; 1 if both are zero but for rounding."""
    return level / earlier if earlier > 0 else 1.0 if level <= ROUNDING else float("inf")


def reference_of(velocity: Array, times_ns: NDArray[np.int64]) -> Reference:
    """Returns what judging needs of the desired velocity (T, 2) at the instants `times_ns`, (T,)."""
    late = times_ns >= _part_ns(times_ns, 4)
    steps = np.diff(velocity[late], axis=0)
    # A jump is the change of velocity in one step, less the larger one of the changes in the steps beside it.
    jump = 0.0
    if len(steps) > 2:
        sizes = np.linalg.norm(steps, axis=1)
        beside = np.maximum(np.append(sizes[1:], sizes[-1]), np.append(sizes[0], sizes[:-1]))
        jump = float(np.max(sizes - beside, initial=0.0))
    with np.errstate(all="ignore"):
        speed = float(np.nanmax(np.linalg.norm(velocity[late], axis=1), initial=0.0))
    return Reference(velocity, speed if np.isfinite(speed) else 0.0, jump if np.isfinite(jump) else 0.0)


def _part_ns(times_ns: NDArray[np.int64], sixths: int) -> int:
    """Returns the instant [ns] at which `sixths` sixths of the run are over."""
    return int(times_ns[0]) + (int(times_ns[-1]) - int(times_ns[0])) * sixths // SIXTHS


def _sixth(times_ns: NDArray[np.int64], number: int) -> NDArray[np.bool_]:
    """Returns a mask (T,) of the instants in the sixth `number` of the run; numbers begin at 0."""
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
    before, last = _sixth(times_ns, 4), times_ns >= _part_ns(times_ns, 5)
    sooner, earlier, level = levels(sizes, times_ns)
    with np.errstate(all="ignore"):
        fit = decay(times_ns, sizes, level)
    if is_too_short(times_ns, wait_ns):
        text = f"cannot be judged: a third of the run is shorter than its dwell time, {wait_ns / 1e9:.4g} s"
        return Ending("too short", text, None, level, floor, fit)
    growth = growth_of(level, earlier)

    begun = start_error(series, times_ns) or 0.0
    spared = spared_because(level, earlier, sooner, floor, begun, bound) if growth > bound else ""

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


def spared_because(level: float, earlier: float, sooner: float, floor: float, begun: float, bound: float) -> str:
    """Returns why an error that grew by more than `bound` does not count as growing; empty if it counts.

    `level`, `earlier` and `sooner` are its amplitudes [m] in the last sixth of the run, in the one before, and in the one
    before that; `begun` is the error that the block started with [m]."""
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
    """True if an error (T, size) is constant in the last third; with a velocity (T, 2), if each of its variables is a constant
    time times the velocity.  From one sixth to the next the constant changes by a factor from `FALLS` to `bound`."""
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
    """True if the error's component along its largest value changes its sign at least twice."""
    error = series.error[part]
    if not error.size:
        return False
    along = error @ error[int(np.argmax(series.norm[part]))]
    signs = np.sign(along)
    return int(np.count_nonzero(np.diff(signs[signs != 0]))) >= 2


def _rises(values: Array) -> bool:
    """True if values rise again: their largest in one of `WINDOWS` windows is more than `RISES` times that in an earlier
    one."""
    peaks = np.array([float(part.max()) for part in np.array_split(values, WINDOWS) if len(part)])
    return bool(len(peaks)) and bool((peaks > RISES * np.minimum.accumulate(peaks)).any())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean())) if len(values) else 0.0
