"""Desired trajectories z_cd(t) of the centroid, with their first two derivatives.

A trajectory is a function of time [s] that returns position [m], velocity [m/s] and acceleration [m/s²] as one array, (3, 2).
To add one, derive a class from `Trajectory` (echelon.plugins).
"""

from abc import ABC, abstractmethod
from math import cos, sin
from typing import Annotated, Any, Final, Protocol

import numpy as np

from echelon.errors import PartRunError
from echelon.parameters import Finite, Limits, NonNegative, Point, Positive
from echelon.plan.plan import Array
from echelon.plugins import PART_ERRORS, Part, Plugin


class Trajectory(Plugin, ABC):
    """Base class of all trajectories.  The fields of a class are its parameters."""

    @abstractmethod
    def at(self, t: float) -> Array:
        """Returns z_cd [m], ż_cd [m/s] and z̈_cd [m/s²] at t [s], (3, 2)."""


class Desired(Protocol):
    """The interface of a trajectory that nodes use."""

    def at(self, t: float) -> Array:
        """Returns z_cd [m], ż_cd [m/s] and z̈_cd [m/s²] at t [s], (3, 2)."""


def _rows(*numbers: float) -> Array:
    """Returns six numbers as an array, (3, 2); from a nested list numpy would make it half as fast."""
    return np.array(numbers).reshape(3, 2)


class Line(Trajectory):
    """z_cd = start + velocity t"""

    start: Point = (0.0, 0.0)
    """Desired position of the centroid at time 0 [m]"""
    velocity: Point
    """Velocity [m/s]"""

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        (x, y), (vx, vy) = self.start, self.velocity
        return _rows(x + vx * t, y + vy * t, vx, vy, 0.0, 0.0)


class Circle(Trajectory):
    """z_cd = centre + radius (cos φ, sin φ), φ = rate t + phase"""

    centre: Point = (0.0, 0.0)
    """Centre of the circle [m]"""
    radius: Positive
    """Radius of the circle [m]"""
    rate: Finite
    """Angular speed [rad/s]; negative is clockwise"""
    phase: Finite = 0.0
    """Angle φ at time 0 [rad]"""

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        phi, rate = self.rate * t + self.phase, self.rate
        c, s = self.radius * cos(phi), self.radius * sin(phi)
        return _rows(self.centre[0] + c, self.centre[1] + s, -rate * s, rate * c, -(rate**2) * c, -(rate**2) * s)


class Sine(Trajectory):
    """z_cd = start + (speed t, amplitude sin(rate t)).  The paper has speed 1, amplitude 30 and rate 0.1"""

    start: Point = (0.0, 0.0)
    """Desired position of the centroid at time 0 [m]"""
    speed: Finite
    """Speed along the x axis [m/s]"""
    amplitude: Finite
    """Amplitude along the y axis [m]"""
    rate: Finite
    """Angular frequency [rad/s]"""

    def at(self, t: float) -> Array:
        """Returns z_cd, ż_cd and z̈_cd at t, (3, 2)."""
        s, c = self.amplitude * sin(self.rate * t), self.amplitude * cos(self.rate * t)
        return _rows(
            self.start[0] + self.speed * t, self.start[1] + s, self.speed, self.rate * c, 0.0, -(self.rate**2) * s
        )


class Waypoints(Trajectory):
    """Straight lines from point to point with minimum jerk, at rest in each point.  From the point q to the next point p,

    z_cd = q + (p - q)(10 s³ - 15 s⁴ + 6 s⁵),   s = (t - t_q)/(t_p - t_q) in [0, 1].

    Before the first and after the last of `times` it rests.
    """

    points: Annotated[list[Point], Limits(min_length=2)]
    """Desired positions of the centroid, one after the other [m]"""
    times: Annotated[list[NonNegative], Limits(min_length=2)]
    """The time at which it is at each point [s], ascending"""

    def __post_init__(self) -> None:
        if len(self.times) != len(self.points):
            raise ValueError(f"{len(self.points)} points need as many times, not {len(self.times)}")
        if any(late <= early for early, late in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must ascend, and no two be equal")

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
"""The built-in trajectories by name."""


class _Checked:
    """A trajectory that is not built in; each of its answers is checked."""

    def __init__(self, part: Part[Trajectory]) -> None:
        self._part = part

    def at(self, t: float) -> Array:
        """Returns the trajectory's answer.  Raises PartRunError if the trajectory raises, or if its answer is not finite or not
        of the shape (3, 2)."""
        try:
            answer = np.asarray(self._part.made.at(t), dtype=np.float64)
        except PART_ERRORS as error:
            raise self._part.raised("", f"at({t:g})", error) from error
        if answer.shape != (3, 2):
            raise PartRunError(f"{self._part.use}: at({t:g}) has the shape {answer.shape}, not (3, 2)")
        if not np.isfinite(answer).all():
            raise PartRunError(f"{self._part.use}: at({t:g}) is not finite: {answer.tolist()}")
        return answer


def make_trajectory(part: Part[Any]) -> Desired:
    """Returns the trajectory of a plan.  The answers of a trajectory that is not built in are checked."""
    trajectory: Trajectory = part.made
    return trajectory if part.is_own else _Checked(part)


def sample(trajectory: Desired, times: Array) -> Array:
    """Returns a trajectory at T instants [s], (T, 3, 2)."""
    return np.array([trajectory.at(t) for t in times.tolist()]).reshape(-1, 3, 2)
