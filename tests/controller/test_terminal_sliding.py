"""Terminal sliding mode against a closed loop derived in another way, against closed forms, and against the linear law."""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from echelon.controller.laws import Block, TerminalSliding
from echelon.plan.plan import Array
from echelon.sim.parts.loading import REGISTRY
from echelon.sim.results.block_series import block_series
from support.runs import trace_of
from support.trees import ROBOT, plan_of, scenario


def least(gamma: float, beta: float) -> float:
    """Returns the κ above which the surface is reached, from the largest value of (1-u)^ρ u^(1-ρ), not from the closed form."""
    rho, u = 2 / gamma - 1, np.linspace(0, 1, 100_001)
    return float(((1 - u) ** rho * u ** (1 - rho)).max() * beta ** (2 / gamma) / gamma)


PARAMETERS = [
    (gamma, beta, round(share * least(gamma, beta), 3))
    for gamma, beta, share in product((1.2, 1.5, 1.8), (0.5, 1.0, 2.0), (1.4, 3.0))
]
"""Triples of γ, β, κ"""
numbers = st.floats(-20, 20).filter(lambda x: x == 0 or abs(x) > 1e-9)


def sig(x, a):
    return np.sign(x) * np.abs(x) ** a


def block(sigma: float = 1.0, T: float = 0.01, lead: float = 0.0, size: int = 1) -> Block:
    return Block("b", "intra", size, sigma, T, lead, np.eye(size), np.eye(size))


def answer(law: TerminalSliding, at: Block, e: float, e_dot: float) -> float:
    """Returns ν of a block with one number, without feed-forward."""
    return float(law.nu(at, 0.0, np.array([e]), np.array([e_dot]), np.zeros(1), np.zeros(0))[0])


@dataclass(frozen=True)
class Motion:
    """A motion with σ = 1: first a numerical solution until it reaches the surface at the time `reached`, then the motion on
    the surface."""

    off_surface: Any
    reached: float
    e_reached: float
    end: float
    along: Any

    def at(self, t: Array) -> Array:
        """Returns e and e' at instants, (2, T)."""
        before = self.off_surface(np.minimum(t, self.reached))
        return np.where(t <= self.reached, before, self.along(np.maximum(t - self.reached, 0.0)))


def motion(gamma: float, beta: float, kappa: float, e: float, rate: float) -> Motion:
    """Returns the motion of ë = ν from the differential equation.  On s = 0, e' = -sig(β e)^(1/γ) has a closed solution:
    |e|^(1-1/γ) falls at the rate (1-1/γ) β^(1/γ)."""

    def on_it(_, y):
        return abs(y[0] + sig(y[1], gamma) / beta) - 1e-7

    def slope(_, y):
        s = y[0] + sig(y[1], gamma) / beta
        return [y[1], -beta / gamma * sig(y[1], 2 - gamma) - kappa * sig(s, 2 / gamma - 1)]

    on_it.terminal = True
    found = solve_ivp(
        slope, (0, 500), [e, rate], method="LSODA", rtol=1e-10, atol=1e-12, events=on_it, dense_output=True
    )
    assert found.status == 1
    reached, start = found.t[-1], found.y[0, -1]
    bend, pace = 1 - 1 / gamma, (1 - 1 / gamma) * beta ** (1 / gamma)

    def along(t):
        left = np.sign(start) * np.maximum(abs(start) ** bend - pace * t, 0.0) ** (1 / bend)
        return np.array([left, -sig(beta * left, 1 / gamma)])

    return Motion(found.sol, reached, start, reached + abs(start) ** bend / pace, along)


def sampled(law: TerminalSliding, at: Block, e: float, ticks: int, e_dot: float = 0.0, w: float = 0.0) -> Array:
    """Returns (e, ė, ν) of a point at each tick, (ticks, 3); its acceleration is ν plus the disturbance w."""
    T, path = at.period_s, []
    for _ in range(ticks):
        nu = answer(law, at, e, e_dot)
        path.append((e, e_dot, nu))
        e, e_dot = e + T * e_dot + T**2 / 2 * (nu + w), e_dot + T * (nu + w)
    return np.array(path)


