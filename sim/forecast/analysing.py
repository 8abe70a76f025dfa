"""Everything that `echelon analyse` predicts about a plan, as one record (`sim.results.analysis`)."""

from collections.abc import Callable, Iterable, Sequence
from math import inf, isfinite
from typing import Final

from echelon.controller.prediction.analysis import analyse
from echelon.controller.prediction.block_margin import delay_margin
from echelon.controller.prediction.cost import expected_cost
from echelon.controller.prediction.gains import PredictionError, linear_gains
from echelon.controller.prediction.largest_delay import LargestDelay, largest_extra_delay
from echelon.controller.prediction.linear_run import Edges, edge_of
from echelon.controller.prediction.link_sets import LinkSet, link_sets
from echelon.controller.prediction.lyapunov import lyapunov_bounds
from echelon.controller.prediction.mean_square import mean_square
from echelon.controller.prediction.modes import block_modes
from echelon.controller.prediction.sampled_limits import coupling_limit, epsilon_range
from echelon.controller.prediction.time_scales import (
    epsilon_counts,
    error_dynamics,
    largest_coupling,
    largest_epsilon,
    with_epsilon,
)
from echelon.plan.plan import Plan
from echelon.sim.forecast.motion import asked_of
from echelon.sim.forecast.settling import predicted_settling
from echelon.sim.forecast.torque_loop import torque_loops
from echelon.sim.results.analysis import (
    AnalysisResult,
    CouplingResult,
    DelayResult,
    EpsilonResult,
    LinksResult,
    LossResult,
    ModesResult,
    ScaledDelays,
    SettlingResult,
    TorqueLoopResult,
)

MOST: Final = 30
"""Largest number of robots for which losses and costs are computed"""
LARGEST: Final = 250
"""Most numbers that may act on each other where losses are computed: a few seconds for each set of links"""
OF_MEMBERS: Final = ("group", "robot")
Say = Callable[[str, int, int], None]
"""What is being computed, how many parts are done, and how many there are"""


def analysis_of(
    plan: Plan,
    time_scales: str,
    epsilon: Sequence[float],
    *,
    members: bool = False,
    say: Say = lambda what, done, of: None,
) -> AnalysisResult:
    """Returns all predictions about a plan; `time_scales` and `epsilon` are those of its law.

    `members`: also for each robot and each group.  `say` gets the progress.

    Raises PredictionError if no exact prediction is possible (`controller.prediction.analysis.analyse`)."""
    say("stability", 0, 1)
    found = analyse(plan)
    asked = asked_of(plan)
    loops = tuple(
        TorqueLoopResult(
            loop.robot, _finite(loop.speed), loop.period, _finite(loop.factor), loop.longest_period, loop.is_stable
        )
        for loop in torque_loops(plan, asked.speeds.tolist())
    )
    skipped: list[str] = []
    table = tuple(_table(plan, members, say)) if found.settles else ()
    say("ε and couplings", 0, 1)
    blocks = tuple(_modes(plan))
    is_stable_alone = all(one.poles[0][0] < 0 for one in blocks)
    epsilons, coupling = _time_scales(plan, time_scales, epsilon, is_stable_alone, found.settles, skipped)
    return AnalysisResult(
        scenario=plan.name,
        assumptions=_assumptions(plan),
        acceleration_periods=found.acceleration_periods,
        torque_periods=found.torque_periods,
        delays={channel.name.lower(): delays for channel, delays in found.delays.items()},
        settles=found.settles,
        torque_loop_diverges=not all(loop.stable for loop in loops),
        hyperperiod=found.hyperperiod,
        spectral_radius=found.radius,
        time_constant=_finite(found.time_constant),
        centroid_age=found.centroid_age,
        blocks=blocks,
        settling=tuple(SettlingResult(one.block, one.band, one.settled) for one in predicted_settling(plan)),
        table=table,
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
            _links(one, largest_extra_delay(scaled, one.edges)) for one in link_sets(scaled) if one.kind == "class"
        )
        found.append(ScaledDelays(by, tuple(row for row in rows if row.delay.seconds is not None), min(margins)))
    return tuple(found)


