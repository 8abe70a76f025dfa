"""Collision avoidance (labels potf, pforce, tp; theory.md section 4).

For a pair at distance s, with avoidance radius r_a < sensing radius R_s:

    V = ( min{0, (s² - R_s²)/(s² - r_a²)} )²        ∇f_i = -Σ_j ∂V_ij/∂p_i

V rises without bound as s falls to r_a and is zero beyond R_s; ∇f_i pushes i away from j.  Written with q = s²:

    -∂V/∂p_i = -2 (p_i - p_j) dV/dq,   dV/dq = 2 (q - R_s²)/(q - r_a²) · (R_s² - r_a²)/(q - r_a²)²   for r_a² < q < R_s²

At and inside r_a the formula of the paper is zero again.  That would be peace where there is none: here the pair is
pushed apart with the cap `force_limit`, which also bounds ∇f outside, where a sampled controller needs a finite slope.
"""

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import Array, AvoidancePlan


def potential(distance: Array, plan: AvoidancePlan) -> Array:
    """Returns V for distances [m] of any shape, as the paper has it (label potf): zero at and inside r_a, too."""
    q = np.asarray(distance, dtype=float) ** 2
    inside = (q > plan.avoidance_radius**2) & (q < plan.sensing_radius**2)
    ratio = np.zeros_like(q)
    np.divide(q - plan.sensing_radius**2, q - plan.avoidance_radius**2, out=ratio, where=inside)
    return np.asarray(np.minimum(0.0, ratio) ** 2)


class PairForces:
    """∇f of given pairs of robots; the pairs of a node are those whose robots stand under different children."""

    def __init__(self, first: NDArray[np.intp], second: NDArray[np.intp], robots: int, plan: AvoidancePlan) -> None:
        self._sensing_square = plan.sensing_radius**2
        self._avoidance_square = plan.avoidance_radius**2
        self._limit = plan.force_limit
        self._apart = np.zeros((len(first), robots))  # positions of robots to differences of pairs
        self._apart[np.arange(len(first)), first] = 1.0
        self._apart[np.arange(len(first)), second] = -1.0

    def __call__(self, positions: Array) -> Array | None:
        """Returns the force ∇f [m/s²] on every robot, (robots, 2), at `positions`, (robots, 2) [m]; None if all are
        beyond the sensing radius of each other."""
        apart = self._apart @ positions
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
        return np.asarray(self._apart.T @ (push[:, None] * direction))


def pairs_between(groups: list[range]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the pairs (i < j) of robots that stand in different ones of `groups`, as two index arrays."""
    pairs = [(i, j) for at, group in enumerate(groups) for other in groups[at + 1 :] for i in group for j in other]
    array = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return array[:, 0], array[:, 1]
