"""Spectral radius of a large, sparse map: of its parts that act on each other, and of those only the outermost eigenvalues."""

from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvals
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, eigs

from echelon.controller.prediction.gains import PredictionError

DENSE: Final = 600
"""Up to this size all eigenvalues of a part are computed"""
LARGE: Final = 2000
"""Up to this size all of them are computed where the outermost do not converge"""
LARGEST: Final = 6000
"""A part that is larger is refused"""
OUTERMOST: Final = 8
VECTORS: Final = 120
"""Of the Krylov space: many, for eigenvalues that come of delays lie close together"""
STARTS: Final = 2
"""From a single vector, one of several eigenvalues of nearly the same magnitude may be missed"""


def spectral_radius(matrix: csr_array) -> float:
    """Returns the largest magnitude of an eigenvalue; infinite if some number is not finite.

    Raises PredictionError if the map is too large."""
    if not np.isfinite(matrix.data).all():
        return inf
    different = {}
    for rows in strong_parts(matrix):
        part = matrix[rows][:, rows]
        part.sort_indices()
        different[part.indptr.tobytes(), part.indices.tobytes(), part.data.tobytes()] = part
    return max((_radius(part) for part in different.values() if part.nnz), default=0.0)


def strong_parts(matrix: csr_array) -> list[NDArray[np.intp]]:
    """Returns the variables of each part: those that act on each other, be it by way of others.  Ordered by parts, the matrix
    is block triangular, so its spectrum is that of the parts."""
    count, label = connected_components(matrix, directed=True, connection="strong")
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])


def _radius(part: csr_array) -> float:
    size = part.shape[0]
    if size <= DENSE:
        return float(np.abs(eigvals(part.toarray())).max())
    if size > LARGEST:
        raise _too_large(size)
    found = [0.0]
    for start in range(STARTS):
        vector = np.random.default_rng(start).normal(size=size)
        try:
            values = eigs(part, OUTERMOST, ncv=VECTORS, v0=vector, tol=1e-12, return_eigenvectors=False)
        except ArpackNoConvergence:
            if size > LARGE:
                raise _too_large(size) from None
            return float(np.abs(eigvals(part.toarray())).max())
        found.append(float(np.abs(values).max()))
    return max(found)


def _too_large(size: int) -> PredictionError:
    return PredictionError(
        f"delays are so long that {size} numbers on their way act on each other, too many to compute with"
    )
