"""The centroid-based transformation from positions to shape variables and centroid, and its inverse (docs/architecture.md,
2.3).

One rule holds at every node of the tree.  A node with children at x_1..x_n (robots, or centroids of groups) and weights w_k
(the number of robots below each child) has

    z_1 = (x_1 - x_2)/√2
    z_k = x_{k+1} - (Σ_{l≤k} w_l x_l)/(Σ_{l≤k} w_l)        k = 2..n-1
    centroid = (Σ w_l x_l)/(Σ w_l)

The rows of all nodes, children before parents, and the row of the root's centroid form the paper's Φ_M: Z = Φ_M X (section IV
of the paper).
"""

from collections.abc import Sequence
from math import sqrt

import numpy as np

from echelon.plan.plan import Array, NodePlan, Plan, ShapePlan


def node_matrix(weights: Sequence[int]) -> Array:
    """Returns Φ_node, (n, n): the rows of the shape variables, then the row of the centroid.  It acts on x and y alike.

    Raises ValueError if there are no weights, or if one is not positive.
    """
    count = len(weights)
    if count == 0 or min(weights) <= 0:
        raise ValueError(f"weights {list(weights)}: a node needs children, each with a positive weight")
    w = np.array(weights, dtype=float)
    phi = np.zeros((count, count))
    if count > 1:
        phi[0, :2] = 1 / sqrt(2), -1 / sqrt(2)
    for k in range(1, count - 1):
        phi[k, : k + 1] = -w[: k + 1] / w[: k + 1].sum()
        phi[k, k + 1] = 1.0
    phi[-1] = w / w.sum()
    return phi


def desired_shape(shape: ShapePlan, weights: Sequence[int]) -> Array:
    """Returns the desired shape variables Z_bd of a node, (n-1, 2) [m]: those of the plan, or those of the plan's positions."""
    points = np.array(shape.points, dtype=float).reshape(-1, 2)
    if shape.kind == "vectors":
        return points
    return np.asarray(node_matrix(weights) @ points, dtype=np.float64)[:-1]


class Transformation:
    """Φ_M of a whole plan, for code that has all robots at once: central law, analysis, reports.

    Its rows are in the order of the blocks, the centroid last; its columns are the robots in the order of their indices.
    """

    def __init__(self, plan: Plan) -> None:
        robots = len(plan.robots)
        mean = np.zeros((len(plan.formation), robots))  # row per member: the mean over the robots below it
        mean[:robots] = np.eye(robots)
        rows, desired = [], []
        for node in plan.nodes:
            node_rows = node_matrix(node.weights) @ mean[list(node.children)]
            mean[node.index] = node_rows[-1]
            rows.append(node_rows[:-1])
            desired.append(desired_shape(node.shape, node.weights))
        self.matrix: Array = np.vstack([*rows, mean[plan.root.index]])
        """Φ_M, (N, N); the paper's matrix is its Kronecker product with the 2×2 identity."""
        self.inverse: Array = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        self.desired_shape: Array = np.vstack(desired)
        """Desired shape variables of all nodes, (N-1, 2)."""

    def forward(self, x: Array) -> Array:
        """Returns Z = Φ_M x for positions, velocities or accelerations x, (..., N, 2)."""
        return np.asarray(self.matrix @ x)

    def backward(self, z: Array) -> Array:
        """Returns x = Φ_M⁻¹ z, (..., N, 2)."""
        return np.asarray(self.inverse @ z)

    def desired(self, centroid: Array) -> Array:
        """Returns Z_d, (..., N, 2), for desired centroids (..., 2)."""
        centroid = np.asarray(centroid, dtype=float)
        shape = np.broadcast_to(self.desired_shape, (*centroid.shape[:-1], *self.desired_shape.shape))
        return np.concatenate([shape, centroid[..., None, :]], axis=-2)


def subtree_robots(plan: Plan, node: NodePlan) -> range:
    """Returns the indices of the robots below a node; they are contiguous."""
    return range(node.first_robot, node.first_robot + node.robots)
