"""The central law: computes from all positions at once what the tree computes in a distributed way (docs/architecture.md,
2.4)."""

import numpy as np

from echelon.controller.laws.law import law_block, make_nu, make_state, make_weight
from echelon.controller.potential import PairForces, pairs_between
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.plan.plan import Array, Plan


class CentralLaw:
    """a = Φ_M⁻¹ Z̈, where Z̈ of every block is given in `controller.laws.law`.  It is the reference for tests and for analysis.

    A law with a state integrates at every call.  So it must be called once per period, and all nodes must have the same
    period; `reset` sets the states to zero again."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.transformation = Transformation(plan)
        self.trajectory = make_trajectory(plan.trajectory)
        self._blocks = [law_block(plan, block) for block in plan.blocks]
        self._nu = [make_nu(plan.law, block) for block in self._blocks]
        self._weights = [make_weight(plan.law, block) for block in self._blocks]
        robots = len(plan.robots)
        self._forces = None
        if plan.avoidance.enabled:
            self._forces = PairForces(*pairs_between([range(i, i + 1) for i in range(robots)]), robots, plan.avoidance)
        self._coupled = plan.coupled
        self._ahead_s = plan.lead * plan.root.period_ns * 1e-9
        self.reset()

    def reset(self) -> None:
        """Sets the law's states of all blocks to zero, their values at the start."""
        self.states = [make_state(self.plan.law, block) for block in self._blocks]

    def __call__(self, t: float, positions: Array, velocities: Array) -> Array:
        """Returns the robots' accelerations a, (N, 2) [m/s²], at t [s], for the positions [m] and velocities [m/s] of the
        reference points, (N, 2)."""
        cbt = self.transformation
        z_cd = self.trajectory.at(t)
        e = (cbt.forward(positions) - cbt.desired(z_cd[0])).ravel()
        e_dot = cbt.forward(velocities)
        e_dot[-1] -= z_cd[1]
        e_dot = e_dot.ravel()
        feed_forward = np.zeros_like(e)
        feed_forward[-2:] = self.trajectory.at(t + self._ahead_s)[2] if self._ahead_s else z_cd[2]
        others = -self.plan.coupling @ e_dot if self._coupled else np.zeros_like(e)
        if self._forces is not None and (forces := self._forces(positions)) is not None:
            sigma = np.repeat([block.sigma for block in self._blocks], [block.size for block in self._blocks])
            others += cbt.forward(forces).ravel() / sigma
        z_ddot = np.zeros_like(e)
        for number, block in enumerate(self.plan.blocks):
            rows = slice(block.offset, block.offset + block.size)
            if block.size:
                nu = self._nu[number](t, e[rows], e_dot[rows], feed_forward[rows], self.states[number])
                z_ddot[rows] = nu + self._weights[number] @ others[rows]
        return cbt.backward(z_ddot.reshape(-1, 2))
