"""What cannot be computed exactly about a scenario's links, estimated from random runs of the batch engine.

The runs are those of the scenario from its start, without limits, avoidance and events, so they are near to what the linear
run describes.  For costs and blackouts the formation moves along its trajectory.  For the growth of errors it stands: otherwise
late and lost references keep an error that neither grows nor vanishes.  The rate at which errors shrink is read from the root
mean squares of the amplitude in the last two sixths of the runs (`sim.results.statistics.moment_growth`): it has an interval,
and near the boundary of stability rare runs decide it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, log
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.agents.plant import Paper
from echelon.controller.trajectory import Line, make_trajectory
from echelon.plan.delay_tables import DelayTrace
from echelon.plan.plan import Plan, RobotPlan
from echelon.plugins import Part
from echelon.sim.batch.outcomes import BatchRuns
from echelon.sim.batch.refusals import refusal
from echelon.sim.results.statistics import moment_growth

RUNS: Final = 64
"""Runs for an estimate"""
MOST_STEPS: Final = 5_000_000
"""Most torque periods of robots in the runs of one estimate: about a second"""
LEAST: Final = 8
"""Runs for an estimate at least"""
IN_SEARCH: Final = 16
"""Runs for each value where a boundary is searched for, at most"""
SEARCH_STEPS: Final = 25_000_000
"""Torque periods of robots in all searches together, with `RUNS` runs: some seconds"""
VALUES: Final = 40
"""Values that are tried in all searches together, roughly"""
VANISHED: Final = 1e-5
"""Errors that are this small, beside those at the start, have vanished: robots that turn keep errors of this size"""
HALVINGS: Final = 3
"""Halvings of the range in which a boundary is searched for"""


@dataclass(frozen=True, slots=True)
class Growth:
    """How E|e|², the sum over all blocks, grows in the last sixth of runs."""

    ratio: float
    """Infinite if a run was lost; 0 if all errors have vanished"""
    low: float
    high: float
    """95 % interval"""
    sixth_s: float
    """A sixth of a run [s]"""

    @property
    def shrinks(self) -> bool:
        """True if E|e|² shrinks."""
        return self.ratio < 1

    def rates(self) -> tuple[float | None, float | None, float | None]:
        """Returns the rate at which the root mean square shrinks, and the ends of its interval [1/s]; None: infinite."""

        def rate(ratio: float) -> float | None:
            return -log(ratio) / (2 * self.sixth_s) if 0 < ratio < inf else None

        return rate(self.ratio), rate(self.high), rate(self.low)


@dataclass(frozen=True, slots=True)
class Boundary:
    """The largest value up to which E|e|² shrinks, by runs (`sim.results.links_analysis.EstimateResult`)."""

    value: float | None
    low: float | None
    high: float | None
    runs: int


class Estimates:
    """Random runs of a scenario's plan, and what they say."""

    def __init__(self, plan: Plan, runs: int = RUNS, say: Callable[[str], None] = lambda text: None) -> None:
        """`runs` is the largest number of runs for each estimate; fewer are made of large scenarios.  0: none at all."""
        self._say = say
        periods = plan.duration_ns // min(robot.torque_period_ns for robot in plan.robots) + 1
        most = min(runs, max(LEAST, MOST_STEPS // (periods * len(plan.robots))))
        self.runs = most if is_random(plan) else 1
        self._share = SEARCH_STEPS / RUNS / (VALUES * periods * len(plan.robots))
        self.in_search = min(runs, IN_SEARCH, int(self._share * runs))
        """Runs for each value of a search; with fewer than `LEAST` there is none"""
        self.why_not = refusal(free(plan)) if runs else "no runs are asked for (--runs 0)"
        """Why there are no estimates; None if there are"""
        if self.why_not:
            self.why_not = self.why_not.partition("; use ")[0]

    @property
    def why_no_search(self) -> str:
        """Why no boundary is searched for; empty if there is no reason."""
        if self.why_not or self.in_search >= LEAST:
            return self.why_not or ""
        return f"a search by runs takes long here; --runs {ceil(LEAST / self._share)} or more asks for it"

    def of(self, plan: Plan) -> BatchRuns:
        """Returns runs of a plan along its trajectory."""
        return self._run(free(plan), self.runs, mean_squares=True)

    def growth(self, plan: Plan, count: int | None = None) -> Growth:
        """Returns how E|e|² grows in `count` runs of a plan whose formation stands still; in one, if nothing is random."""
        return growth(self._run(standing(free(plan)), (count or self.runs) if is_random(plan) else 1))

    def _run(self, plan: Plan, count: int, *, mean_squares: bool = False) -> BatchRuns:
        from echelon.sim.batch.batch import run_many  # the compiler, when it is needed

        return run_many(plan, range(plan.seed, plan.seed + count), mean_squares=mean_squares, say=self._say)

    def boundary(self, plan_of: Callable[[float], Plan], values: Sequence[float], first: int) -> Boundary:
        """Returns up to which value E|e|² shrinks.  From number `first` on, `values` are tried upwards until it grows, or
        downwards until it shrinks; then the range between the last two is halved.  All values have the same seeds."""
        known: dict[float, Growth] = {}
        count = self.in_search

        def shrinks(value: float) -> bool:
            known[value] = self.growth(plan_of(value), count)
            return known[value].shrinks

        at = first
        if shrinks(values[at]):
            while at + 1 < len(values) and shrinks(values[at + 1]):
                at += 1
            low: float | None = values[at]
            high = values[at + 1] if at + 1 < len(values) else None
        else:
            while at and not shrinks(values[at - 1]):
                at -= 1
            low, high = values[at - 1] if at else None, values[at]
        if low is not None and high is not None:
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                low, high = (middle, high) if shrinks(middle) else (low, middle)
        sure = None
        for value in sorted(known):
            if known[value].high >= 1:
                break
            sure = value
        return Boundary(low, sure, min((value for value in known if known[value].low > 1), default=None), count)


def is_random(plan: Plan) -> bool:
    """Returns whether random numbers decide anything on the links of a plan."""
    return any(
        link.loss > 0 or link.duplicates > 0 or not (link.steady or isinstance(link.delays, DelayTrace))
        for link in plan.links
    )


def free(plan: Plan) -> Plan:
    """Returns a plan without limits, avoidance, events and claims, with the plant that the controller knows."""

    def robot(one: RobotPlan) -> RobotPlan:
        envelope = replace(one.envelope, torque_limit=inf, rise_limit=inf, fall_limit=inf, window_limit=inf)
        return replace(
            one,
            model=Part("paper", {}, None, Paper()),
            envelope=envelope,
            torque_limit=inf,
            torque_rate_limit=inf,
            wheel_speed_limit=inf,
        )

    robots = tuple(map(robot, plan.robots))
    return replace(plan, robots=robots, avoidance=replace(plan.avoidance, enabled=False), events=(), claims=())


def standing(plan: Plan) -> Plan:
    """Returns a plan whose desired centroid stays where it is at the start.  So late and lost references leave no error that
    stays: what does not vanish grows."""
    start = make_trajectory(plan.trajectory).at(0.0)[0]
    line = Line(start=(float(start[0]), float(start[1])), velocity=(0.0, 0.0))
    return replace(plan, trajectory=Part("line", {}, None, line))


def growth(runs: BatchRuns) -> Growth:
    """Returns how E|e|² grows in the last sixth of runs, by the amplitudes of all blocks together."""
    lost = int(np.isfinite(runs.runs["diverged"]).sum())
    sixth_s = runs.plan.duration_ns / 6e9
    if lost:
        return Growth(inf, inf, inf, sixth_s)
    level, earlier = (np.sqrt(np.square(runs.blocks[name]).sum(axis=1)) for name in ("level", "earlier"))
    start = np.sqrt(np.square(runs.blocks["start_error"]).sum(axis=1))
    if (level < VANISHED * start).all():
        return Growth(0.0, 0.0, 0.0, sixth_s)
    found = moment_growth(earlier, level)
    return Growth(found.ratio, found.low, found.high, sixth_s)


def mean_integrals(runs: BatchRuns) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Returns the mean of ∫|e|² dt of each block, its standard error, and the same of the sum over the blocks [m² s]."""
    each = runs.blocks["ise"]
    root = np.sqrt(len(each))
    spread = each.std(axis=0, ddof=1) / root if len(each) > 1 else np.zeros(each.shape[1])
    total = each.sum(axis=1)
    return each.mean(axis=0), spread, float(total.mean()), float(total.std(ddof=1) / root) if len(total) > 1 else 0.0
