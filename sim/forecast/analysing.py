"""Everything that `echelon analyse` predicts about a plan, as one record (`sim.results.analysis`)."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from math import exp, inf
from typing import Final, TypeVar

from echelon.controller.prediction.analysis import analyse
from echelon.controller.prediction.block_margin import delay_margin
from echelon.controller.prediction.gains import PredictionError, linear_gains
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import CHANNELS, ruled_links
from echelon.controller.prediction.link_sets import link_sets
from echelon.controller.prediction.lyapunov import lyapunov_bounds
from echelon.controller.prediction.modes import block_modes
from echelon.controller.prediction.sampled_limits import coupling_limit, epsilon_range
from echelon.controller.prediction.time_scales import (
    epsilon_counts,
    error_dynamics,
    largest_coupling,
    largest_epsilon,
    with_epsilon,
)
from echelon.errors import UserError
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.sim.forecast.estimating import RUNS, Estimates, is_random
from echelon.sim.forecast.link_rows import LinkRows, Say, finite, links_result
from echelon.sim.forecast.motion import Asked
from echelon.sim.forecast.own_links import OwnLinks, calm
from echelon.sim.forecast.settling import predicted_settling
from echelon.sim.forecast.torque_loop import torque_loops
from echelon.sim.results.analysis import (
    AnalysisResult,
    CostResult,
    CouplingResult,
    EpsilonResult,
    ModesResult,
    SettlingResult,
    TorqueLoopResult,
)
from echelon.sim.results.links_analysis import (
    PolicyResult,
    ScaledDelays,
)

MOST_RUNS: Final = 100_000
"""Largest number of runs for an estimate"""

Made = TypeVar("Made")
Value = TypeVar("Value", float, str)


@contextmanager
def told_of(name: str) -> Iterator[None]:
    """A context in which a scenario that cannot be analysed is a user's mistake: the error calls it `name`."""
    try:
        yield
    except PredictionError as error:
        raise UserError(f"{name}: cannot be analysed; run it instead: {error}") from None


def analysis_of(
    plan: Plan,
    time_scales: str,
    epsilon: Sequence[float],
    asked: Asked,
    *,
    members: bool = False,
    policies: bool = False,
    runs: int = RUNS,
    say: Say = lambda what, done, of: None,
) -> AnalysisResult:
    """Returns all predictions about a plan; `time_scales` and `epsilon` are those of its law, `asked` is what it asks of its
    robots.

    `members`: also for each robot and each group.  `policies`: also what each policy buys.  `runs` is the number of runs where
    something is estimated.  `say` gets the progress.

    Raises PredictionError if the law is not linear, or if nothing can be said about the links as they are, and UserError for a
    number of runs that is not allowed."""
    if not 0 <= runs <= MOST_RUNS:
        raise UserError(f"--runs {runs}: must be from 0 to {MOST_RUNS}")
    say("stability", 0, 1)
    for block in plan.blocks:
        linear_gains(plan, block)
    estimates = Estimates(plan, runs, lambda text: say(text, 0, 1))
    own = OwnLinks(plan, estimates)
    verdict = own.verdict()
    still, left_out = calm(plan)
    skipped: list[str] = []
    found = own.exact or _or_none(lambda: analyse(still), "what follows from the linear run", skipped)
    loops = tuple(
        TorqueLoopResult(
            loop.robot, finite(loop.speed), loop.period, finite(loop.factor), loop.longest_period, loop.is_stable
        )
        for loop in torque_loops(plan, asked.speeds.tolist())
    )
    holds = found is not None and found.settles
    say("expected cost", 0, 1)
    cost = own.cost()
    rows = LinkRows(plan, still, estimates, say)
    table = tuple(rows.table(members)) if found is not None and verdict.settles else ()
    channels = {one.channel: one.delay.seconds for one in table if one.kind == "channel"}
    effects: tuple[PolicyResult, ...] = ()
    if table and policies:
        effects = own.effects(lambda channel: channels.get(channel.name.lower()), lambda what: say(what, 0, 1))
    say("ε and couplings", 0, 1)
    blocks = tuple(_modes(still, cost)) if found is not None else ()
    is_stable_alone = all(one.poles[0][0] < 0 for one in blocks)
    epsilons, coupling = _time_scales(still, time_scales, epsilon, is_stable_alone, holds, skipped)
    exact = verdict.method == "exact"
    H_s = plan.root.period_ns / 1e9
    return AnalysisResult(
        scenario=plan.name,
        assumptions=_assumptions(plan),
        acceleration_periods=_each_once(node.period_ns for node in plan.nodes),
        torque_periods=_each_once(robot.torque_period_ns for robot in plan.robots),
        delays=_of_channels(plan, lambda link: (link.delay_min_ns / 1e9, link.delay_max_ns / 1e9)),
        losses=_of_channels(plan, lambda link: (link.share_lost,) if link.share_lost else ()),
        policies=_of_channels(plan, lambda link: () if link.policy == "hold" else (link.policy,)),
        random=is_random(plan),
        verdict=verdict,
        calm=left_out,
        settles=verdict.settles,
        torque_loop_diverges=not all(loop.stable for loop in loops),
        hyperperiod=H_s,
        spectral_radius=None if not exact else 0.0 if verdict.rate is None else exp(-verdict.rate * H_s),
        time_constant=None if not verdict.rate else abs(1 / verdict.rate),
        centroid_age=0.0 if found is None else found.centroid_age,
        blocks=blocks,
        settling=() if found is None else _settling(still),
        cost=cost,
        table=table,
        effects=effects,
        blackouts=own.blackouts(),
        epsilon=epsilons,
        coupling=coupling,
        torque_loops=loops,
        not_computed=tuple(skipped),
    )


