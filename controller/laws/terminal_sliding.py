"""Non-singular terminal sliding mode: the error is zero after a finite time.

For each number of a block, with its error e [m], the rate e' = σ ė [m] in the block's own time, and sig(x)^a = |x|^a sign x:

    s = e + sig(e')^γ/β                                              1 < γ < 2,   β > 0,   κ > 0
    ν = Z̈_bd - (1/σ²) ((β/γ) sig(e')^(2-γ) + κ sig(s)^(2/γ-1))

s is the sliding variable [m]; on the surface s = 0 the error runs into zero.  γ bends the surface, β says how fast it leads to
zero, κ how hard the error is pulled towards it.  Powers are of lengths in metres.  The surface is that of Feng, Yu, Man
("Non-singular terminal sliding mode control of rigid manipulators", Automatica 38, 2002).  No exponent is negative, so ν is
finite everywhere.  Where they have sign s there is a power of s, so ν is continuous.  Time scales mean what they mean to the
linear law: the error of a block with σ at time t is that of one with σ = 1 s at t/σ.

*Why the time is finite.*  With ' for σ d/dt, e'' = σ² (ν - Z̈_bd), and so s' = -(κ γ/β) |e'|^(γ-1) sig(s)^(2/γ-1).
1. |s| never grows, and it stands still only while e' = 0, which does not last off s = 0, for there e'' ≠ 0: so e → 0 (LaSalle).
2. At (c^γ e, c e') instead of (e, e'), c > 0, (e', e'') is (c e', c^(2-γ) e''): the motion is homogeneous of degree 1 - γ < 0.
3. Asymptotically stable and homogeneous of negative degree is finite-time stable (Bhat, Bernstein 2005, Theorem 7.1).

*What κ must be.*  With ρ = 2/γ - 1, and

    κ > ρ^ρ (1-ρ)^(1-ρ) β^(2/γ)/γ

the surface is reached before zero is.  Below that there are curves e' = -c e^(1/γ) above the surface (put it into e'') which
motions follow to zero, more slowly; such a κ is refused.

*How long it takes.*  On the surface from e_0: σ γ/(γ-1) β^(-1/γ) |e_0|^(1-1/γ).  From rest it is in the same proportion to
|e_0|^(1-1/γ), by 2.; with γ = 1.5, β = κ = 1 it is 3.7 σ from 1 m.

*What a constant acceleration w leaves*, such as a slope's, without look-ahead: |e| = (σ² |w|/κ)^(γ/(2-γ)), where ν and w
cancel; the error creeps there.

*Sampled.*  ν is held for T.  Its slope has no bound near zero, so it overshoots there: what remains is e = 0 at the ticks, with
e' = ±a from tick to tick and ν - Z̈_bd = ∓2 a/(T σ),

    a = ((T/2σ) (β/γ + κ β^(1-2/γ)))^(1/(γ-1))

With `lead` λ > 0 and h = λT the law counts in what it does itself (docs/architecture.md, 2.5), η = ν - Z̈_bd:

    σ² η = f(e + h ė + h²/2 η, σ (ė + h η)),       f(e, e') = -(β/γ) sig(e')^(2-γ) - κ sig(s)^(2/γ-1)

There is one such η, for f falls in both arguments.  With λ = 1 nothing remains of the motion above; with λ = 0.5, γ = 1.5 and
β = κ = 1 a quarter does.
"""

from collections.abc import Callable
from math import copysign
from typing import Annotated, ClassVar, Final, Self

import numpy as np
from pydantic import Field, model_validator

from echelon.controller.laws.law import Block, Law, Nu
from echelon.plan.plan import Array
from echelon.scenario.values import Positive

PRECISION: Final = 1e-12
"""Relative, of the solution with look-ahead"""
_STEPS: Final = 100
"""More than it ever takes: ten on average"""


class TerminalSliding(Law):
    """ν = Z̈_bd - (1/σ²) ((β/γ) sig(σė)^(2-γ) + κ sig(s)^(2/γ-1)), s = e + sig(σė)^γ/β"""

    uses: ClassVar[frozenset[str]] = frozenset({"lead"})

    gamma: Annotated[float, Field(strict=True, gt=1, lt=2)] = 1.5
    """γ, how the surface bends"""
    beta: Positive = 1.0
    """β, how fast the surface leads to zero"""
    kappa: Positive = 1.0
    """κ, how hard the error is pulled towards the surface"""

    @model_validator(mode="after")
    def _reaches(self) -> Self:
        rho = 2 / self.gamma - 1
        least = rho**rho * (1 - rho) ** (1 - rho) * self.beta ** (2 / self.gamma) / self.gamma
        if self.kappa <= least:
            raise ValueError(
                f"kappa = {self.kappa:g} must be greater than {least:.4g} with this gamma and beta: else no surface is reached"
            )
        return self

    def nu(self, block: Block, t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
        """Returns ν [m/s²], (size,)."""
        return self.nu_of(block)(t, e, e_dot, feed_forward, state)

    def nu_of(self, block: Block) -> Nu:
        """Returns ν of one block."""
        sigma, ahead = block.sigma, block.ahead_s / block.sigma
        pull = self.pull()

        def nu(t: float, e: Array, e_dot: Array, feed_forward: Array, state: Array) -> Array:
            pairs = zip(e.tolist(), (sigma * e_dot).tolist(), strict=True)
            try:
                answer = [_led(pull, x, rate, ahead) for x, rate in pairs]
            except OverflowError:  # the run diverged
                return np.full(block.size, np.nan)
            return feed_forward + np.array(answer) / sigma**2

        return nu

    def pull(self) -> Callable[[float, float], float]:
        """Returns f: (e, e') → σ² (ν - Z̈_bd) of one number, without look-ahead; all in metres."""
        gamma, beta, kappa = self.gamma, self.beta, self.kappa
        slide, bend, reach = 2 - gamma, beta / gamma, 2 / gamma - 1

        def f(e: float, rate: float) -> float:
            s = e + copysign(abs(rate) ** gamma, rate) / beta
            return -bend * copysign(abs(rate) ** slide, rate) - kappa * copysign(abs(s) ** reach, s)

        return f


def _led(f: Callable[[float, float], float], e: float, rate: float, h: float) -> float:
    """Returns the v with v = f(e + h e' + h²/2 v, e' + h v); it lies between 0 and f(e + h e', e').

    Regula falsi, as the Illinois rule has it: the left side less the right one rises with v."""
    e += h * rate
    far = f(e, rate)
    if h == 0 or far == 0 or far != far:
        return far
    near, near_miss, far_miss = 0.0, -far, far - f(e + h * h / 2 * far, rate + h * far)
    for _ in range(_STEPS):
        if far_miss * near_miss >= 0:  # by rounding: `far` solves it
            return far
        v = far - far_miss * (far - near) / (far_miss - near_miss)
        miss = v - f(e + h * h / 2 * v, rate + h * v)
        if miss * far_miss < 0:
            near, near_miss = far, far_miss
        else:
            near_miss /= 2
        far, far_miss = v, miss
        if abs(far - near) <= PRECISION * abs(far) or miss == 0:
            break
    return far
