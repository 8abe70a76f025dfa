"""One CAN bus in time: who sends when, what waits, what is destroyed and sent again.  Pure, integer nanoseconds.

Whenever the bus is free, the waiting frame with the lowest identifier starts, whichever node it waits at; of a data and a
remote frame with the same identifier the data frame.  It takes the bits that `frame_bits` counts; it is delivered with the
last bit of its end of frame, and blocks the bus for three bits more.  A bit lasts 1/bitrate, the frame is rounded up to
whole nanoseconds.

Errors.  An attempt to send is destroyed with a given probability, at a bit that is drawn (bridge.timing.error_draws).  Then
follow the error flag, its echo, the delimiter and the interframe space, and the frame waits again.

Error counters (ISO 11898-1, what a bus with one error at a time needs): the sender of a destroyed frame counts 8, each
other node 1; each delivered frame takes 1 from its sender and from the receivers.  Over 127 a node is error passive and
waits 8 bits longer after a frame of its own; over 255 (errors in sending) it is off: it neither sends nor counts until,
`restart_ns` later, it has seen 128 times 11 recessive bits.  Its frames wait meanwhile, as many as fit.

A node is any number; it counts errors from its first frame on.  Two nodes should not send the same identifier: if they do,
what was sent first goes first.

Frames of others, whose queues this model does not have, took the bus before they were over if it was free; those
that were sent meanwhile wait like all others, and take it then: so several models that hear each other share one bus.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.bus_load import frame_bits
from echelon.bridge.timing.bus_model import BusEvent, BusEventKind, BusModel, Delivered, Traffic
from echelon.bridge.timing.error_draws import INTERFRAME, ErrorDraws

CAPACITY = 64
"""Frames that a node holds unless told otherwise (SocketCAN's own default is 10)"""
PASSIVE_OVER, OFF_OVER = 127, 255
RECOVERED_REC = 119  # what an error passive receiver counts after a good frame: 119 .. 127 by the standard

_ERROR_FLAG, _ERROR_DELIMITER = 6, 8
_SUSPEND = 8
_RECESSIVE, _RECESSIVE_RUNS = 11, 128
_EVER = -(2**62)
_NEVER = 2**62
_OTHERS = -1  # stands for the node of what was heard


class _Waiting(NamedTuple):
    """A frame in a queue; in order of priority, then of sending."""

    priority: int
    order: int
    queued_ns: int
    node: int
    frame: Frame
    bits: int


@dataclass(slots=True)
class _Node:
    held: int = 0
    tec: int = 0
    rec: int = 0
    passive: bool = False


@dataclass(slots=True)
class _Off:
    """How far a node is on its way back: what it must still see, and from when on it looks."""

    from_ns: int
    runs: int = _RECESSIVE_RUNS


class ArbitratedBus(BusModel):
    """A bus of `bitrate` [bit/s]; see `BusModel`.

    `capacity` is how many frames a node holds, the one on the bus included; `note_errors` makes an event of each frame that is
    destroyed, not only a count.  Raises ValueError for a bit rate or a
    capacity under 1, an error rate outside 0 .. 1, or a negative `restart_ns`."""

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
        self.bitrate = bitrate
        self.capacity = capacity
        self.restart_ns = restart_ns
        self.events: list[BusEvent] = []
        self._note_errors = note_errors
        self._traffic: defaultdict[int, Traffic] = defaultdict(Traffic)
        self._nodes: defaultdict[int, _Node] = defaultdict(_Node)
        self._pending: list[_Waiting] = []  # heap
        self._current: _Waiting | None = None
        self._destroyed = False
        self._end_ns = _EVER  # of the current attempt: delivered, or destroyed
        self._free_ns = _EVER  # the bus, after the current attempt
        self._suspended: dict[int, int] = {}  # the error passive node that sent last: when it may start
        self._off: dict[int, _Off] = {}
        self._marked: set[int] = set()  # nodes with an error counter that is not zero
        self._delivered: list[Delivered] = []
        self._began_ns: int | None = None
        self._now_ns = _EVER  # everything earlier is decided
        self._order = self._busy_ns = 0
        self._others = 0  # frames of others that still have to take their time
        self._draws = ErrorDraws(seed, bus_number)
        self._attempts = 0
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
        if self._rate or self._suspended or self._off:
            return self._next_start() + 1  # then it is known who sends, and how long
        return self._next_start() + self._span(self._pending[0].bits - INTERFRAME)

    @property
    def busy_ns(self) -> int:
        return self._busy_ns - max(0, self._free_ns - self._now_ns)

    @property
    def load(self) -> float:
        passed_ns = 0 if self._began_ns is None else self._now_ns - self._began_ns
        return self.busy_ns / passed_ns if passed_ns else 0.0

    def counters(self, node: int) -> tuple[int, int]:
        """The transmit and the receive error counter of a node."""
        known = self._nodes.get(node, _Node())
        return known.tec, known.rec

    def duration_ns(self, frame: Frame) -> int:
        return self._span(frame_bits(frame.can_id, frame.data, frame.remote) - INTERFRAME)

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        bits = frame_bits(frame.can_id, frame.data, frame.remote)
        self._advance(time_ns)
        traffic, sender = self._traffic[frame.can_id], self._nodes[node]
        traffic.sent += 1
        if sender.held == self.capacity:
            traffic.lost += 1
            return False
        sender.held += 1
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
        return node in self._off

    def clear(self, node: int) -> int:
        kept = [waiting for waiting in self._pending if waiting.node != node]
        for waiting in self._pending:
            if waiting.node == node:
                self._traffic[waiting.frame.can_id].lost += 1
        count = len(self._pending) - len(kept)
        self._nodes[node].held -= count
        self._pending = kept
        heapify(self._pending)
        return count

    def bus_off(self, node: int) -> None:
        if node not in self._off:
            self._go_off(self._now_ns, node)

    def _span(self, bits: int) -> int:
        return -(-bits * 1_000_000_000 // self.bitrate)

    def _advance(self, until_ns: int) -> None:
        """Decides what starts before `until_ns`, and finishes what ends by then."""
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
            if self._off:
                self._recover(min(start_ns, until_ns))
            if start_ns >= until_ns:
                break
            self._begin(start_ns)
        self._now_ns = until_ns

    def _next_start(self) -> int:
        """When the next attempt starts if nothing more is sent."""
        if not self._pending:
            return _NEVER
        start_ns = max(self._now_ns, self._free_ns)
        if self._off or self._suspended:
            start_ns = max(start_ns, min(self._ready_ns(waiting.node) for waiting in self._pending))
        return start_ns

    def _ready_ns(self, node: int) -> int:
        """From when on a node may start, if the bus is idle until then."""
        if node in self._off:
            off = self._off[node]
            return self._recessive_from(off) + self._span(off.runs * _RECESSIVE)
        return self._suspended.get(node, _EVER)

    def _recessive_from(self, off: _Off) -> int:
        # acknowledge delimiter, end of frame and interframe space are 11 bits, as are error delimiter and interframe
        return max(off.from_ns, self._free_ns - self._span(_RECESSIVE))

    def _begin(self, start_ns: int) -> None:
        current = self._pop(start_ns)
        self._note_start(start_ns)
        hit = (
            self._draws.hit(self._attempts, self._rate, current.bits)
            if self._rate and current.node != _OTHERS
            else None
        )
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
        """A frame starts: nodes that are off saw the bus idle until now, and nobody is suspended any more."""
        self._suspended.clear()
        for off in self._off.values():
            idle_ns = max(0, start_ns - self._recessive_from(off))
            off.runs -= idle_ns * self.bitrate // (_RECESSIVE * 1_000_000_000)

    def _pop(self, start_ns: int) -> _Waiting:
        """Takes the first in the order of priority of those whose node may start."""
        if not (self._off or self._suspended):
            return heappop(self._pending)
        aside = []
        while self._ready_ns((first := heappop(self._pending)).node) > start_ns:
            aside.append(first)
        for waiting in aside:
            heappush(self._pending, waiting)
        return first

    def _finish(self, current: _Waiting) -> None:
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
            self._nodes[node].held -= 1
            self._delivered.append(Delivered(current.queued_ns, end_ns, node, current.frame))
        self._count(end_ns, node, self._destroyed)
        if node != _OTHERS and self._nodes[node].passive:
            self._suspended[node] = self._free_ns + self._span(_SUSPEND)

    def _count(self, time_ns: int, sender: int, destroyed: bool) -> None:
        """Error counters after an attempt."""
        for node in sorted(self._nodes if destroyed else self._marked):
            if node in self._off:
                continue
            state = self._nodes[node]
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
                self._go_off(time_ns, node)
                continue
            passive = max(state.tec, state.rec) > PASSIVE_OVER
            if passive != state.passive:
                state.passive = passive
                kind = BusEventKind.PASSIVE if passive else BusEventKind.ACTIVE
                self.events.append(BusEvent(time_ns, node, kind))

    def _go_off(self, time_ns: int, node: int) -> None:
        self._off[node] = _Off(time_ns + self.restart_ns)
        self.events.append(BusEvent(time_ns, node, BusEventKind.OFF))

    def _recover(self, until_ns: int) -> None:
        """Takes back what is no longer off by `until_ns`."""
        back = sorted((self._ready_ns(node), node) for node in self._off)
        for time_ns, node in back:
            if time_ns <= until_ns:
                del self._off[node]
                self._nodes[node] = _Node(self._nodes[node].held)
                self._marked.discard(node)
                self.events.append(BusEvent(time_ns, node, BusEventKind.RECOVERED))
