"""Ages of the messages that a receiver uses: their percentiles, from counts.

Up to `EXACT` different ages are counted one by one.  If there are more, each is counted by the eight leading bits of its number
of nanoseconds; then a percentile is off by 0.4 % at most.  So a link needs little memory, however long the run is.
"""

from collections.abc import Sequence
from typing import Final

EXACT: Final = 1024
"""Number of different ages that are counted one by one"""
_KEPT_BITS: Final = 8


def _rough(age_ns: int) -> int:
    """Returns the middle of the ages that have the same leading bits."""
    dropped = age_ns.bit_length() - _KEPT_BITS
    return age_ns if dropped <= 0 else (age_ns >> dropped << dropped) + (1 << dropped >> 1)


class AgeCounts:
    """Counts of ages."""

    __slots__ = ("_counts", "_exact")

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self._exact = True

    def note(self, age_ns: int) -> None:
        """Counts an age."""
        if not self._exact:
            age_ns = _rough(age_ns)
        try:
            self._counts[age_ns] += 1
        except KeyError:
            self._counts[age_ns] = 1
            if self._exact and len(self._counts) > EXACT:
                self._make_rough()

    def _make_rough(self) -> None:
        """Counts the ages from now on by their leading bits."""
        self._exact, counts, self._counts = False, self._counts, {}
        for each, count in counts.items():
            self._counts[_rough(each)] = self._counts.get(_rough(each), 0) + count

    def percentiles(self, shares: Sequence[float], zeros: int) -> list[int]:
        """Returns for each share, ascending, the smallest age that is not exceeded in at least this share of the uses [ns].

        `zeros` counts uses of age 0 that were not noted.  Without uses, all are 0."""
        total = zeros + sum(self._counts.values())
        ages = sorted(self._counts.items())
        found, at, below, age = [], 0, zeros, 0
        for share in shares:
            while below < share * total:
                age = ages[at][0]
                below += ages[at][1]
                at += 1
            found.append(age)
        return found
