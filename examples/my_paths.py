"""A trajectory of the centroid: a figure of eight."""

import numpy as np

from echelon import Trajectory


class Eight(Trajectory):
    size: float = 1.5  # half its length [m]
    rate: float = 0.15  # [rad/s]

    def at(self, t):
        k = self.rate * np.array([1.0, 2.0])
        return self.size * np.array([np.sin(k * t), k * np.cos(k * t), -(k**2) * np.sin(k * t)])
