"""The tree node: leader of a group or coordinator of all, the same role in different places.

Upwards it gathers what its children say and tells its parent its centroid.  Downwards it takes the acceleration of its
centroid from its parent (the root: from the law of the centroid), adds its own shape's, and turns both into one
acceleration per child: μ̈ = Φ_node⁻¹ (ν_shape, a_centroid).  Because Φ_M is built of the nodes, so is its inverse: the
robots' accelerations are those of the central law (`controller.law.CentralLaw`).

What travels besides: error rates of all blocks, where blocks are coupled; and forces of avoidance.  A pair of robots
belongs to the lowest node that has both below it: that node computes its ∇f from the positions its children sent up.
Above that node the pair's two forces cancel in every mean, below it they are handed down.
"""

from collections.abc import Sequence

import numpy as np

from controller.law import BlockGains
from controller.potential import PairForces, pairs_between
from controller.trajectory import make_trajectory
from controller.transformation import desired_shape, node_matrix
from echelon.messages import NULL, Channel, Heard, Message, Values
from echelon.plan import Plan
from echelon.role import Input, Stage


class TreeNode:
    """One node of a plan's tree as a role."""

    def __init__(self, plan: Plan, index: int) -> None:
        node = next(node for node in plan.nodes if node.index == index)
        by_index = {other.index: other for other in plan.nodes}
        self.index = index
        self._plan, self._node = plan, node
        self._phi = node_matrix(node.weights)
        self._phi_inverse = np.linalg.inv(self._phi)
        self._gains = BlockGains.of(plan, plan.block_of(index))
        self._is_root = node.parent is None
        self._trajectory = make_trajectory(plan.trajectory) if self._is_root else None
        self._centroid_gains = BlockGains.of(plan, plan.blocks[-1])
        count = len(node.children)

        # What the children said last: position and velocity of each, and its part of what goes further.
        self._children = np.zeros((count, 4))
        self._desired = np.zeros((count, 4))
        self._desired[:-1, :2] = desired_shape(node.shape, node.weights)
        self._known = False
        self._z = np.zeros((count, 4))

        # Slices of a child's message: error rates of the blocks below it, positions of the robots below it.
        self._rates_at: list[tuple[int, int]] = []
        self._robots_at: list[tuple[int, int]] = []
        rates = robots = 0
        for child, weight in zip(node.children, node.weights, strict=True):
            below = 2 * (weight - 1) if plan.coupled and child in by_index else 0
            self._rates_at.append((rates, rates + below))
            self._robots_at.append((robots, robots + weight))
            rates, robots = rates + below, robots + weight
        self._own_rates = slice(rates, rates + 2 * (count - 1))
        own = rates + 2 * (count - 1) if plan.coupled else 0
        self._rates = np.zeros(own + (2 if self._is_root and plan.coupled else 0))
        self._positions = np.zeros((robots, 2))
        self._child_is_node = [child in by_index for child in node.children]

        # Where this node finds its part in its parent's reference.
        self._external_at = 0
        if node.parent is not None:
            parent = by_index[node.parent]
            rates_size = 2 * len(plan.robots) if plan.coupled else 0
            self._acceleration_at = 2 * node.child_number
            self._all_rates_at = 2 * len(parent.children)
            self._external_at = self._all_rates_at + rates_size + 2 * (node.first_robot - parent.first_robot)
        self._forces: PairForces | None = None
        if plan.avoidance.enabled:
            groups = [range(first, last) for first, last in self._robots_at]
            self._forces = PairForces(*pairs_between(groups), robots, plan.avoidance)
            means = np.zeros((count, robots))
            for row, (first, last) in enumerate(self._robots_at):
                means[row, first:last] = 1 / (last - first)
            self._pot = self._phi @ means  # forces of robots to F_pot of this node, label tp
        self._parent_period_ns = by_index[node.parent].period_ns if node.parent is not None else 0

        depth, deepest = node.depth, max(other.depth for other in plan.nodes)
        up, down = 1 + deepest - depth, 1 + deepest + 1 + depth
        kinds = [Channel.GROUP_STATE if is_node else Channel.STATE for is_node in self._child_is_node]
        children = tuple(Input(child, kind) for child, kind in zip(node.children, kinds, strict=True))
        parents = () if node.parent is None else (Input(node.parent, Channel.REFERENCE),)
        self.stages = (
            Stage("gather", up, node.period_ns, children, self._gather),
            Stage("steer", down, node.period_ns, parents, self._steer),
        )

    def _gather(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the children's states; returns the group's state where the parent wants one now."""
        known = True
        for at, message in enumerate(heard):
            if message is None:
                known = False
                continue
            values = message.values
            self._children[at] = values[:4]
            first, last = self._rates_at[at]
            if last > first:
                self._rates[first:last] = values[4 : 4 + last - first]
            if self._forces is not None:
                first_robot, last_robot = self._robots_at[at]
                if self._child_is_node[at]:
                    self._positions[first_robot:last_robot] = values[4 + last - first :].reshape(-1, 2)
                else:
                    self._positions[first_robot] = values[:2]
        self._known = known
        if not known:
            return self._group_state(time_ns, NULL)
        if self._trajectory is not None:
            self._reference_trajectory = self._trajectory.at(time_ns * 1e-9)
            self._desired[-1] = self._reference_trajectory[:2].ravel()
        self._z = self._phi @ self._children
        self._error = self._z - self._desired
        if self._plan.coupled:
            self._rates[self._own_rates] = self._error[:-1, 2:].ravel()
            if self._is_root:
                self._rates[-2:] = self._error[-1, 2:]
        if self._is_root:
            return ()
        parts = [self._z[-1], self._rates]
        if self._forces is not None:
            parts.append(self._positions.ravel())
        return self._group_state(time_ns, np.concatenate(parts))

    def _group_state(self, time_ns: int, values: Values) -> tuple[Message, ...]:
        if self._is_root or time_ns % self._parent_period_ns:
            return ()
        return (Message(Channel.GROUP_STATE, self.index, time_ns // self._parent_period_ns, time_ns, values),)

    def _steer(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the parent's reference; returns references and commands for the children."""
        reference = heard[0] if heard else None
        if not self._known or (reference is None and not self._is_root):
            return self._down(time_ns, NULL, NULL)
        plan = self._plan
        coupled = plan.coupled
        all_rates = self._rates
        total = NULL
        e, e_dot = self._error[:, :2], self._error[:, 2:]
        nu = np.empty_like(e)
        nu[:-1] = self._gains.nu(e[:-1].ravel(), e_dot[:-1].ravel()).reshape(-1, 2)
        if reference is not None:
            values = reference.values
            nu[-1] = values[self._acceleration_at : self._acceleration_at + 2]
            if coupled:
                all_rates = values[self._all_rates_at : self._all_rates_at + 2 * len(plan.robots)]
        else:
            nu[-1] = self._centroid_gains.nu(e[-1], e_dot[-1]) + self._reference_trajectory[2]
        if coupled:
            nu[:-1] -= (self._gains.K_coupling @ all_rates).reshape(-1, 2)
            if self._is_root:
                nu[-1] -= self._centroid_gains.K_coupling @ all_rates
        if self._forces is not None:
            total = self._forces(self._positions)
            if reference is not None:
                at = self._external_at
                total = total + reference.values[at : at + total.size].reshape(-1, 2)
            f_pot = self._pot @ total
            nu[:-1] += (self._gains.K_pot @ f_pot[:-1].ravel()).reshape(-1, 2)
            if self._is_root:
                nu[-1] += self._centroid_gains.K_pot @ f_pot[-1]
        accelerations = (self._phi_inverse @ nu).ravel()
        further = [accelerations, all_rates, total.ravel()] if coupled else [accelerations, total.ravel()]
        return self._down(time_ns, np.concatenate(further), accelerations)

    def _down(self, time_ns: int, reference: Values, command: Values) -> tuple[Message, ...]:
        number = time_ns // self._node.period_ns
        messages = []
        if any(self._child_is_node):
            messages.append(Message(Channel.REFERENCE, self.index, number, time_ns, reference))
        if not all(self._child_is_node):
            messages.append(Message(Channel.COMMAND, self.index, number, time_ns, command))
        return tuple(messages)


