"""How fast an error decays or grows: a line fitted to the logarithm of its amplitude.

|e| of an oscillating block passes near zero twice in a period; its *amplitude* does not.  For the block alone,

    ë = -K_1 e - K_2 ė,   K_1 = k1/σ²,  K_2 = k2/σ,   α = K_2/2,  ω² = K_1 - α² > 0,

    a² = |e|² + |ė + α e|²/ω²

falls as e^(-2αt), without a ripple.  If the block does not oscillate (ω² ≤ 0), the amplitude is |e|.  For matrix gains k1 and
k2 are the means of their diagonals.  Delays, lead and coupling change α and ω a little; then a small ripple remains.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import BlockPlan
from echelon.sim.results.block_series import BlockSeries
from echelon.sim.results.settling import ROUNDING
from echelon.sim.results.trace import Array

LEFT: Final = 0.02
"""A decay is fitted down to this share of the largest amplitude"""
LEAST: Final = 8
"""Number of instants that a fit needs"""


@dataclass(frozen=True, slots=True)
class Fit:
    """The fit amplitude ~ e^(-rate t): its rate [1/s], negative if the amplitude grows, and r² of the line fitted to the
    logarithm."""

    rate: float
    r_squared: float


def oscillation(block: BlockPlan) -> tuple[float, float]:
    """Returns α [1/s] and ω² [1/s²] of a block alone; ω² = 0 if it has no variables."""
    if not block.size:
        return 0.0, 0.0
    K_1 = float(np.trace(block.k1)) / block.size / block.sigma**2
    alpha = float(np.trace(block.k2)) / block.size / block.sigma / 2
    return alpha, K_1 - alpha**2


def amplitude(series: BlockSeries) -> Array:
    """Returns the amplitude a of a block's error [m], (T,)."""
    alpha, omega_squared = oscillation(series.block)
    if omega_squared <= 0:
        return series.norm
    with np.errstate(all="ignore"):
        rest = np.square(series.error_rate + alpha * series.error).sum(axis=1) / omega_squared
        return np.asarray(np.sqrt(np.square(series.norm) + rest))


def decay(times_ns: NDArray[np.int64], amplitudes: Array, level: float) -> Fit | None:
    """Returns the fit from the largest amplitude down to the share `LEFT` of it, or down to twice the final amplitude `level`
    [m], at most 1/e of the largest, if that comes sooner.

    If the largest amplitude is in the last half of the run, the error grows, and the fit is over that half.  Returns None if an
    amplitude is not finite, or if there are fewer than `LEAST` instants to fit, or an amplitude of zero among them."""
    if len(amplitudes) < LEAST or not np.isfinite(amplitudes).all():
        return None
    begin = int(np.argmax(amplitudes))
    largest = float(amplitudes[begin])
    if 2 * begin >= len(amplitudes):
        return _line(times_ns[len(times_ns) // 2 :], amplitudes[len(times_ns) // 2 :])
    low = max(LEFT * largest, min(2 * level, largest / np.e), ROUNDING)
    below = np.flatnonzero(amplitudes[begin:] < low)
    end = begin + int(below[0]) if below.size else len(amplitudes)
    return _line(times_ns[begin:end], amplitudes[begin:end])


def _line(times_ns: NDArray[np.int64], amplitudes: Array) -> Fit | None:
    if len(amplitudes) < LEAST or amplitudes.min() <= 0:
        return None
    t = (times_ns - times_ns[0]) / 1e9
    y = np.log(amplitudes)
    t, y = t - t.mean(), y - y.mean()
    slope = float(t @ y / (t @ t))
    spread = float(y @ y)
    missed = float(np.square(y - slope * t).sum())
    return Fit(-slope, 1.0 - missed / spread if spread > 0 else 1.0)
