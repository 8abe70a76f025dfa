"""Losses in the mean square: against the numbers of an independent derivation, maps written by hand, and all patterns of loss
in the engine with robots that are points."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import ceil, floor

import numpy as np
import pytest

from echelon.controller.prediction.cost import expected_cost
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import LinearRun, edge_of, later
from echelon.controller.prediction.mean_square import Losses, gilbert, mean_square
from echelon.controller.prediction.random_branches import moment
from echelon.controller.prediction.random_run import RandomRun
from echelon.controller.prediction.random_steps import Chances
from echelon.controller.prediction.second_moment import SecondMoment, Solver
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.controller.prediction.typical_growth import typical_growth
from echelon.messages import Channel
from echelon.plan.delay_tables import LOST, DelayTrace
from echelon.plan.plan import Array, Plan
from support.points import at_rest, point_run
from support.trees import plan_of, random_epsilon, scenario, with_random_gains

T = 0.1
REST = {"kind": "line", "velocity": (0.0, 0.0)}


def pair(lead: float = 0.0, **tables: object) -> Plan:
    """Returns two robots in one group: their distance with σ = 0.25, the centroid with σ = 1."""
    law = {"epsilon": [0.25], "lead": lead}
    further = {"duration": 1.0, "trajectory": REST, "timing": "time_driven"} | tables
    periods = {"acceleration": T, "torque": T / 10}
    return plan_of(scenario((None, None), np.random.default_rng(1), law=law, periods=periods, **further))


@pytest.mark.parametrize(
    ("plan", "channel", "critical"),
    [
        (pair(), Channel.STATE, 0.530),
        (pair(lead=0.5), Channel.STATE, 0.568),
        (pair(), Channel.COMMAND, 0.531),
        (later(pair(), Channel.STATE, round(T * 1e9)), Channel.STATE, 0.230),
    ],
)
def test_critical_losses_of_an_independent_derivation(plan, channel, critical):
    found = mean_square(plan, channel)
    assert found.loss == pytest.approx(critical, abs=6e-4)
    assert found.ends == "unstable"
    assert found.radius < 1


def maps_by_hand(came: bool, K: Array, *, event_driven: bool) -> Array:
    """Returns the map of one robot on (position, velocity, state in use, acceleration) if its state comes, or is lost."""
    move, push, two, none = np.array([[1, T], [0, 1]]), np.array([[T**2 / 2], [T]]), np.eye(2), np.zeros((2, 2))
    use = np.hstack([two, none, np.zeros((2, 1))]) if came else np.hstack([none, two, np.zeros((2, 1))])
    a = K @ use
    at_work = a if came or not event_driven else np.eye(5)[4:]
    return np.vstack([np.hstack([move, np.zeros((2, 3))]) + push @ at_work, use, a])


def by_hand(p: float, K: Array, *, event_driven: bool) -> float:
    """Returns the growth of the second moment of one robot whose states are lost with the probability p."""
    came, lost = (maps_by_hand(each, K, event_driven=event_driven) for each in (True, False))
    return float(np.abs(np.linalg.eigvals((1 - p) * np.kron(came, came) + p * np.kron(lost, lost))).max())


@pytest.mark.parametrize("event_driven", [False, True])
@pytest.mark.parametrize("p", [0.0, 0.3, 0.6, 0.8])
def test_growth_of_one_robot_is_that_of_its_map_by_hand(p, event_driven):
    law = {"epsilon": [1.0], "gains": [{"k1": 4.0, "k2": 1.5}]}
    timing = "event_driven" if event_driven else "time_driven"
    periods = {"acceleration": T, "torque": T}
    plan = plan_of(scenario((None,), np.random.default_rng(1), duration=T, law=law, periods=periods, timing=timing))
    state = [at for at, link in enumerate(plan.links) if link.channel is Channel.STATE]
    chances = Chances.of(np.where(np.arange(len(plan.links)) == state[0], p, 0.0))
    radius = max(SecondMoment(part, chances).radius() for part in RandomRun(plan, state).parts())
    assert radius == pytest.approx(by_hand(p, -np.array([[4.0, 1.5]]), event_driven=event_driven), rel=1e-6)


def patterned(plan: Plan, came: Sequence[Sequence[bool]]) -> Plan:
    """Returns the plan in which messages 0, 1, .. of each link come or not as `came` says."""
    links = tuple(
        replace(link, delays=DelayTrace(tuple(link.delay_min_ns if each else LOST for each in of_link)), punctual=False)
        for link, of_link in zip(plan.links, came, strict=True)
    )
    return replace(plan, links=links)


def random_plan(tree: Sequence[object], seed: int, **tables: object) -> Plan:
    """Returns a plan with full gains and couplings."""
    random = np.random.default_rng(seed)
    periods = {"acceleration": T, "torque": T}
    further = {"duration": T, "trajectory": REST} | tables
    table = scenario(tree, random, law=random_epsilon(tree, random), periods=periods, **further)
    return at_rest(with_random_gains(plan_of(table), random, coupling=0.2))


@pytest.mark.slow
@pytest.mark.parametrize("timing", ["time_driven", "event_driven"])
@pytest.mark.parametrize(("tree", "broadcast", "ticks"), [
    (((None,), None), False, 0),
    (((None, None),), True, 1),
    (((None,), (None,)), True, 0),
    ((((None,),),), False, 0),
    (((None,), (None,)), False, 0.3),
    (((None,), None), True, 1.6),
])  # fmt: skip
def test_second_moment_is_the_mean_over_all_patterns_of_loss(tree, timing, broadcast, ticks, monkeypatch):
    plan = later(random_plan(tree, 3, timing=timing), Channel.STATE, round(ticks * T * 1e9))
    check_patterns(
        replace(plan, links=tuple(replace(link, loss_of_message=broadcast) for link in plan.links)), monkeypatch
    )


@pytest.mark.parametrize("timing", ["time_driven", "event_driven"])
def test_second_moment_where_each_robot_is_late_by_its_own_delay(timing, monkeypatch):
    # Both states come in the same period, so nothing is known before, as the linear run has it.
    plan, further = random_plan(((None, None),), 3, timing=timing), iter((1.3, 1.6))
    for link in plan.links:
        if link.channel is Channel.STATE:
            plan = later(plan, frozenset((edge_of(link),)), round(next(further) * T * 1e9))
    check_patterns(plan, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("timing", ["time_driven", "event_driven"])
@pytest.mark.parametrize("ticks", [0.0, 0.5, 1.0, 1.5, 29.5])
def test_without_loss_the_second_moment_grows_as_the_linear_run_does(ticks, timing):
    plan = later(random_plan(((None, None), (None,)), 4, timing=timing), Channel.STATE, round(ticks * T * 1e9))
    losses = Losses(plan, (), None)
    assert losses.radius(0.0) == pytest.approx(spectral_radius(LinearRun(plan).map()) ** 2, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "links",
    [
        [{"channel": "state", "policy": "predict"}],
        [{"policy": "predict"}, {"channel": "reference"}, {"channel": "command"}],
        [{"channel": "state", "policy": "predict", "delay": 0.2}, {"channel": "command", "delay": 0.1}],
        [{"channel": "state", "policy": "extrapolate"}],
        [{"channel": "state", "policy": "extrapolate", "delay": 0.2}],
        [{"channel": "command", "policy": "zero"}],
        [
            {"channel": "command", "policy": "hold_then_stop", "timeout": 0.15},
            {"channel": "reference", "policy": "zero"},
        ],
    ],
)
def test_policies_are_those_of_the_mean_over_all_patterns_of_loss(links, monkeypatch):
    check_patterns(random_plan(((None,), None), 3, timing="time_driven", links=links), monkeypatch)


def time_driven_robots(plan: Plan) -> Plan:
    """Returns the plan with robots that act at their instants alone, below nodes as they are."""
    return replace(plan, robots=tuple(replace(robot, event_driven=False) for robot in plan.robots))


def test_time_driven_robots_below_event_driven_nodes(monkeypatch):
    plan = time_driven_robots(random_plan(((None,), None), 3, timing="event_driven"))
    check_patterns(later(plan, Channel.STATE, round(T * 1e9)), monkeypatch)
    with pytest.raises(PredictionError, match="whole periods"):
        mean_square(later(plan, Channel.STATE, round(1.5 * T * 1e9)), Channel.STATE)


def check_patterns(plan: Plan, patch: pytest.MonkeyPatch) -> None:
    """Holds the second moment against the mean over all patterns of loss in one period.  In the period after it all is lost;
    before and after these two all comes."""
    losses = np.random.default_rng(5).uniform(0.2, 0.7, len(plan.links))
    draws: dict[object, int] = {}
    draw = [
        draws.setdefault((link.source, link.channel) if link.loss_of_message else at, at)
        for at, link in enumerate(plan.links)
    ]
    losses = losses[draw]
    # Event-driven nodes wait within their period for what comes in it, time-driven ones take it in the next one.
    rounded = floor if plan.root.event_driven else ceil
    late = [rounded(link.delay_min_ns / link.period_ns) for link in plan.links]
    # With late states, nothing is known in the first periods, and nothing is commanded.
    random = 1 + 2 * max(late)
    hyperperiods = random + 3

    expected = np.zeros((4 * len(plan.robots),) * 2)
    for came in product((False, True), repeat=len(draws)):
        fate = dict(zip(draws.values(), came, strict=True))
        share = np.prod([1 - losses[at] if fate[at] else losses[at] for at in draws.values()])
        rows = [(*(True,) * (random - k), fate[at], False, *(True,) * 20) for k, at in zip(late, draw, strict=True)]
        x = point_run(patterned(plan, rows), hyperperiods, patch)[hyperperiods]
        expected += share * np.outer(x, x)

    run = RandomRun(plan, range(len(plan.links)))
    registers = run.registers
    x = np.zeros(registers.count)
    for number, robot in enumerate(plan.robots):
        x[registers.memory(number)[:2]] = robot.start
    X = np.outer(x, x)[None]
    for period in range(hyperperiods):
        chances = Chances.of(losses if period == random else np.full(len(losses), float(period == random + 1)))
        X = moment(run.steps, X, chances)
    places = np.concatenate([registers.memory(number) for number in range(len(plan.robots))])
    assert X[0][np.ix_(places, places)] == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("size", [1, 64, 65, 171])
def test_equations_of_any_size_are_solved(size):
    """X = M X Mᵀ + Y, with complex eigenvalues of M wherever a large equation is halved."""
    random = np.random.default_rng(size)
    M, Y = random.normal(size=(size, size)) / (1.2 * np.sqrt(size)), random.normal(size=(size, size))
    X = Solver(M).solved(Y)
    assert pytest.approx(M @ X @ M.T + Y, abs=1e-9 * np.abs(X).max()) == X


def test_what_is_not_exact_is_refused():
    broadcast = pair(links=[{"channel": "command", "loss": 0.1, "loss_of": "message"}])
    (first, *others) = [link for link in broadcast.links if link.channel is Channel.COMMAND]
    assert mean_square(broadcast, [first, *others]).loss is not None
    with pytest.raises(PredictionError, match="lost for all receivers at once"):
        mean_square(broadcast, [first])
    uneven = tuple(replace(link, loss=0.2) if link is first else link for link in broadcast.links)
    with pytest.raises(PredictionError, match="lost for all receivers at once"):
        mean_square(replace(broadcast, links=uneven), Channel.STATE)
    varying = pair(links=[{"channel": "command", "receiver": "r0", "delay": {"min": 0.0, "max": 1.5 * T}}])
    assert mean_square(varying, Channel.STATE).loss is not None
    robots = tuple(replace(robot, event_driven=True) for robot in varying.robots)
    with pytest.raises(PredictionError, match="time-driven robots"):
        mean_square(replace(varying, robots=robots), Channel.STATE)
    with pytest.raises(PredictionError, match="states whose delays do not vary"):
        expected_cost(pair(links=[{"channel": "state", "source": "r0", "delay": {"min": 0.0, "max": 1.5 * T}}]))


@pytest.mark.parametrize("burst", [1.5, 4.0])
@pytest.mark.parametrize("loss", [0.1, 0.35])
def test_growth_with_bursts_is_that_of_the_chains_kronecker_map(burst, loss):
    """One robot whose states are lost in bursts, its map written by hand for each mode of the chain."""
    law = {"epsilon": [1.0], "gains": [{"k1": 4.0, "k2": 1.5}]}
    periods = {"acceleration": T, "torque": T}
    plan = plan_of(scenario((None,), np.random.default_rng(1), duration=T, law=law, periods=periods))
    state = [at for at, link in enumerate(plan.links) if link.channel is Channel.STATE]
    chances = Chances.of(np.zeros(len(plan.links)), gilbert(loss, burst))
    parts = RandomRun(plan, (), state).parts()
    came, lost = (maps_by_hand(each, -np.array([[4.0, 1.5]]), event_driven=True) for each in (True, False))
    g, b = loss / (1 - loss) / burst, 1 / burst
    kron = np.block([
        [(1 - g) * np.kron(came, came), b * np.kron(lost, lost)],
        [g * np.kron(came, came), (1 - b) * np.kron(lost, lost)],
    ])  # fmt: skip
    expected = float(np.abs(np.linalg.eigvals(kron)).max())
    for part in parts:
        found = SecondMoment(part, chances)
        assert (found.gain() < 1) == (expected < 1)
        assert found.gain(1.001 * expected) < 1 < found.gain(0.999 * expected)


def test_typical_runs_decay_where_the_second_moment_grows():
    """The pair's critical loss in the mean square is 0.530; its typical growth passes zero between 0.6 and 0.7."""
    for loss, decays in ((0.6, True), (0.7, False)):
        found = typical_growth(pair(), Channel.STATE, loss)
        assert (found.rate < 0) == decays
        assert abs(found.rate) > 3 * found.error
    boundary = mean_square(pair(), Channel.STATE).loss
    assert boundary is not None
    assert boundary < 0.6


