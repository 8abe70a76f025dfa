"""Delays from draws: the tables by which a draw (echelon.runtime.fates) becomes a delay, the same in every engine.

A draw is a whole number k of 53 bits; it stands for u = k 2⁻⁵³ in [0, 1).  A table holds the delays at the edges of a grid
over [0, 1].  Between two edges the delay is linear, rounded to the nearest nanosecond.  This takes only shifts, one product
of floats and one rounding; so compiled engines, for a processor or a GPU, get the same delays bit for bit.

Towards both ends of [0, 1] the cells of the grid become smaller: there are `CELLS` for each power of two, down to 2⁻⁴³.  So
the tails of a distribution are as exact as its middle.  The error of the distribution function is below 10⁻⁴ for every table
that `echelon.planning.delays` makes.

The delays of a *correlated* link are drawn otherwise.  z is a stationary Gaussian sequence with mean 0 and variance 1,

    z_k = ρ z_{k-1} + √(1 - ρ²) n_k,

with independent normal n_k.  The delay of message k is Q(Φ(z_k)), where Q is the quantile function of the delays.  So the
delays have the wanted distribution whatever ρ is (a Gaussian copula).  z and n are whole numbers of units 2⁻²⁸, ρ and
√(1 - ρ²) of units 2⁻³⁰, and products are rounded down.  A table for such a link holds Q(Φ(z)) at the edges of an even grid
over z.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.int64]
"""Whole numbers; draws have 53 bits"""

BITS: Final = 53
"""Bits of a draw"""
CELLS_LOG2: Final = 6
CELLS: Final = 1 << CELLS_LOG2
"""Cells of the grid for each power of two of u, and of 1 - u"""
FINEST: Final = 10
"""The cells at both ends have 2¹⁰ draws"""
_TOP: Final = BITS - 1 - (CELLS_LOG2 + 1) - FINEST
HALF: Final = ((_TOP + 1) << CELLS_LOG2) + CELLS
"""Number of cells below u = 1/2, and above it"""
TABLE: Final = 2 * HALF + 1
"""Number of entries of a table over u"""

Z_BITS: Final = 28
"""z counts units of 2⁻²⁸"""
FACTOR_BITS: Final = 30
"""ρ and √(1 - ρ²) count units of 2⁻³⁰"""
Z_CELL_LOG2: Final = Z_BITS - 7
"""A cell of the grid over z has 2²¹ units, 1/128"""
Z_MAX: Final = 8
"""The grid over z goes from -8 to 8"""
Z_TABLE: Final = (2 * Z_MAX << (Z_BITS - Z_CELL_LOG2)) + 1
"""Number of entries of a table over z"""

LOST: Final = -1
"""Stands for a message that is lost, where a delay would stand"""


@dataclass(frozen=True, slots=True)
class DelayTable:
    """Delays of a distribution.  Equal tables of a plan are one object."""

    delays_ns: tuple[int, ...]
    """At the edges of the grid over u, or over z if the delays are correlated; ascending [ns]"""
    correlation: float = 0.0
    """ρ; 0: the delays are independent"""


@dataclass(frozen=True, slots=True)
class DelayTrace:
    """Measured delays, in the order of the messages or by the instant of sending."""

    delays_ns: tuple[int, ...]
    """One-way delays [ns]; `LOST` for a message that was lost"""
    times_ns: tuple[int, ...] = ()
    """Run times from which the delays hold [ns], ascending.  Empty: message number k takes delay k, and after the last one the
    trace begins anew"""


@dataclass(frozen=True, slots=True)
class Bursts:
    """Loss in bursts (Gilbert and Elliott): the link is good or bad, and messages are lost with a probability for each."""

    to_bad: float
    """Probability that a good link is bad at the next message"""
    to_good: float
    """Probability that a bad link is good at the next message: 1 over the mean length of a bad time"""
    loss_good: float
    """Probability of loss while the link is good"""
    loss_bad: float
    """Probability of loss while it is bad"""

    @property
    def share_bad(self) -> float:
        """The share of messages for which the link is bad."""
        return self.to_bad / (self.to_bad + self.to_good)


@dataclass(frozen=True, slots=True)
class ClockPlan:
    """The clock of a process.  It shows the run time t as t + offset + drift t."""

    offset_ns: int = 0
    """What it shows at run time 0 [ns]"""
    drift: float = 0.0
    """By how much it is too fast [s/s]"""

    def reading_ns(self, time_ns: int) -> int:
        """Returns what the clock shows at a run time [ns]."""
        return time_ns + self.offset_ns + round(self.drift * time_ns)

    @property
    def is_true(self) -> bool:
        """True if it always shows the run time."""
        return not self.offset_ns and not self.drift


TRUE_CLOCK: Final = ClockPlan()
"""A clock that shows the run time"""

Windows = tuple[tuple[int, int], ...]
"""Times from an instant until before another [ns], ascending, without overlap"""


def merged(windows: list[tuple[int, int]]) -> Windows:
    """Returns windows in their order; those that touch or overlap become one."""
    found: list[tuple[int, int]] = []
    for begin, end in sorted(windows):
        if found and begin <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((begin, end))
    return tuple(found)


def edges() -> Words:
    """Returns the edges of the lower half of the grid, (HALF + 1,), in draws: from 0 to 2⁵².  The upper half mirrors it."""
    cell = np.arange(HALF + 1)
    shift = np.maximum(0, (cell >> CELLS_LOG2) - 1)
    found: Words = (cell - (shift << CELLS_LOG2)) << (shift + FINEST)
    return found


def looked_up(table: Words, draws: Words) -> Words:
    """Returns for each draw the value of a table over u, rounded to a whole number, ties to the even one."""
    upper = draws >> (BITS - 1) != 0
    near = np.where(upper, (1 << BITS) - 1 - draws, draws)  # the distance from the nearer end, below 2⁵²
    length = np.frexp(near.astype(np.float64))[1]  # the number of its bits; exact, since a float holds 53
    shift = np.maximum(length - (CELLS_LOG2 + 1), FINEST).astype(np.int64)
    cell = ((shift - FINEST) << CELLS_LOG2) + (near >> shift)
    at = np.where(upper, 2 * HALF - cell, cell)
    first = table[at]
    step = table[at + np.where(upper, -1, 1)] - first
    share = np.ldexp((near & ((1 << shift) - 1)).astype(np.float64), -shift)
    found: Words = first + np.rint(step * share).astype(np.int64)
    return found


def looked_up_z(table: Words, z: Words) -> Words:
    """Returns for each z the value of a table over z, rounded to a whole number, ties to the even one."""
    from_left = np.clip(z + (Z_MAX << Z_BITS), 0, (2 * Z_MAX << Z_BITS) - 1)
    at = from_left >> Z_CELL_LOG2
    share = np.ldexp((from_left & ((1 << Z_CELL_LOG2) - 1)).astype(np.float64), -Z_CELL_LOG2)
    first = table[at]
    found: Words = first + np.rint((table[at + 1] - first) * share).astype(np.int64)
    return found


def factors(correlation: float) -> tuple[int, int]:
    """Returns ρ and √(1 - ρ²) in units of 2⁻³⁰."""
    return round(correlation * (1 << FACTOR_BITS)), round((1 - correlation**2) ** 0.5 * (1 << FACTOR_BITS))
