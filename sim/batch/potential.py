"""Collision avoidance (controller.potential, as arrays)."""

from math import sqrt
from typing import Any

from echelon.sim.batch.compiled import fused


@fused
def add_pair_forces(node: Any, run: Any, index: Any, real: Any) -> None:
    """Adds ∇f of all pairs of robots below different children of a node to the forces on its robots."""
    positions, forces = node.state_at + node.positions, node.forces_at
    sensing = run.sensing_radius * run.sensing_radius
    last = index[node.bounds_at + node.count]
    for child in range(node.count - 1):
        first_other = index[node.bounds_at + child + 1]
        for one in range(index[node.bounds_at + child], first_other):
            x, y = real[positions + 2 * one], real[positions + 2 * one + 1]
            for other in range(first_other, last):
                dx, dy = x - real[positions + 2 * other], y - real[positions + 2 * other + 1]
                q = dx * dx + dy * dy
                if q < sensing:
                    fx, fy = _force(run, dx, dy, q)
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
