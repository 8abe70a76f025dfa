"""The avoidance force against finite differences of the potential, and properties of any force between pairs."""

from dataclasses import replace

import numpy as np
import pytest

from echelon.controller.potential import PairForces, pairs_between, potential
from echelon.plan.plan import Array, AvoidancePlan

PLAN = AvoidancePlan(True, avoidance_radius=0.5, sensing_radius=3.0, force_limit=1e12)
ROBOTS = 7


def forces(plan: AvoidancePlan = PLAN, robots: int = ROBOTS) -> PairForces:
    return PairForces(*pairs_between([range(i, i + 1) for i in range(robots)]), robots, plan)


def pair(distance: float, plan: AvoidancePlan = PLAN, angle: float = 0.7) -> Array:
    """Returns the force on the first of two robots at a distance; the line from the second to the first has the angle
    `angle`."""
    away = np.array([np.cos(angle), np.sin(angle)])
    found = forces(plan, 2)(np.array([distance * away, (0.0, 0.0)]))
    assert found is not None
    np.testing.assert_allclose(found[0], -found[1], rtol=1e-12)
    np.testing.assert_allclose(found[0] - (found[0] @ away) * away, 0, atol=1e-9 * (1 + np.abs(found).max()))
    return found[0] @ away


def configurations(count: int = 20):
    """Yields positions of robots: many pairs are within the sensing radius, none within 1.2 r_a."""
    random = np.random.default_rng(7)
    found = 0
    while found < count:
        x = random.uniform(-2.5, 2.5, (ROBOTS, 2))
        s = distances(x)
        if s.min() > 1.2 * PLAN.avoidance_radius and np.abs(s - PLAN.sensing_radius).min() > 1e-3:
            found += 1
            yield x


def distances(x: Array) -> Array:
    i, j = np.triu_indices(len(x), 1)
    return np.hypot(*(x[i] - x[j]).T)


def energy(x: Array) -> float:
    return float(potential(distances(x), PLAN).sum())


def test_potential_is_the_formula_of_the_paper():
    for s in (0.51, 0.6, 1.0, 2.0, 2.999, 3.0, 3.001, 50.0):
        assert potential(np.array(s), PLAN) == pytest.approx(min(0.0, (s**2 - 9) / (s**2 - 0.25)) ** 2)
    np.testing.assert_array_equal(potential(np.array([0.5, 0.49, 0.1, 0.0]), PLAN), 0)
    assert potential(np.array(0.5 + 1e-6), PLAN) > 1e13


def test_force_is_minus_the_gradient_of_all_pairs_potential():
    h = 1e-6
    for x in configurations():
        found = forces()(x)
        gradient = np.zeros_like(x)
        for at in np.ndindex(x.shape):
            step = np.zeros_like(x)
            step[at] = h
            gradient[at] = (energy(x + step) - energy(x - step)) / (2 * h)
        np.testing.assert_allclose(found, -gradient, rtol=1e-6, atol=1e-6)
        assert np.abs(found).max() > 1


def test_forces_of_all_pairs_have_no_sum_and_no_moment():
    for x in configurations():
        found = forces()(x)
        scale = np.abs(found).max()
        np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-13 * scale)
        assert abs((x[:, 0] * found[:, 1] - x[:, 1] * found[:, 0]).sum()) < 1e-12 * scale


@pytest.mark.parametrize("distance", [0.01, 0.3, 0.5, 0.501, 0.7, 1.5, 2.9])
def test_pairs_are_pushed_apart(distance):
    assert pair(distance, replace(PLAN, force_limit=40.0)) > 0


def test_nearer_pushes_harder():
    pushes = [pair(s) for s in np.linspace(0.52, 2.99, 60)]
    assert (np.diff(pushes) < 0).all()


def test_nothing_beyond_the_sensing_radius():
    assert forces(robots=2)(np.array([(0.0, 0.0), (3.0, 0.0)])) is None
    assert forces(robots=2)(np.array([(0.0, 0.0), (3.0 - 1e-9, 0.0)])) is not None
    assert 0 < pair(3.0 - 1e-6) < 1e-4
    far = forces(robots=3)(np.array([(0.0, 0.0), (1.0, 0.0), (50.0, 0.0)]))
    np.testing.assert_array_equal(far[2], 0)
    assert far[0, 0] < 0 < far[1, 0]


def test_the_force_is_capped_outside_and_equals_the_cap_inside():
    plan = replace(PLAN, force_limit=40.0)
    for s in (1e-9, 0.1, 0.4999, 0.5, 0.5 + 1e-9, 0.51):
        assert pair(s, plan) == pytest.approx(40.0)
    for s in (1.9, 2.4, 2.9):
        assert pair(s, plan) == pair(s) < 40


def test_coincident_robots_part():
    plan = replace(PLAN, force_limit=40.0)
    found = forces(plan, 3)(np.array([(1.0, 1.0), (1.0, 1.0), (30.0, 0.0)]))
    np.testing.assert_allclose(found, [(40, 0), (-40, 0), (0, 0)])


def test_pairs_between_groups_are_those_of_different_groups_once():
    first, second = pairs_between([range(0, 2), range(2, 3), range(3, 5)])
    expected = {(0, 2), (0, 3), (0, 4), (1, 2), (1, 3), (1, 4), (2, 3), (2, 4)}
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    assert set(pairs) == expected
    assert len(pairs) == len(expected)
    assert forces(robots=1)(np.zeros((1, 2))) is None


def test_pairs_of_one_group_have_no_force():
    of_groups = PairForces(*pairs_between([range(0, 2), range(2, 3)]), 3, PLAN)
    x = np.array([(0.0, 0.0), (1.0, 0.0), (0.5, 1.5)])
    within = forces(robots=2)(x[:2])
    found = of_groups(x)
    np.testing.assert_allclose(found[:2] + within, forces(robots=3)(x)[:2], rtol=1e-12)
