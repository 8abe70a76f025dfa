"""Who else sends identifiers that belong to a run.  On a CAN bus each identifier has one sender."""

from collections import Counter
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from echelon.bridge.can.wires import Outside

KEPT: Final = 64
"""How many pairs of sender and identifier are told apart"""
OTHERS: Final = "others"
"""The sender of all frames beyond them"""
NODE: Final = "another node"
"""The sender on a bus whose frames do not say who sent them"""


class Intrusion(NamedTuple):
    """Frames from elsewhere: the sender, the identifier, how many."""

    sender: str
    can_id: int
    frames: int


class Guard:
    """Counts frames with identifiers of `own` that this process did not send.

    `outside` hears what comes from other hosts: such frames are counted and never used."""

    __slots__ = ("_counts", "_outside", "own")

    def __init__(self, own: frozenset[int], outside: Outside | None = None) -> None:
        self.own = own
        self._outside = outside
        self._counts: Counter[tuple[str, int]] = Counter()

    def count(self, sender: tuple[Any, ...] | None, can_id: int) -> None:
        """Counts a frame on the bus with an identifier of `own`."""
        self._add(NODE if sender is None or len(sender) < 2 else f"{sender[0]}:{sender[1]}", can_id)

    def _add(self, sender: str, can_id: int) -> None:
        key = sender, can_id
        if key not in self._counts and len(self._counts) >= KEPT:
            key = OTHERS, can_id
        self._counts[key] += 1

    def look_outside(self) -> None:
        """Counts the frames that have come from other hosts; must be called from time to time."""
        if self._outside is not None:
            for address, can_id in self._outside.heard():
                if can_id in self.own:
                    self._add(address, can_id)

    @property
    def intrusions(self) -> Iterator[Intrusion]:
        """All of them so far, the most frequent first."""
        return (Intrusion(sender, can_id, frames) for (sender, can_id), frames in self._counts.most_common())

    def close(self) -> None:
        """Looks outside a last time; what was counted stays."""
        self.look_outside()
        if self._outside is not None:
            self._outside.close()
