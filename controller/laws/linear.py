"""The control law of the paper (labels eq105, eqnus, eq206, pbc3t, pbcmt; docs/architecture.md, 2.4 and 2.5).

For every block b (the shape of each node, and the centroid) with the error e_b = Z_b - Z_bd:

    ν_b = -K_b1 e_b - K_b2 ė_b + Z̈_bd          K_b1 = K_fb1/σ_b²,   K_b2 = K_fb2/σ_b

The tree adds -Σ_{b'≠b} K̄_bb' ė_b' + k_b F_pot,b with k_b = 1/σ_b.  Three slips of the paper are corrected here
(docs/architecture.md, 2.8): Z̈_d counts once; the sign of F_pot is plus, so that it repels; the gain of F_pot is 1/σ_b for
every block.

*Look-ahead.*  An acceleration is held for a period T.  The law in continuous time does not know this, and acts as if half a
period late.  With `lead` λ (in periods; 0.5 is the middle of the hold) the law uses the error as it will be λT later under the
acceleration that the law itself returns.  With η = ν - Z̈_bd held, e(λT) = e + λT ė + (λT)²/2 η and ė(λT) = ė + λT η, so

    η = M (-K_b1 e - (K_b2 + λT K_b1) ė - Σ K̄_bb' ė_b' + k_b F_pot,b),   M = (I + λT K_b2 + (λT)²/2 K_b1)⁻¹

This is the same law with other gains, and the paper's law for λ = 0.
"""

from typing import ClassVar

import numpy as np

from echelon.controller.laws.law import Block, Law, LinearGains, Nu
from echelon.plan.plan import Array


class Linear(Law):
    """ν = Z̈_bd - K_1 e - K_2 ė, the paper's law."""

    uses: ClassVar[frozenset[str]] = frozenset({"gains", "lead"})

    def nu(self, block: Block, t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
        """Returns ν [m/s²], (size,)."""
        return self.nu_of(block)(t, e, e_dot, feed_forward, state)

    def nu_of(self, block: Block) -> Nu:
        """Returns ν of one block, with its gains computed once."""
        gains = self.linear(block)

        def nu(t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
            return np.asarray(feed_forward - gains.K_1 @ e - gains.K_2 @ e_dot)

        return nu

    def weight(self, block: Block) -> Array:
        """Returns W = M of the look-ahead."""
        return self.linear(block).weight

    def linear(self, block: Block) -> LinearGains:
        """Returns the gains M K_1 and M (K_2 + λT K_1), no integral gain, and W = M."""
        ahead = block.ahead_s
        m: Array = np.asarray(np.linalg.inv(np.eye(block.size) + ahead * block.K_2 + ahead**2 / 2 * block.K_1))
        return LinearGains(m @ block.K_1, m @ (block.K_2 + ahead * block.K_1), np.zeros((block.size, block.size)), m)
