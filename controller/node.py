"""The role of a tree node.  Leaders of groups and the coordinator are the same role in different places of the tree.

On the way up, a node gathers the states of its children and sends its parent its centroid.  On the way down, it takes the
acceleration of its centroid from its parent (the root: from the law of the centroid), computes the accelerations ν_shape of
its shape variables, and turns both into one acceleration per child: a = Φ_node⁻¹ (ν_shape, a_centroid).  Φ_M is made of the
matrices of the nodes, and so is its inverse.  So the robots get the same accelerations as from the central law
(`controller.laws.central.CentralLaw`; docs/architecture.md, 2.3 and 2.4).

The same messages carry the error rates of all blocks, if blocks are coupled, and avoidance forces, if avoidance is on
(`echelon.plan.layout`).  A pair of robots belongs to the lowest node that has both below it.  This node computes the pair's ∇f
from the positions that its children send up.  Above this node the two forces of the pair cancel in every mean; below it they
are sent down (docs/architecture.md, 2.6).

Apart from the forces, the linear law is linear in the values that a node has.  So its matrices are multiplied out once
(`NodeLaw`), and a period costs one product on the way up and one on the way down.  Other laws are called for each block in
each period (`NodeBlocks`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

from echelon.controller.late_states import LateStates
from echelon.controller.laws.in_tree import BlockGains, NodeBlocks
from echelon.controller.potential import PairForces, pairs_between
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import desired_shape, node_matrix
from echelon.messages import NULL, Channel, Heard, Message, Values
from echelon.plan.layout import CENTROID, NodeLayout
from echelon.plan.plan import Array, NodePlan, Plan
from echelon.role import Acts, Input, Stage
from echelon.runtime.turns import Turn


@dataclass(frozen=True, slots=True)
class NodeLaw:
    """The law of one node as matrices (docs/architecture.md, 2.4).

        (centroid, its velocity, error rates of the node's shape) = up @ s
        accelerations of the children = down @ (s, c, error rates of all blocks) + of_forces @ forces + constant

    Here s, (4 n,), are the positions and velocities (x, y, vx, vy) of the n children; c is the acceleration of the node's
    centroid, (2,), or for the root (z_cd, ż_cd, z̈_cd), (6,).  The error rates, (2 N,) for N robots in all, are left out if no
    blocks are coupled.  The forces, (2 R,), act on the R robots below the node.
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
        # Places of (e_x, e_y, ė_x, ė_y) in the errors of all variables, the centroid last: Φ_node applied to s, less desired.
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
    """One node of a plan's tree as a role, with the stages GATHER (up) and STEER (down)."""

    def __init__(self, plan: Plan, index: int) -> None:
        node = plan.nodes[index - len(plan.robots)]
        self.index = index
        self._node = node
        self._parent = None if node.parent is None else plan.nodes[node.parent - len(plan.robots)]
        self._coupled = plan.coupled
        self._layout = NodeLayout.of(plan, node)
        self._law = NodeLaw.of(plan, node)
        self._blocks = NodeBlocks.of(plan, node)
        self._trajectory = make_trajectory(plan.trajectory)
        self._ahead_s = plan.lead * node.period_ns * 1e-9  # how far the law looks ahead
        self._pair_forces = _pair_forces(plan, node) if plan.avoidance.enabled else None
        self._no_forces = np.zeros(2 * node.robots)

        # Values that GATHER sets and STEER uses:
        self._s: Array | None = None
        """Positions and velocities of the children; None if the state of a child is missing"""
        self._state: Array = NULL
        """Values of the node's own GROUP_STATE"""
        self._z_cd: Array = NULL
        """Desired centroid (z_cd, ż_cd, z̈_cd), z̈_cd as far ahead as the law looks; only at the root"""

        children = tuple(
            Input(child, Channel.STATE if child < len(plan.robots) else Channel.GROUP_STATE) for child in node.children
        )
        parents = () if node.parent is None else (Input(node.parent, Channel.REFERENCE),)
        acts = Acts.WHEN_HEARD if node.event_driven else Acts.AT_INSTANT
        self._late = LateStates(plan, node, self._trajectory)
        self.stages = (
            Stage(Turn.GATHER, node.period_ns, children, self._gather, acts=acts, depth=node.depth),
            Stage(Turn.STEER, node.period_ns, parents, self._steer, acts=acts, depth=node.depth),
        )

    def _gather(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the children's states; returns the GROUP_STATE if the parent is due when the node is.  It is a null message if
        the state of a child is missing."""
        said = self._late.present(time_ns, heard)
        if len(said) < len(heard):
            self._s = None
            return self._say_up(time_ns, NULL)
        self._s = s = np.concatenate([values[CENTROID] for values in said])
        own = self._law.up @ s
        layout = self._layout.state
        self._state = state = np.empty(layout.size)
        state[layout.centroid] = own[:4]
        if self._coupled:
            state[layout.own_rates] = own[4:]
        for child, there, here in self._layout.carried:
            state[here] = said[child][there]
        if self._parent is None:
            t = time_ns * 1e-9
            self._z_cd = z_cd = self._trajectory.at(t).ravel()
            if self._ahead_s:
                z_cd[4:] = self._trajectory.at(t + self._ahead_s)[2]
            if self._coupled:
                state[layout.centroid_rates] = own[2:4] - z_cd[2:4]
        return self._say_up(time_ns, state)

    def _steer(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Takes the parent's reference; returns REFERENCE and COMMAND for the children.  They are null messages if the state of
        a child or the parent's reference is missing."""
        law, layout, s, state = self._law, self._layout, self._s, self._state
        mine = layout.mine
        if mine is None:
            c, all_rates = self._z_cd, state[layout.state.rates]
        elif (message := heard[0]) is not None:
            reference = message.values
            c, all_rates = reference[mine.acceleration], reference[mine.rates]
        else:
            s = None
        if s is None:
            if self._late.remembers:
                self._late.note(time_ns, None)
            return self._say_down(time_ns, NULL, NULL)
        accelerations = law.down @ np.concatenate((s, c, all_rates)) + law.constant
        if self._blocks is not None:
            accelerations += self._blocks(time_ns * 1e-9, s, c)
        forces = NULL
        if self._pair_forces is not None:
            near = self._pair_forces(state[layout.state.positions].reshape(-1, 2))
            forces = self._no_forces if near is None else near.ravel()
            if mine is not None:
                forces = forces + reference[mine.forces]
            accelerations += law.of_forces @ forces
        if self._late.remembers:
            self._late.note(time_ns, accelerations)
        if (parts := layout.reference) is None:
            return self._say_down(time_ns, NULL, accelerations)
        further = np.empty(parts.size)
        further[parts.accelerations] = accelerations
        further[parts.rates] = all_rates
        further[parts.forces] = forces
        return self._say_down(time_ns, further, accelerations)

    def _say_up(self, time_ns: int, state: Values) -> tuple[Message, ...]:
        """Returns the message to the parent; none if the parent is not due when the node is."""
        due_ns = time_ns - time_ns % self._node.period_ns
        if self._parent is None or due_ns % self._parent.period_ns:
            return ()
        return (Message(Channel.GROUP_STATE, self.index, time_ns // self._parent.period_ns, time_ns, state),)

    def _say_down(self, time_ns: int, reference: Values, command: Values) -> tuple[Message, ...]:
        """Returns the messages to the children: REFERENCE for child nodes, COMMAND for robots."""
        number = time_ns // self._node.period_ns
        messages = []
        if self._layout.reference is not None:
            messages.append(Message(Channel.REFERENCE, self.index, number, time_ns, reference))
        if self._layout.command is not None:
            messages.append(Message(Channel.COMMAND, self.index, number, time_ns, command))
        return tuple(messages)


def _pair_forces(plan: Plan, node: NodePlan) -> PairForces:
    """Returns the forces between robots that are below different children of a node."""
    bounds = accumulate(node.weights, initial=0)
    below = [range(first, last) for first, last in pairwise(bounds)]
    return PairForces(*pairs_between(below), node.robots, plan.avoidance)
