"""Non-singular terminal sliding mode: the error reaches zero in a finite time.

For each number of a block, with its error e [m], the rate e' = σ ė [m] in the block's own time, and sig(x)^a = |x|^a sign x:

    s = e + sig(e')^γ/β                                              1 < γ < 2,   β > 0,   κ > 0
    ν = Z̈_bd - (1/σ²) ((β/γ) sig(e')^(2-γ) + κ sig(s)^(2/γ-1))

s is the sliding variable [m].  On the surface s = 0 the error moves to zero.  γ sets the curvature of the surface, β how fast
the error moves to zero on it, κ how strongly the error is pulled to it.  Powers are powers of lengths in metres.  The surface
is that of Feng, Yu, Man ("Non-singular terminal sliding mode control of rigid manipulators", Automatica 38, 2002).  No exponent
is negative, so ν is finite everywhere.  Their law has sign s; here a power of s takes its place, so ν is continuous.  Time
scales have the same meaning as in the linear law: the error of a block with σ at time t is that of a block with σ = 1 s at t/σ.

*Why the time is finite.*  With ' for σ d/dt, e'' = σ² (ν - Z̈_bd), and so s' = -(κ γ/β) |e'|^(γ-1) sig(s)^(2/γ-1).
1. |s| never grows.  It is constant only while e' = 0; off s = 0 this does not last, because e'' ≠ 0 there.  So e → 0 (LaSalle).
2. If (e, e') becomes (c^γ e, c e') with c > 0, then (e', e'') becomes (c e', c^(2-γ) e''): the motion is homogeneous of degree
   1 - γ < 0.
3. Asymptotic stability and homogeneity of negative degree give finite-time stability (Bhat, Bernstein 2005, Theorem 7.1).

*Smallest κ.*  With ρ = 2/γ - 1, the error reaches the surface before it reaches zero if

    κ > ρ^ρ (1-ρ)^(1-ρ) β^(2/γ)/γ

For a smaller κ there are curves e' = -c e^(1/γ) above the surface (insert this into e''); motions follow them to zero, more
slowly.  Such a κ is refused.

*Time to zero.*  On the surface, from e_0: σ γ/(γ-1) β^(-1/γ) |e_0|^(1-1/γ).  From rest the time is proportional to
|e_0|^(1-1/γ), too, because of 2.  With γ = 1.5 and β = κ = 1 it is 3.7 σ from 1 m.

*Error under a constant disturbance.*  A constant acceleration w, such as that of a slope, leaves without look-ahead the error
|e| = (σ² |w|/κ)^(γ/(2-γ)), at which ν and w cancel.  The error approaches it slowly.

*Sampling.*  ν is held for T.  The slope of ν has no bound near zero, so the error overshoots there.  A motion remains in which
e = 0 at all ticks, e' = ±a alternates from tick to tick, and ν - Z̈_bd = ∓2 a/(T σ), with

    a = ((T/2σ) (β/γ + κ β^(1-2/γ)))^(1/(γ-1))

With `lead` λ > 0 and h = λT the law uses the error as it will be under its own answer η = ν - Z̈_bd (docs/architecture.md,
2.5):

    σ² η = f(e + h ė + h²/2 η, σ (ė + h η)),       f(e, e') = -(β/γ) sig(e')^(2-γ) - κ sig(s)^(2/γ-1)

There is exactly one such η, because f falls in both arguments.  With λ = 1 the remaining motion vanishes; with λ = 0.5, γ = 1.5
and β = κ = 1 a quarter of it remains.
"""

from collections.abc import Callable
from math import copysign
from typing import Annotated, ClassVar, Final

import numpy as np

from echelon.controller.laws.law import Block, Law, Nu
from echelon.parameters import Limits, Positive
from echelon.plan.plan import Array

PRECISION: Final = 1e-12
"""Relative precision of η with look-ahead"""
STEPS: Final = 100
"""Largest number of steps of the search for η; it takes ten on average"""


class TerminalSliding(Law):
    """ν = Z̈_bd - (1/σ²) ((β/γ) sig(σė)^(2-γ) + κ sig(s)^(2/γ-1)), s = e + sig(σė)^γ/β"""

    uses: ClassVar[frozenset[str]] = frozenset({"lead"})

    gamma: Annotated[float, Limits(strict=True, gt=1, lt=2)] = 1.5
    """γ, the curvature of the surface"""
    beta: Positive = 1.0
    """β, how fast the error moves to zero on the surface"""
    kappa: Positive = 1.0
    """κ, how strongly the error is pulled to the surface"""

    def __post_init__(self) -> None:
        rho = 2 / self.gamma - 1
        least = rho**rho * (1 - rho) ** (1 - rho) * self.beta ** (2 / self.gamma) / self.gamma
        if self.kappa <= least:
            raise ValueError(
                f"kappa = {self.kappa:g} must be greater than {least:.4g} with this gamma and beta: else no surface is reached"
            )

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
        """Returns the function f: (e, e') → σ² (ν - Z̈_bd) of one number, without look-ahead; all in metres."""
        gamma, beta, kappa = self.gamma, self.beta, self.kappa
        slide, bend, reach = 2 - gamma, beta / gamma, 2 / gamma - 1

        def f(e: float, rate: float) -> float:
            s = e + copysign(abs(rate) ** gamma, rate) / beta
            return -bend * copysign(abs(rate) ** slide, rate) - kappa * copysign(abs(s) ** reach, s)

        return f


def _led(f: Callable[[float, float], float], e: float, rate: float, h: float) -> float:
    """Returns the solution v of v = f(e + h e' + h²/2 v, e' + h v), where `rate` is e'.  It lies between 0 and f(e + h e', e').

    The difference of both sides rises with v; its zero is found by regula falsi with the Illinois rule."""
    e += h * rate
    far = f(e, rate)
    if h == 0 or far == 0 or far != far:
        return far
    near, near_miss, far_miss = 0.0, -far, far - f(e + h * h / 2 * far, rate + h * far)
    for _ in range(STEPS):
        if far_miss * near_miss >= 0:  # only rounding can do this: `far` is the solution
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
