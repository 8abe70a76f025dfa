"""The role of a robot: it sends its state, takes an acceleration, and moves under its torque loop until the next one.

The torque loop has its own period and runs inside the robot.  The torques of a period are in the STATE message at the end of
the period: a message of their own would double the number of messages.  On the closed torque path drives turn the wheels;
the robot sends the wanted torques in TORQUE messages, and moves with the torques that the drives report
(docs/architecture.md, 5.1 and 5.2).
"""

from collections.abc import Sequence
from math import nan

import numpy as np

from echelon.agents.plant import LOST, make_step, state_at
from echelon.agents.torque import TorqueLimits, make_inverse
from echelon.messages import Channel, Heard, Message
from echelon.plan.layout import acceleration_of
from echelon.plan.plan import Plan
from echelon.role import Input, Stage
from echelon.runtime.turns import Turn


class Robot:
    """One robot of a plan, where torque is mirrored: it moves with the torques that it computes."""

    def __init__(self, plan: Plan, index: int) -> None:
        robot = plan.robots[index]
        self.index = index
        self._plan = robot
        self._step = make_step(robot)
        self._inverse = make_inverse(robot)
        self._limits = TorqueLimits(
            robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit, robot.wheel_radius, robot.arm
        )
        self._limited = any(
            limit != float("inf") for limit in (robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit)
        )
        self._torque_periods = robot.period_ns // robot.torque_period_ns
        self._h = robot.torque_period_ns * 1e-9
        self._acceleration = acceleration_of(robot)
        self.state = state_at(*robot.start, robot.heading, 0.0, 0.0)
        self._period_values = (0.0,) * 9
        self.stages: tuple[Stage, ...] = (
            Stage(Turn.SAY, robot.period_ns, (), self._say),
            Stage(Turn.ACT, robot.period_ns, (Input(robot.parent, Channel.COMMAND),), self._move),
        )

    def _say(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Returns the STATE message at `time_ns`."""
        x, y, theta, v, omega, c, s = self.state
        across = self._plan.offset * omega
        values = np.array((x, y, v * c - across * s, v * s + across * c, theta, v, omega, *self._period_values))
        return (Message(Channel.STATE, self.index, time_ns // self._plan.period_ns, time_ns, values),)

    def _move(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Moves to the end of the period that begins at `time_ns`, with the commanded acceleration, or with zero torque if
        there is no command."""
        command = heard[0]
        if command is None:
            ax = ay = 0.0
        else:
            ax, ay = command.values[self._acceleration].tolist()
        try:
            self._advance(ax, ay, command is not None)
        except (ValueError, OverflowError):  # the run diverged: angles and speeds overflow
            self.state = LOST
            self._period_values = (ax, ay, nan, nan, nan, nan, nan, nan, 0.0)
        return ()

    def _advance(self, ax: float, ay: float, commanded: bool) -> None:
        """Runs the torque loop and the plant through one period."""
        h, state, step, inverse, limits = self._h, self.state, self._step, self._inverse, self._limits
        right_sum = left_sum = right_square = left_square = right_peak = left_peak = 0.0
        saturated = 0
        right = left = 0.0
        for _ in range(self._torque_periods):
            if commanded:
                right, left = inverse(state, ax, ay, 0.5 * h)
            if self._limited:
                right, left, limited = limits.apply(right, left, state.v, state.omega, h)
                saturated += limited
            state = step(state, right, left, h)
            right_sum += right
            left_sum += left
            right_square += right * right
            left_square += left * left
            right_peak = max(right_peak, abs(right))
            left_peak = max(left_peak, abs(left))
        self.state = state
        n = self._torque_periods
        self._period_values = (
            ax, ay, right_sum / n, left_sum / n, right_square / n, left_square / n, right_peak, left_peak, float(saturated),
        )  # fmt: skip


class RobotOnBus(Robot):
    """One robot of a plan on the closed torque path: it moves with the torques that its drives report.

    At an instant it first moves through the torque period that ends there.  Then it sends its state.  When the command has
    come, it sends the wanted torques.
    """

    def __init__(self, plan: Plan, index: int) -> None:
        super().__init__(plan, index)
        robot = plan.robots[index]
        self._torques: list[tuple[float, float]] = []
        self._limited_count = 0
        self._commanded = (0.0, 0.0)
        assert plan.bridge is not None
        h_ns = robot.torque_period_ns
        self.stages = (
            Stage(Turn.CATCH_UP, h_ns, (Input(plan.bridge.index, Channel.WHEELS),), self._catch_up),
            Stage(Turn.SAY, robot.period_ns, (), self._say),
            Stage(Turn.ACT, h_ns, (Input(robot.parent, Channel.COMMAND),), self._want),
        )

    def _catch_up(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Moves through the torque period that ends at `time_ns`."""
        if time_ns == 0:
            return ()
        wheels = heard[0]
        at = 2 * self.index
        right, left = (0.0, 0.0) if wheels is None else wheels.values[at : at + 2].tolist()
        self._torques.append((right, left))
        try:
            self.state = self._step(self.state, right, left, self._h)
        except (ValueError, OverflowError):  # the run diverged
            self.state = LOST
        if time_ns % self._plan.period_ns == 0:
            self._sum_up()
        return ()

    def _sum_up(self) -> None:
        """Sums up the torques of the period that ends, for the next STATE message."""
        right, left = zip(*self._torques, strict=True)
        n = len(self._torques)
        self._period_values = (
            *self._commanded,
            sum(right) / n,
            sum(left) / n,
            sum(tau * tau for tau in right) / n,
            sum(tau * tau for tau in left) / n,
            max(map(abs, right)),
            max(map(abs, left)),
            float(self._limited_count),
        )
        self._torques.clear()
        self._limited_count = 0

    def _want(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Returns the TORQUE message for the torque period that begins at `time_ns`; its torques are zero without a command."""
        command, state, robot = heard[0], self.state, self._plan
        right = left = 0.0
        limited = False
        if command is None:
            self._commanded = (0.0, 0.0)
            self._limits.tau_right = self._limits.tau_left = 0.0
        else:
            ax, ay = self._commanded = command.values[self._acceleration].tolist()
            try:
                right, left = self._inverse(state, ax, ay, 0.5 * self._h)
            except (ValueError, OverflowError):
                right = left = nan
            if self._limited:
                right, left, limited = self._limits.apply(right, left, state.v, state.omega, self._h)
        self._limited_count += limited
        turning = robot.arm * state.omega
        speeds = (state.v + turning) / robot.wheel_radius, (state.v - turning) / robot.wheel_radius
        values = np.array((right, left, float(command is not None), float(limited), *speeds))
        return (Message(Channel.TORQUE, self.index, time_ns // robot.torque_period_ns, time_ns, values),)


def make_robot(plan: Plan, index: int) -> Robot:
    """Returns the role of a robot: `RobotOnBus` if the torque path is closed, otherwise `Robot`."""
    return RobotOnBus(plan, index) if plan.can.closed else Robot(plan, index)
