"""Robots and nodes of the linear run (`controller.prediction.linear_run`): roles whose messages are matrices.

Each column of such a matrix belongs to another run; all runs are computed at once.  Positions are relative to the desired
motion.  So the desired trajectory and the desired shapes are zero, and all stages are linear without constant terms.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from echelon.controller.laws.in_tree import is_linear
from echelon.controller.node import NodeLaw
from echelon.controller.prediction.gains import linear_gains
from echelon.controller.transformation import node_matrix
from echelon.messages import Channel
from echelon.plan.layout import CENTROID, GroupStateLayout, NodeLayout, ReferenceLayout, acceleration_of
from echelon.plan.plan import Array, NodePlan, Plan, RobotPlan
from echelon.runtime.turns import Turn, level

MOTION: Final = (0, 0, 1, 1)
"""The powers of 1/s in the units of (x, y, vx, vy).  A length has 0, a velocity 1, an acceleration 2, the integral of a length
-1"""

Said = dict[Channel, Array]
"""The messages that a stage sends, by channel; each is (numbers in the message, runs)"""


@dataclass(frozen=True, slots=True)
class LinearStage:
    """A stage: at multiples of `period_ns`, `run` is called with the message of each of `inputs`."""

    level: int
    """Place in the order of the stages of one instant"""
    period_ns: int
    source: int
    """Index of the role"""
    inputs: tuple[tuple[int, int, Channel], ...]
    """Source, receiver and channel of the links whose messages it uses"""
    run: Callable[[Sequence[Array]], Said]


def powers_of(plan: Plan, source: int, channel: Channel) -> tuple[int, ...]:
    """Returns for each number in a message the power of 1/s in its unit."""
    if channel is Channel.STATE:
        return MOTION
    if channel is Channel.TORQUE:
        return (2, 2)
    node = plan.nodes[source - len(plan.robots)]
    if channel is Channel.GROUP_STATE:
        return MOTION + (1,) * (GroupStateLayout.of(plan, node).size - len(MOTION))
    accelerations = (2, 2) * len(node.children)
    if channel is Channel.COMMAND:
        return accelerations
    return accelerations + (1,) * (ReferenceLayout.of(plan, node).size - len(accelerations))


class LinearRobot:
    """A robot as a double integrator: it moves under the acceleration of its last command.

    On a closed torque path it asks for this acceleration in each torque period, in a message over the link of its torques."""

    def __init__(self, plan: Plan, robot: RobotPlan) -> None:
        self.powers = MOTION
        self.memory: Array = np.zeros((len(MOTION), 0))
        """(x, y, vx, vy)"""
        self._mine = acceleration_of(robot)
        index, period_ns = robot.index, robot.torque_period_ns if plan.can.closed else robot.period_ns
        T = period_ns * 1e-9
        self._drift, self._push = np.kron([[1.0, T], [0.0, 1.0]], np.eye(2)), np.kron([[T**2 / 2], [T]], np.eye(2))
        say = LinearStage(level(plan, Turn.SAY, 0), robot.period_ns, index, (), self._say)
        command, act = ((robot.parent, index, Channel.COMMAND),), level(plan, Turn.ACT, 0)
        if plan.bridge is None:
            self.stages: tuple[LinearStage, ...] = (say, LinearStage(act, period_ns, index, command, self._act))
        else:
            torque, serve = ((index, plan.bridge.index, Channel.TORQUE),), level(plan, Turn.SERVE, 0)
            ask, move = self._ask, self._move
            self.stages = (
                say,
                LinearStage(act, period_ns, index, command, ask),
                LinearStage(serve, period_ns, index, torque, move),
            )

    def _say(self, heard: Sequence[Array]) -> Said:
        return {Channel.STATE: self.memory}

    def _act(self, heard: Sequence[Array]) -> Said:
        return self._move([heard[0][self._mine]])

    def _ask(self, heard: Sequence[Array]) -> Said:
        return {Channel.TORQUE: heard[0][self._mine]}

    def _move(self, heard: Sequence[Array]) -> Said:
        self.memory = self._drift @ self.memory + self._push @ heard[0]
        return {}


class LinearNode:
    """A node of the tree; it computes the same as `controller.node.TreeNode`."""

    def __init__(self, plan: Plan, node: NodePlan) -> None:
        """Raises PredictionError if the plan's law is not linear."""
        self._coupled, self._is_root = plan.coupled, node.parent is None
        self._law, self._layout = NodeLaw.of(plan, node), NodeLayout.of(plan, node)
        self._blocks = None if is_linear(plan) else _LinearBlocks(plan, node)
        size = 0 if self._blocks is None else self._blocks.size
        self.powers = (-1,) * size
        self.memory: Array = np.zeros((size, 0))
        """The integrals q of the law's integral action"""
        self._s: Array = np.zeros((0, 0))
        self._state: Array = np.zeros((0, 0))
        index, robots = node.index, len(plan.robots)
        children = tuple(
            (child, index, Channel.STATE if child < robots else Channel.GROUP_STATE) for child in node.children
        )
        parent = () if node.parent is None else ((node.parent, index, Channel.REFERENCE),)
        gather, steer = (level(plan, turn, node.depth) for turn in (Turn.GATHER, Turn.STEER))
        self.stages = (
            LinearStage(gather, node.period_ns, index, children, self._gather),
            LinearStage(steer, node.period_ns, index, parent, self._steer),
        )

    def _gather(self, heard: Sequence[Array]) -> Said:
        """Takes the children's states; returns the group's state for the parent, nothing at the root."""
        self._s = s = np.vstack([values[CENTROID] for values in heard])
        own, layout = self._law.up @ s, self._layout.state
        self._state = state = np.empty((layout.size, s.shape[1]))
        state[layout.centroid] = own[: len(MOTION)]
        if self._coupled:
            state[layout.own_rates] = own[len(MOTION) :]
        for child, there, here in self._layout.carried:
            state[here] = heard[child][there]
        if not self._is_root:
            return {Channel.GROUP_STATE: state}
        if self._coupled:
            state[layout.centroid_rates] = own[2:4]
        return {}

    def _steer(self, heard: Sequence[Array]) -> Said:
        """Takes the parent's reference; returns references and commands for the children."""
        mine = self._layout.mine
        if mine is None:
            c, rates = np.zeros((6, self._s.shape[1])), self._state[self._layout.state.rates]
        else:
            c, rates = heard[0][mine.acceleration], heard[0][mine.rates]
        accelerations = self._law.down @ np.vstack((self._s, c, rates))
        if self._blocks is not None:
            further, self.memory = self._blocks(self._s, self.memory)
            accelerations += further
        said = {}
        if self._layout.command is not None:
            said[Channel.COMMAND] = accelerations
        if self._layout.reference is not None:
            said[Channel.REFERENCE] = np.vstack((accelerations, rates))
        return said


