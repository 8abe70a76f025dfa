"""The linear run cut open (`controller.prediction.linear_run.Loop`), part by part, and its frequency response."""

from collections.abc import Iterator
from functools import cached_property
from math import ceil, inf, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, csr_array, eye_array, kron
from scipy.sparse.linalg import splu

from echelon.controller.prediction.crossings import SAME, Crossing, crossings, smallest_delay, unstable_roots
from echelon.controller.prediction.gains import linear_gains
from echelon.controller.prediction.linear_run import Edges, LinearRun, Loop
from echelon.controller.prediction.spectrum import spectral_radius, strong_parts
from echelon.plan.plan import Array

SMALL: Final = 150
"""Number of unknowns up to which equations are solved with dense matrices"""
RANK: Final = 1e-12
"""Singular values below this share of the largest one count as zero"""
TOGETHER: Final = 32
"""Number of frequencies that are computed at once"""
SLOW: Final = 1e-2
"""Crossings are searched from this multiple of the slowest block's natural frequency upwards"""

Complex = NDArray[np.complex128]


def parts(loop: Loop) -> "Iterator[LoopPart]":
    """Yields the parts of a loop whose variables act on each other.  Equal parts are yielded once."""
    seen = set()
    for half, into_whole in mirrored(loop) or ((loop, eye_array(loop.A.shape[0], format="csc")),):
        states = half.A.shape[0]
        for rows in strong_parts(csr_array(block_array([[half.A, half.B], [half.C, half.D]]))):
            x, u = rows[rows < states], rows[rows >= states] - states
            part = Loop(half.A[x][:, x], half.B[x][:, u], half.C[u][:, x], half.D[u][:, u])
            known = tuple(matrix.toarray().tobytes() for matrix in (part.A, part.B, part.C, part.D))
            if part.B.nnz + part.D.nnz and known not in seen:
                seen.add(known)
                yield LoopPart(part, into_whole[:, x])


