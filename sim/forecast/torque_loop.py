"""Whether the torque loop inside each robot is stable at the speed that is asked of it (docs/architecture.md, 2.7).

A robot that moves straight ahead at v, without a desired acceleration, turns into its direction of travel: ω̇ = -(v/d) ω.  Its
torque loop computes this for the middle of the torque period h, and holds it for the period.  So a small yaw rate is multiplied
by a factor in each period; for the paper's plant this is, with q = h v/d,

    ω⁺ = (1 - q + q²/2) ω

Here the factor is that of the robot's own plant and inverse, by differences of one step.  On the closed torque path torques may
come k periods late; then the factor is the largest root of z^{k+1} - z^k + (1 - ω⁺/ω) = 0.  Limits of torque and speed are not
part of it: `motion` compares them with what is asked.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from echelon.agents.plant import state_at
from echelon.agents.torque import make_inverse
from echelon.messages import Channel
from echelon.plan.plan import Plan, RobotPlan

SMALL: Final = 1e-5
"""The yaw rate that is followed through a period, as a share of v/d"""
HALVINGS: Final = 40
"""Halvings in the search for the longest torque period"""


@dataclass(frozen=True, slots=True)
class TorqueLoop:
    """The torque loop of a robot at the largest speed that is asked of it."""

    robot: str
    speed: float
    """v [m/s]"""
    period: float
    """h, the torque period [s]"""
    factor: float
    """By how much a yaw rate is multiplied in a period; the loop is stable if it is below 1"""
    longest_period: float | None
    """The longest torque period for which it is stable at this speed [s]; None if the robot does not move"""

    @property
    def is_stable(self) -> bool:
        """True if a small yaw rate dies away."""
        return self.factor < 1 or self.longest_period is None


def torque_loops(plan: Plan, speeds: list[float]) -> tuple[TorqueLoop, ...]:
    """Returns the torque loops of all robots; `speeds` are those asked of them [m/s]."""
    late: dict[int, int] = {}
    for link in plan.links:
        if link.channel is Channel.TORQUE:
            late[link.source] = max(link.delay_max_ns, late.get(link.source, 0))
    known: dict[tuple[object, ...], tuple[float, float | None]] = {}
    found = []
    for robot, speed in zip(plan.robots, speeds, strict=True):
        h_ns = robot.torque_period_ns
        periods = -(-late.get(robot.index, 0) // h_ns)
        like = (
            robot.model.use,
            robot.model.made,
            robot.mass,
            robot.inertia,
            robot.wheel_radius,
            robot.arm,
            robot.offset,
        )
        key = (repr(like), h_ns, speed, periods)
        if key not in known:
            known[key] = _of_robot(robot, speed, h_ns * 1e-9, periods)
        found.append(TorqueLoop(robot.name, speed, h_ns * 1e-9, *known[key]))
    return tuple(found)


def _of_robot(robot: RobotPlan, speed: float, h: float, periods: int) -> tuple[float, float | None]:
    """Returns the factor of a robot, and the longest stable torque period."""
    if not 0 < speed < np.inf:
        return (1.0, None) if speed == 0 else (np.inf, 0.0)

    def factor(h: float) -> float:
        once = _once(robot, speed, h)
        if not periods:
            return abs(once)
        return float(np.abs(np.roots([1, -1, *[0] * (periods - 1), 1 - once])).max())

    low, high = 0.0, 4 * abs(robot.offset) / speed
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if factor(middle) < 1 else (low, middle)
    return factor(h), low


def _once(robot: RobotPlan, speed: float, h: float) -> float:
    """Returns dω⁺/dω of one torque period h [s] at ω = 0."""
    inverse, step = make_inverse(robot), robot.model.made.step_of(robot)
    small = SMALL * speed / abs(robot.offset)
    after = []
    for omega in (small, -small):
        try:
            state = state_at(0.0, 0.0, 0.0, speed, omega)
            after.append(step(state, *inverse(state, 0.0, 0.0, 0.5 * h), h).omega)
        except (ValueError, OverflowError):
            return float("inf")
    return float((after[0] - after[1]) / (2 * small))
