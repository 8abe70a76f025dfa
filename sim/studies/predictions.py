"""What can be predicted about a sweep without runs: boundaries of stability, decay rates of single blocks, and costs."""

from collections.abc import Callable, Mapping, Sequence
from math import ceil
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.controller.laws.law import LinearGains
from echelon.controller.prediction.cost import expected_cost
from echelon.controller.prediction.gains import PredictionError, linear_gains, poles
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import CHANNELS, LinearRun, ruled_links, untreated
from echelon.controller.prediction.mean_square import Losses
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import BlockPlan, Plan

FINE: Final = 1e-3
"""How closely a boundary is found by bisection, as a share of the range that was tried"""
NODES: Final = 24
"""Chebyshev nodes on the interval of the delay.  With 24 the rightmost root is exact to 1e-6 or better"""
PlanOf = Callable[[float], Plan]


def stable(plan: Plan) -> bool | None:
    """Returns whether errors vanish in the linear run of a plan, in the mean square where links lose messages; None if nothing
    exact can be said."""
    try:
        if not untreated(plan):
            return bool(spectral_radius(LinearRun(plan).map()) < 1)
        if any(link.loss for link in plan.links):
            return Losses(plan, (), None).gain(0.0) < 1
    except PredictionError:
        pass
    return None


def boundary(plan_of: PlanOf, values: Sequence[float]) -> tuple[float | None, bool]:
    """Returns the largest value that is stable, and whether anything can be said.  `values` are those that were tried, in
    ascending order; `plan_of` makes the plan of a value.

    None means that even the lowest value is unstable, and infinity that all are stable, however large.  Delays of all links of
    a channel have a boundary of their own (`largest_extra_delay`), also beyond the values that were tried.  Otherwise it is
    searched for by bisection between the values, which takes what is stable to be one range from the lowest value on."""
    low, high = values[0], values[-1]
    if (found := _of_delay(plan_of, low, high)) is not None:
        return found, True
    first, last = stable(plan_of(low)), stable(plan_of(high))
    if not first:
        return None, first is not None
    if last:
        return float("inf"), True
    while high - low > FINE * (values[-1] - values[0]):
        middle = (low + high) / 2
        holds = stable(plan_of(middle))
        if holds:
            low = middle
        else:
            high, last = middle, holds
    return low, last is not None


def _of_delay(plan_of: PlanOf, low: float, high: float) -> float | None:
    """Returns the boundary if the value is the delay of all ruled links of one channel; None if it is not, or is unstable."""
    plan, other = plan_of(low), plan_of(high)
    changed = {
        at for at, (one, two) in enumerate(zip(plan.links, other.links, strict=True)) if _delay(one) != _delay(two)
    }
    for channel in CHANNELS:
        ruled = {id(link) for link in ruled_links(plan, channel)}
        places = {at for at, link in enumerate(plan.links) if id(link) in ruled}
        step_ns = round((high - low) * 1e9)
        if not places or places != changed or any(_step(plan, other, at) != step_ns for at in places):
            continue
        if untreated(plan):
            return None
        try:
            found = largest_extra_delay(plan, channel).seconds
        except PredictionError:
            return None
        return None if found is None else low + found
    return None


def _delay(link: LinkPlan) -> tuple[int, int]:
    return link.delay_min_ns, link.delay_max_ns


def _step(plan: Plan, other: Plan, at: int) -> int:
    return other.links[at].delay_min_ns - plan.links[at].delay_min_ns


def decay_rates(plan: Plan) -> Mapping[str, float]:
    """Returns the decay rate of each block alone [1/s], without coupling, in continuous time, with the delay of its loop;
    negative where errors grow.

    The delay of the loop is that from the robots up to the block's node and down again, of the slowest path, with the half
    period less lead for which an acceleration is held.  Empty if links are not steady or bring states to the present."""
    if untreated(plan):
        return {}
    try:
        return {
            block.name: -rightmost(linear_gains(plan, block, 0.0), loop_delay(plan, block))
            for block in plan.blocks
            if block.size
        }
    except PredictionError:
        return {}


def costs(plan: Plan) -> Mapping[str, float]:
    """Returns the expected integral of the squared error of each block [m² s], until all errors have vanished; empty if they do
    not vanish in the mean square, or if nothing exact can be said."""
    try:
        cost = expected_cost(plan)
    except PredictionError:
        return {}
    return {} if cost is None else {block.name: block.value for block in cost.blocks}


def loop_delay(plan: Plan, block: BlockPlan) -> float:
    """Returns the delay in the loop of a block [s]; see `decay_rates`."""
    delays = {(link.source, link.receiver): _acting_ns(plan, link) for link in plan.links if link.channel in CHANNELS}
    top = plan.root.index if block.node is None else block.node
    longest = 0
    for robot in plan.robots:
        member, total_ns = robot.index, 0
        while member != top:
            parent = plan.formation[member].parent
            if parent is None:
                break
            total_ns += delays.get((member, parent), 0) + delays.get((parent, member), 0)
            member = parent
        else:
            longest = max(longest, total_ns)
    period_s = plan.formation[top].period_ns * 1e-9
    return longest * 1e-9 + max(0.0, 0.5 - plan.lead) * period_s


def _acting_ns(plan: Plan, link: LinkPlan) -> int:
    """Returns the delay of a link as its receiver feels it: up to the next instant of a receiver that is time-driven."""
    receiver = plan.formation[link.receiver]
    if receiver.event_driven:
        return link.delay_min_ns
    return ceil(link.delay_min_ns / receiver.period_ns) * receiver.period_ns


def rightmost(gains: LinearGains, delay: float) -> float:
    """Returns the real part of the rightmost root of ë(t) = -K_1 e(t - τ) - K_2 ė(t - τ) - K_i ∫e(t - τ) dt [1/s].

    The infinitesimal generator of the delay equation is taken at Chebyshev nodes on [-τ, 0] (Breda, Maset and Vermiglio, SIAM
    Journal on Scientific Computing 27, 2005)."""
    if delay <= 0:
        return float(poles(gains).real.max())
    n = len(gains.K_1)
    zero, unit = np.zeros((n, n)), np.eye(n)
    now = np.block([[zero, unit, zero], [zero, zero, zero], [unit, zero, zero]])
    late = np.block([[zero, zero, zero], [-gains.K_1, -gains.K_2, -gains.K_i], [zero, zero, zero]])
    if not gains.K_i.any():
        now, late = now[: 2 * n, : 2 * n], late[: 2 * n, : 2 * n]
    size = len(now)
    generator = np.kron(_differentiation(NODES) * 2 / delay, np.eye(size))
    generator[:size] = 0.0
    generator[:size, :size], generator[:size, -size:] = now, late
    return float(np.linalg.eigvals(generator).real.max())


def _differentiation(count: int) -> NDArray[np.float64]:
    """Returns the matrix that differentiates a polynomial given at the Chebyshev nodes cos(πk/N), k = 0 … N (Trefethen,
    Spectral Methods in MATLAB, 2000)."""
    nodes = np.cos(np.pi * np.arange(count + 1) / count)
    weight = np.where((np.arange(count + 1) % count) == 0, 2.0, 1.0) * (-1.0) ** np.arange(count + 1)
    gaps = nodes[:, None] - nodes[None] + np.eye(count + 1)
    matrix = np.outer(weight, 1 / weight) / gaps
    return np.asarray(matrix - np.diag(matrix.sum(axis=1)))
