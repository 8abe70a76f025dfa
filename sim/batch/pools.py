"""The pools of a model while it is made, and its arrays of records."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Pools:
    """The pools of constants, and how much scratch is taken."""

    def __init__(self) -> None:
        self._table: list[float] = []
        self._index: list[int] = []
        self._shared: dict[tuple[int, ...], int] = {}
        self.reals = self.wholes = 0

    def table(self, values: Any) -> int:
        """Returns the place of floats."""
        self._table += np.asarray(values, dtype=float).ravel().tolist()
        return len(self._table) - np.asarray(values).size

    def index(self, values: Sequence[int]) -> int:
        """Returns the place of integers."""
        self._index += values
        return len(self._index) - len(values)

    def shared(self, values: tuple[int, ...]) -> int:
        """Returns the place of integers that several have in common."""
        if values not in self._shared:
            self._shared[values] = self.index(values)
        return self._shared[values]

    def real(self, count: int) -> int:
        """Returns the place of scratch for floats."""
        self.reals += count
        return self.reals - count

    def whole(self, count: int) -> int:
        """Returns the place of scratch for integers."""
        self.wholes += count
        return self.wholes - count

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Returns both pools; neither is empty."""
        return np.array([*self._table, 0.0]), np.array([*self._index, 0], dtype=np.int64)


def records_of(kind: np.dtype[np.void], rows: Sequence[dict[str, Any]]) -> NDArray[np.void]:
    """Returns records of a kind with these values, which are attributes too; what is not named is zero."""
    array = np.zeros(len(rows), dtype=kind)
    for at, row in enumerate(rows):
        for name, value in row.items():
            array[name][at] = value
    return array.view(np.recarray)
