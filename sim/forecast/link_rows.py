"""The table of `echelon analyse`: what sets of links bear, a row for each."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from math import isfinite
from typing import Final

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.largest_delay import LargestDelay, largest_extra_delay
from echelon.controller.prediction.linear_run import Edges, edge_of, later
from echelon.controller.prediction.link_sets import LinkSet, link_sets
from echelon.controller.prediction.mean_square import bursts_of, mean_square, most_lost
from echelon.controller.prediction.policy_effects import LARGEST_LOSSES
from echelon.plan.plan import Plan
from echelon.plan.punctuality import with_punctuality
from echelon.sim.forecast.estimating import Boundary, Estimates
from echelon.sim.forecast.own_links import check_size
from echelon.sim.results.links_analysis import (
    BurstsResult,
    DelayResult,
    EstimateResult,
    LinksResult,
    LossResult,
)

DELAYS: Final = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 2.0, 6.0)
"""Delays that are tried by runs, as multiples of what is exact without chance"""
LOSSES: Final = (0.0, 0.3, 0.6, 0.8, 0.9, 0.97)
"""Losses that are tried by runs"""
OF_MEMBERS: Final = ("group", "robot")
Say = Callable[[str, int, int], None]
"""What is being computed, how many parts are done, and how many there are"""


class LinkRows:
    """The rows of the table of what sets of links bear; the same links are computed once."""

    def __init__(self, plan: Plan, still: Plan, estimates: Estimates, say: Say) -> None:
        """`still` is the plan with constant delays, without loss."""
        self._plan, self._still, self._estimates, self._say = plan, still, estimates, say
        self._known: dict[Edges, LargestDelay] = {}

    def table(self, members: bool) -> Iterable[LinksResult]:
        """Yields the rows; `members`: also those of groups and robots."""
        sets = [one for one in link_sets(self._plan) if members or one.kind not in OF_MEMBERS]
        for done, one in enumerate(sets):
            self._say(one.name, done, len(sets))
            if one.edges not in self._known:
                self._known[one.edges] = largest_extra_delay(self._still, one.edges)
            found = self._known[one.edges]
            if one.kind != "class":
                yield links_result(one, found)
                continue
            loss = self._loss(one.edges)
            by_runs = not self._estimates.why_no_search
            delays = self._delay_by_runs(one.edges, found) if by_runs and self._still is not self._plan else None
            losses = self._loss_by_runs(one.edges) if by_runs and loss.why else None
            yield links_result(one, found, loss, delays, losses, self._bursts(one.edges))

    def _loss(self, edges: Edges, burst: float | None = None) -> LossResult:
        """Returns how many messages of some links may be lost in the mean square: each by itself, or in bursts of this mean
        length."""
        try:
            check_size(self._plan)
            links = [link for link in self._plan.links if edge_of(link) in edges]
            found = mean_square(self._plan, links, burst=burst, largest=LARGEST_LOSSES)
        except PredictionError as error:
            no_search = self._estimates.why_no_search
            return LossResult(None, "not computed", f"{error}{no_search and f'; {no_search}'}")
        return LossResult(found.loss, found.ends, "")

    def _delay_by_runs(self, edges: Edges, found: LargestDelay) -> EstimateResult:
        """Searches by runs for how much later messages may be with the links as they are."""
        guess = found.seconds if found.seconds and isfinite(found.seconds) else self._plan.duration_ns / 4e9
        return _estimate(
            self._estimates.boundary(
                lambda extra: later(self._plan, edges, round(extra * 1e9)),
                [by * guess for by in DELAYS],
                DELAYS.index(1.0),
            )
        )

    def _bursts(self, edges: Edges) -> BurstsResult | None:
        """Returns how many messages may be lost in bursts as long as those of the links; None if these have none of one
        length."""
        lengths = {
            1 / link.bursts.to_good
            if link.bursts is not None and link.bursts.loss_bad - link.bursts.loss_good == 1
            else None
            for link in self._plan.links
            if edge_of(link) in edges
        }
        if len(lengths) != 1 or (length := lengths.pop()) is None:
            return None
        loss = self._loss(edges, length)
        by_runs = self._loss_by_runs(edges, length) if loss.why and not self._estimates.why_no_search else None
        return BurstsResult(length, loss, by_runs)

    def _loss_by_runs(self, edges: Edges, burst: float | None = None) -> EstimateResult:
        """Searches by runs for how many messages may be lost: each by itself, or in bursts of this mean length."""

        def lossy(share: float) -> Plan:
            bursts = None if burst is None else bursts_of(share, burst)
            links = (
                replace(link, loss=share, bursts=bursts) if edge_of(link) in edges else link
                for link in self._plan.links
            )
            return replace(self._plan, links=tuple(with_punctuality(list(links), self._plan.nodes)))

        most = 1.0 if burst is None else most_lost(burst)
        tried = [share for share in LOSSES if share < most]
        return _estimate(self._estimates.boundary(lossy, tried, min(LOSSES.index(0.6), len(tried) - 1)))


def _estimate(found: Boundary) -> EstimateResult:
    return EstimateResult(found.value, found.low, found.high, found.runs)


def links_result(
    one: LinkSet,
    found: LargestDelay,
    loss: LossResult | None = None,
    delays: EstimateResult | None = None,
    losses: EstimateResult | None = None,
    bursts: BurstsResult | None = None,
) -> LinksResult:
    """Returns the row of a set of links."""
    channel = None if one.channel is None else one.channel.name.lower()
    seconds = None if found.seconds is None else finite(found.seconds)
    delay = DelayResult(seconds, found.ticks, found.tick_s, found.ends, found.tried, found.limits)
    return LinksResult(
        one.kind, one.name, one.layer, channel, len(one.edges), one.like, delay, loss, delays, losses, bursts
    )


def finite(number: float | None) -> float | None:
    """Returns a number, or None if it is infinite: results have no infinite numbers."""
    return number if number is not None and isfinite(number) else None
