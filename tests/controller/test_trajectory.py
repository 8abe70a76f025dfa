"""Trajectories: derivatives against finite differences, waypoints at rest, minimum jerk against numerical minimisation."""

import numpy as np
import pytest
from scipy.optimize import minimize

from echelon.controller.trajectory import TRAJECTORIES, sample

KINDS = {
    "line": {"start": (1.0, -2.0), "velocity": (0.3, -0.7)},
    "circle": {"centre": (1.0, 2.0), "radius": 1.5, "rate": -0.7, "phase": 0.4},
    "sine": {"start": (-1.0, 3.0), "speed": 1.2, "amplitude": 3.0, "rate": 0.8},
    "waypoints": {"points": ((0.0, 0.0), (4.0, -2.0), (1.0, 1.0)), "times": (0.5, 2.0, 5.0)},
}
POINTS, TIMES = np.array(KINDS["waypoints"]["points"]), KINDS["waypoints"]["times"]


def made(kind: str):
    return TRAJECTORIES[kind](**KINDS[kind])


def test_all_kinds_are_tested():
    assert KINDS.keys() == TRAJECTORIES.keys()


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_the_position(kind):
    trajectory, h = made(kind), 1e-5
    for t in np.linspace(0.013, 6.013, 61):
        before, now, after = (trajectory.at(float(t + k * h)) for k in (-1, 0, 1))
        np.testing.assert_allclose(now[1], (after[0] - before[0]) / (2 * h), atol=3e-8)
        np.testing.assert_allclose(now[2], (after[1] - before[1]) / (2 * h), atol=3e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_sample_agrees_with_single_instants(kind):
    trajectory, times = made(kind), np.array([0.0, 0.7, 3.0])
    many = sample(trajectory, times)
    assert many.shape == (3, 3, 2)
    for at, t in enumerate(times):
        np.testing.assert_array_equal(many[at], trajectory.at(float(t)))
    assert sample(trajectory, times[:0]).shape == (0, 3, 2)


def test_positions_are_those_of_the_formulas():
    np.testing.assert_allclose(made("line").at(2.0)[0], (1.6, -3.4))
    t = 2.0
    np.testing.assert_allclose(made("circle").at(t)[0], (1 + 1.5 * np.cos(-1.0), 2 + 1.5 * np.sin(-1.0)))
    np.testing.assert_allclose(made("sine").at(t)[0], (-1 + 2.4, 3 + 3 * np.sin(1.6)))


def test_paper_trajectory():
    parameters = {"start": (0.0, 0.0), "speed": 1.0, "amplitude": 30.0, "rate": 0.1}
    paper = TRAJECTORIES["sine"](**parameters)
    for t in (0.0, 3.0, 11.0):
        np.testing.assert_allclose(paper.at(t)[0], (t, 30 * np.sin(0.1 * t)))


def test_waypoints_are_met_at_rest():
    trajectory = made("waypoints")
    for point, t in zip(POINTS, TIMES, strict=True):
        np.testing.assert_allclose(trajectory.at(t), [point, (0, 0), (0, 0)], atol=1e-12)


@pytest.mark.parametrize(("t", "point"), [(-1.0, 0), (0.0, 0), (0.4999, 0), (5.0001, 2), (1e6, 2)])
def test_waypoints_rest_before_and_after(t, point):
    np.testing.assert_array_equal(made("waypoints").at(t), [POINTS[point], (0, 0), (0, 0)])


def test_waypoints_go_straight_and_never_back():
    for leg, (q, p) in enumerate(zip(POINTS, POINTS[1:], strict=False)):
        times = np.linspace(TIMES[leg], TIMES[leg + 1], 201)
        places = sample(made("waypoints"), times)[:, 0]
        along = (places - q) @ (p - q) / ((p - q) @ (p - q))
        assert (np.diff(along) >= 0).all()
        assert along[[0, -1]] == pytest.approx([0, 1], abs=1e-12)
        np.testing.assert_allclose(places, q + along[:, None] * (p - q), atol=1e-12)


def test_a_leg_has_least_jerk():
    """Of all polynomials of degree 9 from rest to rest, ours has the smallest ∫ jerk², which is 720 for a unit leg."""
    trajectory = TRAJECTORIES["waypoints"](points=[(0.0, 0.0), (1.0, 0.0)], times=[0.0, 1.0])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    nodes, weights = (nodes + 1) / 2, weights / 2

    def position(free):
        """Returns the polynomial of s³ to s⁹: `free` are coefficients of s⁶ to s⁹; the others follow from the conditions at
        s = 1."""
        high = np.array([*free])
        powers = np.arange(6, 6 + len(high))
        known = np.array([1 - high.sum(), -(high * powers).sum(), -(high * powers * (powers - 1)).sum()])
        low = np.linalg.solve([[1, 1, 1], [3, 4, 5], [6, 12, 20]], known)
        return np.polynomial.Polynomial([0, 0, 0, *low, *high])

    def cost(free):
        return float(weights @ position(free).deriv(3)(nodes) ** 2)

    best = minimize(cost, [0.5, -0.3, 0.2, 0.1], method="BFGS", options={"gtol": 1e-9})
    assert best.fun == pytest.approx(720, rel=1e-8)
    times = np.linspace(0, 1, 21)
    np.testing.assert_allclose(sample(trajectory, times)[:, 0, 0], position(best.x)(times), atol=1e-6)
