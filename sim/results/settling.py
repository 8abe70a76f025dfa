"""When the error of a block has settled.

The *response time* of a block is 3 σ/√k1, where k1 is the smallest gain of its error.  With a linear law this is nearly half a
period of the block's own oscillation.

The error that a block *starts with* is its largest |e| within its first response time: by then the response to any start has
passed its peak.  A shape begins at rest, so this is usually |e| at the start.  A centroid whose robots stand in their places
while the trajectory moves off has |e| = 0 at the start; what it starts with is how far it then falls behind.  The largest |e|
of the whole run would be a wrong measure: it is large when a run goes wrong.

|e| is *settled* from the instant on from which it stays in its band to the end of the run, if it then stays there for the dwell
time at least: by default one response time.  So a run that ends while |e| passes through zero has not settled: an oscillation
that leaves the band again is within it for less than half a period.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import BlockPlan, Plan
from echelon.sim.results.block_series import BlockSeries
from echelon.sim.results.trace import Array

ROUNDING: Final = 1e-9
"""Errors up to this [m] count as zero: they come from rounding"""
RESPONSE: Final = 3.0
"""Response time in multiples of σ/√k1"""


@dataclass(frozen=True, slots=True)
class Settling:
    """Whether |e| settled within a band."""

    band: float
    """[m]"""
    dwell_ns: int
    """How long |e| must stay in the band until the end of the run [ns]"""
    entered_ns: int | None
    """The instant [ns] from which on |e| is in the band to the end; None if it is outside at the end, or not finite at some
    time"""
    end_ns: int
    """End of the run [ns]"""

    @property
    def settled_ns(self) -> int | None:
        """The instant [ns] from which on |e| is settled; None if it is not settled."""
        if self.entered_ns is None or self.end_ns - self.entered_ns < self.dwell_ns:
            return None
        return self.entered_ns


def response_ns(block: BlockPlan) -> int:
    """Returns the response time of a block [ns]."""
    k1 = float(np.abs(np.linalg.eigvals(block.k1)).min()) if block.size else 1.0
    return _limited_ns(RESPONSE * block.sigma / np.sqrt(k1) if k1 > 0 else np.inf)


def dwell_ns(block: BlockPlan, scales: float | None) -> int:
    """Returns the dwell time of a block [ns]: `scales` times its time scale σ, or its response time if `scales` is None."""
    return response_ns(block) if scales is None else _limited_ns(scales * block.sigma)


def _limited_ns(seconds: float) -> int:
    return round(min(seconds, 1e9) * 1e9)


def start_error(series: BlockSeries, times_ns: NDArray[np.int64]) -> float | None:
    """Returns the error that a block starts with [m]: its largest |e| within its first response time.

    Returns None without instants, or if some |e| within that time is not finite."""
    if not len(times_ns):
        return None
    norm = series.norm[: int(np.searchsorted(times_ns, int(times_ns[0]) + response_ns(series.block), side="right"))]
    return float(norm.max()) if np.isfinite(norm).all() else None


def settle(
    plan: Plan, series: BlockSeries, times_ns: NDArray[np.int64], fraction: float, dwell: float | None = None
) -> Settling:
    """Returns whether a block settles within the band of `fraction` times the error that it starts with.

    If it starts with an error of at most `health.floor`, the band is `health.floor`.  `dwell` is the dwell time in multiples of
    the block's time scale σ; None: `health.dwell` of the plan."""
    start, floor = start_error(series, times_ns) or 0.0, plan.health.floor
    band = fraction * start if start > floor else floor
    wait_ns = dwell_ns(series.block, plan.health.dwell if dwell is None else dwell)
    return Settling(band, wait_ns, entered_ns(times_ns, series.norm, band), int(times_ns[-1]) if len(times_ns) else 0)


def entered_ns(times_ns: NDArray[np.int64], norm: Array, band: float) -> int | None:
    """Returns the instant [ns] from which on |e| stays within a band to the end: the first one after the last |e| outside.

    `norm` is |e| [m] at the instants `times_ns`, both (T,).  Returns None if the last |e| is outside, some |e| is not finite,
    or T is 0."""
    if not len(norm) or not np.isfinite(norm).all():
        return None
    outside = np.flatnonzero(norm > band)
    if not outside.size:
        return int(times_ns[0])
    after = int(outside[-1]) + 1
    return int(times_ns[after]) if after < len(norm) else None