@pytest.mark.parametrize(("gamma", "beta", "kappa"), PARAMETERS)
def test_sliding_variable_and_error_are_zero_after_finite_times(gamma, beta, kappa):
    """|s| falls at the rate that the law's docstring gives, and is zero before the error is.  At the end the error is zero, and
    so is that of the law's own loop with a short period."""
    found = motion(gamma, beta, kappa, 1.0, 0.0)
    assert 0 < found.reached < found.end
    assert found.e_reached > 5e-4
    t = np.linspace(0, found.reached, 4000)
    e, rate = found.at(t)
    s = e + sig(rate, gamma) / beta
    assert (np.diff(s) < 1e-9).all()
    pace = -kappa * gamma / beta * np.abs(rate) ** (gamma - 1) * sig(s, 2 / gamma - 1)
    inner = (t > 0.05 * t[-1]) & (t < 0.95 * t[-1])
    np.testing.assert_allclose(np.gradient(s, t)[inner], pace[inner], atol=2e-3 * np.abs(pace).max())
    T = found.end / 4000
    path = sampled(TerminalSliding(gamma=gamma, beta=beta, kappa=kappa), block(T=T, lead=1.0), 1.0, 4400)
    np.testing.assert_allclose(path[:4000, 0], found.at(np.arange(4000) * T)[0], atol=2e-3)
    assert np.abs(path[4200:, 0]).max() < 1e-7


@pytest.mark.parametrize(("gamma", "beta"), [(1.2, 1.0), (1.5, 2.0), (1.8, 0.5)])
def test_below_its_least_kappa_the_surface_is_not_reached_and_so_it_is_refused(gamma, beta):
    """A curve e' = -c e^(1/γ) with a smaller c than the surface's solves the equation of motion; motions cannot cross it."""
    for share in (0.5, 0.999):
        with pytest.raises(ValueError, match="else no surface is reached"):
            TerminalSliding(gamma=gamma, beta=beta, kappa=share * least(gamma, beta))
    TerminalSliding(gamma=gamma, beta=beta, kappa=1.001 * least(gamma, beta))
    kappa = 0.5 * least(gamma, beta)

    def miss(c):  # the residual of e'' = (c²/γ) e^(2/γ-1), divided by e^(2/γ-1)
        s = 1 - c**gamma / beta
        return c**2 / gamma - beta / gamma * c ** (2 - gamma) + kappa * s ** (2 / gamma - 1)

    c = np.geomspace(1e-6, 0.999, 4000) * beta ** (1 / gamma)
    assert np.flatnonzero(np.diff(np.sign(miss(c)))).size == 2
    kappa = 1.001 * least(gamma, beta)
    assert (miss(c) > 0).all()


@pytest.mark.parametrize(("gamma", "beta", "kappa"), PARAMETERS)
@pytest.mark.parametrize("start", [0.2, 3.0])
def test_time_on_the_surface_is_the_closed_form(gamma, beta, kappa, start):
    """From e_0 with e' = -(β e_0)^(1/γ) the law's own loop stays on the surface, and ends at the time of the closed form."""
    expected = gamma / (gamma - 1) * beta ** (-1 / gamma) * start ** (1 - 1 / gamma)
    law = TerminalSliding(gamma=gamma, beta=beta, kappa=kappa)
    T = expected / 3000
    path = sampled(law, block(T=T, lead=1.0), start, 3300, e_dot=-((beta * start) ** (1 / gamma)))
    s = path[:, 0] + sig(path[:, 1], gamma) / beta
    assert np.abs(s).max() < 1e-2 * start
    over = np.flatnonzero(np.abs(path[:, 0]) > 1e-9 * start)[-1]
    assert over * T < 1.05 * expected
    # |e|^(1-1/γ) falls at a constant rate, so at 90 % of the time a tenth of it is left.
    left = start * 0.1 ** (gamma / (gamma - 1))
    assert path[2700, 0] == pytest.approx(left, rel=0.05, abs=1e-4 * start)