def mirrored(loop: Loop) -> tuple[tuple[Loop, csc_array], ...]:
    """Returns the loop of x + y and the loop of x - y, if exchanging x and y changes nothing; otherwise an empty tuple.

    All variables come in pairs, x before y.  Beside each loop stands a matrix, whose column for a variable of the loop says how
    the variables of the whole loop move with it."""
    halves: list[list[csr_array]] = [[], []]
    for matrix in (loop.A, loop.B, loop.C, loop.D):
        if any(length % 2 for length in matrix.shape):
            return ()
        own, other = matrix[::2, ::2], matrix[::2, 1::2]
        if (own - matrix[1::2, 1::2]).data.any() or (other - matrix[1::2, ::2]).data.any():
            return ()
        for half, combined in zip(halves, (own + other, own - other), strict=True):
            combined.eliminate_zeros()
            half.append(csr_array(combined))
    pairs = eye_array(loop.A.shape[0] // 2)
    return tuple(
        (Loop(*half), csc_array(kron(pairs, np.array([[1.0], [sign]]))))
        for half, sign in zip(halves, (1.0, -1.0), strict=True)
    )


class LoopPart:
    """A part of a loop: R(z) = C (z - A)⁻¹ B + D.

    The messages that receivers get act through few combinations, (B; D) = F V with a V of few rows.  So R has the eigenvalues
    of the smaller matrix V (C (z - A)⁻¹, 1) F; the others are zero."""

    def __init__(self, loop: Loop, into_whole: csc_array) -> None:
        """The columns of `into_whole` say how the variables of the whole loop move with those of the part."""
        self._into_whole = into_whole
        size = loop.A.shape[0]
        left, strengths, V = np.linalg.svd(np.vstack([loop.B.toarray(), loop.D.toarray()]), full_matrices=False)
        rank = int((strengths > RANK * strengths.max()).sum())
        F, V = left[:, :rank] * strengths[:rank], V[:rank]
        self._VC, self._VD = V @ loop.C, V @ F[size:]
        self._into_x = F[:size].astype(complex)
        self._size = size
        self._dense = loop.A.toarray() if size <= SMALL else None
        self._sparse, self._unit = csc_array(loop.A), eye_array(size, format="csc")

    def eigenvalues(self, omega: Array) -> Complex:
        """Returns the eigenvalues of R(e^{jω}) at several ω, (m, n)."""
        some = np.array_split(omega, max(1, len(omega) // TOGETHER))
        return np.concatenate([np.linalg.eigvals(self._small(np.exp(1j * each))[0]) for each in some])

    def motions(self, crossing: Crossing) -> Complex:
        """Returns the motions of the whole run's x at a crossing, a column for each eigenvector."""
        matrices, states = self._small(np.exp(1j * np.array([crossing.omega])))
        values, vectors = np.linalg.eig(matrices[0])
        away = np.abs(values - np.exp(1j * crossing.angle))
        found = states[0] @ vectors[:, away <= max(SAME, away.min())]
        return np.asarray(self._into_whole @ found, dtype=np.complex128)

    def _small(self, z: Complex) -> tuple[Complex, Complex]:
        """Returns V (C (z - A)⁻¹, 1) F and (z - A)⁻¹ F for several z."""
        if self._dense is not None:
            states = np.linalg.solve(z[:, None, None] * np.eye(self._size) - self._dense, self._into_x[None])
        else:
            states = np.array([splu(csc_array(each * self._unit - self._sparse)).solve(self._into_x) for each in z])
        return np.asarray(self._VC @ states + self._VD), states


class Cut:
    """A linear run, cut open at some links, and where the eigenvalues of R(e^{jω}) cross the unit circle."""

    def __init__(self, run: LinearRun, late: Edges, window: tuple[float, float] | None) -> None:
        self._run, self._late, self._window = run, late, window
        self._crossings: list[tuple[LoopPart, Crossing]] = []

    @cached_property
    def is_stable(self) -> bool:
        """True if the run is stable when it is not cut."""
        return spectral_radius(self._run.map()) < 1

    @cached_property
    def found(self) -> list[Crossing] | None:
        """The crossings; None if the criterion is not valid."""
        run, plan = self._run, self._run.plan
        stiffness = [linear_gains(plan, block).K_1 for block in plan.blocks if block.size]
        slowest = min(float(np.sqrt(np.abs(np.linalg.eigvals(K_1)).min())) for K_1 in stiffness)
        low, high = self._window or (min(SLOW * slowest * run.hyperperiod_ns * 1e-9, 0.1), pi)
        for part in parts(run.loop(self._late)):
            if np.abs(part.eigenvalues(np.array([pi]))).max() >= 1:
                return None
            self._crossings += [(part, each) for each in crossings(part.eigenvalues, low, high)]
        return [crossing for _, crossing in self._crossings]

    def first_unstable(self) -> int | None:
        """Returns the smallest number of hyperperiods, 1 at least, with which a run is unstable that is stable without."""
        assert self.found is not None
        if (edge := smallest_delay(self.found)) == inf:
            return None
        q = max(1, ceil(edge))
        while unstable_roots(self.found, q) <= 0:
            q += 1
        return q

    @property
    def frequency(self) -> float | None:
        """The frequency ω at which a root first reaches the edge of stability; None if none does."""
        return min(((each.angle / each.omega, each.omega) for each in self.found or ()), default=(inf, None))[1]

    def motions(self, q: int) -> Complex | None:
        """Returns the positions of the robots, (motions, N, 2), complex, in the motions that reached the edge of stability last
        before there were q hyperperiods more; None if none did."""
        assert self.found is not None
        reached = sorted((each.angle / each.omega, at) for at, (_, each) in enumerate(self._crossings) if each.falls)
        before = [at for delay, at in reached if delay <= q]
        if not before:
            return None
        part, crossing = self._crossings[before[-1]]
        states = part.motions(crossing)[: 4 * len(self._run.plan.robots)].T
        return states.reshape(len(states), -1, 4)[:, :, :2]
