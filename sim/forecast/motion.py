"""Warnings about the motion that a scenario asks of its robots: torque at the start, wheel speed, speed of the torque loop.

The motion is computed for points that follow the desired accelerations exactly, over ideal links, in the first `STEPS` periods.

If a robot leaves its reach (`sim.parts.reach`), the computed motion diverges.  Then its speeds say nothing, and only those of
the trajectory count.

*Torque* at the start: by the inverse dynamics of docs/architecture.md, 2.1, for a robot at rest with its own heading.

*Wheel speed*: a robot that moves straight ahead at |v| turns its wheels at |v|/r; in a turn one wheel is faster.

*Torque loop*: see `torque_loop`; q = h v/d says how near the torque period h is to its edge.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from echelon.agents.plant import state_at
from echelon.agents.torque import make_inverse
from echelon.controller.laws.central import CentralLaw
from echelon.controller.trajectory import make_trajectory, sample
from echelon.errors import PartRunError
from echelon.plan.plan import Array, Plan, RobotPlan
from echelon.runtime.admission import LARGEST
from echelon.sim.forecast.torque_loop import torque_loops
from echelon.sim.parts.reach import Reach

STEPS: Final = 1000
"""Number of periods for which the motion is computed"""
INSTANTS: Final = 200
"""Number of instants, spread over the run, at which the speed of the trajectory is computed"""
NEAR: Final = 1.0
"""The torque loop settles slowly from this value of q on"""


@dataclass(frozen=True, slots=True)
class Asked:
    """What the scenario asks of the robots, in their order."""

    accelerations: Array
    """Accelerations at the start, (N, 2) [m/s²]"""
    speeds: Array
    """Largest speeds, of the computed motion or of the trajectory, (N,) [m/s]; of the latter alone if the motion diverges"""
    diverges_s: float | None = None
    """When the computed motion has diverged [s]; None if it does not"""


def asked_of(plan: Plan) -> Asked:
    """Returns what a plan asks of its robots.  Raises PartRunError if a user's law or trajectory fails."""
    T = min(node.period_ns for node in plan.nodes) * 1e-9
    law = CentralLaw(plan)
    positions, velocities = np.array([robot.start for robot in plan.robots]), np.zeros((len(plan.robots), 2))
    times = np.linspace(0.0, plan.duration_ns * 1e-9, INSTANTS)
    travel = np.linalg.norm(sample(make_trajectory(plan.trajectory), times)[:, 1], axis=1).max()
    still = np.full(len(plan.robots), travel)
    speeds, reach = still, Reach(plan)
    first = None
    with np.errstate(all="ignore"):
        for step in range(min(STEPS, plan.duration_ns // round(T * 1e9))):
            a = law(step * T, positions, velocities)
            first = a if first is None else first
            positions, velocities = positions + T * velocities + T**2 / 2 * a, velocities + T * a
            speed = np.linalg.norm(velocities, axis=1)
            after_s = (step + 1) * T
            far = np.linalg.norm(positions - (reach.x, reach.y), axis=1).max()
            if not (far <= reach.at(round(after_s * 1e9)) and np.isfinite(speed).all()):
                return Asked(first, still, after_s)
            speeds = np.maximum(speeds, speed)
    return Asked(velocities if first is None else first, speeds)


def motion_warnings(plan: Plan) -> list[str]:
    """Returns a line for each limit of the robots that is too low for the motion, and one if the torque loop is too slow."""
    try:
        asked = asked_of(plan)
    except PartRunError as error:
        return [str(error)]
    found = []
    torques = [_start_torque(robot, *a) for robot, a in zip(plan.robots, asked.accelerations.tolist(), strict=True)]
    beyond = [at for at, robot in enumerate(plan.robots) if not torques[at] <= robot.torque_limit]
    if beyond:
        worst = max(beyond, key=lambda at: torques[at] / plan.robots[at].torque_limit)
        most = f"{torques[worst]:.3g} N m" if torques[worst] <= LARGEST else "more torque than there can be"
        found.append(
            f"torque_limit = {plan.robots[worst].torque_limit:g}: the start asks {most} of a wheel of "
            f"{_named(plan, worst, len(beyond))}"
        )
    if asked.diverges_s is not None:
        found.append(
            f"law: the motion that is computed for ideal links diverges within {asked.diverges_s:.3g} s; "
            "what it asks of wheels is not said"
        )
    rates = [speed / robot.wheel_radius for speed, robot in zip(asked.speeds.tolist(), plan.robots, strict=True)]
    beyond = [at for at, robot in enumerate(plan.robots) if rates[at] > robot.wheel_speed_limit]
    if beyond:
        worst = max(beyond, key=lambda at: rates[at] / plan.robots[at].wheel_speed_limit)
        who = "start and trajectory ask" if asked.diverges_s is None else "the trajectory asks"
        found.append(
            f"wheel_speed_limit = {plan.robots[worst].wheel_speed_limit:g}: {who} {rates[worst]:.3g} rad/s "
            f"({asked.speeds[worst]:.3g} m/s) of {_named(plan, worst, len(beyond))}"
        )
    return [*found, *torque_loop_warnings(plan, asked)]


def torque_loop_warnings(plan: Plan, asked: Asked) -> list[str]:
    """Returns a line if the torque loop of a robot diverges, or hardly settles, at the largest speed that is asked of it."""
    q = torque_loop_numbers(plan, asked)
    loops = torque_loops(plan, asked.speeds.tolist())
    slow = [at for at, each in enumerate(q) if each >= NEAR or not loops[at].is_stable]
    if not slow:
        return []
    worst = max(slow, key=lambda at: q[at])
    robot, speed = plan.robots[worst], asked.speeds[worst]
    loop = loops[worst]
    does = "hardly settles" if loop.is_stable else "diverges"
    return [
        f"periods.torque = {robot.torque_period_ns / 1e9:g}: the torque loop of {_named(plan, worst, len(slow))} {does} at the "
        f"{speed:.3g} m/s that are asked of it; it must be well below {loop.longest_period:.3g} s"
    ]


def torque_loop_diverges(plan: Plan, asked: Asked) -> bool:
    """Returns whether the torque loop of any robot diverges at the largest speed that is asked of it."""
    return not all(loop.is_stable for loop in torque_loops(plan, asked.speeds.tolist()))


def torque_loop_numbers(plan: Plan, asked: Asked) -> list[float]:
    """Returns q = h v/d of each robot, with the largest speed v that is asked of it."""
    return [
        robot.torque_period_ns * 1e-9 * speed / abs(robot.offset)
        for robot, speed in zip(plan.robots, asked.speeds.tolist(), strict=True)
    ]


def _start_torque(robot: RobotPlan, ax: float, ay: float) -> float:
    """Returns the larger torque of both wheels [N m] for an acceleration [m/s²] from rest; infinite if it is not computable."""
    try:
        torques = make_inverse(robot)(state_at(*robot.start, robot.heading, 0.0, 0.0), ax, ay, 0.0)
    except (ValueError, OverflowError):
        return float("inf")
    return max(map(abs, torques))


def _named(plan: Plan, worst: int, count: int) -> str:
    """Returns the name of robot `worst`, and in words that it is the worst of `count` robots if there are several."""
    return plan.robots[worst].name + (f" (the worst of {count} robots)" if count > 1 else "")
