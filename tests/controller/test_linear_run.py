"""The linear run with links: against the engine with robots that are points, another way to write the loop, and theory."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.signal import cont2discrete

from echelon.controller.laws.central import CentralLaw
from echelon.controller.laws.in_tree import BlockGains
from echelon.controller.laws.law import LinearGains
from echelon.controller.prediction.block_margin import delay_margin
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import LinearRun, later, ruled_links
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.controller.trajectory import Line
from echelon.messages import Channel
from echelon.plan.delay_tables import DelayTrace
from echelon.plan.plan import Array, Plan
from echelon.plan.punctuality import with_punctuality
from echelon.plugins import Part
from echelon.sim.parts.loading import load
from support.growth import growth, largest_delay_of, radius_of, single
from support.points import at_rest, growth_of_points
from support.runs import plan_of as shipped
from support.synthetic import PAPER
from support.trees import PAPER_TREE, plan_of, random_epsilon, scenario, trees, with_random_gains

SETTINGS = settings(derandomize=True, deadline=None, max_examples=30)
SEEDS = st.integers(0, 2**32 - 1)
REST = {"kind": "line", "velocity": (0.0, 0.0)}


def random_plan(tree, seed: int, T: float) -> Plan:
    random = np.random.default_rng(seed)
    law = random_epsilon(tree, random) | {"lead": random.choice([0.0, 0.5, 1.0])}
    table = scenario(tree, random, law=law, trajectory=REST, duration=T, periods={"acceleration": T, "torque": T})
    return with_random_gains(plan_of(table), random, coupling=0.2)


def run(plan: Plan, delay_ticks: int, ticks: int) -> Array:
    """Returns |(e, T ė)| at each tick for points that have exactly the accelerations of the central law, computed from states
    that are `delay_ticks` old."""
    T = plan.root.period_ns * 1e-9
    rest = Part("line", {}, None, Line(velocity=(0.0, 0.0)))
    central, random = CentralLaw(replace(plan, trajectory=rest)), np.random.default_rng(1)
    x = central.transformation.backward(central.transformation.desired(np.zeros(2)))
    x, v = x + random.normal(size=x.shape), np.zeros_like(x)
    known: deque[tuple[Array, Array]] = deque([(x, v)] * (delay_ticks + 1), maxlen=delay_ticks + 1)
    norms = np.empty(ticks)
    for tick in range(ticks):
        known.append((x, v))
        a = central(0.0, *known[0])
        x, v = x + T * v + T**2 / 2 * a, v + T * a
        e = central.transformation.forward(x) - central.transformation.desired(np.zeros(2))
        norms[tick] = np.hypot(np.linalg.norm(e), np.linalg.norm(T * central.transformation.forward(v)))
        if norms[tick] > 1e100:
            return norms[: tick + 1]
    return norms


def histories(plan: Plan, delay_ticks: int) -> Array:
    """Returns the loop's map on (x_n, x_{n-1} .. x_{n-k}), x = (e, ė): other unknowns than those of `error_map`."""
    T, size = plan.root.period_ns * 1e-9, 2 * len(plan.robots)
    unit = np.eye(size)
    a_c, b_c = np.kron([[0, 1], [0, 0]], unit), np.kron([[0], [1]], unit)
    a, b, *_ = cont2discrete((a_c, b_c, np.eye(2 * size), np.zeros((2 * size, size))), T, method="zoh")
    f = np.zeros((size, 2 * size))
    for block in plan.blocks:
        rows, gains = slice(block.offset, block.offset + block.size), BlockGains.of(plan, block)
        f[rows, rows] = -gains.K_1
        f[rows, size + block.offset : size + block.offset + block.size] = -gains.K_2
        f[rows, size:] -= gains.K_coupling
    whole = np.eye(2 * size * (delay_ticks + 1), k=-2 * size)
    whole[: 2 * size, : 2 * size] = a
    whole[: 2 * size, -2 * size :] += b @ f
    return whole


