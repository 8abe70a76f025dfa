"""The desired trajectory for code that observes a run: the recorder, the results and the figures.

A trajectory from a user's file or from a plug-in may raise an error at some instant, or never return.  In the run itself that
ends the run with an error message.  Here it gives NaN instead, so that everything else about the run can still be shown.
"""

import numpy as np

from echelon.controller.trajectory import make_trajectory
from echelon.errors import PartRunError
from echelon.plan.plan import Array, Plan
from echelon.sim.parts.time_limit import TookTooLong, time_limit

PATIENCE_S = 2.0
"""Time limit for one instant; a trajectory that exceeds it once is not called again"""


class Desired:
    """The desired position z_cd of the centroid and its derivatives at any instant; NaN where the trajectory fails."""

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
        """Returns z_cd, ż_cd and z̈_cd at the instants `times` [s], (T,), as an array (T, 3, 2)."""
        return np.array([self.at(t) for t in times.tolist()]).reshape(-1, 3, 2)
