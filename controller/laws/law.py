"""The base class of control laws.  A law computes ν, the wanted Z̈_b [m/s²] of one block of the transformed state, from the
block's error.

The tree is the same for all laws (docs/architecture.md, 2.3): it adds coupling and avoidance to ν, and turns the results of
all blocks into accelerations of robots.  With the error e = Z_b - Z_bd the acceleration of block b is

    Z̈_b = ν_b(t, e_b, ė_b, Z̈_bd) + W_b (-Σ_{b'≠b} K̄_bb' ė_b' + F_pot,b/σ_b)

where W_b is the unit matrix unless the law defines another.  To add a law, derive a class from `Law` (docs/add-a-law.md).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np

from echelon.errors import PartRunError
from echelon.plan.plan import Array, BlockPlan, Plan
from echelon.plugins import PART_ERRORS, Part, PartError, Plugin


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A block as a law sees it."""

    name: str
    """Name of the block: `g1` for the shape of the group g1, `inter`, `centroid`"""
    layer: str
    """`intra`, `middle`, `inter` or `centroid`"""
    size: int
    """Number of values of e: x and y of each variable"""
    sigma: float
    """σ, the block's time scale [s]"""
    period_s: float
    """T, the period for which ν is held [s]"""
    lead: float
    """λ of `law.lead`, how far the law looks ahead, in periods"""
    K_1: Array
    """K_f1/σ² [1/s²], (size, size), from `law.gains`"""
    K_2: Array
    """K_f2/σ [1/s], (size, size), from `law.gains`"""

    @property
    def ahead_s(self) -> float:
        """λ T, how far the law looks ahead [s]."""
        return self.lead * self.period_s


@dataclass(frozen=True, slots=True)
class LinearGains:
    """The gains of a linear law, with look-ahead multiplied out; all matrices are (size, size).

        ν = Z̈_bd - K_1 e - K_2 ė - K_i q        q ← q + T e + T²/2 ė    after each period

    `weight` is the law's W."""

    K_1: Array
    K_2: Array
    K_i: Array
    weight: Array


Nu = Callable[[float, Array, Array, Array, Array], Array]
"""(t [s], e [m], ė [m/s], Z̈_bd [m/s²], state of the law) → ν [m/s²]"""


class Law(Plugin, ABC):
    """Base class of all control laws.  The fields of a class are its parameters."""

    uses: ClassVar[frozenset[str]] = frozenset()
    """The keys `gains` and `lead` of `[law]` that the law uses.  A scenario that sets one that is not used is refused"""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if not (isinstance(cls.uses, (set, frozenset)) and cls.uses <= {"gains", "lead"}):
            raise PartError(f"{cls.__name__}: uses = {cls.uses!r:.60}: must be a set of 'gains', 'lead' or both")

    @abstractmethod
    def nu(self, block: Block, t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
        """Returns ν [m/s²], (size,), for the error e [m] and its rate ė [m/s] at t [s].

        `feed_forward` is Z̈_bd [m/s²], zero for shapes.  `state` is the law's state of this block: `state_size` numbers, zero at
        the start.  The law may write into it; the other arrays are read-only.

        `nu` is called once in each period T of the block's node.  It is not called in a period in which the node misses a
        message, because then the node commands nothing."""

    def nu_of(self, block: Block) -> Nu:
        """Returns `nu` of one block.  A class may override this to compute values once per block."""
        return partial(self.nu, block)

    def state_size(self, block: Block) -> int:
        """Returns the number of values in the law's state of a block."""
        return 0

    def weight(self, block: Block) -> Array:
        """Returns W, (size, size): the matrix by which coupling and avoidance enter Z̈_b."""
        return np.eye(block.size)

    def linear(self, block: Block) -> LinearGains | None:
        """Returns the gains of a linear law, for analysis; None if the law is not linear."""
        return None


def law_block(plan: Plan, block: BlockPlan, lead: float | None = None) -> Block:
    """Returns a block of a plan as a law sees it; `lead` [periods] replaces that of the plan."""
    node = plan.root if block.node is None else plan.formation[block.node]
    K_1, K_2 = block.k1 / block.sigma**2, block.k2 / block.sigma
    K_1.flags.writeable = K_2.flags.writeable = False
    lead = plan.lead if lead is None else lead
    return Block(block.name, block.layer, block.size, block.sigma, node.period_ns * 1e-9, lead, K_1, K_2)


_HUGE: Final = 1e12
"""From this magnitude of its inputs on a law that is not built in may fail: the run has diverged"""


def make_nu(part: Part[Any], block: Block) -> Nu:
    """Returns ν of a plan's law for a block.  The answers of a law that is not built in are checked.

    Raises PartRunError if `nu_of` of the law raises."""
    law: Law = part.made
    if part.is_own:
        return law.nu_of(block)
    try:
        nu = law.nu_of(block)
    except PART_ERRORS as error:
        raise part.raised(f" of block {block.name}", "nu_of", error) from error
    return _checked(nu, part, block)


def make_state(part: Part[Any], block: Block) -> Array:
    """Returns the state of a plan's law for a block at the start: zeros.  Raises PartRunError if `state_size` is wrong."""
    law: Law = part.made
    who = f"{part.use} of block {block.name}"
    try:
        size = law.state_size(block)
    except PART_ERRORS as error:
        raise part.raised(f" of block {block.name}", "state_size", error) from error
    if not isinstance(size, int) or size < 0:
        raise PartRunError(f"{who}: state_size must be a whole number that is not negative, not {size!r:.60}")
    return np.zeros(size)


def make_weight(part: Part[Any], block: Block) -> Array:
    """Returns W of a plan's law for a block.  Raises PartRunError if `weight` is wrong."""
    law: Law = part.made
    who, shape = f"{part.use} of block {block.name}", (block.size, block.size)
    try:
        weight = np.asarray(law.weight(block), dtype=np.float64)
    except PART_ERRORS as error:
        raise part.raised(f" of block {block.name}", "weight", error) from error
    if weight.shape != shape:
        raise PartRunError(f"{who}: weight has the shape {weight.shape}, not {shape}")
    if not np.isfinite(weight).all():
        raise PartRunError(f"{who}: weight is not finite: {weight.tolist()!s:.120}")
    return weight


def _checked(nu: Nu, part: Part[Any], block: Block) -> Nu:
    """Returns `nu` with its answers checked: it raises PartRunError if `nu` raises, or returns anything but `size` finite
    numbers.  In a run that has diverged (inputs from `_HUGE` on) `nu` may fail; then the answer is NaN."""

    who, size = f"{part.use} of block {block.name}", block.size

    def checked(t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
        diverged = not all(np.abs(given).max() < _HUGE for given in (e, e_dot, feed_forward))
        try:
            given = nu(t, e, e_dot, feed_forward, state)
            answer = np.asarray(given, dtype=np.float64)
        except PART_ERRORS as error:
            if diverged:
                return np.full(size, np.nan)
            raise part.raised(f" of block {block.name}", f"nu at t = {t:g} s", error) from error
        if given is None:
            raise PartRunError(f"{who}: nu at t = {t:g} s returned nothing; it must return {size} numbers")
        if answer.shape != (size,):
            raise PartRunError(f"{who}: nu at t = {t:g} s has the shape {answer.shape}, not ({size},)")
        if not diverged and not np.isfinite(answer).all():
            raise PartRunError(f"{who}: nu at t = {t:g} s is not finite: {answer.tolist()!s:.120}")
        return answer

    return checked
