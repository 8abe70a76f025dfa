"""What a scenario's own links do, as they stand: with their losses, delays that vary, policies and blackouts.

Each answer is exact where `controller.prediction` can give one, otherwise estimated from random runs (`estimating`), and says
which, and why.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from math import isfinite, log
from typing import Final

import numpy as np

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.controller.prediction.analysis import Analysis, analyse
from echelon.controller.prediction.blackout import BlackoutEffect, blackout, effect
from echelon.controller.prediction.cost import expected_cost
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import CHANNELS, ruled_links, untreated
from echelon.controller.prediction.mean_square import Losses
from echelon.controller.prediction.policy_effects import LONGEST, POLICIES, policy_effect, uses_policy
from echelon.controller.prediction.random_delays import mean_delay_ns
from echelon.controller.prediction.typical_growth import typical_growth
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.plan.punctuality import with_punctuality
from echelon.sim.batch.outcomes import BatchRuns
from echelon.sim.forecast.estimating import Estimates, mean_integrals
from echelon.sim.results.analysis import (
    BlackoutBlockResult,
    BlackoutResult,
    BlockCostResult,
    CostResult,
    VerdictResult,
)
from echelon.sim.results.links_analysis import LossResult, PolicyResult

MOST: Final = 30
"""Largest number of robots for which losses, costs and policies are computed exactly"""
LARGEST: Final = 400
"""Most numbers that may act on each other where the verdict is computed"""
SHORT: Final = 1000
LONG: Final = 20_000
"""Hyperperiods over which typical growth is estimated, at least and at most"""
TIMES: Final = 15.0
"""Time constants over which it is"""
LONGER: Final = 6
"""Delays are tried with policies up to this multiple of what `hold` bears"""


class OwnLinks:
    """The links of a plan as they stand."""

    def __init__(self, plan: Plan, estimates: Estimates) -> None:
        self.plan, self.estimates = plan, estimates
        self.random = [link for link in plan.links if not link.steady]
        self._runs: BatchRuns | None = None
        self.exact: Analysis | None = None
        """The prediction for constant delays without loss; None if the links are otherwise"""

    def verdict(self) -> VerdictResult:
        """Returns whether errors vanish.  Raises PredictionError if that can be neither computed nor estimated."""
        plan, why = self.plan, ""
        try:
            if not untreated(plan):
                self.exact = analyse(plan)
                rate = _rate(self.exact.radius, self.exact.hyperperiod)
                return VerdictResult("exact", self.exact.settles, rate, rate, rate, None, None, 0, "")
            check_size(plan)
            radius = Losses(plan, (), None, LARGEST).radius(0.0) ** 0.5
            rate = _rate(radius, plan.root.period_ns / 1e9)
            return VerdictResult("exact", radius < 1, rate, rate, rate, *self._typical(radius), 0, "")
        except PredictionError as error:
            why = str(error)
        if self.estimates.why_not:
            raise PredictionError(f"{why}; nor can it be estimated: {self.estimates.why_not}")
        found = self.estimates.growth(self.plan)
        return VerdictResult("estimated", found.shrinks, *found.rates(), None, None, self.estimates.runs, why)

    def runs(self) -> BatchRuns:
        """Returns random runs of the plan; the same ones each time."""
        if self._runs is None:
            self._runs = self.estimates.of(self.plan)
        return self._runs

    def cost(self) -> CostResult:
        """Returns the expected integrals of the squared errors."""
        plan = self.plan
        try:
            check_size(plan)
            cost = expected_cost(plan)
            if cost is None:
                return CostResult("not computed", None, 0.0, (), 0, "errors do not vanish in the mean square")
            blocks = tuple(BlockCostResult(one.name, one.value, 0.0, one.share) for one in cost.blocks)
            return CostResult("exact", cost.total, 0.0, blocks, 0, "")
        except PredictionError as error:
            why = str(error)
        if self.estimates.why_not or len(plan.robots) > MOST:
            return CostResult("not computed", None, 0.0, (), 0, why)
        means, errors, total, error_of_total = mean_integrals(self.runs())
        if not isfinite(total):
            return CostResult("not computed", None, 0.0, (), 0, f"{why}; and a run was lost")
        shares = means / total if total else means
        rows = zip(plan.blocks, means.tolist(), errors.tolist(), shares.tolist(), strict=True)
        found = tuple(BlockCostResult(block.name, *values) for block, *values in rows if block.size)
        return CostResult("estimated", total, error_of_total, found, self.estimates.runs, why)

    def effects(self, bears: Callable[[Channel], float | None], say: Callable[[str], None]) -> tuple[PolicyResult, ...]:
        """Returns what each policy buys on each channel; `bears` tells the delay that a channel bears with `hold` [s]."""
        found = []
        for channel in CHANNELS:
            if not (links := ruled_links(self.plan, channel)) or channel not in POLICIES:
                continue
            for policy in POLICIES[channel]:
                name = channel.name.lower()
                say(f"{name}: {policy}")
                own = any(uses_policy(link, policy) for link in links)
                try:
                    check_size(self.plan)
                    most = bears(channel)
                    T_s = self.plan.root.period_ns / 1e9
                    longest = LONGEST if most is None else max(4, round(LONGER * most / T_s))
                    effect = policy_effect(self.plan, channel, policy, min(longest, LONGEST))
                except PredictionError as error:
                    none = LossResult(None, "not computed", str(error))
                    found.append(PolicyResult(name, policy, own, None, "not computed", none, str(error)))
                    continue
                loss = LossResult(None, "not computed", effect.why)
                if effect.loss is not None:
                    loss = LossResult(effect.loss.loss, effect.loss.ends, "")
                found.append(PolicyResult(name, policy, own, effect.delay, effect.delay_ends, loss, ""))
        return tuple(found)

    def blackouts(self) -> tuple[BlackoutResult, ...]:
        """Returns what blackouts do."""
        windows: dict[tuple[int, int], list[LinkPlan]] = {}
        for link in self.plan.links:
            for begin_ns, end_ns in link.blackouts:
                windows.setdefault((begin_ns, min(end_ns, self.plan.duration_ns)), []).append(link)
        return tuple(
            self._blackout(begin_ns, end_ns, links, len(windows)) for (begin_ns, end_ns), links in windows.items()
        )

    def _blackout(self, begin_ns: int, end_ns: int, links: Sequence[LinkPlan], count: int) -> BlackoutResult:
        plan = self.plan
        facts = (
            tuple(dict.fromkeys(link.channel.name.lower() for link in links)),
            len(links),
            begin_ns / 1e9,
            (end_ns - begin_ns) / 1e9,
        )
        try:
            check_size(plan)
            if count > 1:
                raise PredictionError("several blackouts: exact for one window of time, the same for all its links")
            if untreated(plan):
                raise PredictionError("the links lose other messages, have delays that vary, or policies")
            effects = blackout(plan, links, begin_ns, end_ns - begin_ns)
            return BlackoutResult(*facts, "exact", _results(effects), "")
        except (PredictionError, ValueError) as error:
            why = str(error)
        if self.estimates.why_not:
            return BlackoutResult(*facts, "not computed", (), f"{why}; nor is it estimated: {self.estimates.why_not}")
        runs = self.runs()
        assert runs.mean_squares is not None
        H_ns = plan.duration_ns // max(1, len(runs.mean_squares) - 1)
        errors = np.sqrt(runs.mean_squares)
        found = [
            effect(block.name, errors[:, at], H_ns, begin_ns, end_ns)
            for at, block in enumerate(plan.blocks)
            if block.size
        ]
        return BlackoutResult(*facts, "estimated", _results(found), why)

    def _typical(self, radius: float) -> tuple[float | None, float | None]:
        """Returns the rate at which a typical run shrinks [1/s], and its standard error; None if it is not computed."""
        lossy = [link for link in self.plan.links if link.loss]
        shares = {link.loss for link in lossy}
        if len(shares) != 1 or len(lossy) != len(self.random) or any(link.bursts for link in lossy):
            return None, None
        slow = SHORT if radius <= 0 or radius == 1 else min(LONG, round(TIMES / abs(log(radius))))
        try:
            found = typical_growth(self.plan, lossy, shares.pop(), hyperperiods=max(SHORT, slow))
        except PredictionError:
            return None, None
        H_s = self.plan.root.period_ns / 1e9
        return -found.rate / H_s, found.error / H_s


def _results(effects: Iterable[BlackoutEffect]) -> tuple[BlackoutBlockResult, ...]:
    return tuple(BlackoutBlockResult(one.name, one.peak, one.peak_time, one.recovery) for one in effects)


def check_size(plan: Plan) -> None:
    """Raises PredictionError if a plan has too many robots for what takes long."""
    if len(plan.robots) > MOST:
        raise PredictionError(f"only computed for up to {MOST} robots, here are {len(plan.robots)}")


def calm(plan: Plan) -> tuple[Plan, str]:
    """Returns a plan with constant delays that loses nothing, for what is exact there alone, and what is left out: losses and
    policies that bring states to the present; delays that vary take their mean."""
    found = untreated(plan)
    if not found:
        return plan, ""
    out = [
        "losses" if any(link.share_lost for link in found) else "",
        "policies extrapolate and predict" if any(link.policy in (EXTRAPOLATE, PREDICT) for link in found) else "",
    ]
    varying = any(link.delays or link.delay_min_ns != link.delay_max_ns for link in found)
    words = f"without {' and '.join(each for each in out if each)}" if any(out) else ""
    mean = "delays that vary at their mean" if varying else ""

    def steady(link: LinkPlan) -> LinkPlan:
        if not any(link is each for each in found):
            return link
        at_ns = mean_delay_ns(link)
        link = replace(link, loss=0.0, bursts=None, loss_of_message=False, duplicates=0.0)
        link = replace(link, delays=None, delay_min_ns=at_ns, delay_max_ns=at_ns, fifo=False)
        ahead = link.policy in (EXTRAPOLATE, PREDICT)
        return replace(link, policy="hold", timeout_ns=NEVER_NS) if ahead else link

    links = tuple(with_punctuality([steady(link) for link in plan.links], plan.nodes))
    return replace(plan, links=links), ", ".join(each for each in (words, mean) if each)


def _rate(radius: float, hyperperiod_s: float) -> float | None:
    return None if radius <= 0 else -log(radius) / hyperperiod_s
