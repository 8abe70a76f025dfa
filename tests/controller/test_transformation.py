"""The centroid-based transformation against the paper's matrix, its definitions and its invariants."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.controller.transformation import Transformation, desired_shape, node_matrix, subtree_robots
from echelon.plan.plan import Array, ShapePlan
from echelon.sim.parts.loading import load
from support.synthetic import PAPER
from support.trees import PAPER_TREE, Tree, plan_of, scenario, trees

WEIGHTS = st.lists(st.integers(1, 30), min_size=1, max_size=12)
SEEDS = st.integers(0, 2**32 - 1)
SETTINGS = settings(derandomize=True, deadline=None, max_examples=60)


@SETTINGS
@given(WEIGHTS)
def test_node_matrix_is_invertible(weights):
    phi = node_matrix(weights)
    assert np.linalg.matrix_rank(phi) == len(weights)
    np.testing.assert_allclose(phi @ np.linalg.inv(phi), np.eye(len(weights)), atol=1e-12)


@SETTINGS
@given(WEIGHTS, SEEDS)
def test_rows_are_their_definitions(weights, seed):
    x = np.random.default_rng(seed).normal(size=(len(weights), 2), scale=10)
    z = node_matrix(weights) @ x
    np.testing.assert_allclose(z[-1], np.average(x, axis=0, weights=weights), atol=1e-12)
    for k in range(1, len(weights)):
        expected = (x[0] - x[1]) / sqrt(2) if k == 1 else x[k] - np.average(x[:k], axis=0, weights=weights[:k])
        np.testing.assert_allclose(z[k - 1], expected, atol=1e-12)


@pytest.mark.parametrize("weights", [[], [0], [1, -1], [2, 0, 1]])
def test_node_matrix_refuses_wrong_weights(weights):
    with pytest.raises(ValueError, match="positive weight"):
        node_matrix(weights)


def paper_matrix() -> Array:
    """Returns Φ_M of the paper's section IV as printed: rows z_11, z_12, z_21, z_22, z_31, z_32, z_r1, z_r2, z_c."""
    a, h, t = 1 / sqrt(2), 1 / 2, 1 / 3
    mu_1, mu_2, mu_3 = np.repeat(np.eye(3), 3, axis=1) * t
    return np.array(
        [
            [-a, a, 0, 0, 0, 0, 0, 0, 0],
            [-h, -h, 1, 0, 0, 0, 0, 0, 0],
            [0, 0, 0, a, -a, 0, 0, 0, 0],
            [0, 0, 0, -h, -h, 1, 0, 0, 0],
            [0, 0, 0, 0, 0, 0, a, -a, 0],
            [0, 0, 0, 0, 0, 0, -h, -h, 1],
            a * (mu_1 - mu_2),
            mu_3 - h * (mu_1 + mu_2),
            np.full(9, 1 / 9),
        ]
    )


def test_nine_robots_give_the_matrix_of_the_paper():
    _, plan = load(PAPER)
    assert [robot.path for robot in plan.robots[:3]] == ["g1/r2", "g1/r1", "g1/r3"]
    in_order = [1, 0, 2, *range(3, 9)]
    np.testing.assert_allclose(Transformation(plan).matrix, paper_matrix()[:, in_order], atol=1e-15)


def test_desired_shape_of_the_paper():
    _, plan = load(PAPER)
    given = [(-4.9497, 0), (0, 6.0622)] * 3 + [(-14.1421, 0), (0, 17.3205)]
    np.testing.assert_allclose(Transformation(plan).desired_shape, given, atol=5e-5)


def test_desired_shape_is_that_of_the_points_or_as_given():
    points = ((1.0, 2.0), (3.0, -1.0), (0.0, 5.0))
    expected = [((1 - 3) / sqrt(2), 3 / sqrt(2)), (0 - (2 * 1 + 1 * 3) / 3, 5 - (2 * 2 + 1 * -1) / 3)]
    np.testing.assert_allclose(desired_shape(ShapePlan("points", points), (2, 1, 4)), expected, atol=1e-15)
    np.testing.assert_array_equal(desired_shape(ShapePlan("vectors", points[:2]), (2, 1, 4)), points[:2])
    assert desired_shape(ShapePlan("points", ((0.0, 0.0),)), (3,)).shape == (0, 2)


def walked(tree: Tree, x: Array, first: int = 0) -> tuple[list[Array], Array, int]:
    """Returns the shape variables of a tree in the order of blocks, its centroid and its number of robots, by walking it."""
    rows: list[Array] = []
    at, places, weights = first, [], []
    for child in sorted(tree, key=lambda child: child is not None):
        if child is None:
            places.append(x[at])
            weights.append(1)
        else:
            below, centroid, count = walked(child, x, at)
            rows += below
            places.append(centroid)
            weights.append(count)
        at += weights[-1]
    z = node_matrix(weights) @ np.array(places)
    return [*rows, *z[:-1]], z[-1], sum(weights)


@SETTINGS
@given(trees(), SEEDS)
def test_whole_matrix_is_the_composition_of_its_nodes(tree, seed):
    random = np.random.default_rng(seed)
    cbt = Transformation(plan_of(scenario(tree, random)))
    x = random.normal(size=(len(cbt.matrix), 2), scale=10)
    rows, centroid, _ = walked(tree, x)
    np.testing.assert_allclose(cbt.forward(x), [*rows, centroid], atol=1e-12)
    np.testing.assert_allclose(centroid, x.mean(axis=0), atol=1e-12)


@SETTINGS
@given(trees(), SEEDS)
def test_backward_undoes_forward_for_one_and_for_many(tree, seed):
    random = np.random.default_rng(seed)
    cbt = Transformation(plan_of(scenario(tree, random)))
    x = random.normal(size=(5, len(cbt.matrix), 2), scale=10)
    z = cbt.forward(x)
    np.testing.assert_allclose(z[2], cbt.forward(x[2]), atol=1e-13)
    np.testing.assert_allclose(cbt.backward(z), x, atol=1e-11)
    np.testing.assert_allclose(cbt.forward(cbt.backward(x)), x, atol=1e-11)


@SETTINGS
@given(trees(), SEEDS)
def test_shape_variables_do_not_depend_on_the_place_of_the_formation(tree, seed):
    random = np.random.default_rng(seed)
    cbt = Transformation(plan_of(scenario(tree, random)))
    x, shift = random.normal(size=(len(cbt.matrix), 2), scale=10), np.array([123.0, -45.0])
    difference = cbt.forward(x + shift) - cbt.forward(x)
    np.testing.assert_allclose(difference[:-1], 0, atol=1e-11)
    np.testing.assert_allclose(difference[-1], shift, atol=1e-11)


def test_desired_stacks_shape_and_centroid_for_any_number_of_instants():
    cbt = Transformation(plan_of(scenario(PAPER_TREE, np.random.default_rng(1))))
    centroids = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    many = cbt.desired(centroids)
    assert many.shape == (3, 9, 2)
    np.testing.assert_array_equal(many[1], cbt.desired(centroids[1]))
    np.testing.assert_array_equal(many[:, -1], centroids)
    np.testing.assert_array_equal(many[2, :-1], cbt.desired_shape)


@SETTINGS
@given(trees())
def test_robots_below_a_node_are_those_whose_parents_lead_to_it(tree):
    plan = plan_of(scenario(tree, np.random.default_rng(1)))
    for node in plan.nodes:
        below = []
        for robot in plan.robots:
            above: int | None = robot.parent
            while above is not None and above != node.index:
                above = plan.formation[above].parent
            if above == node.index:
                below.append(robot.index)
        assert list(subtree_robots(plan, node)) == below
