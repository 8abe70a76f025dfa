"""Nodes that are bus-off, and how they recover: each must see 11 recessive bits 128 times (ISO 11898-1)."""

from dataclasses import dataclass
from typing import Final

_RECESSIVE: Final = 11
_RUNS: Final = 128


@dataclass(slots=True)
class _Recovery:
    """The recovery of a node: it counts from `from_ns` on, and still needs `runs` times 11 recessive bits."""

    from_ns: int
    runs: int = _RUNS


class OffNodes:
    """The nodes that are bus-off on a bus.  `free_ns` is the instant at which the bus is free after the present attempt
    [ns]."""

    def __init__(self, bitrate: int) -> None:
        self._bitrate = bitrate
        self.nodes: dict[int, _Recovery] = {}
        """By number of the node"""

    def add(self, node: int, from_ns: int) -> None:
        """Adds a node, which begins to count recessive bits at `from_ns`."""
        self.nodes[node] = _Recovery(from_ns)

    def ready_ns(self, node: int, free_ns: int) -> int:
        """Returns when a node has recovered, if the bus is idle until then."""
        recovery = self.nodes[node]
        bits = recovery.runs * _RECESSIVE
        return self._recessive_from(recovery, free_ns) - (-bits * 1_000_000_000 // self._bitrate)

    def count_idle(self, start_ns: int, free_ns: int) -> None:
        """Counts the recessive bits of all nodes before a frame that starts at `start_ns`."""
        for recovery in self.nodes.values():
            idle_ns = max(0, start_ns - self._recessive_from(recovery, free_ns))
            recovery.runs -= idle_ns * self._bitrate // (_RECESSIVE * 1_000_000_000)

    def remove_recovered(self, until_ns: int, free_ns: int) -> list[tuple[int, int]]:
        """Removes the nodes that have recovered by `until_ns`; returns instant [ns] and number of each, in order of time."""
        back = sorted((self.ready_ns(node, free_ns), node) for node in self.nodes)
        recovered = [(time_ns, node) for time_ns, node in back if time_ns <= until_ns]
        for _, node in recovered:
            del self.nodes[node]
        return recovered

    def _recessive_from(self, recovery: _Recovery, free_ns: int) -> int:
        # The last 11 bits before the bus is free are recessive: acknowledge delimiter, end of frame and interframe space, or
        # error delimiter and interframe space.
        return max(recovery.from_ns, free_ns - -(-_RECESSIVE * 1_000_000_000 // self._bitrate))
