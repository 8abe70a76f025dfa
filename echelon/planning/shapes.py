"""Named shapes: positions of a node's children relative to each other [m], so that a scenario need not list them."""

from math import cos, pi, radians, sin, sqrt

Point = tuple[float, float]


def triangle(side: float) -> list[Point]:
    """Returns an equilateral triangle: the base from left to right, then the apex above it (the paper's Fig. 1)."""
    return [(-side / 2, 0.0), (side / 2, 0.0), (0.0, side * sqrt(3) / 2)]


def polygon(count: int, side: float) -> list[Point]:
    """Returns a regular polygon with `count` corners, the first on the positive x axis, counter-clockwise."""
    if count < 2:
        return [(0.0, 0.0)] * count
    radius = side / (2 * sin(pi / count))
    return [(radius * cos(2 * pi * k / count), radius * sin(2 * pi * k / count)) for k in range(count)]


def line(count: int, spacing: float) -> list[Point]:
    """Returns a row along the y axis, the first child at the positive end: side by side for travel along x."""
    return [(0.0, spacing * ((count - 1) / 2 - k)) for k in range(count)]


def column(count: int, spacing: float) -> list[Point]:
    """Returns a column along the x axis, the first child in front."""
    return [(-spacing * k, 0.0) for k in range(count)]


def wedge(count: int, spacing: float, angle: float) -> list[Point]:
    """Returns a V open to the rear.  The first child is in front; the others alternate between the left and the right arm, each
    at a distance of `spacing` from the one before it in its arm.  `angle` is the angle between the arms [rad]."""
    points = [(0.0, 0.0)]
    for k in range(1, count):
        along = spacing * ((k + 1) // 2)
        points.append((-along * cos(angle / 2), along * sin(angle / 2) * (1 if k % 2 else -1)))
    return points[:count]


def rotated(points: list[Point], degrees: float) -> list[Point]:
    """Returns the points turned counter-clockwise about the origin by an angle [°]."""
    if degrees == 0.0:
        return points
    c, s = cos(radians(degrees)), sin(radians(degrees))
    return [(c * x - s * y, s * x + c * y) for x, y in points]
