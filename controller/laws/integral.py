"""The linear law with integral action: a constant disturbance leaves no constant error.

For every block, with the integral q of its error,

    ν = Z̈_bd - K_1 e - K_2 ė - K_i q        q̇ = e        K_i = k_i/σ³

Under a constant disturbing acceleration w (a slope, friction, a load) the linear law keeps the error e = K_1⁻¹ w.  Here q
compensates for it: at rest q̇ = e = 0 and K_i q = w.  All gains scale with σ, so all blocks have the same characteristic
polynomial in p = σ s, for gains that are numbers p³ + K_f2 p² + K_f1 p + k_i.  By Routh and Hurwitz it is stable if and only if

    0 < k_i < K_f1 K_f2

*Integration.*  Once per period, after ν: q ← q + T e + T²/2 ė.  A constant q needs e = 0 (and ė = 0), so the sampled loop
leaves no constant error either.

*Look-ahead* (`controller.laws.linear`).  With η = ν - Z̈_bd held and h = λT,

    e(h) = e + h ė + h²/2 η,   ė(h) = ė + h η,   q(h) = q + h e + h²/2 ė + h³/6 η

    η = M (-(K_1 + h K_i) e - (K_2 + h K_1 + h²/2 K_i) ė - K_i q - Σ K̄_bb' ė_b' + k_b F_pot,b)
    M = (I + h K_2 + h²/2 K_1 + h³/6 K_i)⁻¹

*Windup.*  After each period q is clipped so that each number of K_i q stays within ± `limit` [m/s²].  So a disturbance above
`limit` leaves a constant error; and after a time in which a robot could not follow, its q is not large and decays soon.
"""

from typing import ClassVar

import numpy as np

from echelon.controller.laws.law import Block, Law, LinearGains, Nu
from echelon.parameters import Positive
from echelon.plan.plan import Array


class Integral(Law):
    """ν = Z̈_bd - K_1 e - K_2 ė - K_i ∫e dt"""

    uses: ClassVar[frozenset[str]] = frozenset({"gains", "lead"})

    k_i: Positive
    """Gain of the integral, K_i = k_i/σ³; in continuous time the law is stable if k_i is less than k1 k2 of `law.gains`"""
    limit: Positive = 1.0
    """Largest acceleration that the integral can give, for each number of a block [m/s²]"""

    def nu(self, block: Block, t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
        """Returns ν [m/s²], (size,), and integrates once: `state` is q [m s]."""
        return self.nu_of(block)(t, e, e_dot, feed_forward, state)

    def nu_of(self, block: Block) -> Nu:
        """Returns ν of one block, with its gains computed once."""
        gains, T = self.linear(block), block.period_s
        bound = self.limit * block.sigma**3 / self.k_i

        def nu(t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
            answer = feed_forward - gains.K_1 @ e - gains.K_2 @ e_dot - gains.K_i @ state
            state += T * e + T**2 / 2 * e_dot
            np.clip(state, -bound, bound, out=state)
            return np.asarray(answer)

        return nu

    def state_size(self, block: Block) -> int:
        """Returns the size of q, which is that of e."""
        return block.size

    def weight(self, block: Block) -> Array:
        """Returns W = M of the look-ahead."""
        return self.linear(block).weight

    def linear(self, block: Block) -> LinearGains:
        """Returns the gains with look-ahead multiplied out; they hold while q is within its bounds."""
        h, unit = block.ahead_s, np.eye(block.size)
        K_1, K_2, K_i = block.K_1, block.K_2, self.k_i / block.sigma**3 * unit
        m: Array = np.asarray(np.linalg.inv(unit + h * K_2 + h**2 / 2 * K_1 + h**3 / 6 * K_i))
        return LinearGains(m @ (K_1 + h * K_i), m @ (K_2 + h * K_1 + h**2 / 2 * K_i), m @ K_i, m)
