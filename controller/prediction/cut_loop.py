"""The linear run cut open (`controller.prediction.linear_run.Loop`), part by part, and its frequency response."""

from collections.abc import Iterator
from functools import cached_property
from math import ceil, inf, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, csr_array, eye_array
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
    size = loop.A.shape[0]
    seen = set()
    for rows in strong_parts(csr_array(block_array([[loop.A, loop.B], [loop.C, loop.D]]))):
        x, u = rows[rows < size], rows[rows >= size] - size
        part = Loop(loop.A[x][:, x], loop.B[x][:, u], loop.C[u][:, x], loop.D[u][:, u])
        known = tuple(matrix.toarray().tobytes() for matrix in (part.A, part.B, part.C, part.D))
        if part.B.nnz + part.D.nnz and known not in seen:
            seen.add(known)
            yield LoopPart(part, x)


class LoopPart:
    """A part of a loop: R(z) = C (z - A)⁻¹ B + D.

    The messages that receivers get act through few combinations, (B; D) = F V with a V of few rows.  So R has the eigenvalues
    of the smaller matrix V (C (z - A)⁻¹, 1) F; the others are zero."""

    def __init__(self, loop: Loop, index: NDArray[np.intp]) -> None:
        self._index = index
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

    def motions(self, crossing: Crossing) -> tuple[NDArray[np.intp], Complex]:
        """Returns the motions of x at a crossing: the numbers of its components in the whole run, and their values, a column
        for each eigenvector."""
        matrices, states = self._small(np.exp(1j * np.array([crossing.omega])))
        values, vectors = np.linalg.eig(matrices[0])
        away = np.abs(values - np.exp(1j * crossing.angle))
        return self._index, np.asarray(states[0] @ vectors[:, away <= max(SAME, away.min())], dtype=np.complex128)

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

    def motions(self, q: int) -> Array | None:
        """Returns the positions of the robots, (motions, N, 2), complex, in the motions that reached the edge of stability last
        before there were q hyperperiods more; None if none did."""
        assert self.found is not None
        reached = sorted((each.angle / each.omega, at) for at, (_, each) in enumerate(self._crossings) if each.falls)
        before = [at for delay, at in reached if delay <= q]
        if not before:
            return None
        part, crossing = self._crossings[before[-1]]
        index, values = part.motions(crossing)
        whole = np.zeros((values.shape[1], 4 * len(self._run.plan.robots)), dtype=complex)
        here = index < whole.shape[1]
        whole[:, index[here]] = values[here].T
        return whole.reshape(len(whole), -1, 4)[:, :, :2]
