"""What many random runs of a point say together, and how sure that is."""

from dataclasses import dataclass
from math import exp, inf, isfinite, log, nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

LEVEL: Final = 0.95
"""Confidence level of all intervals"""
NORMAL: Final = 1.959963984540054
"""Quantile of the normal distribution for `LEVEL`"""
Array = NDArray[np.float64]


def wilson(holds: int, runs: int) -> tuple[float, float]:
    """Returns the Wilson interval, at `LEVEL`, of the probability that a run holds, from the number of independent runs that
    do."""
    from scipy.stats import binomtest  # takes long to import

    interval = binomtest(holds, runs).proportion_ci(LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def runs_needed(share: float) -> int:
    """Returns the smallest number of runs that can show a share: with fewer, the interval of n of n runs that hold begins
    below it.  From the closed form: n/(n + z²) ≥ share."""
    return max(1, int(np.ceil(share * NORMAL**2 / (1 - share) - 1e-9))) if share < 1 else 1 << 62


def median(values: Array) -> float:
    """Returns the median of values, NaN counting as infinite; NaN if the median is infinite, or there are no values."""
    if not len(values):
        return nan
    middle = np.sort(np.where(np.isnan(values), inf, values))[[(len(values) - 1) // 2, len(values) // 2]]
    found = float(middle.mean()) if np.isfinite(middle).all() else inf
    return found if isfinite(found) else nan


@dataclass(frozen=True, slots=True)
class MomentGrowth:
    """Growth of the second moment E|e|² over runs: the ratio of its estimates in the last two sixths of the run."""

    ratio: float
    """Infinite if a run was lost; NaN if nothing can be said"""
    low: float
    high: float
    """Interval at `LEVEL`; equal to the ratio if there is one run, or all are equal"""
    heaviest: float
    """Share of the sum in the last sixth that comes from the run with the largest part.  Near 1, the sample says little about
    the mean: rare runs decide it"""


def moment_growth(earlier: Array, level: Array, lost: int = 0) -> MomentGrowth:
    """Returns the growth of the second moment, from the root mean squares of the amplitude in the last two sixths of each run,
    both (runs,) [m]; `lost` is the number of runs that ended with states that are not finite.

    The interval is that of a ratio of means of pairs, on a logarithmic scale: var ln(ȳ/x̄) ≈ Σ(y/ȳ - x/x̄)²/(n (n - 1))."""
    if lost:
        return MomentGrowth(inf, inf, inf, 1.0)
    known = np.isfinite(earlier) & np.isfinite(level)
    x, y = np.square(earlier[known]), np.square(level[known])
    n = len(x)
    if not n or not x.mean() > 0 or not y.mean() > 0:
        ratio = nan if not n else 0.0 if x.mean() > 0 else inf if y.mean() > 0 else 1.0
        return MomentGrowth(ratio, ratio, ratio, nan)
    ratio = float(y.mean() / x.mean())
    spread = float(np.square(y / y.mean() - x / x.mean()).sum())
    error = sqrt(spread / (n * (n - 1))) if n > 1 else 0.0
    widths = log(ratio) - NORMAL * error, log(ratio) + NORMAL * error
    low, high = (exp(min(max(width, -700.0), 700.0)) for width in widths)
    return MomentGrowth(ratio, low, high, float(y.max() / y.sum()))
