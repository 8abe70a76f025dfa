"""A control law: first-order sliding mode with a boundary layer."""

import numpy as np

from echelon import Law


class SlidingMode(Law):
    """s = e + σ ė;  ν = Z̈_bd - ė/σ - (reach/σ²) sat(s/width).  So σ ṡ = -reach sat(s/width), and then σ ė = -e."""

    reach: float = 0.25  # how fast s goes to zero [m]
    width: float = 0.2  # of the boundary layer [m]

    def nu(self, block, t, e, e_dot, feed_forward, state):
        s = e + block.sigma * e_dot
        return feed_forward - e_dot / block.sigma - self.reach / block.sigma**2 * np.clip(s / self.width, -1, 1)
