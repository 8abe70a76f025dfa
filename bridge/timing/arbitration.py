"""A model of one CAN bus: arbitration, queues, errors and retransmission (docs/architecture.md, 5.6).

Pure.  Instants are integer nanoseconds.  A bit lasts 1/bitrate; the length of a frame is rounded up to nanoseconds.

*Arbitration.*  When the bus is free, the waiting frame with the lowest identifier starts, at whichever node it waits.  With
the same identifier, a data frame goes before a remote frame, and then the frame that was queued first.  A frame takes
`frame_bits` bits.  It is delivered with the last bit of its end of frame; then the bus is blocked for three more bits.

*Errors.*  An attempt to send is destroyed with a given probability, at a random bit (bridge.timing.error_draws).  Error flag,
echo, delimiter and interframe space follow; then the frame waits again.

*Error states.*  The error counters (bridge.timing.error_counters) decide about a node's state.

state           entered when                                    what the node does
error active    at first; both counters are at most 127         sends without restrictions
error passive   a counter is over 127                           waits 8 more bits after each of its own frames
bus-off         TEC is over 255, or `bus_off` was called        does not send or count; its frames wait in its queue.
                                                                `restart_ns` later it starts to count idle times; after 128
                                                                times 11 recessive bits it is error active, counters at zero

*Frames of other processes* are not in the queues of this model; `hear` tells it of them when they are over.  If the model's bus
was free, it counts as occupied by the frame just before.  Otherwise the frame waits with the others and occupies the bus later.
In this way several models that hear each other stand for one bus.
"""

from collections import defaultdict
from collections.abc import Mapping
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.bus_load import frame_bits
from echelon.bridge.timing.bus_model import BusEvent, BusEventKind, BusModel, Delivered, Traffic
from echelon.bridge.timing.bus_off import OffNodes
from echelon.bridge.timing.error_counters import ErrorCounters, NodeErrors
from echelon.bridge.timing.error_draws import INTERFRAME, ErrorDraws

CAPACITY = 64
"""Default length of a node's queue [frames] (SocketCAN's default is 10)"""
_ERROR_FLAG, _ERROR_DELIMITER, _SUSPEND = 6, 8, 8
_EVER, _NEVER = -(2**62), 2**62
_OTHERS = -1  # node number for all frames of other processes


class _Waiting(NamedTuple):
    """A frame in a queue.  Tuples compare in the order in which frames are sent: by priority, then by the order of queueing."""

    priority: int
    order: int
    queued_ns: int
    node: int
    frame: Frame
    bits: int


