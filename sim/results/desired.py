"""The desired trajectory for those who look on: the recorder, measures, figures.

A trajectory that others wrote may fail at an instant, or never answer.  That ends a run, and is said there; who looks at what
the run left is to see the rest of it.
"""

import numpy as np

from echelon.controller.trajectory import make_trajectory
from echelon.errors import PartRunError
from echelon.plan.plan import Array, Plan
from echelon.sim.parts.time_limit import TookTooLong, time_limit

PATIENCE_S = 2.0
"""For one instant; a trajectory that takes longer is not asked any more"""


class Desired:
    """z_cd, ż_cd and z̈_cd of a plan at any instant; not a number where the trajectory does not say."""

    def __init__(self, plan: Plan) -> None:
        self._trajectory = make_trajectory(plan.trajectory)
        self._is_own = plan.trajectory.is_own
        self._gave_up = False

    def at(self, t: float) -> Array:
        """Returns z_cd [m], ż_cd [m/s] and z̈_cd [m/s²] at t [s], (3, 2)."""
        if self._is_own:
            return self._trajectory.at(t)
        if not self._gave_up:
            try:
                with time_limit(PATIENCE_S):
                    return self._trajectory.at(t)
            except PartRunError:
                pass
            except TookTooLong:
                self._gave_up = True
        return np.full((3, 2), np.nan)

    def sample(self, times: Array) -> Array:
        """Returns it at many instants [s], (T, 3, 2)."""
        return np.array([self.at(t) for t in times.tolist()]).reshape(-1, 3, 2)
