"""Integral action against a closed loop derived in another way: in continuous time, sampled, with look-ahead, and in runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

from echelon.controller.laws import Block, Integral
from echelon.controller.laws.central import CentralLaw
from echelon.controller.laws.law import LinearGains, law_block
from echelon.controller.prediction.block_margin import delay_margin
from echelon.controller.prediction.gains import linear_gains
from echelon.plan.plan import Array, Plan
from echelon.sim.parts.loading import REGISTRY, load
from echelon.sim.results.block_series import block_series
from support.growth import growth, largest_delay_of, radius_of, single
from support.runs import SCENARIOS, trace_of
from support.runs import plan_of as shipped
from support.trees import PAPER_TREE, plan_of, random_epsilon, scenario, with_random_gains

REST = {"kind": "line", "velocity": (0.0, 0.0)}


def integral(k_i: float, limit: float = 1e60):
    return REGISTRY.make("laws", "integral", {"k_i": k_i, "limit": limit}, Path())


def alone(T: float, k1: float, k2: float, k_i: float, lead: float = 0.0, limit: float = 1e60) -> Plan:
    """Returns the plan of a single robot that shall stay at the origin, with σ = 1."""
    rest = REGISTRY.make("trajectories", "line", {"velocity": (0.0, 0.0)}, Path())
    return replace(single(T, lead, k1, k2), law=integral(k_i, limit), trajectory=rest)


def pushed(plan: Plan, w: Array, ticks: int, start: float = 1.0) -> Array:
    """Returns the positions of a point, (ticks, 2); its acceleration is that of the law plus the disturbance w."""
    T, central = plan.root.period_ns * 1e-9, CentralLaw(plan)
    x, v, path = np.full((1, 2), start), np.zeros((1, 2)), []
    for tick in range(ticks):
        path.append(x[0])
        a = central(tick * T, x, v) + w
        x, v = x + T * v + T**2 / 2 * a, v + T * a
    return np.array(path)


def continuous(k1: float, k2: float, k_i: float, w: Array, times: Array, start: float = 1.0) -> Array:
    """Returns the positions in continuous time, (times, 2), from ë = -K_1 e - K_2 ė - K_i ∫e + w."""

    def slope(_, y):
        e, e_dot, q = y[:2], y[2:4], y[4:]
        return np.concatenate([e_dot, -k1 * e - k2 * e_dot - k_i * q + w, e])

    begin = np.array([start, start, 0, 0, 0, 0])
    found = solve_ivp(slope, (0, times[-1]), begin, t_eval=times, method="DOP853", rtol=1e-11, atol=1e-13)
    return found.y[:2].T


@pytest.mark.parametrize(("k1", "k2"), [(1.0, 1.0), (0.5, 1.0), (2.0, 0.3), (0.25, 0.5)])
@pytest.mark.parametrize("sigma", [1.0, 0.25])
def test_stable_if_and_only_if_routh_and_hurwitz_say_so(k1, k2, sigma):
    """At k_i = k1 k2 eigenvalues of the companion matrix, made from the law's answers, cross the imaginary axis; σ only scales
    time."""

    def slowest(k_i: float) -> float:
        block = Block("b", "intra", 1, sigma, 0.01, 0.0, np.array([[k1 / sigma**2]]), np.array([[k2 / sigma]]))
        law, zero = Integral(k_i=k_i, limit=1e9), np.zeros(1)
        row = [law.nu(block, 0.0, *np.eye(3)[at][:2, None], zero, np.eye(3)[at][2:].copy())[0] for at in range(3)]
        companion = [[0, 1, 0], [*row[:2], row[2]], [1, 0, 0]]
        return float(np.linalg.eigvals(companion).real.max()) * sigma

    assert slowest(0.99 * k1 * k2) < 0 < slowest(1.01 * k1 * k2)
    assert brentq(slowest, 0.5 * k1 * k2, 2 * k1 * k2) == pytest.approx(k1 * k2, rel=1e-9)
    assert slowest(0.3 * k1 * k2) == pytest.approx(np.roots([1, k2, k1, 0.3 * k1 * k2]).real.max(), rel=1e-9)


@pytest.mark.parametrize("lead", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_lead_is_the_law_taken_at_error_rate_and_integral_to_come(seed, lead):
    random = np.random.default_rng(seed)
    law = random_epsilon(PAPER_TREE, random) | {
        "lead": lead,
        "use": "integral",
        "parameters": {"k_i": 0.2, "limit": 1e9},
    }
    periods = {"acceleration": 0.1, "torque": 0.1}
    plan = plan_of(scenario(PAPER_TREE, random, law=law, duration=0.1, periods=periods))
    plan = with_random_gains(plan, random)
    h = lead * 0.1
    for block in plan.blocks:
        seen = law_block(plan, block)
        e, e_dot, q, others = random.normal(size=(4, block.size))

        def implicit(eta, seen=seen, e=e, e_dot=e_dot, q=q, others=others):
            e_h = e + h * e_dot + h**2 / 2 * eta
            q_h = q + h * e + h**2 / 2 * e_dot + h**3 / 6 * eta
            return eta + seen.K_1 @ e_h + seen.K_2 @ (e_dot + h * eta) + 0.2 / seen.sigma**3 * q_h - others

        solved = root(implicit, np.zeros(block.size), tol=1e-13).x
        made = plan.law.made
        found = made.nu(seen, 0.0, e, e_dot, np.zeros(block.size), q) + made.weight(seen) @ others
        np.testing.assert_allclose(found, solved, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("lead", [0.0, 0.5])
def test_sampled_loop_tends_to_the_continuous_one(lead):
    """The hold leaves an error of first order in the period, also under a constant push.  Look-ahead leaves an error of second
    order without a push; it does not know the push."""
    w, gains = np.array([0.0, 0.0] if lead else [0.3, -0.1]), (1.0, 1.2, 0.4)
    off = []
    for T in (0.1, 0.05, 0.025):
        times = np.arange(0, 20, T)
        found = pushed(alone(T, *gains, lead=lead), w, len(times))
        off.append(np.abs(found - continuous(*gains, w, times)).max())
    order = np.log2(np.array(off[:-1]) / off[1:])
    assert off[0] < 0.1
    np.testing.assert_allclose(order, 2 if lead else 1, atol=0.15)


@pytest.mark.slow
def test_a_constant_push_leaves_no_error_where_the_linear_law_keeps_one():
    w = np.array([0.3, -0.1])
    for lead in (0.0, 0.5):
        plan = alone(0.05, 0.8, 1.2, 0.4, lead=lead)
        assert np.abs(pushed(plan, w, 4000)[-1]).max() < 1e-12
        linear = replace(plan, law=REGISTRY.make("laws", "linear", {}, Path()))
        kept = w / 0.8 * (1 + lead * 0.05 * 1.2 + (lead * 0.05) ** 2 / 2 * 0.8)  # (M K_1)⁻¹ w
        np.testing.assert_allclose(pushed(linear, w, 2000)[-1], kept, rtol=1e-9)


def test_beyond_its_limit_a_push_leaves_an_error_and_the_integral_does_not_grow():
    """The integral compensates for `limit` of the push, K_1 e for the rest.  When the push ends, the integral decays soon."""
    plan = alone(0.05, 1.0, 1.2, 0.4, limit=0.25)
    np.testing.assert_allclose(pushed(plan, np.array([0.4, 0.2]), 2000)[-1], [0.15, 0.0], atol=1e-9)
    central = CentralLaw(plan)
    for _ in range(1000):
        central(0.0, np.full((1, 2), 50.0), np.zeros((1, 2)))
    np.testing.assert_allclose(central.states[-1] * 0.4, 0.25)


@pytest.mark.slow
@pytest.mark.parametrize(("k1", "k2", "k_i"), [(1.0, 1.2, 0.4), (0.5, 1.0, 0.45), (2.0, 1.0, 0.3), (1.0, 1.0, 0.9)])
@pytest.mark.parametrize("lead", [0.0, 0.5])
def test_runs_grow_and_decay_as_the_spectral_radius_says(k1, k2, k_i, lead):
    """Periods reach from short ones to unstable ones."""
    found = []
    for T in (0.05, 0.2, 0.6, 0.9, 1.3, 2.0, 2.6):
        plan = alone(T, k1, k2, k_i, lead=lead)
        radius = radius_of(plan)
        norms = np.linalg.norm(pushed(plan, np.zeros(2), int(min(20_000, max(64, 20 / abs(np.log(radius)))))), axis=1)
        assert growth(norms) == pytest.approx(np.log(radius), rel=0.15, abs=1e-3)
        found.append(radius < 1)
    assert found[0]
    assert lead or not found[-1]


def test_boundary_in_k_i_is_that_of_routh_and_hurwitz_as_the_period_falls():
    for T, precision in ((0.1, 0.2), (0.01, 0.02), (0.001, 0.002)):
        boundary = brentq(lambda k_i, T=T: radius_of(alone(T, 1.0, 1.2, k_i)) - 1, 0.1, 3.0)
        assert boundary == pytest.approx(1.2, rel=precision)


@pytest.mark.parametrize("delay_ticks", [0, 1, 4])
def test_map_is_the_loop_itself_pushed_by_unit_vectors(delay_ticks):
    """The blocks are coupled and have full gains, and the states are `delay_ticks` old when the law uses them.  The vector
    holds all unknowns of the loop."""
    random = np.random.default_rng(5)
    law = random_epsilon(PAPER_TREE, random) | {
        "lead": 0.5,
        "use": "integral",
        "parameters": {"k_i": 0.1, "limit": 1e9},
    }
    periods = {"acceleration": 0.02, "torque": 0.02}
    table = scenario(PAPER_TREE, random, law=law, trajectory=REST, duration=0.02, periods=periods)
    plan = with_random_gains(plan_of(table), random, 0.2)
    n, T, central = 18, 0.02, CentralLaw(plan)
    wanted = central.transformation.backward(central.transformation.desired(np.zeros(2)))

    def tick(unknown: Array) -> Array:
        """Returns the unknowns after a tick: (e, ė) of this and of the last ticks, in the coordinates of the robots, and q of
        all blocks."""
        told, q = unknown[: 4 * n * (delay_ticks + 1) // 2].reshape(delay_ticks + 1, 2, 9, 2), unknown[-n:]
        central.states = [q[block.offset : block.offset + block.size].copy() for block in plan.blocks]
        a = central(0.0, wanted + told[-1, 0], told[-1, 1])
        (x, v) = told[0]
        now = np.array([x + T * v + T**2 / 2 * a, v + T * a])
        return np.concatenate([now.ravel(), told[:-1].ravel(), *central.states])

    size = 2 * n * (delay_ticks + 1) + n
    whole = np.array([tick(unit) for unit in np.eye(size)]).T
    expected = np.abs(np.linalg.eigvals(whole)).max()
    assert radius_of(plan, delay_ticks) == pytest.approx(expected, rel=1e-6)


def numbers(*of_e_rate_and_integral: float) -> LinearGains:
    """Returns scalar gains as a block has them."""
    return LinearGains(*(np.array([[gain]]) for gain in of_e_rate_and_integral), np.eye(1))


@pytest.mark.parametrize(("k1", "k2", "k_i"), [(1.0, 1.2, 0.4), (0.5, 1.0, 0.1), (2.0, 1.0, 1.9), (0.3, 2.0, 0.5)])
def test_margin_puts_a_root_on_the_axis_and_is_where_the_sampled_boundary_tends_to(k1, k2, k_i):
    tau = delay_margin(numbers(k1, k2, k_i))
    assert tau is not None
    axis = 1j * np.geomspace(1e-3, 1e3, 200_001)

    def least(delay: float) -> float:
        return float(np.abs(1 + (k2 * axis**2 + k1 * axis + k_i) * np.exp(-axis * delay) / axis**3).min())

    assert least(tau) < 1e-4
    assert min(least(share * tau) for share in (0.0, 0.3, 0.6, 0.9)) > 1e-3
    T = round(tau / 40, 6)
    found = largest_delay_of(alone(T, k1, k2, k_i))
    assert found is not None
    assert abs((found + 0.5) * T - tau) < 1.1 * T
    assert delay_margin(numbers(k1, k2, k1 * k2 * 1.001)) is None


def steady(name: str, *overrides: str) -> dict[str, Array]:
    """Returns the errors of all blocks at the end of a run in one process."""
    blocks = block_series(trace_of(shipped(name, *overrides)))
    return {series.block.name: series.error[-1] for series in blocks.series}


@pytest.mark.slow
def test_what_the_controller_does_not_know_vanishes_in_runs():
    """The shipped scenario has a slope, rolling resistance and loads.  With the linear law the centroid's error is that of the
    balance of forces."""
    kept = steady("integral", "law.use=linear", "law.parameters={}")
    gone = steady("integral", "law.parameters.limit=2.0", "duration=120.0")
    # At 0.3 m/s uphill the law must give a robot (m g sin + c v)/(4 kg), with its load in m; this is the mean of nine robots.
    slope = 9.81 * 0.05 / np.hypot(1, 0.05)
    needed = (8 * (4 * slope + 0.3) + (6 * slope + 0.3)) / 9 / 4
    h, k1, k2 = 0.005, 0.5, 1.0
    assert kept["centroid"] == pytest.approx([-needed / k1 * (1 + h * k2 + h**2 / 2 * k1), 0.0], abs=1e-4)
    assert np.linalg.norm(kept["g2"]) > 0.02
    for name, error in gone.items():
        assert np.abs(error).max() < 1e-6, name


def test_the_loop_of_a_heavier_robot_is_stable_where_its_own_polynomial_is():
    """A robot of mass m in place of m1 has r = m1/m of the wanted acceleration.  The characteristic polynomial is
    p³ + r (k2 p² + k1 p + k_i) with p in 1/σ; it is stable if and only if k_i < r k1 k2."""
    _, plan = load(SCENARIOS / "integral.toml")
    r, k1, k2 = 4 / 6, 0.5, 1.0
    assert r * k1 * k2 > 0.1
    assert linear_gains(plan, plan.blocks[-1], 0.0).K_i[0, 0] == pytest.approx(0.1)
    assert np.roots([1, r * k2, r * k1, r * 0.1]).real.max() < 0 < np.roots([1, r * k2, r * k1, r * 0.4]).real.max()
