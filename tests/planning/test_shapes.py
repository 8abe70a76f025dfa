from itertools import combinations, pairwise
from math import cos, dist, hypot, pi, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.planning.shapes import column, line, polygon, rotated, triangle, wedge
from support.shape_variables import variables

counts = st.integers(1, 40)
lengths = st.floats(1e-3, 1e3)


@given(lengths)
def test_triangle_has_equal_sides(side):
    assert [dist(one, other) for one, other in combinations(triangle(side), 2)] == pytest.approx([side] * 3)


@pytest.mark.parametrize(
    ("side", "vectors"),
    [(7, [(-4.9497, 0), (0, 6.0622)]), (20, [(-14.1421, 0), (0, 17.3205)])],
)
def test_triangle_gives_the_papers_vectors(side, vectors):
    for found, wanted in zip(variables(triangle(side)), vectors, strict=True):
        assert found == pytest.approx(wanted, abs=5e-5)


@given(st.integers(2, 40), lengths)
def test_polygon_has_equal_sides_and_radii_and_turns_left(count, side):
    points = polygon(count, side)
    ring = [*points, points[0]]
    assert [dist(one, other) for one, other in pairwise(ring)] == pytest.approx([side] * count)
    assert [hypot(*point) for point in points] == pytest.approx([hypot(*points[0])] * count)
    assert points[0][0] > 0
    assert points[0][1] == 0
    if count > 2:
        area = sum(ax * by - bx * ay for (ax, ay), (bx, by) in pairwise(ring)) / 2
        circumradius = side / (2 * sin(pi / count))
        assert area == pytest.approx(count / 2 * circumradius**2 * sin(2 * pi / count))


def test_polygon_of_one_is_a_point():
    assert polygon(1, 3.0) == [(0.0, 0.0)]


@given(counts, lengths)
def test_line_is_side_by_side_from_left_to_right(count, spacing):
    points = line(count, spacing)
    assert [x for x, _ in points] == [0.0] * count
    assert [one[1] - other[1] for one, other in pairwise(points)] == pytest.approx([spacing] * (count - 1))
    assert sum(y for _, y in points) == pytest.approx(0, abs=spacing * 1e-9)


@given(counts, lengths)
def test_column_is_one_behind_the_other(count, spacing):
    points = column(count, spacing)
    assert [y for _, y in points] == [0.0] * count
    assert [one[0] - other[0] for one, other in pairwise(points)] == pytest.approx([spacing] * (count - 1))


@given(counts, lengths, st.floats(0.1, pi - 0.1))
def test_wedge_opens_to_the_rear(count, spacing, angle):
    points = wedge(count, spacing, angle)
    assert len(points) == count
    assert points[0] == (0.0, 0.0)
    for arm, side in ((points[1::2], 1), (points[2::2], -1)):
        steps = list(pairwise([points[0], *arm]))
        assert [dist(*step) for step in steps] == pytest.approx([spacing] * len(arm))
        assert all(x < 0 and side * y > 0 for x, y in arm)
    if count >= 3:
        (ax, ay), (bx, by) = points[1:3]
        assert (ax * bx + ay * by) / spacing**2 == pytest.approx(cos(angle))


@given(st.lists(st.tuples(st.floats(-10, 10), st.floats(-10, 10)), max_size=6), st.floats(-720, 720))
def test_rotation_keeps_distances_and_turns_left(points, degrees):
    turned = rotated(points, degrees)
    for (one, other), (before, after) in zip(combinations(turned, 2), combinations(points, 2), strict=True):
        assert dist(one, other) == pytest.approx(dist(before, after), abs=1e-9)
    back = rotated(turned, -degrees)
    assert [number for point in back for number in point] == pytest.approx(
        [number for point in points for number in point], abs=1e-9
    )


def test_rotation_by_a_right_angle():
    (point,) = rotated([(2.0, 0.0)], 90)
    assert point == pytest.approx((0, 2))
