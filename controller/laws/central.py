"""The law of all blocks with all robots seen at once: what the tree computes in a distributed way."""

import numpy as np

from echelon.controller.laws.law import law_block, make_nu, make_state, make_weight
from echelon.controller.potential import PairForces, pairs_between
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.plan.plan import Array, Plan


class CentralLaw:
    """a = Φ_M⁻¹ Z̈ with Z̈ of every block as `controller.laws.law` has it: the reference for tests, for analysis, and for anyone
    who wants to compare.

    A law with a state integrates with every call: call it once per period, the same for all nodes; `reset` begins anew."""

    def __init__(self, plan: Plan, lead: float | None = None) -> None:
        """Takes the law of a plan; with `lead` [periods] instead of the plan's, if given."""
        self.plan = plan
        self.transformation = Transformation(plan)
        self.trajectory = make_trajectory(plan.trajectory)
        self._blocks = [law_block(plan, block, lead) for block in plan.blocks]
        self._nu = [make_nu(plan.law, block) for block in self._blocks]
        self._weights = [make_weight(plan.law, block) for block in self._blocks]
        robots = len(plan.robots)
        self._forces = PairForces(*pairs_between([range(i, i + 1) for i in range(robots)]), robots, plan.avoidance)
        self.reset()

    def reset(self) -> None:
        """Sets the states of all blocks to zero, as they are at the start."""
        self.states = [make_state(self.plan.law, block) for block in self._blocks]

    def __call__(self, t: float, positions: Array, velocities: Array) -> Array:
        """Returns accelerations a, (N, 2) [m/s²], for positions and velocities of the reference points, (N, 2)."""
        cbt = self.transformation
        z_cd = self.trajectory.at(t)
        e = (cbt.forward(positions) - cbt.desired(z_cd[0])).ravel()
        e_dot = cbt.forward(velocities)
        e_dot[-1] -= z_cd[1]
        e_dot = e_dot.ravel()
        feed_forward = np.zeros_like(e)
        feed_forward[-2:] = z_cd[2]
        others = -self.plan.coupling @ e_dot
        if self.plan.avoidance.enabled and (forces := self._forces(positions)) is not None:
            sigma = np.repeat([block.sigma for block in self._blocks], [block.size for block in self._blocks])
            others += cbt.forward(forces).ravel() / sigma
        z_ddot = np.zeros_like(e)
        for number, block in enumerate(self.plan.blocks):
            rows = slice(block.offset, block.offset + block.size)
            if block.size:
                nu = self._nu[number](t, e[rows], e_dot[rows], feed_forward[rows], self.states[number])
                z_ddot[rows] = nu + self._weights[number] @ others[rows]
        return cbt.backward(z_ddot.reshape(-1, 2))
