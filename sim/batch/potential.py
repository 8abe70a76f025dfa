"""Pairs of robots that are near: collision avoidance (controller.potential, as arrays).

Pairs are found along one axis.  Robots are kept in the order of their coordinate; from each robot on, those within reach follow
one another.  From one instant to the next the order hardly changes, so sorting by insertion costs little more than one
comparison for each robot.
"""

from math import sqrt
from typing import Any, Final

from echelon.sim.batch.compiled import fused

_FEW: Final = 16


@fused
def sort_along(count: int, positions: int, order: int, real: Any, whole: Any) -> int:
    """Sorts the numbers of `count` robots, from `order` on in `whole`, along the axis on which they are spread; returns the
    axis, 0 or 1.  The axis, which follows the numbers, changes only if the spread along the other is twice as large.

    A few robots stay as they are: to look at all their pairs costs less.  Then it returns -1, and their order need not be
    read: it is 0 to `count` - 1."""
    if count <= _FEW:
        return -1
    low_x = high_x = real[positions]
    low_y = high_y = real[positions + 1]
    for robot in range(1, count):
        x, y = real[positions + 2 * robot], real[positions + 2 * robot + 1]
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
    axis = whole[order + count]
    if axis == 0 and high_y - low_y > 2 * (high_x - low_x):
        axis = 1
    elif axis == 1 and high_x - low_x > 2 * (high_y - low_y):
        axis = 0
    whole[order + count] = axis
    for place in range(1, count):
        robot = whole[order + place]
        along = real[positions + 2 * robot + axis]
        free = place
        while free > 0 and real[positions + 2 * whole[order + free - 1] + axis] > along:
            whole[order + free] = whole[order + free - 1]
            free -= 1
        whole[order + free] = robot
    return int(axis)


@fused
def add_pair_forces(node: Any, run: Any, index: Any, real: Any, whole: Any) -> None:
    """Adds ∇f of all pairs of robots below different children of a node to the forces on its robots."""
    positions, forces, order = node.state_at + node.positions, node.forces_at, node.order_at
    reach = run.sensing_radius
    axis = sort_along(node.robots, positions, order, real, whole)
    for place in range(node.robots - 1):
        one = place if axis < 0 else whole[order + place]
        x, y = real[positions + 2 * one], real[positions + 2 * one + 1]
        last = x + reach if axis == 0 else y + reach
        child = index[node.child_of_at + one]
        for later in range(place + 1, node.robots):
            other = later if axis < 0 else whole[order + later]
            if axis >= 0 and real[positions + 2 * other + axis] > last:
                break
            dx, dy = x - real[positions + 2 * other], y - real[positions + 2 * other + 1]
            q = dx * dx + dy * dy
            if q < reach * reach and index[node.child_of_at + other] != child:
                fx, fy = _force(run, dx, dy, q)
                if one > other and q == 0.0:
                    fx = -fx  # without a direction the first robot is pushed along x
                real[forces + 2 * one] += fx
                real[forces + 2 * one + 1] += fy
                real[forces + 2 * other] -= fx
                real[forces + 2 * other + 1] -= fy


@fused
def _force(run: Any, dx: float, dy: float, q: float) -> tuple[float, float]:
    """Returns the force on the first of two robots that are (dx, dy) apart, √q within the sensing radius."""
    sensing, avoidance = run.sensing_radius * run.sensing_radius, run.avoidance_radius * run.avoidance_radius
    gap, distance = q - avoidance, sqrt(q)
    push = run.force_limit
    if gap > 0.0:
        push = min(4 * distance * (sensing - q) * (sensing - avoidance) / (gap * gap * gap), push)
    if distance > 0.0:
        return push * (dx / distance), push * (dy / distance)
    return push, 0.0
