"""The error counters of the nodes on a CAN bus, after ISO 11898-1, as far as a bus with one error at a time needs them.

Each node has a transmit error counter (TEC) and a receive error counter (REC).  It counts from its first frame on.

attempt to send     TEC of the sender     REC of each other node
destroyed           + 8                   + 1
delivered           - 1, down to 0        - 1, down to 0; 119 if it was over 127

state           entered when
error active    at first; both counters are at most 127
error passive   a counter is over 127
bus-off         TEC is over 255
"""

from collections import defaultdict
from collections.abc import Container
from dataclasses import dataclass
from typing import Final

from echelon.bridge.timing.bus_model import BusEventKind

PASSIVE_OVER: Final = 127
OFF_OVER: Final = 255
RECOVERED_REC: Final = 119
"""REC of an error passive receiver after a good frame; the standard allows 119 .. 127"""


@dataclass(slots=True)
class NodeErrors:
    """The error counters of a node, and whether it is error passive."""

    tec: int = 0
    rec: int = 0
    passive: bool = False


class ErrorCounters:
    """The error counters of all nodes that have sent a frame."""

    def __init__(self) -> None:
        self.nodes: defaultdict[int, NodeErrors] = defaultdict(NodeErrors)
        self._marked: set[int] = set()  # nodes with a counter above zero

    def reset(self, node: int) -> None:
        """Sets the counters of a node to zero; it is error active then."""
        self.nodes[node] = NodeErrors()
        self._marked.discard(node)

    def count(self, sender: int, destroyed: bool, off: Container[int]) -> list[tuple[int, BusEventKind]]:
        """Updates the counters after an attempt to send; returns the nodes whose state changes, with their new states.

        Nodes in `off` are bus-off and do not count."""
        if not (destroyed or self._marked):
            return []
        changes = []
        for node in sorted(self.nodes if destroyed else self._marked):
            if node in off:
                continue
            state = self.nodes[node]
            if node == sender:
                state.tec = state.tec + 8 if destroyed else max(0, state.tec - 1)
            elif destroyed:
                state.rec = min(PASSIVE_OVER + 1, state.rec + 1)
            else:
                state.rec = RECOVERED_REC if state.rec > PASSIVE_OVER else max(0, state.rec - 1)
            if state.tec or state.rec:
                self._marked.add(node)
            else:
                self._marked.discard(node)
            if state.tec > OFF_OVER:
                changes.append((node, BusEventKind.OFF))
                continue
            passive = max(state.tec, state.rec) > PASSIVE_OVER
            if passive != state.passive:
                state.passive = passive
                changes.append((node, BusEventKind.PASSIVE if passive else BusEventKind.ACTIVE))
        return changes
