"""When the error of a block has settled.

The *response time* of a block is 3 σ/√k1, k1 being the smallest gain of its error: nearly half a period of its own
oscillation, if its law is linear.  The error that it *starts with* is the largest |e| of its first response time, by which
the answer to any start has passed its peak.  Shapes begin at rest: for them that is mostly |e| at the start.  The centroid of
robots that stand in their place while their trajectory moves off starts with what it must catch up, and not with zero; nor
with the largest |e| of the whole run, which is large where a run goes wrong.

|e| is *settled* from the instant on from which it stays in its band to the end of the run, if it stays there for the dwell
time at least, a response time unless given.  A run that ends while |e| passes through zero has not settled: an oscillation is
in a band that it leaves again for less than half a period.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import BlockPlan, Plan
from echelon.sim.results.block_series import BlockSeries
from echelon.sim.results.trace import Array

ROUNDING: Final = 1e-9
"""Errors up to this [m] are rounding"""
RESPONSE: Final = 3.0
"""Response time in multiples of σ/√k1"""


@dataclass(frozen=True, slots=True)
class Settling:
    """Whether |e| settled within a band [m], staying there for a dwell time at least [ns]."""

    band: float
    dwell_ns: int
    entered_ns: int | None
    """From when on |e| is in the band to the end; None if it is outside at the end, or was not finite"""
    end_ns: int
    """Of the run"""

    @property
    def settled_ns(self) -> int | None:
        """From when on |e| is settled; None if it is not."""
        if self.entered_ns is None or self.end_ns - self.entered_ns < self.dwell_ns:
            return None
        return self.entered_ns


def response_ns(block: BlockPlan) -> int:
    """Returns the response time of a block [ns]."""
    k1 = float(np.abs(np.linalg.eigvals(block.k1)).min()) if block.size else 1.0
    return _limited_ns(RESPONSE * block.sigma / np.sqrt(k1) if k1 > 0 else np.inf)


def dwell_ns(block: BlockPlan, scales: float | None) -> int:
    """Returns a dwell time [ns] of so many time scales of a block, its response time if none are given."""
    return response_ns(block) if scales is None else _limited_ns(scales * block.sigma)


def _limited_ns(seconds: float) -> int:
    return round(min(seconds, 1e9) * 1e9)


def start_error(series: BlockSeries, times_ns: NDArray[np.int64]) -> float | None:
    """Returns the error that a block starts with [m], the largest |e| of its first response time; None if that is not finite,
    or there is none."""
    if not len(times_ns):
        return None
    norm = series.norm[: int(np.searchsorted(times_ns, int(times_ns[0]) + response_ns(series.block), side="right"))]
    return float(norm.max()) if np.isfinite(norm).all() else None


def settle(
    plan: Plan, series: BlockSeries, times_ns: NDArray[np.int64], fraction: float, dwell: float | None = None
) -> Settling:
    """Returns whether a block settles within `fraction` of the error that it starts with.  A block that starts within the
    plan's floor need only stay there.  `dwell` is in time scales of the block (None: as the plan says)."""
    start, floor = start_error(series, times_ns) or 0.0, plan.health.floor
    band = fraction * start if start > floor else floor
    wait_ns = dwell_ns(series.block, plan.health.dwell if dwell is None else dwell)
    return Settling(band, wait_ns, entered_ns(times_ns, series.norm, band), int(times_ns[-1]) if len(times_ns) else 0)


def entered_ns(times_ns: NDArray[np.int64], norm: Array, band: float) -> int | None:
    """Returns the first instant [ns] from which on |e| stays within a band to the end, or None if the last |e| is outside, some
    |e| is not finite, or there is none.

    norm is |e| (T,) [m] at times_ns (T,); the answer is one of these instants: the one after the last that is outside."""
    if not len(norm) or not np.isfinite(norm).all():
        return None
    outside = np.flatnonzero(norm > band)
    if not outside.size:
        return int(times_ns[0])
    after = int(outside[-1]) + 1
    return int(times_ns[after]) if after < len(norm) else None