class ArbitratedBus(BusModel):
    """A CAN bus with arbitration, queues and errors; a `BusModel`.

    Parameters: `bitrate` [bit/s]; `seed` and `bus_number`, the key of the error draws; `capacity`, the length of a node's queue
    [frames], the frame on the bus included; `error_rate`, the probability that an attempt is destroyed; `restart_ns`, the
    time until a node that is bus-off starts its recovery; `note_errors`, whether each destroyed frame becomes an event.

    Raises ValueError for a bit rate or a capacity under 1, an error rate outside 0 .. 1, or a negative `restart_ns`."""

    def __init__(
        self,
        bitrate: int,
        seed: int = 0,
        bus_number: int = 0,
        *,
        capacity: int = CAPACITY,
        error_rate: float = 0.0,
        restart_ns: int = 0,
        note_errors: bool = False,
    ) -> None:
        for name, value, least in (("bit rate", bitrate, 1), ("capacity", capacity, 1), ("restart_ns", restart_ns, 0)):
            if value < least:
                raise ValueError(f"{name} must be at least {least}, not {value!r}")
        self.bitrate, self.capacity, self.restart_ns = bitrate, capacity, restart_ns
        self.events: list[BusEvent] = []
        self._note_errors = note_errors
        self._traffic: defaultdict[int, Traffic] = defaultdict(Traffic)
        self._held: defaultdict[int, int] = defaultdict(
            int
        )  # frames in the queue of each node, the one on the bus included
        self._counters = ErrorCounters()
        self._pending: list[_Waiting] = []  # heap
        self._current: _Waiting | None = None
        self._destroyed = False
        self._end_ns = _EVER  # end of the current attempt: the frame is delivered or destroyed then
        self._free_ns = _EVER  # when the bus is free after the current attempt
        self._suspended: dict[int, int] = {}  # the error passive node that sent last, and when it may start again
        self._off = OffNodes(bitrate)
        self._delivered: list[Delivered] = []
        self._began_ns: int | None = None
        self._now_ns = _EVER  # the model is decided up to this instant
        self._order = self._busy_ns = self._attempts = 0
        self._others = 0  # number of waiting frames of other processes
        self._draws = ErrorDraws(seed, bus_number)
        self.set_error_rate(error_rate)

    @property
    def traffic(self) -> Mapping[int, Traffic]:
        return self._traffic

    @property
    def due_ns(self) -> int | None:
        if self._current is not None:
            return self._end_ns
        if not self._pending:
            return None
        if self._rate or self._suspended or self._off.nodes:
            return self._next_start() + 1  # only then it is known which frame is sent, and whether it is destroyed
        return self._next_start() + self._span(self._pending[0].bits - INTERFRAME)

    @property
    def busy_ns(self) -> int:
        return self._busy_ns - max(0, self._free_ns - self._now_ns)

    @property
    def load(self) -> float:
        passed_ns = 0 if self._began_ns is None else self._now_ns - self._began_ns
        return self.busy_ns / passed_ns if passed_ns else 0.0

    def counters(self, node: int) -> tuple[int, int]:
        """Returns the transmit and the receive error counter of a node."""
        known = self._counters.nodes.get(node, NodeErrors())
        return known.tec, known.rec

    def duration_ns(self, frame: Frame) -> int:
        return self._span(frame_bits(frame.can_id, frame.data, frame.remote) - INTERFRAME)

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        bits = frame_bits(frame.can_id, frame.data, frame.remote)
        self._advance(time_ns)
        traffic = self._traffic[frame.can_id]
        traffic.sent += 1
        self._counters.nodes[node]  # it counts from its first frame on
        if self._held[node] == self.capacity:
            traffic.lost += 1
            return False
        self._held[node] += 1
        self._order += 1
        heappush(self._pending, _Waiting(frame.can_id * 2 + frame.remote, self._order, time_ns, node, frame, bits))
        return True

    def hear(self, time_ns: int, frame: Frame, end_ns: int) -> None:
        bits = frame_bits(frame.can_id, frame.data, frame.remote)
        self._advance(time_ns)
        span_ns = self._span(bits - INTERFRAME)
        began_ns = max(self._free_ns, min(end_ns, time_ns) - span_ns)
        if began_ns + span_ns <= time_ns:
            self._note_start(began_ns)
            self._free_ns = began_ns + self._span(bits)
            self._busy_ns += self._free_ns - began_ns
            self._count(time_ns, _OTHERS, destroyed=False)
        elif self._others < self.capacity:
            self._others += 1
            self._order += 1
            waiting = _Waiting(frame.can_id * 2 + frame.remote, self._order, time_ns, _OTHERS, frame, bits)
            heappush(self._pending, waiting)

    def run(self, until_ns: int) -> list[Delivered]:
        self._advance(until_ns)
        delivered, self._delivered = self._delivered, []
        return delivered

    def set_error_rate(self, rate: float) -> None:
        if not 0 <= rate <= 1:
            raise ValueError(f"error rate must be 0 .. 1, not {rate!r}")
        self._rate = rate

    def is_off(self, node: int) -> bool:
        return node in self._off.nodes

    def clear(self, node: int) -> int:
        kept = [waiting for waiting in self._pending if waiting.node != node]
        for waiting in self._pending:
            if waiting.node == node:
                self._traffic[waiting.frame.can_id].lost += 1
        count = len(self._pending) - len(kept)
        self._held[node] -= count
        self._pending = kept
        heapify(self._pending)
        return count

    def bus_off(self, node: int) -> None:
        if node not in self._off.nodes:
            self._go_off(self._now_ns, node)

    def _span(self, bits: int) -> int:
        """Returns how long some bits last [ns], rounded up."""
        return -(-bits * 1_000_000_000 // self.bitrate)

    def _advance(self, until_ns: int) -> None:
        """Starts the attempts that start before `until_ns`, and finishes those that end by then."""
        if until_ns < self._now_ns:
            raise ValueError(f"time must not be before {self._now_ns} ns, not {until_ns!r}")
        if self._began_ns is None:
            self._began_ns = self._now_ns = until_ns
        while True:
            if self._current is not None:
                if self._end_ns > until_ns:
                    break
                self._finish(self._current)
            start_ns = self._next_start()
            if self._off.nodes:
                self._recover(min(start_ns, until_ns))
            if start_ns >= until_ns:
                break
            self._begin(start_ns)
        self._now_ns = until_ns

    def _next_start(self) -> int:
        """Returns when the next attempt starts if no other frame is sent before."""
        if not self._pending:
            return _NEVER
        start_ns = max(self._now_ns, self._free_ns)
        if self._off.nodes or self._suspended:
            start_ns = max(start_ns, min(self._ready_ns(waiting.node) for waiting in self._pending))
        return start_ns

    def _ready_ns(self, node: int) -> int:
        """Returns from when on a node may start, if the bus is idle until then."""
        if node in self._off.nodes:
            return self._off.ready_ns(node, self._free_ns)
        return self._suspended.get(node, _EVER)

    def _begin(self, start_ns: int) -> None:
        """Starts the next attempt to send, and decides whether it is destroyed."""
        current = self._pop(start_ns)
        self._note_start(start_ns)
        hit = None
        if self._rate and current.node != _OTHERS:
            hit = self._draws.hit(self._attempts, self._rate, current.bits)
        if hit is None:
            on_bus, end = current.bits, current.bits - INTERFRAME
        else:
            end, echo = hit
            on_bus = end + _ERROR_FLAG + echo + _ERROR_DELIMITER + INTERFRAME
        self._attempts += 1
        self._current, self._destroyed = current, hit is not None
        self._end_ns = start_ns + self._span(end)
        self._free_ns = start_ns + self._span(on_bus)
        self._busy_ns += self._free_ns - start_ns

    def _note_start(self, start_ns: int) -> None:
        """Notes that a frame starts: the idle time before counts for nodes that are bus-off, and suspension ends."""
        self._suspended.clear()
        if self._off.nodes:
            self._off.count_idle(start_ns, self._free_ns)

    def _pop(self, start_ns: int) -> _Waiting:
        """Takes the first waiting frame whose node may start."""
        if not (self._off.nodes or self._suspended):
            return heappop(self._pending)
        aside = []
        while self._ready_ns((first := heappop(self._pending)).node) > start_ns:
            aside.append(first)
        for waiting in aside:
            heappush(self._pending, waiting)
        return first

    def _finish(self, current: _Waiting) -> None:
        """Ends the present attempt: the frame is delivered, or waits again."""
        end_ns, node, can_id = self._end_ns, current.node, current.frame.can_id
        self._current = None
        if node == _OTHERS:
            self._others -= 1
        elif self._destroyed:
            self._traffic[can_id].retransmitted += 1
            if self._note_errors:
                self.events.append(BusEvent(end_ns, node, BusEventKind.ERROR, can_id))
            heappush(self._pending, current)
        else:
            self._traffic[can_id].deliver(end_ns - current.queued_ns)
            self._held[node] -= 1
            self._delivered.append(Delivered(current.queued_ns, end_ns, node, current.frame))
        self._count(end_ns, node, self._destroyed)
        if node != _OTHERS and self._counters.nodes[node].passive:
            self._suspended[node] = self._free_ns + self._span(_SUSPEND)

    def _count(self, time_ns: int, sender: int, destroyed: bool) -> None:
        """Updates all error counters after an attempt, and the states that depend on them."""
        for node, kind in self._counters.count(sender, destroyed, self._off.nodes):
            if kind is BusEventKind.OFF:
                self._go_off(time_ns, node)
            else:
                self.events.append(BusEvent(time_ns, node, kind))

    def _go_off(self, time_ns: int, node: int) -> None:
        """Makes a node bus-off."""
        self._off.add(node, time_ns + self.restart_ns)
        self.events.append(BusEvent(time_ns, node, BusEventKind.OFF))

    def _recover(self, until_ns: int) -> None:
        """Ends bus-off for the nodes that have recovered by `until_ns`."""
        for time_ns, node in self._off.remove_recovered(until_ns, self._free_ns):
            self._counters.reset(node)
            self.events.append(BusEvent(time_ns, node, BusEventKind.RECOVERED))
