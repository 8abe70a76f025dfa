"""How the second moment of a run with losses grows (docs/architecture.md, 2.11).

In a hyperperiod X becomes L(X) = E[M X Mᵀ], with the random map M of the state.  L keeps X positive semidefinite, so its
spectral radius is an eigenvalue (Krein and Rutman).  L is hard to iterate where slow modes lie close together.  It is split
into what a mean map M̄ makes of X, and the rest,

    L(X) = M̄ X M̄ᵀ + N(X),        N(X) = E[(M - M̄) X (M - M̄)ᵀ]

N keeps X positive semidefinite, too.  So the spectral radius of L is below s > ρ(M̄)² if and only if that of

    K_s = (s - M̄ · M̄ᵀ)⁻¹ N

is below 1 (as for regular splittings of nonnegative matrices; Varga, *Matrix Iterative Analysis*).  In K_s the slow modes are
solved for, and few of its eigenvalues are not small.

With a Markov chain there is an X for each mode, and no such mean map.  Then the spectral radius of L is found by Arnoldi's
method directly, and fails rather than being inexact where modes lie too close together.
"""

from collections.abc import Callable
from math import inf, log, sqrt
from typing import Final

import numpy as np
from scipy.linalg import schur
from scipy.linalg.lapack import dtrsyl
from scipy.optimize import brentq
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs, gmres

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.random_branches import mean, moment
from echelon.controller.prediction.random_run import Part
from echelon.controller.prediction.random_steps import Chances
from echelon.plan.plan import Array

VANISHED: Final = 1e-12
"""A rest N below this share counts as zero"""
CONVERGED: Final = 1e-7
"""Relative accuracy of eigenvalues"""
VECTORS: Final = 20
"""Dimension of the Krylov space"""
CHAIN_VECTORS: Final = 60
"""The same with a chain"""
MOST: Final = 200
"""Largest number of restarts"""
SMALL: Final = 80
"""Size up to which maps of the second moment are computed as matrices"""
HALVED: Final = 64
"""Size from which on Sylvester's equation is halved"""
EDGE: Final = 0.999
"""With a chain M̄ is made smaller if its spectral radius is above this share of √s"""