class _LinearBlocks:
    """The blocks of a node under a linear law that nodes call block by block, like `controller.laws.in_tree.NodeBlocks`."""

    def __init__(self, plan: Plan, node: NodePlan) -> None:
        blocks = [plan.block_of(node.index), *plan.blocks[-1:]] if node.parent is None else [plan.block_of(node.index)]
        gains = [linear_gains(plan, block) for block in blocks]
        self._K_1, self._K_2, self._K_i = (
            block_diag(*(getattr(each, name) for each in gains)) for name in ("K_1", "K_2", "K_i")
        )
        # A component of q without effect would keep its value for ever: an eigenvalue of 1 that says nothing about the run.
        self._uses_q = np.any(self._K_i, axis=0, keepdims=True).T
        self.size = len(self._K_1)
        phi = node_matrix(node.weights)
        self._back = np.kron(np.linalg.inv(phi), np.eye(2))[:, : self.size]
        errors = np.kron(phi, np.eye(4)).reshape(
            len(phi), 2, 2, -1
        )  # axes: variable, order of the derivative, x or y, then s
        self._e = errors[:, 0].reshape(2 * len(phi), -1)[: self.size]
        self._e_dot = errors[:, 1].reshape(2 * len(phi), -1)[: self.size]
        self._T = node.period_ns * 1e-9

    def __call__(self, s: Array, q: Array) -> tuple[Array, Array]:
        """Returns Φ_node⁻¹ η and the next q."""
        e, e_dot = self._e @ s, self._e_dot @ s
        eta = -(self._K_1 @ e) - self._K_2 @ e_dot - self._K_i @ q
        return self._back @ eta, self._uses_q * (q + self._T * e + self._T**2 / 2 * e_dot)