@pytest.mark.parametrize(("gamma", "beta", "kappa"), PARAMETERS)
def test_times_are_in_proportion_to_a_power_of_the_start(gamma, beta, kappa):
    """The motion is homogeneous, so from rest at c^γ e_0 it takes c^(γ-1) times as long."""
    one, other = (motion(gamma, beta, kappa, start, 0.0) for start in (1.0, 5.0**gamma))
    assert other.end == pytest.approx(5.0 ** (gamma - 1) * one.end, rel=1e-4)
    t = np.linspace(0, 0.99 * one.end, 50)
    e, rate = one.at(t)
    np.testing.assert_allclose(other.at(5.0 ** (gamma - 1) * t), [5.0**gamma * e, 5.0 * rate], atol=2e-4 * 5.0**gamma)


def test_finite_against_exponential_in_numbers():
    """From rest at 1 m, times in units of σ: the linear law with K_f1 = K_f2 = 1 has an error long after that of terminal
    sliding is zero."""
    assert motion(1.5, 1.0, 1.0, 1.0, 0.0).end == pytest.approx(3.74, abs=0.01)

    def linear(t):  # e'' = -e' - e from (1, 0)
        w = np.sqrt(3) / 2
        return np.exp(-t / 2) * (np.cos(w * t) + np.sin(w * t) / np.sqrt(3))

    path = np.abs(sampled(TerminalSliding(), block(T=0.01, lead=1.0), 1.0, 1301)[:, 0])
    for t, slow, gone in ((4.0, 0.09, 1e-9), (8.0, 0.01, 1e-11), (13.0, 4e-4, 1e-12)):
        assert np.abs(linear(np.linspace(t, t + 3.7, 400))).max() > slow  # 3.7 is one oscillation
        assert path[round(100 * t)] < gone


@pytest.mark.slow
@pytest.mark.parametrize(("gamma", "beta", "kappa"), PARAMETERS[::3])
@pytest.mark.parametrize("w", [0.05, -0.3])
def test_the_error_under_a_constant_acceleration_is_the_closed_form(gamma, beta, kappa, w):
    sigma, law = 0.5, TerminalSliding(gamma=gamma, beta=beta, kappa=kappa)
    kept = np.sign(w) * (sigma**2 * abs(w) / kappa) ** (gamma / (2 - gamma))
    assert abs(kept) < 3
    at = block(sigma, 0.001)
    assert sampled(law, at, kept, 5000, w=w)[-2:, 0].mean() == pytest.approx(kept, rel=0.02, abs=1e-4)
    for start in (kept - 0.1, kept + 0.1):  # the error slowly approaches `kept`
        later = sampled(law, at, start, 20_000, w=w)[[9_999, -1], 0]
        assert np.abs(later - kept)[1] < 1e-4 + 0.9 * np.abs(later - kept)[0] < 0.1


@settings(derandomize=True, deadline=None, max_examples=200)
@given(numbers, numbers, st.sampled_from(PARAMETERS), st.sampled_from([0.0, 0.5, 1.0]), st.floats(0.05, 1.0))
def test_symmetric_and_scaled_by_its_time(e, e_dot, parameters, lead, sigma):
    """ν(-e, -ė) = -ν(e, ė).  For σ and the period σ T, ν(e, ė) is that for σ = 1 and T at (e, σ ė), divided by σ²."""
    law = TerminalSliding(**dict(zip(("gamma", "beta", "kappa"), parameters, strict=True)))
    at = block(sigma, 0.02 * sigma, lead)
    nu = answer(law, at, e, e_dot)
    assert answer(law, at, -e, -e_dot) == -nu
    assert nu == pytest.approx(answer(law, block(1.0, 0.02, lead), e, sigma * e_dot) / sigma**2, rel=1e-7, abs=1e-7)


