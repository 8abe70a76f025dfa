"""Desired trajectories of the centroid, z_cd(t), with their first two derivatives.

A trajectory is a function of time [s] that returns position [m], velocity [m/s] and acceleration [m/s²] as one (3, 2)
array.  To add one, derive a class from `Trajectory` (echelon.plugins).
"""

from abc import ABC, abstractmethod
from math import cos, sin
from typing import Annotated, Any, Final, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from echelon.errors import PartRunError
from echelon.plan.plan import Array
from echelon.plugins import Part, Plugin
from echelon.scenario.values import Finite, NonNegative, Point, Positive


class Trajectory(Plugin, ABC):
    """Base of all trajectories; the fields of a class are its parameters."""

    @abstractmethod
    def at(self, t: float) -> Array:
        """Returns z_cd [m], ż_cd [m/s] and z̈_cd [m/s²] at t [s], (3, 2)."""


class Desired(Protocol):
    """What a node asks of a trajectory."""

    def at(self, t: float) -> Array:
        """Returns z_cd [m], ż_cd [m/s] and z̈_cd [m/s²] at t [s], (3, 2)."""


class Line(Trajectory):
    """z_cd = start + velocity t"""

    start: Point = (0.0, 0.0)
    """Where the centroid is to be at time 0 [m]"""
    velocity: Point
    """[m/s]"""

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        (x, y), (vx, vy) = self.start, self.velocity
        return np.array([[x + vx * t, y + vy * t], [vx, vy], [0.0, 0.0]])


class Circle(Trajectory):
    """z_cd = centre + radius (cos φ, sin φ), φ = rate t + phase"""

    centre: Point = (0.0, 0.0)
    """[m]"""
    radius: Positive
    """[m]"""
    rate: Finite
    """[rad/s]; negative: clockwise"""
    phase: Finite = 0.0
    """Where on the circle at time 0, in radians [rad]"""

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        phi, rate = self.rate * t + self.phase, self.rate
        c, s = self.radius * cos(phi), self.radius * sin(phi)
        return np.array(
            [[self.centre[0] + c, self.centre[1] + s], [-rate * s, rate * c], [-(rate**2) * c, -(rate**2) * s]]
        )


class Sine(Trajectory):
    """z_cd = start + (speed t, amplitude sin(rate t)): the paper's, with speed 1, amplitude 30, rate 0.1"""

    start: Point = (0.0, 0.0)
    """Where the centroid is to be at time 0 [m]"""
    speed: Finite
    """Along the x axis [m/s]"""
    amplitude: Finite
    """[m]"""
    rate: Finite
    """[rad/s]"""

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


class Waypoints(Trajectory):
    """Straight from point to point, at rest in each, with least jerk in between: over a leg from q to p,

    z_cd = q + (p - q)(10 s³ - 15 s⁴ + 6 s⁵),   s = (t - t_q)/(t_p - t_q) in [0, 1].

    Before the first time and after the last it rests.
    """

    points: Annotated[list[Point], Field(min_length=2)]
    """Where the centroid is to be, one after the other [m]"""
    times: Annotated[list[NonNegative], Field(min_length=2)]
    """When to be at each point [s], ascending"""

    @model_validator(mode="after")
    def _times(self) -> Self:
        if len(self.times) != len(self.points):
            raise ValueError(f"{len(self.points)} points need as many times, not {len(self.times)}")
        if any(late <= early for early, late in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must ascend, and no two be equal")
        return self

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


TRAJECTORIES: Final[dict[str, type[Plugin]]] = {"line": Line, "circle": Circle, "sine": Sine, "waypoints": Waypoints}
"""What is built in, by name."""


class _Checked:
    """A trajectory that others wrote, each of its answers checked."""

    def __init__(self, part: Part[Trajectory]) -> None:
        self._part = part

    def at(self, t: float) -> Array:
        """Returns the trajectory's answer.  Raises PartRunError if it raises, or gives anything but six finite numbers."""
        try:
            answer = np.asarray(self._part.made.at(t), dtype=np.float64)
        except Exception as error:
            raise PartRunError(f"{self._part.use}: at({t:g}) raised {type(error).__name__}: {error}") from error
        if answer.shape != (3, 2):
            raise PartRunError(f"{self._part.use}: at({t:g}) has the shape {answer.shape}, not (3, 2)")
        if not np.isfinite(answer).all():
            raise PartRunError(f"{self._part.use}: at({t:g}) is not finite: {answer.tolist()}")
        return answer


def make_trajectory(part: Part[Any]) -> Desired:
    """Returns the trajectory of a plan; one that is not built in has its answers checked."""
    trajectory: Trajectory = part.made
    return trajectory if part.is_own else _Checked(part)


def sample(trajectory: Desired, times: Array) -> Array:
    """Returns the trajectory at many instants [s], (T, 3, 2)."""
    return np.array([trajectory.at(t) for t in times.tolist()]).reshape(-1, 3, 2)
