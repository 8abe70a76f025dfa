"""How far from the start of its trajectory a robot may be before its run, or a motion that is computed, has diverged.

At an instant the reach is `FACTOR` times the sum of

- how far the trajectory has been from its start up to then,
- how far the farthest robot starts from there, and the farthest place in the desired formation is,
- the length of a robot, and with avoidance its sensing radius.

Limits of torque and speed do not matter: an error that they keep from growing exponentially leaves the reach, too.  Large
errors at the start, and a trajectory that the formation has to catch up with, are within it.

A robot that has no torque for `IDLE_NS`, though no limit acts, rolls on, or stands while others go on.  Then how far robots get
says nothing about the law; and afterwards they may be `FACTOR` times as far as they got meanwhile.
"""

from collections.abc import Sequence
from math import hypot, inf
from typing import Final

import numpy as np

from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.errors import PartRunError
from echelon.messages import STATE_FIELDS, Message
from echelon.plan.plan import Plan
from echelon.sim.parts.time_limit import no_longer

FACTOR: Final = 2.0
"""With 1 the shipped scenarios would be within their reach, too"""
INSTANTS: Final = 100
"""Number of instants, spread over the run, at which the trajectory is looked at"""
PATIENCE_S: Final = 0.5
"""Time limit for that; without an answer there is no bound [s]"""
IDLE_NS: Final = 500_000_000
"""A robot without torque for this time is not driven [ns]"""
_RIGHT, _LEFT, _SATURATED = map(STATE_FIELDS.index, ("tau_right", "tau_left", "saturated"))
DIVERGED: Final = f"more than {FACTOR:g} times as far as its start, its place in the formation and the trajectory ask"


class Reach:
    """The reach of the robots of a plan, around (`x`, `y`), where its trajectory begins [m]."""

    def __init__(self, plan: Plan) -> None:
        self._step_ns = max(1, plan.duration_ns // INSTANTS)
        self.x = self.y = 0.0
        self._bounds = [inf]
        times = [0.0, *((number + 0.382) / INSTANTS * plan.duration_ns * 1e-9 for number in range(INSTANTS))]
        trajectory = make_trajectory(plan.trajectory)
        try:
            with no_longer(PATIENCE_S, PartRunError("the trajectory takes too long")), np.errstate(all="ignore"):
                path = np.array([trajectory.at(t)[0] for t in times])
        except PartRunError:  # the run finds it, too, if it asks at that instant
            return
        transformation = Transformation(plan)
        places = transformation.backward(transformation.desired(path[0]))
        starts = np.array([robot.start for robot in plan.robots])
        with np.errstate(all="ignore"):
            size = sum(float(np.linalg.norm(points - path[0], axis=1).max()) for points in (places, starts))
            gone = np.maximum.accumulate(np.linalg.norm(path - path[0], axis=1))
        size += max(robot.arm + abs(robot.offset) for robot in plan.robots)
        size += plan.avoidance.sensing_radius if plan.avoidance.enabled else 0.0
        self.x, self.y = path[0].tolist()
        self._bounds = (FACTOR * (gone[1:] + size)).tolist()

    def at(self, time_ns: int) -> float:
        """Returns the reach at an instant of the run [m]."""
        return self._bounds[min(max(0, time_ns) // self._step_ns + 1, len(self._bounds) - 1)]


class ReachWatch:
    """Finds the first instant of a run at which a robot is beyond its reach, from the robots' states in order of time."""

    def __init__(self, plan: Plan) -> None:
        self._reach = Reach(plan)
        count = len(plan.robots)
        self._far = [0.0] * count
        """How far each robot is from where the trajectory begins [m]"""
        self._driven_ns = [0] * count
        """When each robot had torque last"""
        self._excused = 0.0
        """How far robots got while one was not driven [m]"""
        self._time_ns = 0

    def first(self, states: Sequence[Message]) -> tuple[int, int, float] | None:
        """Returns the first instant of which all states have come, and at which a robot is beyond its reach: the index of the
        robot, the instant [ns], and how far it is [m]; None if there is none."""
        x, y = self._reach.x, self._reach.y
        for _, source, _, time_ns, values in states:
            if time_ns > self._time_ns:
                if (found := self._beyond()) is not None:
                    return found
                self._time_ns = time_ns
            self._far[source] = hypot(values[0] - x, values[1] - y)
            if time_ns - self._driven_ns[source] > IDLE_NS:
                self._excused = max(self._excused, self._far[source])
            if values[_RIGHT] or values[_LEFT] or values[_SATURATED]:
                self._driven_ns[source] = time_ns
        return None

    def _beyond(self) -> tuple[int, int, float] | None:
        farthest = max(self._far)
        if self._time_ns - min(self._driven_ns) > IDLE_NS:
            self._excused = max(self._excused, farthest)
        elif farthest > max(self._reach.at(self._time_ns), FACTOR * self._excused):
            return self._far.index(farthest), self._time_ns, farthest
        return None
