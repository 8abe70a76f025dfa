"""A law as a node of the tree uses it: the part that is matrices, and the part that is computed for each block in each period.

The linear law consists of matrices only; a node multiplies them out once (`controller.node.NodeLaw`).  In any other law
coupling and avoidance are matrices as well.  The rest is η = ν - Z̈_bd of the node's own blocks.  It is computed in each period
and gives a part of the children's accelerations, Φ_node⁻¹ η.
"""

from dataclasses import dataclass

import numpy as np

from echelon.controller.laws.law import law_block, make_nu, make_state, make_weight
from echelon.controller.laws.linear import Linear
from echelon.controller.transformation import desired_shape, node_matrix
from echelon.plan.plan import Array, BlockPlan, NodePlan, Plan


@dataclass(frozen=True, slots=True)
class BlockGains:
    """The matrices of one block as they act, look-ahead and W (controller.laws.law) included."""

    K_1: Array
    """Gain of the error [1/s²], (size, size); zero if the law is not the linear one"""
    K_2: Array
    """Gain of the error's rate [1/s], (size, size); zero if the law is not the linear one"""
    K_coupling: Array
    """W K̄_b, the rows of the coupling that act on the block [1/s], (size, 2 N)"""
    K_pot: Array
    """W/σ, the gain of F_pot [1/s], (size, size)"""

    @classmethod
    def of(cls, plan: Plan, block: BlockPlan) -> "BlockGains":
        """Returns the matrices of a block of a plan.

        Raises PartRunError if the law's W is wrong."""
        rows = slice(block.offset, block.offset + block.size)
        seen = law_block(plan, block)
        if is_linear(plan):
            gains = plan.law.made.linear(seen)
            K_1, K_2, weight = gains.K_1, gains.K_2, gains.weight
        else:
            K_1 = K_2 = np.zeros((block.size, block.size))
            weight = make_weight(plan.law, seen)
        return cls(K_1, K_2, weight @ plan.coupling[rows], weight / block.sigma)


def is_linear(plan: Plan) -> bool:
    """True if the plan's law is `Linear`, which has no state and consists of matrices only."""
    return type(plan.law.made) is Linear


class NodeBlocks:
    """The blocks of one node under a law that does not consist of matrices only."""

    def __init__(self, plan: Plan, node: NodePlan) -> None:
        count = len(node.children)
        phi = node_matrix(node.weights)
        self._back = np.kron(np.linalg.inv(phi), np.eye(2))
        self._errors_of_s = np.kron(phi, np.eye(4))
        self._desired = np.zeros((count, 4))
        self._desired[:-1, :2] = desired_shape(node.shape, node.weights)
        self._is_root = node.parent is None
        shape, centroid = plan.block_of(node.index), plan.blocks[-1]
        own = [(shape, slice(0, count - 1))] if count > 1 else []
        if self._is_root:
            own.append((centroid, slice(count - 1, count)))
        self._own = []
        for block, variables in own:
            seen = law_block(plan, block)
            self._own.append((variables, make_nu(plan.law, seen), make_state(plan.law, seen)))

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "NodeBlocks | None":
        """Returns the blocks of a node; None if the plan's law is `Linear`."""
        return None if is_linear(plan) else cls(plan, node)

    def __call__(self, t: float, s: Array, c: Array) -> Array:
        """Returns Φ_node⁻¹ η, (2 n,) [m/s²]: the law's part of the children's accelerations at t [s].

        `s`, (4 n,), are the positions and velocities of the n children.  `c` is (z_cd, ż_cd, z̈_cd), (6,), at the root; other
        nodes do not use it."""
        errors = (self._errors_of_s @ s).reshape(-1, 4) - self._desired
        feed_forward = np.zeros((len(errors), 2))
        if self._is_root:
            errors[-1] -= c[:4]
            feed_forward[-1] = c[4:]
        eta = np.zeros_like(feed_forward)
        for variables, nu, state in self._own:
            e, e_dot = errors[variables, :2].ravel(), errors[variables, 2:].ravel()
            given = feed_forward[variables].ravel()
            e.flags.writeable = e_dot.flags.writeable = given.flags.writeable = False
            eta[variables] = (nu(t, e, e_dot, given, state) - given).reshape(-1, 2)
        return np.asarray(self._back @ eta.ravel())
