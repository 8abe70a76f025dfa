"""Bounds on ε_1, ε_2, … by composite Lyapunov functions (paper, Theorem 1), as corrected in docs/architecture.md, 2.12.

Layer i consists of the blocks whose time scale is the product of the first i of `law.epsilon`.  χ are the layers before it, E_f
is the layer, with σ_f = ε_i σ_{i-1}; faster layers have settled.  P_χ and P_f solve Aᵀ P + P A = -1 for the closed loop A_χ of
the layers before, couplings included, and for A_f.  With

    V = (1 - d) χᵀ P_χ χ + d E_fᵀ P_f E_f,   V̇ = -(χ; E_f)ᵀ Q (χ; E_f)

    Q = ( (1-d)     -S
          -Sᵀ       d (1/σ_f - P_f C_ff - C_ffᵀ P_f) ),     S = (1-d) P_χ C_χf + d C_fχᵀ P_f

where C are the couplings.  By the Schur complement Q is positive definite if and only if

    1/σ_f > λ_max( P_f C_ff + C_ffᵀ P_f + Sᵀ S/(d (1-d)) )

whose right side is convex in log(d/(1-d)), so its least value over d is found by a search along one line.  For ε_1 this is the
paper's V; for the next ε the paper composes V_χ again, which needs ε_1 below its own bound.  The paper's Q leaves out the part
of S with C_χf (label liap01), and its bound (label be1) does not follow from the Schur complement: it is reported, not relied
on.
The paper's appendix bounds V̇ by norms (labels condeps, epsval, dval): with α_1 = α_2 = 1, β_1 = 2 |P_χ C_χf|,
β_2 = 2 |P_f C_fχ| and γ = λ_max(P_f C_ff + C_ffᵀ P_f), at least 0,

    σ_f < α_1 α_2/(α_1 γ + β_1 β_2)      at d = β_1/(β_1 + β_2)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, prod
from typing import Final

import numpy as np
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import minimize_scalar

from echelon.controller.prediction.time_scales import ErrorDynamics
from echelon.plan.plan import Array

ZERO: Final = 1e-12
"""1/σ up to this counts as zero [1/s]: no coupling, so every ε is stable"""


@dataclass(frozen=True, slots=True)
class LyapunovBounds:
    """Bounds below which every ε_i is stable: 0 if the layers before are not stable, infinite if no coupling limits it."""

    corrected: float
    """From the complete Q, the best over d"""
    by_norms: float
    """From norms, as in the paper's appendix"""
    literal: float | None
    """The paper's formula (label be1), the best over d: it proves nothing.  Only for ε_1"""


def lyapunov_bounds(loop: ErrorDynamics, epsilon: Sequence[float]) -> list[LyapunovBounds]:
    """Returns the bounds on each of `law.epsilon`, those before it as they are."""
    levels = [np.flatnonzero(loop.count == at) for at in range(len(epsilon) + 1)]
    slow = levels[0]
    found: list[LyapunovBounds] = []
    for at, fast in enumerate(levels[1:]):
        before = prod(epsilon[:at])
        if not len(fast):
            found.append(LyapunovBounds(inf, inf, None))
            continue
        A_x = loop.A[np.ix_(slow, slow)] / loop.sigma[slow][:, None] + loop.C[np.ix_(slow, slow)]
        A_f, C_ff = loop.A[np.ix_(fast, fast)], loop.C[np.ix_(fast, fast)]
        if max(np.linalg.eigvals(A_x).real.max(), np.linalg.eigvals(A_f).real.max()) >= 0:
            break
        P_x, P_f = _lyapunov(A_x), _lyapunov(A_f)
        PC, CP = P_x @ loop.C[np.ix_(slow, fast)], loop.C[np.ix_(fast, slow)].T @ P_f
        own = P_f @ C_ff + C_ff.T @ P_f
        best = minimize_scalar(
            lambda log, args=(own, PC, CP): _needed(log, *args),
            bounds=(-40.0, 40.0), method="bounded", options={"xatol": 1e-6},
        )  # fmt: skip
        norms = max(0.0, _largest(own)) + 4 * float(np.linalg.norm(PC, 2) * np.linalg.norm(CP, 2))
        found.append(
            LyapunovBounds(
                inf if best.fun <= ZERO else 1 / (float(best.fun) * before),
                inf if norms <= ZERO else 1 / (norms * before),
                _literal(CP) if at == 0 else None,
            )
        )
        slow = np.concatenate([slow, fast])
    return found + [LyapunovBounds(0.0, 0.0, None)] * (len(epsilon) - len(found))


def _needed(log: float, own: Array, PC: Array, CP: Array) -> float:
    """Returns the least 1/σ_f for log(d/(1-d))."""
    mixed = PC.T @ CP
    return _largest(own + PC.T @ PC * np.exp(-log) + CP.T @ CP * np.exp(log) + mixed + mixed.T)


def _largest(symmetric: Array) -> float:
    """Returns the largest eigenvalue of a symmetric matrix."""
    return float(np.linalg.eigvalsh(symmetric)[-1])


def _lyapunov(A: Array) -> Array:
    """Returns P of Aᵀ P + P A = -1."""
    return np.asarray(solve_continuous_lyapunov(A.T, -np.eye(len(A))), dtype=np.float64)


def _literal(CP: Array) -> float:
    """Returns the largest det(A) det(C̄ - Bᵀ A⁻¹ B) over d, with A = (1-d), B = -d A_rcᵀ P_r and C̄ = d (label be1)."""
    n, m = CP.shape

    def value(d: float) -> float:
        signs = np.linalg.eigvalsh(d * np.eye(m) - d**2 / (1 - d) * CP.T @ CP)
        return float((1 - d) ** n * np.prod(signs)) if signs[0] > 0 else 0.0

    grid = np.linspace(0, 1, 402)[1:-1]
    near = grid[int(np.argmax([value(d) for d in grid]))]
    step = grid[1] - grid[0]
    best = minimize_scalar(lambda d: -value(d), bounds=(max(0, near - step), min(1, near + step)), method="bounded")
    return float(-best.fun)
