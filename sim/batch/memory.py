"""Copies within the scratch of a run.

Several numbers are read before the first is written.  Where reading takes long, as on a GPU, the reads go on side by side; a
read that follows a write waits for it, since both might be of the same place.
"""

from typing import Any

from echelon.sim.batch.compiled import compiled


@compiled
def copy(real: Any, source: int, place: int, size: int) -> None:
    """Copies `size` numbers from `source` to `place`; the two parts must not overlap."""
    last = source + size
    while source + 6 <= last:
        a, b, c = real[source], real[source + 1], real[source + 2]
        d, e, f = real[source + 3], real[source + 4], real[source + 5]
        real[place], real[place + 1], real[place + 2] = a, b, c
        real[place + 3], real[place + 4], real[place + 5] = d, e, f
        source += 6
        place += 6
    while source + 2 <= last:
        a, b = real[source], real[source + 1]
        real[place], real[place + 1] = a, b
        source += 2
        place += 2
    if source < last:
        real[place] = real[source]


@compiled
def copy_four(real: Any, source: int, place: int) -> None:
    """Copies four numbers."""
    a, b, c, d = real[source], real[source + 1], real[source + 2], real[source + 3]
    real[place], real[place + 1], real[place + 2], real[place + 3] = a, b, c, d
