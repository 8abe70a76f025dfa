"""The control law (labels eq105, eqnus, eq206, pbc3t, pbcmt; theory.md section 3), for one block and for all at once.

For every block b (the shape of each node, the centroid) with error e = Z_b - Z_bd:

    ν_b = -K_b1 e_b - K_b2 ė_b - Σ_{b'≠b} K̄_bb' ė_b' + Z̈_bd + k_b F_pot,b
    K_b1 = K_fb1/σ_b²,   K_b2 = K_fb2/σ_b,   k_b = 1/σ_b

Three slips of the paper are mended here (theory.md section 6): Z̈_d counts once; F_pot repels, so its sign is plus; the
potential's gain is 1/σ_b for every block.

An acceleration is held for a period T, and the law in continuous time knows nothing of that: it acts as if half a period
late.  With `lead` λ (in periods; 0.5 is the middle of the hold) the law is taken where the error will be λ T later, under
the very acceleration it returns.  With η = ν - Z̈_bd held, e(λT) = e + λT ė + (λT)²/2 η and ė(λT) = ė + λT η, so

    η = M (-K_b1 e - (K_b2 + λT K_b1) ė - Σ K̄_bb' ė_b' + k_b F_pot,b),   M = (I + λT K_b2 + (λT)²/2 K_b1)⁻¹

which is the same law with other gains, and the paper's for λ = 0.
"""

from dataclasses import dataclass

import numpy as np

from echelon.controller.potential import PairForces, pairs_between
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.plan import Array, BlockPlan, Plan


@dataclass(frozen=True, slots=True)
class BlockGains:
    """Gains of one block, as they act: K_1 [1/s²], K_2 [1/s], the row K̄_b of the coupling [1/s], k_b [1/s]; matrices."""

    K_1: Array
    K_2: Array
    K_coupling: Array
    K_pot: Array

    @classmethod
    def of(cls, plan: Plan, block: BlockPlan, lead: float | None = None) -> "BlockGains":
        """Returns the gains of a block of a plan; with `lead` [periods] instead of the plan's, if given."""
        rows = slice(block.offset, block.offset + block.size)
        node = plan.root if block.node is None else plan.formation[block.node]
        ahead = (plan.lead if lead is None else lead) * node.period_ns * 1e-9
        K_1, K_2 = block.k1 / block.sigma**2, block.k2 / block.sigma
        unit = np.eye(block.size)
        m: Array = np.asarray(np.linalg.inv(unit + ahead * K_2 + ahead**2 / 2 * K_1), dtype=np.float64)
        return cls(m @ K_1, m @ (K_2 + ahead * K_1), m @ plan.coupling[rows], m / block.sigma)

    def nu(self, e: Array, e_dot: Array) -> Array:
        """Returns -K_1 e - K_2 ė, (size,): what the block does on its own."""
        return -(self.K_1 @ e) - self.K_2 @ e_dot


class CentralLaw:
    """The law of all blocks with all robots seen at once: a = Φ_M⁻¹ ν.  What the tree computes in a distributed way; the
    reference for tests, for analysis, and for anyone who wants to compare."""

    def __init__(self, plan: Plan, lead: float | None = None) -> None:
        self.plan = plan
        self.transformation = Transformation(plan)
        self.trajectory = make_trajectory(plan.trajectory)
        self._gains = [BlockGains.of(plan, block, lead) for block in plan.blocks]
        robots = len(plan.robots)
        self._forces = PairForces(*pairs_between([range(i, i + 1) for i in range(robots)]), robots, plan.avoidance)

    def __call__(self, t: float, positions: Array, velocities: Array) -> Array:
        """Returns accelerations a, (N, 2) [m/s²], for positions and velocities of the reference points, (N, 2)."""
        cbt = self.transformation
        z_cd = self.trajectory.at(t)
        e = (cbt.forward(positions) - cbt.desired(z_cd[0])).ravel()
        e_dot = cbt.forward(velocities)
        e_dot[-1] -= z_cd[1]
        e_dot = e_dot.ravel()
        nu = np.zeros_like(e)
        f_pot = None
        if self.plan.avoidance.enabled and (forces := self._forces(positions)) is not None:
            f_pot = cbt.forward(forces).ravel()
        for block, gains in zip(self.plan.blocks, self._gains, strict=True):
            rows = slice(block.offset, block.offset + block.size)
            nu[rows] = gains.nu(e[rows], e_dot[rows]) - gains.K_coupling @ e_dot
            if f_pot is not None:
                nu[rows] += gains.K_pot @ f_pot[rows]
        nu[-2:] += z_cd[2]
        return cbt.backward(nu.reshape(-1, 2))
