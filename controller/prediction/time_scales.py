"""The closed loop in continuous time, and how far time scales and couplings may go (docs/architecture.md, 2.12).

With E_b = (Z_b/σ_b, Ż_b) in errors (paper, proof of Theorem 1) the closed loop of labels eq45 and eq207 is

    Ė_b = (1/σ_b) A_b E_b - Σ_{b'≠b} K̄_bb' ė_b',      A_b = (0, 1; -K_fb1, -K_fb2)

and so Ė = (D⁻¹ A + C) E, where D has the time scales and C the couplings.  A law with integral action has q_b/σ_b² as a further
part of E_b.  `lead` and sampling are left out.

*The largest ε_i* is the largest number below which every ε_i is stable, when the other ε stay as they are: σ of the blocks that
contain ε_i grows with it.  *The largest coupling* is the largest number κ for which κ' C is stable for all κ' ≤ κ.  Both are
found as the first sign change of the spectral abscissa on a grid of `PER_DECADE` numbers a decade, with a finer search where it
comes near zero between two of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, prod
from typing import Final

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq, minimize_scalar
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from echelon.controller.prediction.gains import PredictionError, linear_gains
from echelon.plan.plan import Array, Plan

LOW: Final = 1e-4
"""The smallest multiple of an ε or of the couplings that is looked at"""
HIGH: Final = 1e4
"""The largest one"""
PER_DECADE: Final = 40
"""Number of multiples per decade"""
NEAR: Final = 0.05
"""A finer search follows where the spectral abscissa has a maximum above minus this share of its size"""
MOST: Final = 500
"""Largest number of unknowns"""


def epsilon_counts(plan: Plan, time_scales: str) -> list[int]:
    """Returns for each block of a plan how many of `law.epsilon` its time scale is the product of."""
    nodes = plan.nodes
    if time_scales == "three":
        return [*(node.depth + 1 for node in nodes), 0]
    return [*range(len(nodes), 0, -1), 0]


@dataclass(frozen=True, slots=True)
class ErrorDynamics:
    """The closed loop Ė = (D⁻¹ A + C) E of some blocks.  Its unknowns are in the order of the blocks."""

    A: Array
    C: Array
    sigma: Array
    """The time scale of each unknown, the diagonal of D"""
    count: Array
    """For each unknown, how many ε its time scale has"""

    def abscissa(self, scaled: int = 0, by: float = 1.0, coupling: float = 1.0) -> float:
        """Returns the largest real part of the eigenvalues, with ε number `scaled` (from 1 on) multiplied by a number, and with
        the couplings multiplied by `coupling`."""
        sigma = np.where(self.count >= scaled, self.sigma * by, self.sigma) if scaled else self.sigma
        # Times the smallest σ, so that fast blocks do not overflow; the sign is the same.
        return float(np.linalg.eigvals(self.A / sigma[:, None] + coupling * self.C).real.max() * sigma.min())

    def up_to(self, count: int) -> "ErrorDynamics":
        """Returns the loop of the blocks with at most `count` ε: faster ones have settled."""
        keep = np.flatnonzero(self.count <= count)
        return ErrorDynamics(self.A[np.ix_(keep, keep)], self.C[np.ix_(keep, keep)], self.sigma[keep], self.count[keep])

    def coupled(self) -> "ErrorDynamics | None":
        """Returns the loop of the blocks that act on each other both ways; None if there are none.  The others are stable if
        each block is."""
        pattern = csr_array((self.A != 0) | (self.C != 0))
        _, labels = connected_components(pattern, directed=True, connection="strong")
        at, to = np.nonzero(self.C)
        both = np.unique(labels[at[labels[at] == labels[to]]])
        keep = np.flatnonzero(np.isin(labels, both))
        if not len(keep):
            return None
        return ErrorDynamics(self.A[np.ix_(keep, keep)], self.C[np.ix_(keep, keep)], self.sigma[keep], self.count[keep])


def error_dynamics(plan: Plan, counts: Sequence[int]) -> ErrorDynamics:
    """Returns the closed loop of a plan, from the counts of `epsilon_counts`.

    Raises PredictionError if the law is not linear, or if there are more than `MOST` unknowns."""
    blocks = [(block, count) for block, count in zip(plan.blocks, counts, strict=True) if block.size]
    own, places, sigma, number = [], [], [], []
    integrates = [linear_gains(plan, block, 0.0).K_i.any() for block, _ in blocks]
    sizes = [block.size * (3 if acts else 2) for (block, _), acts in zip(blocks, integrates, strict=True)]
    if sum(sizes) > MOST:
        raise PredictionError(f"the closed loop has {sum(sizes)} unknowns, more than {MOST}")
    weights = np.zeros_like(plan.coupling)
    start = 0
    for (block, count), acts, size in zip(blocks, integrates, sizes, strict=True):
        gains, n = linear_gains(plan, block, 0.0), block.size
        zero, unit, s = np.zeros((n, n)), np.eye(n), block.sigma
        k1, k2, ki = gains.K_1 * s**2, gains.K_2 * s, gains.K_i * s**3
        rows = [[zero, unit, zero], [-k1, -k2, -ki], [unit, zero, zero]]
        own.append(np.block(rows if acts else [row[:2] for row in rows[:2]]))
        places.append((slice(block.offset, block.offset + n), slice(start + n, start + 2 * n)))
        weights[places[-1][0]] = gains.weight @ plan.coupling[places[-1][0]]
        sigma += [s] * size
        number += [count] * size
        start += size
    C = np.zeros((start, start))
    for of_row, row in places:
        for of_column, column in places:
            C[row, column] = -weights[of_row, of_column]
    return ErrorDynamics(block_diag(*own), C, np.array(sigma), np.array(number))


def largest_epsilon(loop: ErrorDynamics, epsilon: Sequence[float], number: int) -> float:
    """Returns the largest ε_number (from 1 on): every smaller one is stable, down to `LOW` of the present one.

    0 if the smallest is not stable, infinite if every one is up to `HIGH` times the present one."""
    if (coupled := loop.coupled()) is None or not (coupled.count >= number).any():
        return inf if loop.abscissa() < 0 else 0.0
    return epsilon[number - 1] * first_root(lambda by: coupled.abscissa(number, by))


def largest_coupling(loop: ErrorDynamics) -> float:
    """Returns the largest multiple of all couplings for which the loop is stable, with all smaller ones; infinite if every one
    is up to `HIGH`."""
    if (coupled := loop.coupled()) is None:
        return inf if loop.abscissa() < 0 else 0.0
    return first_root(lambda by: coupled.abscissa(coupling=by))


def first_root(abscissa: Callable[[float], float]) -> float:
    """Returns the smallest positive x at which the abscissa is zero: 0 if it is not negative for the smallest x, infinite if it
    is negative for all."""
    logs = np.linspace(np.log(LOW), np.log(HIGH), round(PER_DECADE * np.log10(HIGH / LOW)) + 1)
    before: list[tuple[float, float]] = []
    for log in logs:
        value = abscissa(float(np.exp(log)))
        if value >= 0:
            return float(np.exp(brentq(lambda x: abscissa(np.exp(x)), before[-1][0], log))) if before else 0.0
        before.append((float(log), value))
        if len(before) >= 3:
            (left, one), (_, top), (right, two) = before[-3:]
            if top > max(one, two) and top > -NEAR * max(abs(one), abs(two)):
                peak = minimize_scalar(lambda x: -abscissa(np.exp(x)), bounds=(left, right), method="bounded")
                if peak.fun <= 0:
                    return float(np.exp(brentq(lambda x: abscissa(np.exp(x)), left, peak.x)))
    return inf


def with_epsilon(plan: Plan, counts: Sequence[int], epsilon: Sequence[float]) -> Plan:
    """Returns the plan with other `law.epsilon`."""
    return replace(
        plan,
        blocks=tuple(
            replace(block, sigma=prod(epsilon[:count])) for block, count in zip(plan.blocks, counts, strict=True)
        ),
    )
