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
from echelon.controller.prediction.schedule import TimedStage
from echelon.controller.transformation import node_matrix
from echelon.messages import Channel
from echelon.plan.layout import CENTROID, GroupStateLayout, NodeLayout, ReferenceLayout, acceleration_of
from echelon.plan.plan import Array, NodePlan, Plan, RobotPlan
from echelon.role import Acts, Input
from echelon.runtime.turns import Turn, level

MOTION: Final = (0, 0, 1, 1)
"""The powers of 1/s in the units of (x, y, vx, vy).  A length has 0, a velocity 1, an acceleration 2, the integral of a length
-1"""

Said = dict[Channel, Array]
"""The messages that a stage sends, by channel; each is (numbers in the message, runs)"""


Heard = Sequence[tuple[int, Sequence[Array]]]
"""The acts of a stage in one of its periods: how long after the beginning of the period [ns], and what was heard"""


@dataclass(frozen=True, slots=True)
class LinearStage:
    """A stage: `run` takes its acts in one of its periods."""

    timed: TimedStage
    run: Callable[[Heard], Said]


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


def moved(memory: Array, a: Array, T: float) -> Array:
    """Returns positions and velocities, (4, runs), after a time T [s] under accelerations a, (2, runs)."""
    position, velocity = memory[:2], memory[2:]
    return np.vstack((position + T * velocity + T**2 / 2 * a, velocity + T * a))


class LinearRobot:
    """A robot as a double integrator: it moves under the acceleration of its last command.

    On a closed torque path it asks for this acceleration in each torque period, in a message over the link of its torques."""

    def __init__(self, plan: Plan, robot: RobotPlan) -> None:
        self.powers = MOTION
        self.memory: Array = np.zeros((len(MOTION), 0))
        """(x, y, vx, vy)"""
        self._mine = acceleration_of(robot)
        index, period_ns = robot.index, robot.period_ns
        command = (Input(robot.parent, Channel.COMMAND),)
        says = ((Channel.STATE, period_ns),)
        say = TimedStage(Turn.SAY, level(plan, Turn.SAY, 0), period_ns, index, (), Acts.IN_TURN, says)
        at = level(plan, Turn.ACT, 0)
        self.stages: tuple[LinearStage, ...]
        if plan.bridge is None:
            acts = Acts.ON_ARRIVAL if robot.event_driven else Acts.AT_INSTANT
            act = TimedStage(Turn.ACT, at, period_ns, index, command, acts, ())
            self._period_ns = period_ns
            self.stages = LinearStage(say, self._say), LinearStage(act, self._act)
        else:
            self._period_ns = h_ns = robot.torque_period_ns
            ask = TimedStage(Turn.ACT, at, h_ns, index, command, Acts.IN_TURN, ((Channel.TORQUE, h_ns),))
            at, torque = level(plan, Turn.SERVE, 0), (Input(index, Channel.TORQUE),)
            serve = TimedStage(Turn.SERVE, at, h_ns, plan.bridge.index, torque, Acts.IN_TURN, ())
            self.stages = LinearStage(say, self._say), LinearStage(ask, self._ask), LinearStage(serve, self._serve)

    def _say(self, heard: Heard) -> Said:
        return {Channel.STATE: self.memory}

    def _act(self, heard: Heard) -> Said:
        return self._move([(after_ns, command[self._mine]) for after_ns, (command,) in heard])

    def _ask(self, heard: Heard) -> Said:
        ((_, (command,)),) = heard
        return {Channel.TORQUE: command[self._mine]}

    def _serve(self, heard: Heard) -> Said:
        return self._move([(after_ns, torque) for after_ns, (torque,) in heard])

    def _move(self, accelerations: Sequence[tuple[int, Array]]) -> Said:
        """Moves through a period; each acceleration holds from its instant after the beginning of the period [ns]."""
        ends = [after_ns for after_ns, _ in accelerations[1:]] + [self._period_ns]
        for (after_ns, a), end_ns in zip(accelerations, ends, strict=True):
            self.memory = moved(self.memory, a, (end_ns - after_ns) * 1e-9)
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
        self.s: Array = np.zeros((len(MOTION) * len(node.children), 0))
        """Positions and velocities of its children at its last upward act"""
        self.state: Array = np.zeros((self._layout.state.size, 0))
        """Its GROUP_STATE of that act"""
        robots = len(plan.robots)
        children = tuple(
            Input(child, Channel.STATE if child < robots else Channel.GROUP_STATE) for child in node.children
        )
        parent = () if node.parent is None else (Input(node.parent, Channel.REFERENCE),)
        up: tuple[tuple[Channel, int], ...] = ()
        if node.parent is not None:
            up = ((Channel.GROUP_STATE, plan.nodes[node.parent - robots].period_ns),)
        down = [
            (channel, node.period_ns)
            for channel, layout in (
                (Channel.REFERENCE, self._layout.reference),
                (Channel.COMMAND, self._layout.command),
            )
            if layout is not None
        ]
        acts = Acts.WHEN_HEARD if node.event_driven else Acts.AT_INSTANT
        gather, steer = (
            TimedStage(turn, level(plan, turn, node.depth), node.period_ns, node.index, inputs, acts, tuple(says))
            for turn, inputs, says in ((Turn.GATHER, children, up), (Turn.STEER, parent, down))
        )
        self.stages = LinearStage(gather, self._gather), LinearStage(steer, self._steer)

    def _gather(self, acts: Heard) -> Said:
        """Takes the children's states; returns the group's."""
        ((_, heard),) = acts
        self.s = s = np.vstack([values[CENTROID] for values in heard])
        own, layout = self._law.up @ s, self._layout.state
        self.state = state = np.empty((layout.size, s.shape[1]))
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

    def _steer(self, acts: Heard) -> Said:
        """Takes the parent's reference; returns references and commands for the children."""
        ((_, heard),) = acts
        mine = self._layout.mine
        if mine is None:
            c, rates = np.zeros((6, self.s.shape[1])), self.state[self._layout.state.rates]
        else:
            c, rates = heard[0][mine.acceleration], heard[0][mine.rates]
        accelerations = self._law.down @ np.vstack((self.s, c, rates))
        if self._blocks is not None:
            further, self.memory = self._blocks(self.s, self.memory)
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
