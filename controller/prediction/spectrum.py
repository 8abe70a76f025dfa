"""The spectral radius of a large, sparse matrix: part by part, and for large parts from the outermost eigenvalues only."""

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
"""Size up to which all eigenvalues of a part are computed"""
LARGE: Final = 2000
"""Size up to which all eigenvalues are computed if the outermost ones do not converge"""
LARGEST: Final = 6000
"""Size of the largest part; a larger one is refused"""
OUTERMOST: Final = 8
"""Number of outermost eigenvalues that are computed"""
VECTORS: Final = 120
"""Dimension of the Krylov space; it is large, since eigenvalues that come from delays lie close together"""
STARTS: Final = 2
"""Number of starting vectors; with a single one, one of several eigenvalues of nearly the same magnitude may be missed"""


def spectral_radius(matrix: csr_array) -> float:
    """Returns the largest magnitude of the eigenvalues of a square matrix; infinite if a number in it is not finite.

    Raises PredictionError if a part of the matrix is too large."""
    if not np.isfinite(matrix.data).all():
        return inf
    different = {}
    for rows in strong_parts(matrix):
        part = matrix[rows][:, rows]
        part.sort_indices()
        different[part.indptr.tobytes(), part.indices.tobytes(), part.data.tobytes()] = part
    return max((_radius(part) for part in different.values() if part.nnz), default=0.0)


def strong_parts(matrix: csr_array) -> list[NDArray[np.intp]]:
    """Returns the indices of the variables in each part.  Variables are in the same part if each acts on the other, directly or
    through others (strongly connected components).  Ordered by parts the matrix is block triangular, so its spectrum is that of
    the parts."""
    count, label = connected_components(matrix, directed=True, connection="strong")
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])


def _radius(part: csr_array) -> float:
    """Returns the spectral radius of a part."""
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
