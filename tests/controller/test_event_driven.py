"""Event-driven nodes and robots: the textbook's loop with a delay below the period, the map against runs of points, and the
boundaries of the delay."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import LinearRun, later
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.messages import Channel
from support.growth import single
from support.points import at_rest, growth_of_points, point_run, time_driven

MS = 1_000_000


def textbook_radius(T: float, tau: float, K1: float, K2: float) -> float:
    """Returns the spectral radius of a double integrator under u = -K1 p - K2 v with a delay 0 < τ < T (Åström, Wittenmark):
    x⁺ = Φ x + Γ₁ u₋₁ + Γ₀ u, where Γ₁ acts over the first τ of the period and Γ₀ over the rest."""
    a, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])

    def held(h: float) -> tuple[np.ndarray, np.ndarray]:
        phi, gamma, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), h, method="zoh")
        return phi, gamma

    phi, _ = held(T)
    rest, gamma_0 = held(T - tau)
    gamma_1 = rest @ held(tau)[1]
    K = np.array([[K1, K2]])
    whole = np.block([[phi - gamma_0 @ K, gamma_1], [-K, np.zeros((1, 1))]])
    return float(np.abs(np.linalg.eigvals(whole)).max())


@pytest.mark.parametrize("channel", [Channel.STATE, Channel.COMMAND])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.77, 0.999])
@pytest.mark.parametrize("T", [0.1, 0.6])
def test_one_robot_with_a_delay_below_its_period_is_the_textbooks_loop(T, share, channel):
    plan, tau_ns = single(T), round(share * T * 1e9)
    found = spectral_radius(LinearRun(later(plan, channel, tau_ns)).map())
    assert found == pytest.approx(textbook_radius(T, tau_ns * 1e-9, 1.0, 1.0), rel=1e-9)


def test_a_run_of_points_is_the_textbooks_loop_to_rounding(monkeypatch):
    """Position and velocity at each instant, from the same start, with a state that is 0.3 periods late."""
    T, tau = 0.5, 0.15
    plan = at_rest(later(single(T), Channel.STATE, round(tau * 1e9)))
    plan = replace(plan, robots=(replace(plan.robots[0], start=(1.0, -2.0)),))
    found = point_run(plan, 40, monkeypatch)
    x, u = np.array([[1.0, -2.0], [0.0, 0.0]]), np.zeros(2)
    for row in found:
        assert row == pytest.approx(np.concatenate([x[0], T * x[1]]), abs=1e-12)
        state = x  # what the node uses 0.15 s later
        x = np.array([x[0] + tau * x[1] + tau**2 / 2 * u, x[1] + tau * u])
        u = -(state[0] + state[1])
        rest = T - tau
        x = np.array([x[0] + rest * x[1] + rest**2 / 2 * u, x[1] + rest * u])


def test_one_block_of_gains_4_and_2_bears_a_state_0_3424_s_old():
    """docs/architecture.md, 4.6: T = 50 ms, lead 0.5; in continuous time it would be 0.3556 s."""
    plan = single(0.05, lead=0.5, k1=4.0, k2=2.0)
    found = largest_extra_delay(plan, Channel.STATE)
    assert found.seconds == pytest.approx(0.3424, abs=1e-4)
    timed = largest_extra_delay(time_driven(plan), Channel.STATE)
    assert timed.seconds == pytest.approx(0.3, abs=1e-9)


def test_points_begin_to_grow_where_the_boundary_is(monkeypatch):
    plan = at_rest(single(0.2, k1=4.0, k2=2.0))
    seconds = largest_extra_delay(plan, Channel.COMMAND).seconds
    assert seconds is not None
    for share, grows in ((0.99, False), (1.01, True)):
        late = later(plan, Channel.COMMAND, round(share * seconds * 1e9))
        assert (growth_of_points(late, 1500, monkeypatch) > 0) == grows


@pytest.mark.parametrize("extra_ns", [1, 5 * MS, 10 * MS])
def test_time_driven_nodes_take_any_delay_for_a_whole_period(extra_ns):
    plan = time_driven(single(0.01))
    found = spectral_radius(LinearRun(later(plan, Channel.STATE, extra_ns)).map())
    assert found == spectral_radius(LinearRun(later(plan, Channel.STATE, 10 * MS)).map())
