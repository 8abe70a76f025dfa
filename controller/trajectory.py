"""Desired trajectories of the centroid, z_cd(t), with their first two derivatives.

A trajectory is a function of time [s] that returns position [m], velocity [m/s] and acceleration [m/s²] as one (3, 2)
array.  To add one: write a class with `at`, enter it in `TRAJECTORIES`, and give `echelon.scenario` a table of its keys.
"""

from dataclasses import dataclass
from math import cos, sin
from typing import Final, Protocol

import numpy as np

from echelon.plan import Array, TrajectoryPlan

Point = tuple[float, float]


class Trajectory(Protocol):
    """What a node asks of a trajectory."""

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""


@dataclass(frozen=True, slots=True)
class Line:
    """z_cd = start + velocity t"""

    start: Point
    velocity: Point

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        (x, y), (vx, vy) = self.start, self.velocity
        return np.array([[x + vx * t, y + vy * t], [vx, vy], [0.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Circle:
    """z_cd = centre + radius (cos φ, sin φ), φ = rate t + phase"""

    centre: Point
    radius: float
    rate: float
    phase: float

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        phi, rate = self.rate * t + self.phase, self.rate
        c, s = self.radius * cos(phi), self.radius * sin(phi)
        return np.array(
            [[self.centre[0] + c, self.centre[1] + s], [-rate * s, rate * c], [-(rate**2) * c, -(rate**2) * s]]
        )


@dataclass(frozen=True, slots=True)
class Sine:
    """z_cd = start + (speed t, amplitude sin(rate t)): the paper's, with speed 1, amplitude 30, rate 0.1"""

    start: Point
    speed: float
    amplitude: float
    rate: float

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        s, c = self.amplitude * sin(self.rate * t), self.amplitude * cos(self.rate * t)
        return np.array(
            [
                [self.start[0] + self.speed * t, self.start[1] + s],
                [self.speed, self.rate * c],
                [0.0, -(self.rate**2) * s],
            ]
        )


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Straight from point to point, at rest in each, with least jerk in between: over a leg from q to p,

    z_cd = q + (p - q)(10 s³ - 15 s⁴ + 6 s⁵),   s = (t - t_q)/(t_p - t_q) in [0, 1].

    Before the first time and after the last it rests.
    """

    points: tuple[Point, ...]
    times: tuple[float, ...]

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        leg = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2))
        q, p = np.array(self.points[leg]), np.array(self.points[leg + 1])
        length = self.times[leg + 1] - self.times[leg]
        s = min(max((t - self.times[leg]) / length, 0.0), 1.0)
        ratio = s**3 * (10 - 15 * s + 6 * s**2)
        rate = 30 * s**2 * (1 - s) ** 2 / length
        bend = 60 * s * (1 - s) * (1 - 2 * s) / length**2
        return np.array([q + (p - q) * ratio, (p - q) * rate, (p - q) * bend])


TRAJECTORIES: Final = {"line": Line, "circle": Circle, "sine": Sine, "waypoints": Waypoints}


def make_trajectory(plan: TrajectoryPlan) -> Trajectory:
    """Returns the trajectory that a plan names.  Raises ValueError on an unknown kind."""
    if plan.kind not in TRAJECTORIES:
        raise ValueError(f"trajectory {plan.kind!r}: must be one of {', '.join(TRAJECTORIES)}")
    trajectory: Trajectory = TRAJECTORIES[plan.kind](**plan.parameters)
    return trajectory


def sample(trajectory: Trajectory, times: Array) -> Array:
    """Returns the trajectory at many instants [s], (T, 3, 2)."""
    return np.array([trajectory.at(t) for t in times.tolist()]).reshape(-1, 3, 2)
