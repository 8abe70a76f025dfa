"""How far a number of the law may be changed with the run as sampled: an ε, or all couplings (docs/architecture.md, 2.12)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import Final, NamedTuple

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.likeness import reduced
from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.controller.prediction.time_scales import with_epsilon
from echelon.plan.plan import Plan

STEP: Final = 1.25
"""Ratio of two multiples that are tried, from the present one outwards"""
MOST: Final = 1000.0
"""The largest multiple that is tried, and the inverse of the smallest"""
FINE: Final = 1e-4
"""How closely the edge is found, as a share"""


class Range(NamedTuple):
    """The multiples between which the run is stable."""

    low: float
    """0 if it is stable down to the smallest that is tried"""
    high: float
    """Infinite if it is stable up to the largest that is tried"""


def epsilon_range(plan: Plan, counts: Sequence[int], epsilon: Sequence[float], number: int) -> Range:
    """Returns the range of ε_number (from 1 on) in which the run is stable, the others as they are; `counts` are those of
    `epsilon_counts`.  The run must be stable as it is."""
    small, _, names = reduced(plan)
    count_of = {block.name: count for block, count in zip(plan.blocks, counts, strict=True)}
    of_small = [count_of[each[0]] for each in names]

    def changed(by: float) -> Plan:
        return with_epsilon(small, of_small, [*epsilon[: number - 1], epsilon[number - 1] * by, *epsilon[number:]])

    low, high = _range(changed)
    return Range(low * epsilon[number - 1], high * epsilon[number - 1])


def coupling_limit(plan: Plan) -> float:
    """Returns the multiple of all couplings up to which the run is stable.  The run must be stable as it is."""
    return _edge(lambda by: replace(plan, coupling=by * plan.coupling), up=True)


def _range(changed: Callable[[float], Plan]) -> Range:
    return Range(_edge(changed, up=False), _edge(changed, up=True))


def _edge(changed: Callable[[float], Plan], *, up: bool) -> float:
    """Returns the multiple nearest to 1 at which the run becomes unstable, upwards or downwards, as far as steps of `STEP` find
    it; infinite or 0 if it does not."""

    def is_stable(by: float) -> bool:
        try:
            return spectral_radius(LinearRun(changed(by)).map()) < 1
        except (PredictionError, FloatingPointError, OverflowError):
            return False

    stable, ratio = 1.0, STEP if up else 1 / STEP
    while is_stable(stable * ratio):
        stable *= ratio
        if not 1 / MOST < stable < MOST:
            return inf if up else 0.0
    unstable = stable * ratio
    while abs(unstable / stable - 1) > FINE:
        middle = (stable * unstable) ** 0.5
        stable, unstable = (middle, unstable) if is_stable(middle) else (stable, middle)
    return stable
