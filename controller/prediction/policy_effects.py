"""What each policy of a link buys: how much constant delay and loss a channel bears with it (docs/architecture.md, 2.11).

All is computed with time-driven nodes, in whole periods, so that policies are compared on equal terms.  Delays are tried in
growing steps, and between the last stable one and the first that is not, halved; so nothing is said of the delays between those
that were tried.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import exp, log
from typing import Final, Literal

import numpy as np
from scipy.sparse import csr_array

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.likeness import reduced
from echelon.controller.prediction.linear_run import edges_of, later, ruled_links
from echelon.controller.prediction.mean_square import LossBoundary, mean_square
from echelon.controller.prediction.random_run import RandomRun
from echelon.controller.prediction.random_steps import Linear
from echelon.controller.prediction.spectrum import DENSE, spectral_radius
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan
from echelon.plan.punctuality import with_punctuality

POLICIES: Final = {
    Channel.STATE: ("hold", EXTRAPOLATE, PREDICT),
    Channel.GROUP_STATE: ("hold", PREDICT),
    Channel.REFERENCE: ("hold", "zero"),
    Channel.COMMAND: ("hold", "zero"),
}
"""The policies that are compared on each channel; `hold_then_stop` is as `zero` on commands, and not linear elsewhere"""
LARGEST: Final = 5500
"""Number of registers with which delays are still tried"""
STEPS: Final = 2000
"""Hyperperiods over which random states are followed"""
MANY: Final = 100
"""Number of registers from which that is tried first: it is faster than all eigenvalues"""
CLEAR: Final = 1e-3
"""How far from 1 a growth must be that is found so"""
LARGEST_LOSSES: Final = 250
"""Most numbers that may act on each other where losses are computed: a few seconds for each set of links"""
LONGEST: Final = 400
"""Longest delay that is tried [periods]"""
GROWTH: Final = 1.6
"""Ratio of a delay that is tried to the one before, at least"""


@dataclass(frozen=True, slots=True)
class PolicyEffect:
    """What a channel bears with one policy, beyond the delays and losses that the plan has."""

    channel: Channel
    policy: str
    delay: float | None
    """Largest constant delay more that was found stable [s]; None: unstable even without"""
    delay_ends: Literal["unstable", "limit"]
    """Why it is not more: one period more is unstable, or longer ones are not tried"""
    loss: LossBoundary | None
    """The loss that it bears in the mean square, with no delay more; None if that is not computed"""
    why: str = ""
    """Why it is not computed; empty if it is"""


def policy_effects(plan: Plan, channel: Channel, longest: int = LONGEST) -> tuple[PolicyEffect, ...]:
    """Returns what a channel bears with each policy, all links of the channel having the same.  Delays up to `longest` periods
    are tried.

    Raises PredictionError if the law is not linear, or if periods differ."""
    return tuple(policy_effect(plan, channel, policy, longest) for policy in POLICIES[channel])


def uses_policy(link: LinkPlan, policy: str) -> bool:
    """Returns whether a link has a policy of `POLICIES`; `hold_then_stop` of commands counts as `zero`."""
    return link.policy == policy or (policy == "zero" and link.policy == "hold_then_stop")


def with_policy(plan: Plan, channel: Channel, policy: str, extra_ns: int = 0) -> Plan:
    """Returns a plan with time-driven nodes, this policy on all links of a channel, and longer delays there."""
    ruled = ruled_links(plan, channel)

    def changed(link: LinkPlan) -> LinkPlan:
        if not any(link is each for each in ruled):
            return link
        timeout_ns = link.delay_max_ns + extra_ns + link.period_ns - 1 if policy == "zero" else NEVER_NS
        return replace(link, policy=policy, timeout_ns=timeout_ns)

    driven = replace(
        plan,
        robots=tuple(replace(robot, event_driven=False) for robot in plan.robots),
        nodes=tuple(replace(node, event_driven=False) for node in plan.nodes),
        links=tuple(map(changed, plan.links)),
    )
    driven = replace(driven, links=tuple(with_punctuality(list(driven.links), driven.nodes)))
    return later(driven, channel, extra_ns)


def largest_stable(is_stable: Callable[[int], bool], most: int) -> tuple[int | None, bool]:
    """Returns the largest number that was found stable, and whether a larger one was found that is not.  Numbers are tried in
    growing steps from 0 to `most`; then the last step is halved."""
    if not is_stable(0):
        return None, True
    low, high = 0, 1
    while is_stable(high):
        if high == most:
            return high, False
        low, high = high, min(most, max(high + 1, round(GROWTH * high)))
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low, True


def policy_effect(plan: Plan, channel: Channel, policy: str, longest: int = LONGEST) -> PolicyEffect:
    """Returns what a channel bears with one policy, all its links having it.  Delays up to `longest` periods are tried.

    Raises PredictionError if the law is not linear, or if periods differ."""
    T_ns = plan.root.period_ns
    # Like robots are left out: with constant delays the eigenvalues are the same.
    alike, *_ = reduced(without_loss(plan), edges_of(plan, channel))

    def is_stable(periods: int) -> bool:
        return radius_without_loss(with_policy(alike, channel, policy, periods * T_ns), MANY) < 1

    registers = len(RandomRun(with_policy(alike, channel, policy, T_ns), ()).parts()[0].registers)
    registers -= len(RandomRun(with_policy(alike, channel, policy), ()).parts()[0].registers)
    periods, unstable = largest_stable(is_stable, min(longest, LARGEST // max(1, registers) - 2))
    loss, why = None, ""
    try:
        changed = with_policy(plan, channel, policy)
        loss = mean_square(changed, ruled_links(changed, channel), largest=LARGEST_LOSSES)
    except PredictionError as error:
        why = str(error)
    ends: Literal["unstable", "limit"] = "unstable" if unstable else "limit"
    return PolicyEffect(channel, policy, None if periods is None else periods * T_ns * 1e-9, ends, loss, why)


def without_loss(plan: Plan) -> Plan:
    """Returns a plan whose links lose nothing."""
    return replace(plan, links=tuple(replace(link, loss=0.0, bursts=None) for link in plan.links))


def radius_without_loss(plan: Plan, many: int = DENSE) -> float:
    """Returns the spectral radius of the run of a plan without loss, with time-driven nodes and any policies.

    Where it is clearly not 1 and the run has more than `many` registers, it is the growth of random states over many
    hyperperiods."""
    found, seen = [], list[Array]()
    for part in RandomRun(plan, ()).parts():
        (step,) = part.steps
        assert isinstance(step, Linear)
        image = step.F @ np.random.default_rng(0).normal(size=step.F.shape[1])
        if any(one.shape == image.shape and np.allclose(one, image, rtol=1e-9, atol=0) for one in seen):
            continue  # x and y, and groups that are alike
        seen.append(image)
        growth = _growth(step.F) if step.F.shape[0] > many else 1.0
        found.append(growth if abs(growth - 1) > CLEAR else spectral_radius(step.F))
    return max(found)


def _growth(F: csr_array) -> float:
    """Returns by which factor random states grow per step in the long run."""
    x = np.random.default_rng(0).normal(size=(F.shape[0], 4))
    logs = []
    for _ in range(STEPS):
        x = F @ x
        size = float(np.abs(x).max())
        if size == 0:
            return 0.0
        x /= size
        logs.append(log(size))
    return exp(float(np.mean(logs[STEPS // 2 :])))
