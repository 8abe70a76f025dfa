"""The sampled, delayed loop: its map against the loop itself run tick by tick, and against continuous time."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.signal import cont2discrete

from echelon.controller.laws.central import CentralLaw
from echelon.controller.laws.in_tree import BlockGains
from echelon.controller.prediction.sampled import (
    delay_margin,
    error_map,
    largest_stable_delay,
    spectral_radius,
    tick_gains,
)
from echelon.controller.trajectory import Line
from echelon.plan.plan import Array, Plan
from echelon.plugins import Part
from echelon.sim.parts.loading import load
from support.growth import growth, single
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
    """Returns |(e, T ė)| tick by tick of points that do exactly what the central law tells them, from old states."""
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


def test_double_integrator_is_that_of_scipy():
    """In ticks, (e, T ė, T² η): the map without any answer, and the effect of an answer on its way."""
    T = 0.037
    a_c, b_c = np.array([[0, 1], [0, 0]]), np.array([[0], [1]])
    a, b, *_ = cont2discrete((a_c, b_c, np.eye(2), np.zeros((2, 1))), T, method="zoh")
    in_ticks = np.diag([1, T])
    found = error_map(np.array([[0.3, 0.7]]), 1)
    np.testing.assert_allclose(found[:2, :2], in_ticks @ a @ np.linalg.inv(in_ticks), atol=1e-15)
    np.testing.assert_allclose(found[:2, 2:], in_ticks @ b / T**2, atol=1e-15)
    np.testing.assert_array_equal(found[2], [-0.3, -0.7, 0.0])
    expected = in_ticks @ (a - b / T**2 @ [[0.3, 0.7]] @ in_ticks) @ np.linalg.inv(in_ticks)
    np.testing.assert_allclose(error_map(np.array([[0.3, 0.7]]), 0), expected, atol=1e-15)


@SETTINGS
@given(trees(max_depth=3, max_robots=6), SEEDS, st.integers(0, 5), st.sampled_from([0.01, 0.1, 0.4]))
def test_radius_is_that_of_the_map_on_histories(tree, seed, delay_ticks, T):
    """Matrix gains tie x to y, K̄ ties all blocks; both ways of writing the loop have one spectrum but for zeros."""
    plan = random_plan(tree, seed, T)
    expected = np.abs(np.linalg.eigvals(histories(plan, delay_ticks))).max()
    assert spectral_radius(plan, delay_ticks) == pytest.approx(expected, rel=1e-6)


@SETTINGS
@given(trees(max_depth=3, max_robots=6), SEEDS, st.sampled_from([0.02, 0.1]))
def test_parts_that_do_not_act_on_each_other_change_nothing(tree, seed, T):
    """Without coupling, and with gains that are numbers, the whole falls into parts; its radius is their largest."""
    random = np.random.default_rng(seed)
    law = random_epsilon(tree, random)
    plan = plan_of(scenario(tree, random, law=law, duration=T, periods={"acceleration": T, "torque": T}))
    for k in (0, 3):
        whole = np.abs(np.linalg.eigvals(error_map(tick_gains(plan), k))).max()
        assert spectral_radius(plan, k) == pytest.approx(whole, rel=1e-7)
        assert spectral_radius(plan, k) == pytest.approx(np.abs(np.linalg.eigvals(histories(plan, k))).max(), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_boundary_is_that_of_the_loop_run_tick_by_tick(seed):
    """Random gains and couplings: around the boundary the run grows or decays as the radius says, and at that rate."""
    plan = random_plan(((None, None), (None, None, None)), seed, 0.05)
    last = largest_stable_delay(plan)
    assert last is not None
    for k in range(max(0, last - 1), last + 3):
        radius = spectral_radius(plan, k)
        assert (radius < 1) == (k <= last)
        found = growth(run(plan, k, int(min(20_000, 20 / abs(np.log(radius))))))
        assert (found < 0) == (radius < 1)
        assert found == pytest.approx(np.log(radius), rel=0.15)


def test_paper_bears_six_milliseconds_and_not_seven():
    _, plan = load(PAPER, ["periods={acceleration=0.001, torque=0.0001}", "law.lead=0.5"])
    assert spectral_radius(plan, 6) < 1 < spectral_radius(plan, 7)
    assert largest_stable_delay(plan) == 6
    assert spectral_radius(plan, 7) == pytest.approx(1.00153, abs=1e-5)
    assert growth(run(plan, 7, 6000)) == pytest.approx(np.log(1.00153), abs=1e-4)
    assert growth(run(plan, 6, 6000)) < 0
    assert delay_margin(1e4, 1e2) == pytest.approx(0.00711, abs=1e-5)


@pytest.mark.parametrize("sigma", [1.0, 0.1, 0.01])
def test_margin_of_the_architecture_page(sigma):
    assert delay_margin(1 / sigma**2, 1 / sigma) == pytest.approx(0.7112 * sigma, rel=2e-4)


@pytest.mark.parametrize(("K1", "K2"), [(1.0, 1.0), (4.0, 0.5), (0.3, 5.0), (1e4, 1e2)])
def test_margin_puts_a_root_on_the_axis(K1, K2):
    """At τ* the equation s² + (K2 s + K1) e^{-sτ} = 0 has a root s = jω; for less delay it has none on the axis."""
    tau = delay_margin(K1, K2)
    omega = brentq(lambda w: np.abs(K2 * 1j * w + K1) - w**2, 1e-6, 1e6)
    s = 1j * omega
    assert abs(s**2 + (K2 * s + K1) * np.exp(-s * tau)) < 1e-9 * omega**2
    axis = 1j * np.geomspace(1e-3, 1e3, 20001) * omega
    assert np.abs(axis**2 + (K2 * axis + K1) * np.exp(-0.9 * tau * axis)).min() > 0


@pytest.mark.parametrize(("k1", "k2"), [(1.0, 1.0), (2.0, 0.8)])
def test_boundary_tends_to_the_continuous_margin(k1, k2):
    """Held for T the answer is T/2 older on average: the largest delay is τ* - T/2, to a tick, whatever the lead does
    beyond; so it tends to τ* as T falls."""
    tau = delay_margin(k1, k2)
    for T in (0.04, 0.02, 0.01):
        found = largest_stable_delay(single(T, 0.0, k1, k2))
        assert found is not None
        assert (found + 0.5) * T <= tau + 0.1 * T
        assert (found + 1.5) * T > tau - 0.1 * T
        led = largest_stable_delay(single(T, 0.5, k1, k2))
        assert led is not None
        assert abs(led * T - tau) < 2 * T


def test_too_slow_a_period_is_unstable_without_any_delay():
    """z² + (T² K1/2 + T K2 - 2) z + (1 + T² K1/2 - T K2) = 0 has both roots inside the unit circle if and only if
    K2 T < 2 (at z = -1) and K1 T < 2 K2 (the product of the roots)."""
    assert spectral_radius(single(1.9)) < 1 < spectral_radius(single(2.1))
    assert largest_stable_delay(single(2.1)) is None
    assert largest_stable_delay(single(1.9)) == 0
    for T, k1, k2 in ((0.3, 1.0, 1.0), (0.9, 0.5, 1.5), (1.2, 1.0, 0.5), (0.9, 1.0, 0.5)):
        jury = k2 * T < 2 and k1 * T < 2 * k2
        assert (spectral_radius(single(T, 0.0, k1, k2)) < 1) == jury


def test_limit_ends_the_search():
    assert largest_stable_delay(single(0.01), limit=5) == 5


def test_axes_may_be_coupled_by_gains():
    """A gain that turns the error by an angle eats phase: stability ends where the margin is used up."""

    def turned(angle: float) -> Plan:
        plan = single(0.01)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shape, centroid = plan.blocks
        return replace(plan, blocks=(shape, replace(centroid, k1=centroid.k1 @ turn, k2=centroid.k2 @ turn)))

    crossover = np.sqrt((1 + np.sqrt(5)) / 2)
    margin = np.arctan(crossover)  # phase margin of (s + 1)/s²; the hold takes ω_c T/2 of it
    assert spectral_radius(turned(margin - crossover * 0.005 - 0.01)) < 1
    assert spectral_radius(turned(margin - crossover * 0.005 + 0.01)) > 1


def test_what_has_no_answer_is_refused():
    plan = plan_of(scenario(PAPER_TREE, np.random.default_rng(1)))
    with pytest.raises(ValueError, match="must not be negative"):
        spectral_radius(plan, -1)
    slow = replace(plan, nodes=(*plan.nodes[:-1], replace(plan.root, period_ns=2_000_000)))
    for function in (spectral_radius, largest_stable_delay):
        with pytest.raises(ValueError, match="all nodes must have the same"):
            function(slow)
