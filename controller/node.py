"""The tree node: leader of a group or coordinator of all, the same role in different places.

Upwards it gathers what its children say and tells its parent its centroid.  Downwards it takes the acceleration of its
centroid from its parent (the root: from the law of the centroid), adds its own shape's, and turns both into one
acceleration per child: a = Φ_node⁻¹ (ν_shape, a_centroid).  Because Φ_M is built of the nodes, so is its inverse: the
robots' accelerations are those of the central law (`controller.law.CentralLaw`).

What travels besides: error rates of all blocks, where blocks are coupled; and forces of avoidance.  A pair of robots
belongs to the lowest node that has both below it: that node computes its ∇f from the positions its children sent up.
Above that node the pair's two forces cancel in every mean, below it they are handed down.

All of the law is linear in what a node knows, but for the forces.  So its matrices are multiplied out once
(`NodeLaw`), and a period costs one product for each thing that was heard.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.law import BlockGains
from controller.potential import PairForces, pairs_between
from controller.trajectory import make_trajectory
from controller.transformation import desired_shape, node_matrix
from echelon.messages import NULL, Channel, Heard, Message, Values
from echelon.plan import Array, NodePlan, Plan
from echelon.role import Input, Stage


@dataclass(frozen=True, slots=True)
class NodeLaw:
    """The law of one node as matrices onto its children's accelerations, all of them behind Φ_node⁻¹ ⊗ I.

    With n children, N robots in all and R below the node: of its errors (4 n: e and ė of each variable, the centroid
    last), of the error rates of all blocks (2 N), of the forces on its robots (2 R), of its centroid's acceleration (2).
    """

    of_error: Array
    of_rates: Array
    of_forces: Array
    of_centroid: Array

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "NodeLaw":
        """Returns the law of a node of a plan."""
        count, size = len(node.children), 2 * len(node.children)
        blocks = [(plan.block_of(node.index), slice(0, size - 2))]
        if node.parent is None:
            blocks.append((plan.blocks[-1], slice(size - 2, size)))
        errors = np.arange(4 * count).reshape(count, 2, 2)
        nu_of_error = np.zeros((size, 4 * count))
        nu_of_rates = np.zeros((size, 2 * len(plan.robots)))
        nu_of_f_pot = np.zeros((size, size))
        for block, rows in blocks:
            gains = BlockGains.of(plan, block)
            variables = range(rows.start // 2, rows.stop // 2)
            nu_of_error[rows, errors[variables, 0].ravel()] = -gains.K_1
            nu_of_error[rows, errors[variables, 1].ravel()] = -gains.K_2
            nu_of_rates[rows] = -gains.K_coupling
            nu_of_f_pot[rows, rows] = gains.K_pot
        phi = node_matrix(node.weights)
        means = np.repeat(np.eye(count), node.weights, axis=1) / np.array(node.weights)[:, None]
        f_pot = np.kron(phi @ means, np.eye(2))  # forces on robots to F_pot of this node, label tp
        back = np.kron(np.linalg.inv(phi), np.eye(2))
        return cls(back @ nu_of_error, back @ nu_of_rates, back @ nu_of_f_pot @ f_pot, back[:, -2:].copy())


class TreeNode:
    """One node of a plan's tree as a role."""

    def __init__(self, plan: Plan, index: int) -> None:
        node = next(node for node in plan.nodes if node.index == index)
        by_index = {other.index: other for other in plan.nodes}
        parent = None if node.parent is None else by_index[node.parent]
        count = len(node.children)
        self.index = index
        self._node, self._is_root, self._coupled = node, parent is None, plan.coupled
        self._phi = node_matrix(node.weights)
        self._law = NodeLaw.of(plan, node)
        self._trajectory = make_trajectory(plan.trajectory) if parent is None else None
        self._centroid_acceleration: Array = np.zeros(2)
        self._child_is_node = [child in by_index for child in node.children]

        # What the children said last: position and velocity of each; what is wanted; the difference, transformed.
        self._children = np.zeros((count, 4))
        self._desired = np.zeros((count, 4))
        self._desired[:-1, :2] = desired_shape(node.shape, node.weights)
        self._z = self._error = np.zeros((count, 4))
        self._known = False

        # Error rates of all blocks below, this node's own last (the root: then the centroid's); positions of all robots
        # below; and where each child's part of them stands.
        self._rates_at: list[tuple[int, int]] = []
        self._robots_at: list[tuple[int, int]] = []
        rates = robots = 0
        for child, weight in zip(node.children, node.weights, strict=True):
            more = 2 * (weight - 1) if plan.coupled and child in by_index else 0
            self._rates_at.append((rates, rates + more))
            self._robots_at.append((robots, robots + weight))
            rates, robots = rates + more, robots + weight
        self._own_rates = rates
        self._rates = np.zeros((rates + 2 * (count - (parent is not None))) if plan.coupled else 0)
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
        self._all_rates = slice(self._all_rates_at, self._all_rates_at + 2 * len(plan.robots))

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
        self._known = all(message is not None for message in heard)
        if not self._known:
            return self._group_state(time_ns, NULL)
        for at, message in enumerate(heard):
            assert message is not None
            values = message.values
            self._children[at] = values[:4]
            if self._child_is_node[at]:
                first, last = self._rates_at[at]
                self._rates[first:last] = values[4 : 4 + last - first]
                if self._forces is not None:
                    first_robot, last_robot = self._robots_at[at]
                    self._positions[first_robot:last_robot] = values[4 + last - first :].reshape(-1, 2)
            elif self._forces is not None:
                self._positions[self._robots_at[at][0]] = values[:2]
        if self._trajectory is not None:
            z_cd = self._trajectory.at(time_ns * 1e-9)
            self._desired[-1] = z_cd[:2].ravel()
            self._centroid_acceleration = z_cd[2]
        self._z = self._phi @ self._children
        self._error = self._z - self._desired
        if self._coupled:
            own = self._error[:, 2:].ravel()
            self._rates[self._own_rates :] = own if self._is_root else own[:-2]
        if self._is_root:
            return ()
        if self._forces is None:
            return self._group_state(time_ns, np.concatenate((self._z[-1], self._rates)))
        return self._group_state(time_ns, np.concatenate((self._z[-1], self._rates, self._positions.ravel())))

    def _group_state(self, time_ns: int, values: Values) -> tuple[Message, ...]:
        if self._is_root or time_ns % self._parent_period_ns:
            return ()
        return (Message(Channel.GROUP_STATE, self.index, time_ns // self._parent_period_ns, time_ns, values),)

    def _steer(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the parent's reference; returns references and commands for the children."""
        reference = heard[0] if heard else None
        if not self._known or (reference is None and not self._is_root):
            return self._down(time_ns, NULL, NULL)
        law = self._law
        all_rates, forces = self._rates, self._no_forces
        if self._forces is not None and (near := self._forces(self._positions)) is not None:
            forces = near.ravel()
        if reference is None:
            accelerations = law.of_error @ self._error.ravel() + law.of_centroid @ self._centroid_acceleration
        else:
            values = reference.values
            at = self._acceleration_at
            accelerations = law.of_error @ self._error.ravel() + law.of_centroid @ values[at : at + 2]
            all_rates = values[self._all_rates]
            if self._forces is not None:
                forces = forces + values[self._forces_at : self._forces_at + forces.size]
        if self._coupled:
            accelerations += law.of_rates @ all_rates
        if self._forces is None:
            further: tuple[Array, ...] = (accelerations, all_rates) if self._coupled else (accelerations,)
        else:
            accelerations += law.of_forces @ forces
            further = (accelerations, all_rates, forces) if self._coupled else (accelerations, forces)
        return self._down(time_ns, np.concatenate(further), accelerations)

    def _down(self, time_ns: int, reference: Values, command: Values) -> tuple[Message, ...]:
        number = time_ns // self._node.period_ns
        messages = []
        if any(self._child_is_node):
            messages.append(Message(Channel.REFERENCE, self.index, number, time_ns, reference))
        if not all(self._child_is_node):
            messages.append(Message(Channel.COMMAND, self.index, number, time_ns, command))
        return tuple(messages)