@settings(derandomize=True, deadline=None, max_examples=300)
@given(numbers, numbers, st.sampled_from(PARAMETERS), st.sampled_from([0.25, 0.5, 1.0]), st.floats(0.001, 2.0))
def test_look_ahead_solves_its_equation(e, e_dot, parameters, lead, T):
    """The equation σ² η = f(e + h ė + h²/2 η, σ (ė + h η)) with σ = 1, solved by another root finder."""
    gamma, beta, kappa = parameters
    law, h = TerminalSliding(gamma=gamma, beta=beta, kappa=kappa), lead * T

    def miss(eta):
        ahead, rate = e + h * e_dot + h**2 / 2 * eta, e_dot + h * eta
        s = ahead + sig(rate, gamma) / beta
        return eta + beta / gamma * sig(rate, 2 - gamma) + kappa * sig(s, 2 / gamma - 1)

    expected = brentq(miss, -1e4, 1e4, xtol=1e-13, rtol=1e-14)
    assert answer(law, block(1.0, T, lead), e, e_dot) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(("gamma", "beta", "kappa"), PARAMETERS)
def test_the_remaining_motion_of_a_held_loop_is_the_closed_form(gamma, beta, kappa):
    """e = 0 at all ticks, while e' = ±a alternates.  This is a motion of the loop, and runs that reach it stay in it."""
    law, sigma, T = TerminalSliding(gamma=gamma, beta=beta, kappa=kappa), 0.5, 0.01
    a = (T / (2 * sigma) * (beta / gamma + kappa * beta ** (1 - 2 / gamma))) ** (1 / (gamma - 1))
    assert answer(law, block(sigma, T), 0.0, a / sigma) == pytest.approx(-2 * a / (T * sigma), rel=1e-9)
    if gamma == 1.5:
        path = sampled(law, block(sigma, T), 0.3, 3000)[-100:]
        assert np.abs(path[:, 0]).max() < 1e-9
        np.testing.assert_allclose(np.abs(path[:, 1]), a / sigma, rtol=1e-6)
        np.testing.assert_allclose(path[1:, 1], -path[:-1, 1], rtol=1e-6)


def test_look_ahead_takes_the_chatter_away():
    law = TerminalSliding()
    paths = {lead: np.abs(sampled(law, block(0.5, 0.01, lead), 0.3, 3000)[-100:]).max(axis=0) for lead in (0, 0.5, 1)}
    assert paths[0.5][2] / paths[0][2] == pytest.approx(0.25, abs=0.01)
    assert paths[1][2] < 1e-6 * paths[0][2]


def test_runs_tend_to_the_continuous_motion_as_the_period_falls():
    """Two robots with the paper's plant; shape and centroid have different time scales.  Each number is compared with its own
    motion."""
    off = []
    for period in (0.04, 0.02, 0.01):
        table = scenario(
            (None, None),
            np.random.default_rng(2),
            duration=2.0,
            periods={"acceleration": period, "torque": 0.0005},
            law={
                "use": "terminal_sliding",
                "epsilon": [0.5],
                "parameters": {"gamma": 1.4, "beta": 0.8, "kappa": 1.0},
                "lead": 0.5,
            },
            trajectory={"kind": "line", "velocity": (0.5, 0.0)},
            robot=ROBOT | {"mass": 3.0},
        )
        plan = plan_of(table)
        blocks = block_series(trace_of(plan))
        worst = 0.0
        for series in blocks.series:
            sigma = series.block.sigma
            for at in range(series.block.size):
                start, rate = series.error[0, at], series.error_rate[0, at] * sigma
                expected = motion(1.4, 0.8, 1.0, start, rate).at(blocks.seconds / sigma)[0]
                worst = max(worst, np.abs(series.error[:, at] - expected).max())
        off.append(worst)
    assert off[0] < 0.02
    assert off[0] / off[1] > 1.8
    assert off[1] / off[2] > 1.8


def test_terminal_sliding_does_not_use_the_gains_of_the_scenario():
    law = REGISTRY.make("laws", "terminal_sliding", {}, Path()).made
    assert law.uses == {"lead"}
    changed = replace(block(), K_1=5 * np.eye(1), K_2=7 * np.eye(1))
    assert answer(law, changed, 0.3, 0.1) == answer(law, block(), 0.3, 0.1)


def test_overflowing_inputs_give_nan():
    law = TerminalSliding()
    for lead in (0.0, 1.0):
        for e in (np.nan, 1e300):
            assert not np.isfinite(answer(law, block(lead=lead), e, 1e300))