def _assumptions(plan: Plan) -> tuple[str, ...]:
    bus = ("bus and drives take no time",) if plan.can.closed else ()
    events = ("blackouts of links are left out",) if any(link.blackouts for link in plan.links) else ()
    return (
        "robots follow the desired accelerations exactly",
        "no limit acts",
        "avoidance does not act",
        *bus,
        *events,
        "the delays are constant, and beyond those of the scenario",
    )


def _table(plan: Plan, members: bool, say: Say) -> Iterable[LinksResult]:
    """Yields what sets of links bear; the same links are computed once."""
    sets = [one for one in link_sets(plan) if members or one.kind not in OF_MEMBERS]
    known: dict[Edges, LargestDelay] = {}
    count = len(plan.robots)
    for done, one in enumerate(sets):
        say(one.name, done, len(sets))
        if one.edges not in known:
            known[one.edges] = largest_extra_delay(plan, one.edges)
        loss = None
        if one.kind == "class":
            why = f"only computed for up to {MOST} robots, here are {count}" if count > MOST else ""
            loss = LossResult(None, "not computed", why) if why else _loss(plan, one.edges)
        yield _links(one, known[one.edges], loss)


def _loss(plan: Plan, edges: Edges) -> LossResult:
    """Returns how many messages of some links may be lost in the mean square."""
    try:
        found = mean_square(plan, [link for link in plan.links if edge_of(link) in edges], largest=LARGEST)
    except PredictionError as error:
        return LossResult(None, "not computed", str(error))
    return LossResult(found.loss, found.ends, "")


def _links(one: LinkSet, found: LargestDelay, loss: LossResult | None = None) -> LinksResult:
    channel = None if one.channel is None else one.channel.name.lower()
    seconds = None if found.seconds is None else _finite(found.seconds)
    delay = DelayResult(seconds, found.ticks, found.tick_s, found.ends, found.tried, found.limits)
    return LinksResult(one.kind, one.name, one.layer, channel, len(one.edges), one.like, delay, loss)


def _modes(plan: Plan) -> Iterable[ModesResult]:
    """Yields the modes of the blocks; blocks that are alike once."""
    of_name = {block.name: block for block in plan.blocks}
    hyperperiod, shares = plan.root.period_ns * 1e-9, _cost_shares(plan)
    for one in block_modes(plan):
        rate = one.rate(hyperperiod)
        yield ModesResult(
            one.names,
            one.layer,
            one.size,
            one.sigma,
            _finite(delay_margin(linear_gains(plan, of_name[one.names[0]], 0.0))),
            tuple((each.real, each.imag) for each in one.poles),
            tuple((each.real, each.imag) for each in one.eigenvalues),
            None if rate is None else -rate.real,
            None if rate is None else abs(rate.imag),
            sum(shares[name] for name in one.names) if shares else None,
        )


def _cost_shares(plan: Plan) -> dict[str, float]:
    """Returns the share of each block in the expected cost of the run; empty if it is not computed."""
    if len(plan.robots) > MOST:
        return {}
    try:
        cost = expected_cost(plan)
    except PredictionError:
        return {}
    return {} if cost is None else {block.name: block.share for block in cost.blocks}


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
        sampled = (low or None, _finite(high))
        if loop is None or bounds is None:
            uncoupled = None if is_stable_alone else 0.0
            epsilons.append(EpsilonResult(value, *(uncoupled,) * 4, None, *sampled))
            continue
        layers = loop.up_to(at + 1)
        epsilons.append(
            EpsilonResult(
                value,
                _finite(largest_epsilon(loop, epsilon, at + 1)),
                _finite(largest_epsilon(layers, epsilon, at + 1)),
                _finite(bounds[at].corrected),
                _finite(bounds[at].by_norms),
                bounds[at].literal,
                *sampled,
            )
        )
    if loop is None:
        return tuple(epsilons), None
    sampled_limit = coupling_limit(plan) if settles else inf
    return tuple(epsilons), CouplingResult(_finite(largest_coupling(loop)), _finite(sampled_limit))


def _finite(number: float | None) -> float | None:
    return number if number is not None and isfinite(number) else None
