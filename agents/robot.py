"""The role of a robot: it sends its state, takes an acceleration, and moves under its torque loop until the next one.

The torque loop has its own period and runs inside the robot.  The torques of a period are in the STATE message at the end of
the period: a message of their own would double the number of messages.  On the closed torque path drives turn the wheels;
the robot sends the wanted torques in TORQUE messages, and moves with the torques that the drives report
(docs/architecture.md, 5.1 and 5.2).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from math import nan
from operator import add
from typing import Final

import numpy as np

from echelon.agents.plant import LOST, RobotState, make_step, state_at
from echelon.agents.torque import TorqueLimits, make_inverse
from echelon.agents.torque_loop import Loop, constants, usual
from echelon.messages import Channel, Heard, Message
from echelon.plan.layout import acceleration_of
from echelon.plan.plan import Plan
from echelon.role import Acts, Input, Stage
from echelon.runtime.turns import Turn

Sums = tuple[float, float, float, float, float, float, int]
"""Over torque periods: of both torques the sums, the sums of squares and the largest magnitudes, right wheel first; the number
of torque periods in which a torque was limited"""
_LOST_SUMS: Final[Sums] = (nan, nan, nan, nan, nan, nan, 0)
"""Of a period in which the run diverged"""


class Robot:
    """One robot of a plan, where torque is mirrored: it moves with the torques that it computes.

    It computes torques at the beginning of each torque period.  An event-driven robot takes an acceleration in the instant of
    its arrival, and computes torques anew for the rest of the torque period (docs/architecture.md, 4.6).  The motion up to an
    instant is computed when it is needed: when the robot sends its state, and when an acceleration arrives.  `loop` is the
    usual torque loop, as Python or compiled."""

    def __init__(self, plan: Plan, index: int, loop: Loop = usual) -> None:
        robot = plan.robots[index]
        self.index = index
        self._plan = robot
        self._loop, self._constants = loop, constants(robot)
        self._step = make_step(robot)
        self._inverse = make_inverse(robot)
        self._limits = TorqueLimits(
            robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit, robot.wheel_radius, robot.arm
        )
        self._limited = any(
            limit != float("inf") for limit in (robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit)
        )
        self._torque_periods = robot.period_ns // robot.torque_period_ns
        self._h_ns, self._h = robot.torque_period_ns, robot.torque_period_ns * 1e-9
        self._acceleration_part = acceleration_of(robot)
        self.state = state_at(*robot.start, robot.heading, 0.0, 0.0)
        self._moved_ns = 0  # instant of `state`
        self._a: tuple[float, float] | None = None  # commanded acceleration [m/s²]; None: no command
        self._held = self._h  # how long the torques have been held that the limits know [s]
        self._sums = _TorqueSums()
        self._period_values = (0.0,) * 9
        acts = Acts.ON_ARRIVAL if robot.event_driven else Acts.AT_INSTANT
        self.stages: tuple[Stage, ...] = (
            Stage(Turn.SAY, robot.period_ns, (), self._say),
            Stage(Turn.ACT, robot.period_ns, (Input(robot.parent, Channel.COMMAND),), self._obey, acts=acts),
        )

    def _say(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Returns the STATE message at `time_ns`."""
        if time_ns > 0:
            self._end_period(time_ns)
        x, y, theta, v, omega, c, s = self.state
        across = self._plan.offset * omega
        values = np.array((x, y, v * c - across * s, v * s + across * c, theta, v, omega, *self._period_values))
        return (Message(Channel.STATE, self.index, time_ns // self._plan.period_ns, time_ns, values),)

    def _obey(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """Follows the commanded acceleration from `time_ns` on; without a command the torques are zero."""
        if time_ns > self._moved_ns:
            self._move(time_ns)
        command = heard[0]
        self._a = None
        if command is not None:
            ax, ay = command.values[self._acceleration_part].tolist()
            self._a = ax, ay
        return ()

    def _end_period(self, time_ns: int) -> None:
        """Moves to the end of a period, and sums it up for the STATE message."""
        count = self._torque_periods
        if time_ns - self._moved_ns == count * self._h_ns:  # nothing arrived within the period
            try:
                sums = self._pass_torque_periods(count)
            except (ValueError, OverflowError):  # the run diverged: angles and speeds overflow
                self.state, sums = LOST, _LOST_SUMS
            self._moved_ns = time_ns
        else:
            self._move(time_ns)
            sums = self._sums.taken()
        right, left, right_square, left_square, right_peak, left_peak, saturated = sums
        self._period_values = (
            *(self._a or (0.0, 0.0)), right / count, left / count, right_square / count, left_square / count,
            right_peak, left_peak, float(saturated),
        )  # fmt: skip

    def _move(self, until_ns: int) -> None:
        """Moves until an instant with the acceleration that holds."""
        h_ns = self._h_ns
        try:
            while (now_ns := self._moved_ns) < until_ns:
                left_ns, whole = h_ns - now_ns % h_ns, (until_ns - now_ns) // h_ns
                if left_ns == h_ns and whole:
                    self._moved_ns += whole * h_ns
                    self._sums.add_sums(self._pass_torque_periods(whole))
                else:  # an acceleration arrives within this torque period, or has arrived
                    span_ns = min(left_ns, until_ns - now_ns)
                    self._moved_ns += span_ns
                    self._pass_part(span_ns * 1e-9, left_ns * 1e-9, first=left_ns == h_ns)
        except (ValueError, OverflowError):  # the run diverged
            self.state, self._moved_ns = LOST, until_ns
            self._sums.add_sums(_LOST_SUMS)

    def _pass_torque_periods(self, count: int) -> Sums:
        """Runs the torque loop and the plant through whole torque periods; returns the sums over them."""
        h, state, step, inverse, limits = self._h, self.state, self._step, self._inverse, self._limits
        right_sum = left_sum = right_square = left_square = right_peak = left_peak = 0.0
        passed = saturated = 0
        commanded, held = self._a is not None, self._held
        ax, ay = self._a or (0.0, 0.0)
        if self._constants is not None:
            last = limits.tau_right, limits.tau_left, held
            passed, after, last, sums = self._loop(count, state, (ax, ay, float(commanded)), last, self._constants)
            state, (right_sum, left_sum, right_square, left_square, right_peak, left_peak) = RobotState(*after), sums
            if self._limited:
                limits.tau_right, limits.tau_left, held = last
        for _ in range(count - passed):
            right = left = 0.0
            if commanded:
                right, left = inverse(state, ax, ay, 0.5 * h)
            if self._limited:
                right, left, limited = limits.apply(right, left, state.v, state.omega, held)
                saturated += limited
                held = h
            state = step(state, right, left, h)
            right_sum += right
            left_sum += left
            right_square += right * right
            left_square += left * left
            right_peak = max(right_peak, abs(right))
            left_peak = max(left_peak, abs(left))
        self.state, self._held = state, held
        return right_sum, left_sum, right_square, left_square, right_peak, left_peak, saturated

    def _pass_part(self, span: float, left: float, *, first: bool) -> None:
        """Runs the torque loop and the plant through `span` [s] of a torque period of which `left` [s] are left.

        `first`: the torque period begins now."""
        state, sums = self.state, self._sums
        right = left_torque = 0.0
        if self._a is not None:
            right, left_torque = self._inverse(state, *self._a, 0.5 * left)
        if first:
            sums.part_saturated = False
        if self._limited:
            right, left_torque, limited = self._limits.apply(right, left_torque, state.v, state.omega, self._held)
            sums.saturated += limited and not sums.part_saturated
            sums.part_saturated |= limited
        self._held = span
        self.state = self._step(state, right, left_torque, span)
        sums.add(right, left_torque, span / self._h)


@dataclass(slots=True)
class _TorqueSums:
    """Sums over the torques of one period, in torque periods."""

    right: float = 0.0
    left: float = 0.0
    right_square: float = 0.0
    left_square: float = 0.0
    right_peak: float = 0.0
    left_peak: float = 0.0
    saturated: int = 0
    """Torque periods in which a torque was limited"""
    part_saturated: bool = False
    """True if a torque was limited in an earlier part of the present torque period"""

    def add(self, right: float, left: float, share: float) -> None:
        """Adds torques that were held for a share of a torque period."""
        self.right += share * right
        self.left += share * left
        self.right_square += share * right * right
        self.left_square += share * left * left
        self.right_peak = max(self.right_peak, abs(right))
        self.left_peak = max(self.left_peak, abs(left))

    def add_sums(self, sums: Sums) -> None:
        """Adds the sums over whole torque periods."""
        right, left, right_square, left_square, right_peak, left_peak, saturated = sums
        self.right += right
        self.left += left
        self.right_square += right_square
        self.left_square += left_square
        self.right_peak = max(right_peak, self.right_peak)
        self.left_peak = max(left_peak, self.left_peak)
        self.saturated += saturated

    def taken(self) -> Sums:
        """Returns the sums, and begins anew."""
        sums = (
            *(self.right, self.left, self.right_square, self.left_square, self.right_peak, self.left_peak),
            self.saturated,
        )
        self.right = self.left = self.right_square = self.left_square = self.right_peak = self.left_peak = 0.0
        self.saturated = 0
        return sums


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
        return ()

    def _end_period(self, time_ns: int) -> None:
        """Sums up the torques of the period that ends; the motion is that of CATCH_UP."""
        right, left = zip(*self._torques, strict=True)
        n = len(self._torques)
        self._period_values = (
            *self._commanded,
            _total(right) / n,
            _total(left) / n,
            _total(tau * tau for tau in right) / n,
            _total(tau * tau for tau in left) / n,
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
            ax, ay = self._commanded = command.values[self._acceleration_part].tolist()
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


def make_robot(plan: Plan, index: int, loop: Loop = usual) -> Robot:
    """Returns the role of a robot: `RobotOnBus` if the torque path is closed, otherwise `Robot` with its usual torque loop."""
    return RobotOnBus(plan, index) if plan.can.closed else Robot(plan, index, loop)


def _total(values: Iterable[float]) -> float:
    """Returns the sum, added from left to right.  From Python 3.12 on `sum` compensates for rounding, and gives other bits."""
    return reduce(add, values, 0.0)
