"""The tree node: leader of a group or coordinator of all, the same role in different places.

Upwards it gathers what its children say and tells its parent its centroid.  Downwards it takes the acceleration of its
centroid from its parent (the root: from the law of the centroid), adds its own shape's, and turns both into one
acceleration per child: a = Φ_node⁻¹ (ν_shape, a_centroid).  Because Φ_M is built of the nodes, so is its inverse: the
robots' accelerations are those of the central law (`controller.laws.central.CentralLaw`).

What travels besides: error rates of all blocks, where blocks are coupled; and forces of avoidance.  A pair of robots
belongs to the lowest node that has both below it: that node computes its ∇f from the positions its children sent up.
Above that node the pair's two forces cancel in every mean, below it they are handed down.

The linear law is linear in what a node knows, but for the forces.  So its matrices are multiplied out once (`NodeLaw`), and
a period costs one product upwards and one downwards.  Any other law is asked block by block besides (`NodeBlocks`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from echelon.controller.laws.in_tree import BlockGains, NodeBlocks
from echelon.controller.potential import PairForces, pairs_between
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import desired_shape, node_matrix
from echelon.messages import NULL, Channel, Heard, Message, Values
from echelon.plan import Array, NodePlan, Plan
from echelon.role import Input, Stage


@dataclass(frozen=True, slots=True)
class NodeLaw:
    """The law of one node as matrices.  With n children, whose positions and velocities (x, y, vx, vy) make up s (4 n),
    N robots in all and R below the node:

        (centroid, its velocity, error rates of the own shape) = up @ s
        accelerations of the children = down @ (s, c, error rates of all blocks) + of_forces @ forces + constant

    where c is the acceleration of the own centroid (2), or for the root (z_cd, ż_cd, z̈_cd) (6).  The rates (2 N) are
    left out where no block is coupled.
    """

    up: Array
    down: Array
    of_forces: Array
    constant: Array

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "NodeLaw":
        """Returns the law of a node of a plan."""
        count, size = len(node.children), 2 * len(node.children)
        blocks = [(plan.block_of(node.index), slice(0, size - 2))]
        if node.parent is None:
            blocks.append((plan.blocks[-1], slice(size - 2, size)))
        # An error is (e_x, e_y, ė_x, ė_y) for each variable, the centroid last, as Φ_node makes it of s.
        error = np.arange(4 * count).reshape(count, 2, 2)
        nu_of_error = np.zeros((size, 4 * count))
        nu_of_rates = np.zeros((size, 2 * len(plan.robots)))
        nu_of_f_pot = np.zeros((size, size))
        for block, rows in blocks:
            gains = BlockGains.of(plan, block)
            variables = range(rows.start // 2, rows.stop // 2)
            nu_of_error[rows, error[variables, 0].ravel()] = -gains.K_1
            nu_of_error[rows, error[variables, 1].ravel()] = -gains.K_2
            nu_of_rates[rows] = -gains.K_coupling
            nu_of_f_pot[rows, rows] = gains.K_pot
        phi = node_matrix(node.weights)
        error_of_s = np.kron(phi, np.eye(4))
        desired = np.zeros((count, 4))
        desired[:-1, :2] = desired_shape(node.shape, node.weights)
        means = np.repeat(np.eye(count), node.weights, axis=1) / np.array(node.weights)[:, None]
        f_pot_of_forces = np.kron(phi @ means, np.eye(2))  # label tp
        back = np.kron(np.linalg.inv(phi), np.eye(2))
        of_error, of_centroid = back @ nu_of_error, back[:, -2:]
        if node.parent is None:
            of_centroid = np.hstack([-of_error[:, error[-1].ravel()], of_centroid])
        of_rates = back @ nu_of_rates if plan.coupled else np.zeros((size, 0))
        return cls(
            np.vstack([error_of_s[-4:], error_of_s[error[:-1, 1].ravel()]]),
            np.hstack([of_error @ error_of_s, of_centroid, of_rates]),
            back @ nu_of_f_pot @ f_pot_of_forces,
            -of_error @ desired.ravel(),
        )


class TreeNode:
    """One node of a plan's tree as a role."""

    def __init__(self, plan: Plan, index: int) -> None:
        node = next(node for node in plan.nodes if node.index == index)
        by_index = {other.index: other for other in plan.nodes}
        parent = None if node.parent is None else by_index[node.parent]
        count = len(node.children)
        self.index = index
        self._node, self._is_root, self._coupled = node, parent is None, plan.coupled
        self._law = NodeLaw.of(plan, node)
        self._blocks = NodeBlocks.of(plan, node)
        self._trajectory = make_trajectory(plan.trajectory) if parent is None else None
        self._z_cd: Array = np.zeros(6)
        self._child_is_node = [child in by_index for child in node.children]
        self._has_groups, self._has_robots = any(self._child_is_node), not all(self._child_is_node)
        self._s: Array | None = None  # of the children, once all of them have been heard

        # Error rates of all blocks below (the root: then of its own and of the centroid), positions of all robots below,
        # and where each child's part of them stands.
        self._rates_at: list[tuple[int, int]] = []
        self._robots_at: list[tuple[int, int]] = []
        rates = robots = 0
        for child, weight in zip(node.children, node.weights, strict=True):
            more = 2 * (weight - 1) if plan.coupled and child in by_index else 0
            self._rates_at.append((rates, rates + more))
            self._robots_at.append((robots, robots + weight))
            rates, robots = rates + more, robots + weight
        self._own_rates = rates
        self._rates = np.zeros(rates + (2 * count if plan.coupled and parent is None else 0))
        self._below = [self._rates] if rates else []
        self._positions = np.zeros((robots, 2))
        self._no_forces = np.zeros(2 * robots)
        self._forces: PairForces | None = None
        if plan.avoidance.enabled:
            pairs = pairs_between([range(first, last) for first, last in self._robots_at])
            self._forces = PairForces(*pairs, robots, plan.avoidance)

        # Where this node's part stands in its parent's reference.
        self._acceleration_at = self._all_rates_at = self._forces_at = self._parent_period_ns = 0
        if parent is not None:
            self._acceleration_at = 2 * node.child_number
            self._all_rates_at = 2 * len(parent.children)
            self._forces_at = self._all_rates_at + (2 * len(plan.robots) if plan.coupled else 0)
            self._forces_at += 2 * (node.first_robot - parent.first_robot)
            self._parent_period_ns = parent.period_ns
        self._all_rates = slice(self._all_rates_at, self._all_rates_at + (2 * len(plan.robots) if plan.coupled else 0))

        deepest = max(other.depth for other in plan.nodes)
        kinds = [Channel.GROUP_STATE if is_node else Channel.STATE for is_node in self._child_is_node]
        children = tuple(Input(child, kind) for child, kind in zip(node.children, kinds, strict=True))
        parents = () if parent is None else (Input(parent.index, Channel.REFERENCE),)
        self.stages = (
            Stage("gather", 1 + deepest - node.depth, node.period_ns, children, self._gather),
            Stage("steer", 2 + deepest + node.depth, node.period_ns, parents, self._steer),
        )

    def _gather(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the children's states; returns the group's state where the parent wants one now."""
        said = [message.values for message in heard if message is not None]
        if len(said) < len(heard):
            self._s = None
            return self._group_state(time_ns, NULL)
        self._s = s = np.concatenate([values[:4] for values in said])
        if self._forces is not None or self._has_groups:
            self._gather_rest(said)
        own = self._law.up @ s
        if self._trajectory is not None:
            self._z_cd = self._trajectory.at(time_ns * 1e-9).ravel()
            if self._coupled:
                self._rates[self._own_rates : -2] = own[4:]
                self._rates[-2:] = own[2:4] - self._z_cd[2:4]
            return ()
        parts = [own[:4], *self._below, own[4:]] if self._coupled else [own[:4]]
        if self._forces is not None:
            parts.append(self._positions.ravel())
        return self._group_state(time_ns, np.concatenate(parts))

    def _gather_rest(self, said: list[Values]) -> None:
        """Takes what else the children say: error rates of blocks and positions of robots below them."""
        for at, values in enumerate(said):
            first_robot, last_robot = self._robots_at[at]
            if self._child_is_node[at]:
                first, last = self._rates_at[at]
                self._rates[first:last] = values[4 : 4 + last - first]
                if self._forces is not None:
                    self._positions[first_robot:last_robot] = values[4 + last - first :].reshape(-1, 2)
            elif self._forces is not None:
                self._positions[first_robot] = values[:2]

    def _group_state(self, time_ns: int, values: Values) -> tuple[Message, ...]:
        if self._is_root or time_ns % self._parent_period_ns:
            return ()
        return (Message(Channel.GROUP_STATE, self.index, time_ns // self._parent_period_ns, time_ns, values),)

    def _steer(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the parent's reference; returns references and commands for the children."""
        law, s = self._law, self._s
        if self._is_root:
            c, all_rates = self._z_cd, self._rates
        elif heard[0] is not None:
            reference = heard[0].values
            c = reference[self._acceleration_at : self._acceleration_at + 2]
            all_rates = reference[self._all_rates]
        else:
            s = None
        if s is None:
            return self._down(time_ns, NULL, NULL)
        accelerations = law.down @ np.concatenate((s, c, all_rates)) + law.constant
        if self._blocks is not None:
            accelerations += self._blocks(time_ns * 1e-9, s, c)
        if self._forces is None:
            further: tuple[Array, ...] = (accelerations, all_rates)
        else:
            near = self._forces(self._positions)
            forces = self._no_forces if near is None else near.ravel()
            if not self._is_root:
                forces = forces + reference[self._forces_at : self._forces_at + forces.size]
            accelerations += law.of_forces @ forces
            further = (accelerations, all_rates, forces)
        return self._down(time_ns, np.concatenate(further) if self._has_groups else NULL, accelerations)

    def _down(self, time_ns: int, reference: Values, command: Values) -> tuple[Message, ...]:
        number = time_ns // self._node.period_ns
        messages = []
        if self._has_groups:
            messages.append(Message(Channel.REFERENCE, self.index, number, time_ns, reference))
        if self._has_robots:
            messages.append(Message(Channel.COMMAND, self.index, number, time_ns, command))
        return tuple(messages)
