"""A robot's own numbers, from its plan to its record."""

from math import hypot, sqrt
from typing import Any

from echelon.agents.plant import GRAVITY, Hill, Paper
from echelon.plan.plan import RobotPlan
from echelon.sim.batch import records as r


def motion_of(robot: RobotPlan) -> dict[str, Any]:
    """Returns how a robot moves: its periods, torque loop, limits and plant (agents.plant, agents.torque)."""
    h = robot.torque_period_ns * 1e-9
    m, d, radius, arm = robot.mass, robot.offset, robot.wheel_radius, robot.arm
    infinite = float("inf")
    found = {
        "period_ns": robot.period_ns,
        "torque_period_ns": robot.torque_period_ns,
        "torque_periods": robot.period_ns // robot.torque_period_ns,
        "limited": min(robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit) != infinite,
        "h": h,
        "offset": d,
        "per_offset": 1 / d,
        "half_sum": m * radius / 2,
        "half_difference": (robot.inertia - m * d * d) * radius / (d * arm) / 2,
        "torque_limit": robot.torque_limit,
        "torque_rate_limit": robot.torque_rate_limit,
        "speed_limit": robot.wheel_speed_limit * radius,
        "arm": arm,
        "x": robot.start[0],
        "y": robot.start[1],
        "heading": robot.heading,
    }
    plant = robot.model.made
    if isinstance(plant, Paper):
        per_difference = arm / ((robot.inertia - m * d**2) * radius)
        return found | {"plant": r.PAPER, "per_sum": 1 / (m * radius), "per_difference": per_difference}
    load, pull, resistance = 0.0, (0.0, 0.0), 0.0
    if isinstance(plant, Hill):
        steep = -GRAVITY / hypot(1.0, *plant.rise)
        load, pull, resistance = plant.load, (steep * plant.rise[0], steep * plant.rise[1]), plant.resistance
    m += load
    inertia = robot.inertia + load * d**2
    drag, turn_drag, lever = resistance / m, resistance * arm**2 / inertia, m * d / inertia
    return found | {
        "plant": r.BODY,
        "per_sum": 1 / (m * radius),
        "per_difference": arm / (radius * inertia),
        "lever": lever,
        "pull_x": pull[0],
        "pull_y": pull[1],
        "drag": drag,
        "turn_drag": turn_drag,
        "always": drag + turn_drag + sqrt(lever * hypot(*pull)),
    }