def test_without_loss_typical_growth_is_that_of_the_map():
    plan = pair()
    found = typical_growth(plan, Channel.STATE, 0.0)
    assert found.rate == pytest.approx(np.log(spectral_radius(LinearRun(plan).map())), abs=2e-3)


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("gain", [2.0, 8.0])
def test_delays_that_vary_are_those_of_all_delays_that_messages_may_have(gain, loss):
    """One robot whose states take up to 1.5 periods: the joint chain of the delays of the last messages, by Kronecker
    products."""
    law = {"epsilon": [1.0], "gains": [{"k1": gain, "k2": 3.0}]}
    links = [{"channel": "state", "delay": {"min": 0.0, "max": 1.5 * T}, "loss": loss}]
    periods = {"acceleration": T, "torque": T}
    timing = {"timing": "time_driven", "links": links}
    plan = plan_of(scenario((None,), np.random.default_rng(1), duration=T, law=law, periods=periods, **timing))
    losses = Losses(plan, (), None)

    # In periods, rounded up: 0 has no probability, 1 two thirds, 2 one third; 9 is lost.
    shares = {1: (1 - loss) * 2 / 3, 2: (1 - loss) / 3, 9: loss}
    kinds = list(product(shares, repeat=2))  # delays of the messages of n - 1 and n - 2
    move, push, K = np.array([[1, T], [0, 1]]), np.array([[T**2 / 2], [T]]), -np.array([[gain, 3.0]])
    size = 8  # states of n, n - 1, n - 2, and the one in use at n - 1
    kron = np.zeros((len(kinds) * size**2,) * 2)
    for here, (one, two) in enumerate(kinds):
        for delay, share in shares.items():
            there = kinds.index((delay, one))
            # At n the message of n - 1 is there if it took one period, that of n - 2 if it took two and n - 1 is not there;
            # if it took one, it is in use already.
            rows = slice(2, 4) if one == 1 else slice(4, 6) if two == 2 else slice(6, 8)
            use = np.eye(size)[rows]
            whole = np.zeros((size, size))
            whole[:2] = np.hstack([move, np.zeros((2, 6))]) + push @ K @ use
            whole[2:6], whole[6:] = np.eye(4, size), use
            at, to = slice(here * size**2, (here + 1) * size**2), slice(there * size**2, (there + 1) * size**2)
            kron[to, at] += share * np.kron(whole, whole)
    expected = float(np.abs(np.linalg.eigvals(kron)).max())
    for part in losses.parts:
        found = SecondMoment(part, losses.chances(0.0))
        assert found.gain(1.001 * expected) < 1 < found.gain(0.999 * expected)
