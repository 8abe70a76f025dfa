"""A scenario of two robots, for runs on a wall clock: a busy machine delays few processes less than many."""

from typing import Final

_TEXT: Final = """
name = "two"
duration = 60.0
robot = { mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }
law = { epsilon = [0.5, 0.5], lead = 0.5 }
trajectory = { kind = "line", velocity = [0.3, 0.0] }
formation.groups.a.shape = { kind = "line", spacing = 1.0 }
formation.groups.a.robots = { a1 = { start = [0, 1.5] }, a2 = { start = [1, 1.5] } }
"""


def two_robots(watchdog: float) -> str:
    """Returns the scenario with a watchdog [s]."""
    return f"{_TEXT}can.watchdog = {watchdog}\n"