class SecondMoment:
    """The second moment's map L of a part of a run."""

    def __init__(self, part: Part, chances: Chances) -> None:
        self._part, self._chances = part, chances
        size, modes = len(part.registers), chances.modes
        self.shape = (modes, size, size)
        self._pi = chances.stationary()[:, None, None]
        M = mean(part.steps, self._pi * np.eye(size), chances).sum(axis=0)
        self._M = M
        self.rate = float(np.abs(np.linalg.eigvals(M)).max())
        """ρ(M̄)"""
        self._solver: tuple[float, Solver] | None = None

    def after(self, X: Array) -> Array:
        """Returns L(X); X is (modes, registers, registers)."""
        return np.asarray(moment(self._part.steps, X, self._chances))

    def gain(self, s: float = 1.0) -> float:
        """Returns a number that is below 1 if and only if the spectral radius of L is below s: the largest real eigenvalue of
        K_s, or with a chain of L/s; infinite if s is not above ρ(M̄)²."""
        if self.shape[0] > 1:
            start = (self._pi * np.eye(self.shape[1])).ravel()
            return self._largest(lambda X: self.after(X).ravel(), start, CHAIN_VECTORS) / s
        if not self.rate**2 < s:
            return inf
        start = self._solved(np.eye(self.shape[1])[None], s).ravel()

        def gained(X: Array) -> Array:
            return self._solved(self.after(X) - self._of_mean(X, s), s).ravel()

        if (after := float(np.abs(gained(start.reshape(self.shape))).max())) < VANISHED * np.abs(start).max():
            return after
        return self._largest(gained, start, VECTORS)

    def _largest(self, of: Callable[[Array], Array], start: Array, vectors: int) -> float:
        """Returns the largest real eigenvalue of a map of X."""

        def symmetric(vector: Array) -> Array:
            X = vector.reshape(self.shape)
            return of((X + X.transpose(0, 2, 1)) / 2)

        if start.size <= SMALL:
            return float(np.linalg.eigvals(np.array([symmetric(unit) for unit in np.eye(start.size)])).real.max())
        operator = LinearOperator((start.size, start.size), symmetric, dtype=float)
        try:
            found = eigs(
                operator, 1, which="LR", ncv=vectors, v0=start, tol=CONVERGED, return_eigenvectors=False, maxiter=MOST
            )
        except ArpackNoConvergence:
            raise PredictionError(
                "the growth of the second moment is not found: the iteration does not converge"
            ) from None
        return float(found.real.max())

    def radius(self) -> float:
        """Returns the spectral radius of L."""
        if self.shape[0] > 1:
            return self.gain()
        low = self.rate**2 * (1 + 1e-9)
        if low == 0 or self.gain(low) <= 1:
            return self.rate**2
        high = max(1.0, low)
        while self.gain(high) > 1:
            low, high = high, 2 * high
        return float(brentq(lambda s: log(self.gain(s)), low, high, xtol=1e-9))

    def sum(self, X: Array) -> Array:
        """Returns the sum of X, L(X), L(L(X)), … for a run in which errors vanish."""
        source = self._solved(X, 1.0).ravel()

        def rest(vector: Array) -> Array:
            X = vector.reshape(self.shape)
            return vector - self._solved(self.after(X) - self._of_mean(X, 1.0), 1.0).ravel()

        operator = LinearOperator((source.size, source.size), rest, dtype=float)
        found, failed = gmres(operator, source, rtol=1e-10, atol=0.0, restart=VECTORS, maxiter=100)
        if failed:
            raise PredictionError("the sum of second moments is not found: the iteration does not converge")
        return np.asarray(found.reshape(self.shape))

    def _mean_map(self, s: float) -> Array:
        """Returns M̄; with a chain it is made smaller if s is not above ρ(M̄)²."""
        largest = EDGE * sqrt(s)
        return np.asarray(self._M * (largest / self.rate)) if self.shape[0] > 1 and self.rate > largest else self._M

    def _of_mean(self, X: Array, s: float) -> Array:
        """Returns what M̄ makes of X."""
        M = self._mean_map(s)
        return np.asarray(self._pi * (M @ X.sum(axis=0) @ M.T))

    def _solved(self, Y: Array, s: float) -> Array:
        """Returns X with s X = M̄ X M̄ᵀ + Y; s must be above ρ(M̄)²."""
        if self._solver is None or self._solver[0] != s:
            self._solver = s, Solver(self._mean_map(s) / sqrt(s))
        total = Y.sum(axis=0)
        return np.asarray((Y + self._pi * (self._solver[1].solved(total) - total)) / s)


class Solver:
    """Solves X = M X Mᵀ + Y by Cayley's transform: with W = (M + 1)⁻¹ and A = (M - 1) W it is A X + X Aᵀ = -2 W Y Wᵀ."""

    def __init__(self, M: Array) -> None:
        unit = np.eye(len(M))
        W = np.linalg.inv(M + unit)
        self._T, self._U = schur((M - unit) @ W)
        self._right = self._U.T @ W

    def solved(self, Y: Array) -> Array:
        """Returns X."""
        return np.asarray(self._U @ _sylvester(self._T, self._T, -2 * self._right @ Y @ self._right.T) @ self._U.T)


def _sylvester(A: Array, B: Array, C: Array) -> Array:
    """Returns X with A X + X Bᵀ = C, where A and B are real Schur forms.  Large equations are halved, so that most of the work
    is products of matrices: five times faster than LAPACK's routine for 600 rows."""
    rows, columns = C.shape
    if max(rows, columns) <= HALVED:
        solution, scale, _ = dtrsyl(A, B, C, tranb="T")
        return np.asarray(solution / scale)
    if rows >= columns:
        at = _middle(A)
        below = _sylvester(A[at:, at:], B, C[at:])
        return np.vstack([_sylvester(A[:at, :at], B, C[:at] - A[:at, at:] @ below), below])
    at = _middle(B)
    right = _sylvester(A, B[at:, at:], C[:, at:])
    return np.hstack([_sylvester(A, B[:at, :at], C[:, :at] - right @ B[:at, at:].T), right])


def _middle(T: Array) -> int:
    """Returns about half the size of a real Schur form, not within one of its blocks of two."""
    half = len(T) // 2
    return half + 1 if T[half, half - 1] else half