@SETTINGS
@given(trees(max_depth=3, max_robots=6), SEEDS, st.integers(0, 5), st.sampled_from([0.01, 0.1, 0.4]))
def test_radius_is_that_of_the_map_on_histories(tree, seed, delay_ticks, T):
    """Matrix gains couple x and y, K̄ couples all blocks; the two ways to write the loop have the same spectrum apart from
    zeros."""
    plan = random_plan(tree, seed, T)
    expected = np.abs(np.linalg.eigvals(histories(plan, delay_ticks))).max()
    assert radius_of(plan, delay_ticks) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
@SETTINGS
@given(trees(max_depth=3, max_robots=6), SEEDS, st.sampled_from([0.02, 0.1]))
def test_parts_that_do_not_act_on_each_other_change_nothing(tree, seed, T):
    """Without coupling and with scalar gains the loop falls into parts; its spectral radius is the largest of theirs."""
    random = np.random.default_rng(seed)
    law = random_epsilon(tree, random)
    plan = plan_of(scenario(tree, random, law=law, duration=T, periods={"acceleration": T, "torque": T}))
    for k in (0, 3):
        whole = np.abs(
            np.linalg.eigvals(LinearRun(later(plan, Channel.STATE, k * plan.root.period_ns)).map().toarray())
        ).max()
        assert radius_of(plan, k) == pytest.approx(whole, rel=1e-7)
        assert radius_of(plan, k) == pytest.approx(np.abs(np.linalg.eigvals(histories(plan, k))).max(), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_boundary_is_that_of_the_loop_run_tick_by_tick(seed):
    """Random gains and couplings: around the boundary the run grows or decays as the radius says, and at that rate."""
    plan = random_plan(((None, None), (None, None, None)), seed, 0.05)
    last = largest_delay_of(plan)
    assert last is not None
    for k in range(max(0, last - 1), last + 3):
        radius = radius_of(plan, k)
        assert (radius < 1) == (k <= last)
        found = growth(run(plan, k, int(min(20_000, 20 / abs(np.log(radius))))))
        assert (found < 0) == (radius < 1)
        assert found == pytest.approx(np.log(radius), rel=0.15)


@pytest.mark.slow
def test_paper_bears_six_milliseconds_and_not_seven():
    _, plan = load(PAPER, ["periods={acceleration=0.001, torque=0.0001}", "law.lead=0.5"])
    assert radius_of(plan, 6) < 1 < radius_of(plan, 7)
    assert largest_delay_of(plan) == 6
    assert radius_of(plan, 7) == pytest.approx(1.00153, abs=1e-5)
    assert growth(run(plan, 7, 6000)) == pytest.approx(np.log(1.00153), abs=1e-4)
    assert growth(run(plan, 6, 6000)) < 0
    assert margin_of(1e4, 1e2) == pytest.approx(0.00711, abs=1e-5)


@pytest.mark.parametrize("sigma", [1.0, 0.1, 0.01])
def test_margin_of_the_architecture_page(sigma):
    assert margin_of(1 / sigma**2, 1 / sigma) == pytest.approx(0.7112 * sigma, rel=2e-4)


@pytest.mark.parametrize(("K1", "K2"), [(1.0, 1.0), (4.0, 0.5), (0.3, 5.0), (1e4, 1e2)])
def test_margin_puts_a_root_on_the_axis(K1, K2):
    """At τ* the equation s² + (K2 s + K1) e^{-sτ} = 0 has a root s = jω; for less delay it has none on the axis."""
    tau = margin_of(K1, K2)
    omega = brentq(lambda w: np.abs(K2 * 1j * w + K1) - w**2, 1e-6, 1e6)
    s = 1j * omega
    assert abs(s**2 + (K2 * s + K1) * np.exp(-s * tau)) < 1e-9 * omega**2
    axis = 1j * np.geomspace(1e-3, 1e3, 20001) * omega
    assert np.abs(axis**2 + (K2 * axis + K1) * np.exp(-0.9 * tau * axis)).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize(("k1", "k2"), [(1.0, 1.0), (2.0, 0.8)])
def test_boundary_tends_to_the_continuous_margin(k1, k2):
    """A command that is held for T is T/2 older on average, so without lead the largest delay is τ* - T/2, up to a tick.  With
    and without lead it tends to τ* as T falls."""
    tau = margin_of(k1, k2)
    for T in (0.04, 0.02, 0.01):
        found = largest_delay_of(single(T, 0.0, k1, k2))
        assert found is not None
        assert (found + 0.5) * T <= tau + 0.1 * T
        assert (found + 1.5) * T > tau - 0.1 * T
        led = largest_delay_of(single(T, 0.5, k1, k2))
        assert led is not None
        assert abs(led * T - tau) < 2 * T


def test_too_slow_a_period_is_unstable_without_any_delay():
    """z² + (T² K1/2 + T K2 - 2) z + (1 + T² K1/2 - T K2) = 0 has both roots inside the unit circle if and only if
    K2 T < 2 (at z = -1) and K1 T < 2 K2 (the product of the roots)."""
    assert radius_of(single(1.9)) < 1 < radius_of(single(2.1))
    assert largest_delay_of(single(2.1)) is None
    assert largest_delay_of(single(1.9)) == 0
    for T, k1, k2 in ((0.3, 1.0, 1.0), (0.9, 0.5, 1.5), (1.2, 1.0, 0.5), (0.9, 1.0, 0.5)):
        jury = k2 * T < 2 and k1 * T < 2 * k2
        assert (radius_of(single(T, 0.0, k1, k2)) < 1) == jury


def test_axes_may_be_coupled_by_gains():
    """A gain that turns the error by an angle reduces the phase margin: stability ends where none is left."""

    def turned(angle: float) -> Plan:
        plan = single(0.01)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shape, centroid = plan.blocks
        return replace(plan, blocks=(shape, replace(centroid, k1=centroid.k1 @ turn, k2=centroid.k2 @ turn)))

    crossover = np.sqrt((1 + np.sqrt(5)) / 2)
    margin = np.arctan(crossover)  # phase margin of (s + 1)/s²; the hold takes ω_c T/2 of it
    assert radius_of(turned(margin - crossover * 0.005 - 0.01)) < 1
    assert radius_of(turned(margin - crossover * 0.005 + 0.01)) > 1


def margin_of(K1: float, K2: float) -> float:
    """Returns the margin of a block whose gains are numbers."""
    margin = delay_margin(LinearGains(np.eye(2) * K1, np.eye(2) * K2, np.zeros((2, 2)), np.eye(2)))
    assert margin is not None
    return margin


@pytest.mark.parametrize("seed", range(8))
def test_margin_of_matrix_gains_is_where_all_roots_first_reach_the_axis(seed):
    """The delayed block ë(t) = -K_1 e(t - τ) - K_2 ė(t - τ), its roots by collocation on Chebyshev points: stable just below
    the margin, unstable just above it."""
    random = np.random.default_rng(seed)
    n = 4
    K_1, K_2 = (np.eye(n) + 0.2 * random.normal(size=(n, n)) for _ in range(2))
    tau = delay_margin(LinearGains(K_1, K_2, np.zeros((n, n)), np.eye(n)))
    assert tau is not None
    assert rightmost(K_1, K_2, 0.99 * tau) < 0 < rightmost(K_1, K_2, 1.01 * tau)
    assert min(-rightmost(K_1, K_2, share * tau) for share in (0.05, 0.3, 0.6, 0.9)) > 0


def test_margins_of_matrix_gains_are_not_those_of_their_first_entries():
    K_1, K_2 = np.diag([1.0, 9.0]), np.diag([1.0, 3.0])
    tau = delay_margin(LinearGains(K_1, K_2, np.zeros((2, 2)), np.eye(2)))
    assert tau == pytest.approx(margin_of(9.0, 3.0), rel=1e-9)
    assert tau < 0.5 * margin_of(1.0, 1.0)
    assert delay_margin(LinearGains(-np.eye(2), np.eye(2), np.zeros((2, 2)), np.eye(2))) is None


def rightmost(K_1: Array, K_2: Array, tau: float, order: int = 24) -> float:
    """Returns the largest real part of the roots of a delayed block: the delay as a transport on Chebyshev points."""
    n = len(K_1)
    at = np.cos(np.pi * np.arange(order + 1) / order)
    weights = np.r_[2.0, np.ones(order - 1), 2.0] * (-1.0) ** np.arange(order + 1)
    apart = at[:, None] - at[None]
    slope = np.outer(weights, 1 / weights) / (apart + np.eye(order + 1))
    slope -= np.diag(slope.sum(axis=1))
    whole = np.kron(2 / tau * slope, np.eye(2 * n))
    whole[: 2 * n] = 0
    whole[:n, n : 2 * n] = np.eye(n)
    whole[n : 2 * n, -2 * n :] = -np.hstack([K_1, K_2])
    return float(np.linalg.eigvals(whole).real.max())


# Links: against the engine with robots that are points

CHANNELS = (Channel.STATE, Channel.GROUP_STATE, Channel.REFERENCE, Channel.COMMAND)
TREE = ((None, None), (None, None, None))


def with_links(plan: Plan, delays_ns: Sequence[int]) -> Plan:
    """Returns a plan whose links have these delays, one after the other."""

    late = [
        replace(link, delay_min_ns=delay_ns, delay_max_ns=delay_ns)
        for link, delay_ns in zip(plan.links, delays_ns, strict=True)
    ]
    return replace(plan, links=tuple(with_punctuality(late, plan.nodes)))


def check_points(plan: Plan, monkeypatch: pytest.MonkeyPatch, rel: float = 0.15) -> float:
    """Holds the predicted growth against that of points in the engine; returns the radius."""
    radius = spectral_radius(LinearRun(plan).map())
    rate = np.log(radius)
    found = growth_of_points(plan, int(min(6000, max(400, 20 / abs(rate)))), monkeypatch)
    assert (found < 0) == (radius < 1)
    assert found == pytest.approx(rate, rel=rel)
    return radius


@pytest.mark.slow
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("seed", range(2))
def test_points_grow_and_decay_as_predicted_around_the_margin_of_each_channel(channel, seed, monkeypatch):
    """Coupled blocks with full gains: at the predicted margin, and one tick beyond it."""
    plan = at_rest(random_plan(TREE, seed, 0.05))
    last = largest_delay_of(plan, channel)
    assert last is not None
    for k in (last, last + 1):
        radius = check_points(later(plan, channel, k * plan.root.period_ns), monkeypatch)
        assert (radius < 1) == (k <= last)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_every_link_may_have_a_delay_of_its_own(seed, monkeypatch):
    """Delays of any length, on and between ticks, beside a group with a shorter period."""
    random = np.random.default_rng(seed)
    table = scenario(
        TREE,
        random,
        duration=0.06,
        trajectory=REST,
        periods={"acceleration": 0.03, "torque": 0.03},
        law=random_epsilon(TREE, random),
    )
    table["formation"]["period"] = 0.06
    table["formation"]["groups"]["g1"]["period"] = 0.03
    table["formation"]["groups"]["g0"]["period"] = 0.06
    plan = at_rest(with_random_gains(plan_of(table), random, coupling=0.2))
    delays = random.choice([0, 10_000_000, 30_000_000, 45_000_000, 90_000_000], size=len(plan.links))
    check_points(with_links(plan, delays.tolist()), monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("channel", CHANNELS)
def test_margin_with_periods_of_different_length_is_where_points_begin_to_grow(channel, monkeypatch):
    random = np.random.default_rng(7)
    table = scenario(
        TREE,
        random,
        duration=0.2,
        trajectory=REST,
        periods={"acceleration": 0.1, "torque": 0.1},
        law=random_epsilon(TREE, random),
    )
    table["formation"]["period"] = 0.2
    plan = at_rest(plan_of(table))
    found = largest_extra_delay(plan, channel)
    assert found.ends == "unstable"
    assert found.ticks is not None
    tick_ns = round(found.tick_s * 1e9)
    for ticks in (found.ticks, found.ticks + 1):
        radius = check_points(later(plan, channel, ticks * tick_ns), monkeypatch)
        assert (radius < 1) == (ticks <= found.ticks)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("channel", CHANNELS)
def test_every_delay_up_to_the_margin_is_stable_and_the_next_is_not(channel, seed):
    """The frequency criterion, which tries no delays, against the map at every delay; some links have delays from the start."""
    random = np.random.default_rng(seed)
    plan = random_plan(TREE, seed, float(random.choice([0.02, 0.05, 0.2])))
    delays = random.choice([0, 0, plan.root.period_ns // 3, plan.root.period_ns], size=len(plan.links))
    late = with_links(plan, delays.tolist())
    plan = late if radius_of(late) < 1 else plan
    last = largest_delay_of(plan, channel)
    if last is None:
        assert radius_of(plan) >= 1
        return
    for k in range(last + 2):
        assert (radius_of(plan, k, channel) < 1) == (k <= last)


@pytest.mark.slow
def test_integral_action_in_the_tree_is_predicted_as_the_engine_runs_it(monkeypatch):
    random = np.random.default_rng(3)
    law = random_epsilon(TREE, random) | {"lead": 0.5, "use": "integral", "parameters": {"k_i": 0.2, "limit": 1e60}}
    table = scenario(
        TREE, random, duration=0.05, trajectory=REST, periods={"acceleration": 0.05, "torque": 0.05}, law=law
    )
    plan = at_rest(with_random_gains(plan_of(table), random, coupling=0.1))
    last = largest_delay_of(plan, Channel.COMMAND)
    assert last is not None
    for k in (0, last, last + 1):
        check_points(later(plan, Channel.COMMAND, k * plan.root.period_ns), monkeypatch)


@pytest.mark.slow
def test_where_the_torque_path_is_closed_a_late_torque_is_a_late_command():
    mirrored = shipped("lab")
    closed = shipped("lab", 'can={path="closed", watchdog=5.0}')
    assert radius_of(closed) == pytest.approx(radius_of(mirrored), abs=1e-12)
    expected = largest_extra_delay(mirrored, Channel.COMMAND)
    for channel in (Channel.COMMAND, Channel.TORQUE):
        assert largest_extra_delay(closed, channel) == replace(expected, beyond_s=0.0)  # taken at torque periods
    assert not ruled_links(mirrored, Channel.TORQUE)


def test_a_timeout_ends_what_may_be_later():
    closed = shipped("lab", 'can={path="closed", watchdog=0.1}')
    found = largest_extra_delay(closed, Channel.STATE)
    assert (found.ticks, found.ends) == (10, "timeout")
    LinearRun(later(closed, Channel.STATE, 100_000_000))
    with pytest.raises(PredictionError, match=r"state from g1/r1 to g1 is older than its timeout of 0\.1 s"):
        LinearRun(later(closed, Channel.STATE, 100_000_001))


def test_what_has_no_answer_is_refused():
    plan = plan_of(scenario(PAPER_TREE, np.random.default_rng(1)))
    for changed in ({"loss": 0.1}, {"delay_max_ns": 1_000_000}, {"delays": DelayTrace((5, 6)), "delay_max_ns": 6}):
        links = (replace(plan.links[0], **changed), *plan.links[1:])
        with pytest.raises(PredictionError, match="1 of 24 links lose messages or have delays that vary"):
            LinearRun(replace(plan, links=links))
    with pytest.raises(PredictionError, match="is not linear"):
        LinearRun(shipped("sliding"))
    with pytest.raises(ValueError, match="there is no link of it"):
        largest_extra_delay(plan, Channel.TORQUE)