SCALES: Final = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""What all ε are multiplied by in the figure of delays against ε"""


def scaled_delays(plan: Plan, time_scales: str, epsilon: Sequence[float], say: Say) -> tuple[ScaledDelays, ...]:
    """Returns what link classes bear when all ε are multiplied by some numbers."""
    counts = epsilon_counts(plan, time_scales)
    found = []
    for done, by in enumerate(SCALES):
        say("delays against ε", done, len(SCALES))
        scaled = with_epsilon(plan, counts, [by * one for one in epsilon])
        gains = {one.names[0]: one for one in block_modes(scaled)}
        margins = [
            delay_margin(linear_gains(scaled, block, 0.0)) or 0.0 for block in scaled.blocks if block.name in gains
        ]
        rows = tuple(
            links_result(one, largest_extra_delay(scaled, one.edges))
            for one in link_sets(scaled)
            if one.kind == "class"
        )
        found.append(ScaledDelays(by, tuple(row for row in rows if row.delay.seconds is not None), min(margins)))
    return tuple(found)


def _or_none(make: Callable[[], Made], what: str, skipped: list[str]) -> Made | None:
    """Returns what can be predicted; None if it cannot, and `skipped` gets a line about it."""
    try:
        return make()
    except PredictionError as error:
        skipped.append(f"{what}: {error}")
        return None


def _of_channels(plan: Plan, of: Callable[[LinkPlan], tuple[Value, ...]]) -> dict[str, tuple[Value, ...]]:
    """Returns for each channel the values of its links, each once, in ascending order; channels without values are left out."""
    found = {
        channel.name.lower(): tuple(sorted({each for link in ruled_links(plan, channel) for each in of(link)}))
        for channel in CHANNELS
    }
    return {channel: values for channel, values in found.items() if values}


def _each_once(instants_ns: Iterable[int]) -> tuple[float, ...]:
    """Returns times in seconds, each once, in ascending order."""
    return tuple(each / 1e9 for each in sorted(set(instants_ns)))


def _settling(plan: Plan) -> tuple[SettlingResult, ...]:
    return tuple(SettlingResult(one.block, one.band, one.settled) for one in predicted_settling(plan))


def _assumptions(plan: Plan) -> tuple[str, ...]:
    bus = ("bus and drives take no time",) if plan.can.closed else ()
    events = (
        ("blackouts of links are left out, but for what is said of each",)
        if any(link.blackouts for link in plan.links)
        else ()
    )
    return (
        "robots follow the desired accelerations exactly",
        "no limit acts",
        "avoidance does not act",
        *bus,
        *events,
        "the delays in the tables are constant, and beyond those of the scenario",
    )


def _modes(plan: Plan, cost: CostResult) -> Iterable[ModesResult]:
    """Yields the modes of the blocks; blocks that are alike once."""
    of_name = {block.name: block for block in plan.blocks}
    hyperperiod, shares = plan.root.period_ns * 1e-9, {one.block: one.share for one in cost.blocks}
    for one in block_modes(plan):
        rate = one.rate(hyperperiod)
        yield ModesResult(
            one.names,
            one.layer,
            one.size,
            one.sigma,
            finite(delay_margin(linear_gains(plan, of_name[one.names[0]], 0.0))),
            tuple((each.real, each.imag) for each in one.poles),
            tuple((each.real, each.imag) for each in one.eigenvalues),
            None if rate is None else -rate.real,
            None if rate is None else abs(rate.imag),
            sum(shares[name] for name in one.names) if shares else None,
        )


def _time_scales(
    plan: Plan, time_scales: str, epsilon: Sequence[float], is_stable_alone: bool, settles: bool, skipped: list[str]
) -> tuple[tuple[EpsilonResult, ...], CouplingResult | None]:
    """Returns how far ε and couplings may go; adds to `skipped` what is not computed.

    `is_stable_alone`: each block is, in continuous time; then every ε is where nothing is coupled."""
    counts = epsilon_counts(plan, time_scales)
    try:
        loop = None if not plan.coupled else error_dynamics(plan, counts)
    except PredictionError as error:
        skipped.append(f"largest ε and largest coupling: {error}")
        return (), None
    bounds = None if loop is None else lyapunov_bounds(loop, epsilon)
    epsilons = []
    for at, value in enumerate(epsilon):
        low, high = epsilon_range(plan, counts, epsilon, at + 1) if settles else (0.0, inf)
        sampled = (low or None, finite(high))
        if loop is None or bounds is None:
            uncoupled = None if is_stable_alone else 0.0
            epsilons.append(EpsilonResult(value, *(uncoupled,) * 4, None, *sampled))
            continue
        layers = loop.up_to(at + 1)
        epsilons.append(
            EpsilonResult(
                value,
                finite(largest_epsilon(loop, epsilon, at + 1)),
                finite(largest_epsilon(layers, epsilon, at + 1)),
                finite(bounds[at].corrected),
                finite(bounds[at].by_norms),
                bounds[at].literal,
                *sampled,
            )
        )
    if loop is None:
        return tuple(epsilons), None
    sampled_limit = coupling_limit(plan) if settles else inf
    return tuple(epsilons), CouplingResult(finite(largest_coupling(loop)), finite(sampled_limit))
