"""Collision avoidance (labels potf, pforce, tp; docs/architecture.md, 2.6).

For two robots at distance s, with the avoidance radius r_a smaller than the sensing radius R_s:

    V = ( min{0, (s² - R_s²)/(s² - r_a²)} )²        ∇f_i = -Σ_j ∂V_ij/∂p_i

V grows without bound as s falls to r_a, and is zero beyond R_s.  ∇f_i pushes robot i away from robot j.  With q = s²:

    -∂V/∂p_i = -2 (p_i - p_j) dV/dq,   dV/dq = 2 (q - R_s²)/(q - r_a²) · (R_s² - r_a²)/(q - r_a²)²   for r_a² < q < R_s²

At and within r_a the paper's formula is zero again, so it would not separate robots that are too close.  Here the pair is
pushed apart with `force_limit` in this case.  `force_limit` also bounds ∇f outside r_a, because a sampled controller needs a
finite slope.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import Array, AvoidancePlan

LARGEST: Final = 2_000_000
"""Largest number of pairs times robots up to which a matrix gives the differences of all pairs"""


def potential(distance: Array, plan: AvoidancePlan) -> Array:
    """Returns V for an array of distances [m] of any shape, as in the paper (label potf): also zero at and within r_a."""
    q = np.asarray(distance, dtype=float) ** 2
    inside = (q > plan.avoidance_radius**2) & (q < plan.sensing_radius**2)
    ratio = np.zeros_like(q)
    np.divide(q - plan.sensing_radius**2, q - plan.avoidance_radius**2, out=ratio, where=inside)
    return np.asarray(np.minimum(0.0, ratio) ** 2)


class PairForces:
    """∇f of given pairs of robots: pair k has the robots `first[k]` and `second[k]` of `robots` robots."""

    def __init__(self, first: NDArray[np.intp], second: NDArray[np.intp], robots: int, plan: AvoidancePlan) -> None:
        self._sensing_square = plan.sensing_radius**2
        self._avoidance_square = plan.avoidance_radius**2
        self._limit = plan.force_limit
        self._first, self._second, self._robots = first, second, robots
        self._apart: Array | None = None  # the matrix from robots' positions to p_i - p_j of each pair
        if len(first) * robots <= LARGEST:
            self._apart = np.zeros((len(first), robots))
            self._apart[np.arange(len(first)), first] = 1.0
            self._apart[np.arange(len(first)), second] = -1.0

    def __call__(self, positions: Array) -> Array | None:
        """Returns the force ∇f on every robot, (robots, 2) [m/s²], at `positions`, (robots, 2) [m].  Returns None if no pair is
        within the sensing radius."""
        apart = positions[self._first] - positions[self._second] if self._apart is None else self._apart @ positions
        q = np.einsum("ij,ij->i", apart, apart)
        if not q.size or np.minimum.reduce(q) >= self._sensing_square:
            return None
        gap = q - self._avoidance_square
        distance = np.sqrt(q)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            slope = 4 * distance * (self._sensing_square - q) * (self._sensing_square - self._avoidance_square) / gap**3
            push = np.where(gap > 0, np.minimum(slope, self._limit), self._limit)
            direction = np.where(distance[:, None] > 0, apart / distance[:, None], [1.0, 0.0])
        push = np.where(q < self._sensing_square, push, 0.0)
        each = push[:, None] * direction
        if self._apart is not None:
            return np.asarray(self._apart.T @ each)
        forces = np.zeros((self._robots, 2))
        near = np.flatnonzero(push)
        np.add.at(forces, self._first[near], each[near])
        np.subtract.at(forces, self._second[near], each[near])
        return forces


def pairs_between(groups: list[range]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns all pairs of robots from two different `groups`, as two index arrays; the first index is of the earlier group."""
    if all(len(group) == 1 for group in groups):
        robots = np.array([group[0] for group in groups], dtype=np.intp)
        one, other = np.triu_indices(len(groups), 1)
        return robots[one], robots[other]
    pairs = [(i, j) for at, group in enumerate(groups) for other in groups[at + 1 :] for i in group for j in other]
    array = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return array[:, 0], array[:, 1]
