"""Matrices of a linear map, found by taking unit vectors through it: their columns, and the rows that come out as sparse
matrices.

The map takes x and an input u.  Only those components of x get a unit vector that the map uses.
"""

import numpy as np
from scipy.sparse import coo_array, csr_array

from echelon.plan.plan import Array


class Columns:
    """The unit vectors: those of the components of x that the map uses, then those of u."""

    def __init__(self) -> None:
        self.x: list[int] = []
        """The component of x that each of the first columns belongs to"""
        self.u = 0
        """Number of columns of u"""

    def of_x(self, at: int, unit: Array) -> tuple[int, Array]:
        """Adds the columns of the components of x from `at` on; returns their first number, and `unit`.  They must be added
        before those of u.  `unit` has the factors from SI units to components of x, (n,)."""
        self.x.extend(range(at, at + len(unit)))
        return len(self.x) - len(unit), unit

    def of_u(self, unit: Array) -> tuple[int, Array]:
        """Adds columns of u; returns their first number, and `unit`."""
        self.u += len(unit)
        return len(self.x) + self.u - len(unit), unit

    def unit_vectors(self, seed: tuple[int, Array]) -> Array:
        """Returns the values of added components in SI units as a matrix over all columns, (n, columns)."""
        at, unit = seed
        matrix = np.zeros((len(unit), len(self.x) + self.u))
        matrix[np.arange(len(unit)), at + np.arange(len(unit))] = 1 / unit
        return matrix


class Rows:
    """The rows of a matrix over x and u."""

    def __init__(self, columns: Columns) -> None:
        self._columns = columns
        self._found: list[tuple[int, Array]] = []
        self._moved: list[tuple[int, int]] = []

    def add(self, at: int, values: Array) -> None:
        """Adds rows from number `at` on; `values` are over all columns, (n, columns)."""
        self._found.append((at, values))

    def move(self, at: int, source: int, size: int) -> None:
        """Adds `size` rows from number `at` on that are equal to the components of x from `source` on."""
        self._moved += [(at + each, source + each) for each in range(size)]

    def matrices(self, rows: int, size: int) -> tuple[csr_array, csr_array]:
        """Returns the matrix over x, (rows, size), and the matrix over u."""
        count = len(self._columns.x)
        stacked = (
            np.vstack([values for _, values in self._found]) if self._found else np.zeros((0, count + self._columns.u))
        )
        at = np.concatenate([start + np.arange(len(values)) for start, values in self._found] or [np.zeros(0, int)])
        one, two = stacked.nonzero()
        is_x = two < count
        moved = np.array(self._moved, dtype=int).reshape(-1, 2)
        x = np.array(self._columns.x, dtype=int)
        over_x = coo_array(
            (
                np.concatenate([stacked[one[is_x], two[is_x]], np.ones(len(moved))]),
                (np.concatenate([at[one[is_x]], moved[:, 0]]), np.concatenate([x[two[is_x]], moved[:, 1]])),
            ),
            (rows, size),
        )
        over_u = coo_array(
            (stacked[one[~is_x], two[~is_x]], (at[one[~is_x]], two[~is_x] - count)), (rows, self._columns.u)
        )
        return over_x.tocsr(), over_u.tocsr()
