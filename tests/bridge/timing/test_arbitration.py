"""The model of a bus, compared with a slow simulation bit by bit, and with results computed by hand."""

import hashlib
from collections import Counter, deque
from dataclasses import dataclass, field
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Philox

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.arbitration import ArbitratedBus
from echelon.bridge.timing.bus_load import frame_bits, worst_case_bits
from echelon.bridge.timing.bus_model import BusEvent, BusEventKind, BusModel, Delivered
from echelon.bridge.timing.ideal_bus import IdealBus

MEGA = 1_000_000
BIT = 1_000  # ns at 1 Mbit/s


def on_wire(frame: Frame) -> str:
    """Returns a frame as levels from start to end: CRC by long division, stuffing by looking back five bits."""
    bits = f"0{frame.can_id:011b}{frame.remote:b}00{len(frame.data):04b}" + "".join(f"{n:08b}" for n in frame.data)
    remainder = int(bits, 2) << 15
    while remainder.bit_length() > 15:
        remainder ^= 0b1100010110011001 << (remainder.bit_length() - 16)
    bits += f"{remainder:015b}"
    sent = ""
    for bit in bits:
        sent += bit
        if sent[-5:] in ("00000", "11111"):
            sent += "1" if bit == "0" else "0"
    return sent + "1" + "0" + "1" + "1" * 7


def key(seed: int, number: int) -> int:
    return int.from_bytes(hashlib.blake2b(f"{seed}|bus {number}".encode(), digest_size=16).digest(), "little")


@dataclass
class SlowNode:
    capacity: int
    waiting: list[tuple[int, int, Frame]] = field(default_factory=list)  # bit of queueing, order, frame
    counts: bool = False
    tec: int = 0
    rec: int = 0
    passive: bool = False
    off_from: int | None = None
    run: int = 0
    runs: int = 0

    def first(self) -> tuple[int, int, Frame]:
        return min(self.waiting, key=lambda item: (item[2].can_id, item[2].remote, item[1]))


class SlowBus:
    """A bus simulated bit by bit: nodes that see it free start together, and a node stops where its 1 is overwritten by a 0."""

    def __init__(self, seed: int, number: int, capacity: int, restart_bits: int) -> None:
        self.key = key(seed, number)
        self.nodes = {n: SlowNode(capacity) for n in range(4)}
        self.restart_bits = restart_bits
        self.rate = 0.0
        self.bit = 0
        self.quiet = 1_000  # recessive bits so far
        self.levels: deque[int] = deque()
        self.decided_in = 0  # bits until the current attempt is through, or destroyed
        self.current: tuple[int, tuple[int, int, Frame]] | None = None
        self.destroyed = False
        self.last_sender = -1
        self.attempts = self.order = self.busy = 0
        self.delivered: list[Delivered] = []
        self.events: list[BusEvent] = []
        self.lost: Counter[int] = Counter()
        self.again: Counter[int] = Counter()

    def send(self, number: int, frame: Frame) -> bool:
        node = self.nodes[number]
        node.counts = True
        held = len(node.waiting) + (self.current is not None and self.current[0] == number)
        if held == node.capacity:
            self.lost[frame.can_id] += 1
            return False
        self.order += 1
        node.waiting.append((self.bit, self.order, frame))
        return True

    def note(self, node: int, kind: BusEventKind, can_id: int | None = None) -> None:
        self.events.append(BusEvent(self.bit * BIT, node, kind, can_id))

    def off(self, number: int) -> None:
        node = self.nodes[number]
        node.counts = True
        if node.off_from is None:
            node.off_from, node.run, node.runs = self.bit + self.restart_bits, 0, 0
            self.note(number, BusEventKind.OFF)

    def start(self) -> None:
        starters = {}
        for number, node in self.nodes.items():
            needed = 19 if node.passive and number == self.last_sender else 11
            if node.waiting and node.off_from is None and self.quiet >= needed:
                starters[number] = node.first()
        if not starters:
            return
        wires = {number: on_wire(item[2]) for number, item in starters.items()}
        at = 0
        while len(wires) > 1:
            level = min(wire[at] for wire in wires.values())
            wires = {number: wire for number, wire in wires.items() if wire[at] == level}
            at += 1
        ((winner, wire),) = wires.items()
        self.current = winner, starters[winner]
        self.nodes[winner].waiting.remove(starters[winner])
        levels = [int(bit) for bit in wire]
        chance, where, echo, _ = (
            int(word >> 11) / 2**53 for word in Philox(key=self.key, counter=self.attempts).random_raw(4).tolist()
        )
        self.attempts += 1
        self.destroyed = chance < self.rate
        self.decided_in = len(levels)
        if self.destroyed:
            self.decided_in = 1 + int(where * (len(levels) - 1))
            levels = levels[: self.decided_in] + [0] * (6 + int(7 * echo)) + [1] * 8
        self.levels = deque(levels)
        self.busy += len(levels) + 3

    def step(self) -> None:
        """Simulates one bit."""
        if not self.levels:
            self.start()
        level = self.levels.popleft() if self.levels else 1
        self.quiet = self.quiet + 1 if level else 0
        bit, self.bit = self.bit, self.bit + 1
        for number, node in self.nodes.items():
            if node.off_from is None or bit < node.off_from:
                continue
            node.run = node.run + 1 if level else 0
            if node.run == 11:
                node.run, node.runs = 0, node.runs + 1
            if node.runs == 128:
                node.off_from, node.tec, node.rec, node.passive = None, 0, 0, False
                self.note(number, BusEventKind.RECOVERED)
        if self.current is not None:
            self.decided_in -= 1
            if not self.decided_in:
                self.decide(*self.current)

    def decide(self, sender: int, item: tuple[int, int, Frame]) -> None:
        queued, _, frame = item
        self.current = None
        self.last_sender = sender
        if self.destroyed:
            self.nodes[sender].waiting.append(item)
            self.again[frame.can_id] += 1
            self.note(sender, BusEventKind.ERROR, frame.can_id)
        else:
            self.delivered.append(Delivered(queued * BIT, self.bit * BIT, sender, frame))
        for number, node in self.nodes.items():
            if not node.counts or node.off_from is not None:
                continue
            if self.destroyed:
                node.tec += 8 * (number == sender)
                node.rec = min(128, node.rec + (number != sender))
            elif number == sender:
                node.tec -= node.tec > 0
            else:
                node.rec = 119 if node.rec > 127 else node.rec - (node.rec > 0)
            if node.tec >= 256:
                self.off(number)
            elif node.passive != (node.tec >= 128 or node.rec >= 128):
                node.passive = not node.passive
                self.note(number, BusEventKind.PASSIVE if node.passive else BusEventKind.ACTIVE)


identifiers = {node: st.sampled_from([node, 0x100 + node, 0x2A8 + node, 0x7F0 + node]) for node in range(4)}


@st.composite
def frames(draw: st.DrawFn) -> tuple[int, Frame]:
    node = draw(st.integers(0, 3))
    remote = draw(st.booleans())
    return node, Frame(draw(identifiers[node]), b"" if remote else draw(st.binary(max_size=8)), remote)


gaps = st.one_of(st.just(0), st.integers(0, 30), st.integers(0, 400))
Script = list[tuple[int, tuple[int, Frame] | int | float | None]]  # gap; send, bus-off, error rate, or run


def compare(script: Script, capacity: int, restart_bits: int, rest_bits: int) -> SlowBus:
    """Runs a script on both buses; all results must agree."""
    fast = ArbitratedBus(MEGA, 7, 2, capacity=capacity, restart_ns=restart_bits * BIT, note_errors=True)
    slow = SlowBus(7, 2, capacity, restart_bits)
    delivered: list[Delivered] = fast.run(0)
    for gap, action in [*script, (rest_bits, None)]:
        for _ in range(gap):
            slow.step()
        now = slow.bit * BIT
        if isinstance(action, tuple):
            assert fast.send(now, *action) == slow.send(*action)
            continue
        delivered += fast.run(now)
        if isinstance(action, float):
            fast.set_error_rate(action)
            slow.rate = action
        elif action is not None:
            fast.bus_off(action)
            slow.off(action)
        else:
            assert delivered == slow.delivered
            assert fast.events == slow.events
            pending = Counter(item[2].can_id for node in slow.nodes.values() for item in node.waiting)
            if slow.current is not None:
                pending[slow.current[1][2].can_id] += 1
            assert {can_id: traffic.pending for can_id, traffic in fast.traffic.items() if traffic.pending} == pending
            for number, node in slow.nodes.items():
                if node.off_from is None:
                    assert fast.counters(number) == (node.tec, node.rec)
    for can_id, traffic in fast.traffic.items():
        latencies = [end_ns - queued_ns for queued_ns, end_ns, _, frame in delivered if frame.can_id == can_id]
        assert traffic.delivered == len(latencies)
        assert traffic.latency_max_ns == max(latencies, default=0)
        assert traffic.latency_mean_ns == (sum(latencies) / len(latencies) if latencies else 0.0)
        assert (traffic.lost, traffic.retransmitted) == (slow.lost[can_id], slow.again[can_id])
        assert traffic.sent == traffic.delivered + traffic.lost + traffic.pending
    if not slow.levels and slow.quiet >= 11:
        assert fast.busy_ns == slow.busy * BIT
        assert fast.load == (slow.busy / slow.bit if slow.bit else 0.0)
    return slow


@given(st.lists(st.tuples(gaps, st.one_of(frames(), frames(), st.none())), max_size=40), st.integers(1, 5))
def test_arbitration_bit_by_bit(script: Script, capacity: int) -> None:
    compare(script, capacity, 0, 500)


@pytest.mark.slow
@settings(max_examples=300)
@given(
    st.lists(
        st.tuples(gaps, st.one_of(frames(), frames(), frames(), st.none(), st.floats(0, 1), st.integers(0, 3))),
        max_size=40,
    ),
    st.integers(1, 5),
    st.sampled_from([0, 5, 700]),
    st.sampled_from([0.0, 0.3, 0.9, 1.0]),
    st.sampled_from([0, 2500]),
)
def test_errors_bit_by_bit(script: Script, capacity: int, restart_bits: int, rate: float, rest_bits: int) -> None:
    compare([(0, rate), *script, (rest_bits, None)], capacity, restart_bits, 1000)


@pytest.mark.slow
def test_errors_of_all_kinds_bit_by_bit() -> None:
    kinds: Counter[BusEventKind] = Counter()
    lost = 0
    for seed in range(24):
        random = Random(seed)
        script: Script = [(0, (node, Frame(node))) for node in range(random.randint(1, 4))]
        for rate in (0.0, random.choice([0.7, 0.9, 1.0]), random.choice([0.0, 0.5]), 0.95, 0.0):
            script.append((0, rate))
            for _ in range(60):
                node = random.randrange(4)
                frame = Frame(random.choice([node, 0x400 + node]), random.randbytes(random.randint(0, 8)))
                script.append((random.choice([0, 30, 100, 300]), (node, frame)))
                if random.random() < 0.02:
                    script.append((random.randint(0, 100), random.randrange(4)))
        slow = compare(script, random.choice([1, 3, 20]), random.choice([0, 100]), 15_000)
        kinds.update(event.kind for event in slow.events)
        lost += sum(slow.lost.values())
    assert set(kinds) == set(BusEventKind)
    assert lost > 100


A, B, C = Frame(0x100, bytes(8)), Frame(0x200, b"\xaa"), Frame(0x300)


def bits(frame: Frame) -> int:
    return frame_bits(frame.can_id, frame.data, frame.remote)


def test_by_hand() -> None:
    bus = ArbitratedBus(500_000)
    assert (bus.due_ns, bus.busy_ns, bus.load) == (None, 0, 0.0)
    bus.run(-5_000)
    assert bus.load == 0.0
    assert bus.send(-5_000, 3, C)
    assert bus.due_ns == -5_000 + (bits(C) - 3) * 2_000
    assert bus.send(-5_000, 1, B)  # at the same instant, and more important
    assert bus.send(-4_999, 2, A)  # too late: B has started
    ends = [
        -5_000 + 2_000 * (bits(B) - 3),
        -5_000 + 2_000 * (bits(B) + bits(A) - 3),
        -5_000 + 2_000 * (bits(B) + bits(A) + bits(C) - 3),
    ]
    assert bus.run(ends[0] - 1) == []
    assert bus.due_ns == ends[0]
    assert bus.busy_ns == ends[0] - 1 + 5_000  # so far
    assert bus.run(ends[0]) == [Delivered(-5_000, ends[0], 1, B)]
    assert bus.run(ends[2]) == [Delivered(-4_999, ends[1], 2, A), Delivered(-5_000, ends[2], 3, C)]
    assert bus.run(ends[2] + 6_000) == []
    assert bus.busy_ns == 2_000 * (bits(A) + bits(B) + bits(C))
    assert bus.load == 1.0
    bus.run(ends[2] + 6_000 + bus.busy_ns)
    assert bus.load == 0.5
    latency = bus.traffic[0x300]
    assert (latency.delivered, latency.latency_max_ns, latency.latency_mean_ns) == (1, ends[2] + 5_000, ends[2] + 5_000)


def test_data_comes_before_remote() -> None:
    bus = ArbitratedBus(MEGA)
    bus.send(0, 1, Frame(5, remote=True))
    bus.send(0, 2, Frame(5, b"x"))
    assert [sent.frame.remote for sent in bus.run(MEGA)] == [False, True]


def test_three_bits_between_frames_are_time_enough_to_answer() -> None:
    bus = ArbitratedBus(MEGA)
    bus.send(0, 1, A)
    bus.send(0, 1, C)
    (first,) = bus.run(bits(A) * BIT - 3 * BIT)
    bus.send(first.end_ns + 3 * BIT, 2, B)  # just as the bus is free
    assert [sent.frame for sent in bus.run(MEGA)] == [B, C]


def test_a_full_queue_loses_and_one_that_empties_takes_again() -> None:
    bus = ArbitratedBus(MEGA, capacity=2)
    assert [bus.send(0, 1, A), bus.send(0, 1, B), bus.send(0, 1, C), bus.send(0, 2, C)] == [True, True, False, True]
    end_ns = (bits(A) - 3) * BIT
    assert not bus.send(end_ns - 1, 1, C)
    assert bus.send(end_ns, 1, C)
    assert (bus.traffic[0x300].lost, bus.traffic[0x300].pending) == (2, 2)


@given(st.integers(1, 2_000_000), frames())
def test_a_frame_takes_its_bits_at_any_bit_rate(bitrate: int, sent: tuple[int, Frame]) -> None:
    node, frame = sent
    bus = ArbitratedBus(bitrate)
    bus.send(11, node, frame)
    due_ns = bus.due_ns
    assert due_ns is not None
    assert 0 <= (due_ns - 11) * bitrate - (bits(frame) - 3) * 10**9 < bitrate
    assert due_ns - 11 == bus.duration_ns(frame)
    assert bus.run(due_ns - 1) == []
    assert bus.run(due_ns) == [Delivered(11, due_ns, node, frame)]


def run_to(bus: BusModel, due_ns: int) -> list[Delivered]:
    delivered = bus.run(due_ns)
    assert all(sent.end_ns == due_ns for sent in delivered)
    return delivered


def play(bus: BusModel, script: list[tuple[int, tuple[int, Frame]]], step: bool) -> list[Delivered]:
    """Sends the frames of a script; runs the bus from send to send, or, with `step`, from one `due_ns` to the next."""
    delivered, now = [], 0
    for gap, (node, frame) in script:
        now += gap * BIT + gap % 7
        while step and bus.due_ns is not None and bus.due_ns <= now:
            delivered += run_to(bus, bus.due_ns)
        bus.send(now, node, frame)
    while step and bus.due_ns is not None:
        delivered += run_to(bus, bus.due_ns)
    return delivered + bus.run(now + 10**9)


@given(st.lists(st.tuples(gaps, frames()), max_size=30), st.sampled_from([0.0, 0.5]))
def test_from_one_due_instant_to_the_next_is_the_same(script: list[tuple[int, tuple[int, Frame]]], rate: float) -> None:
    once = play(ArbitratedBus(MEGA, 1, error_rate=rate), script, step=False)
    assert play(ArbitratedBus(MEGA, 1, error_rate=rate), script, step=True) == once
    assert len(once) == len(script)


def test_a_bus_that_is_only_waiting_for_a_node_to_come_back_is_due_by_then() -> None:
    bus = ArbitratedBus(MEGA, restart_ns=5_000)
    bus.run(100)
    bus.bus_off(1)
    bus.bus_off(1)
    assert bus.due_ns is None
    bus.send(100, 1, C)
    steps: list[int] = []
    while bus.due_ns is not None:
        steps.append(bus.due_ns)
        bus.run(steps[-1])
    back_ns = 100 + 5_000 + 128 * 11 * BIT
    assert steps == [back_ns + 1, back_ns + (bits(C) - 3) * BIT]
    assert bus.events == [BusEvent(100, 1, BusEventKind.OFF), BusEvent(back_ns, 1, BusEventKind.RECOVERED)]


def test_errors_are_a_function_of_seed_bus_and_attempt() -> None:
    def errors(seed: int, number: int) -> list[int]:
        bus = ArbitratedBus(MEGA, seed, number, error_rate=0.2, note_errors=True)
        for n in range(900):
            bus.send(n * 1_000_000, 1, Frame(n))
        bus.run(10**12)
        return [event.can_id or 0 for event in bus.events if event.kind is BusEventKind.ERROR]

    def drawn(seed: int, number: int) -> list[int]:
        chances = Philox(key=key(seed, number)).random_raw(4 * 2000)[::4].tolist()
        found = []
        for n in range(900):
            while chances.pop(0) < 0.2 * 2**64:
                found.append(n)
        return found

    cases = [(1, 0), (1, 1), (2, 0)]
    assert [errors(*case) for case in cases] == [drawn(*case) for case in cases]
    assert len({tuple(drawn(*case)) for case in cases}) == 3


@pytest.mark.parametrize(("errors", "after"), [(1, 0), (126, 125), (127, 126), (128, 119), (135, 119)])
def test_a_receiver_counts_errors_of_others(errors: int, after: int) -> None:
    bus = ArbitratedBus(MEGA)
    for node in range(4):
        bus.send(0, node, Frame(node))
    bus.run(MEGA)
    bus.set_error_rate(1.0)
    for node in (1, 2, 3):
        bus.send(MEGA, node, Frame(node))
    while sum(traffic.retransmitted for traffic in bus.traffic.values()) < errors:
        assert bus.due_ns is not None
        bus.run(bus.due_ns)
    assert bus.counters(0) == (0, min(errors, 128))
    bus.set_error_rate(0.0)
    while not bus.run(bus.due_ns or 0):
        pass
    assert bus.counters(0) == (0, after)
    kinds = [event.kind for event in bus.events if event.node == 0]
    assert kinds == ([BusEventKind.PASSIVE, BusEventKind.ACTIVE] if errors >= 128 else [])


def test_an_error_costs_between_17_and_23_bits_besides_what_was_sent() -> None:
    costs = set()
    for seed in range(200):
        bus = ArbitratedBus(MEGA, seed, error_rate=1.0, note_errors=True)
        bus.send(0, 1, A)
        due_ns = bus.due_ns
        assert due_ns == 1
        bus.run(due_ns)
        hit_ns = bus.due_ns
        assert hit_ns is not None
        assert BIT <= hit_ns <= (bits(A) - 4) * BIT
        bus.set_error_rate(0.0)
        ((_, end_ns, _, _),) = bus.run(10**9)
        costs.add((end_ns - hit_ns) // BIT - (bits(A) - 3))
        assert bus.traffic[0x100].retransmitted == 1
    assert costs == set(range(17, 24))


@given(st.lists(frames(), min_size=1, max_size=30))
def test_nothing_waits_longer_than_all_that_was_sent_takes(sent: list[tuple[int, Frame]]) -> None:
    bus = ArbitratedBus(MEGA)
    for node, frame in sent:
        bus.send(0, node, frame)
    bound = sum(worst_case_bits(len(frame.data)) for _, frame in sent) - 3
    assert max(end_ns for _, end_ns, _, _ in bus.run(10**9)) <= bound * BIT


@pytest.mark.parametrize("bus", [ArbitratedBus(MEGA), IdealBus()])
def test_time_goes_on_and_frames_are_frames(bus: BusModel) -> None:
    bus.run(-10)
    with pytest.raises(ValueError, match="before -10 ns, not -11"):
        bus.send(-11, 0, A)
    with pytest.raises(ValueError, match="before -10 ns, not -11"):
        bus.run(-11)
    for bad in (Frame(0x800), Frame(-1), Frame(1, bytes(9)), Frame(1, b"x", remote=True)):
        with pytest.raises(ValueError, match=r"must have|has"):
            bus.send(0, 0, bad)
        with pytest.raises(ValueError, match=r"must have|has"):
            bus.duration_ns(bad)
    assert bus.send(-10, 0, A)
    assert bus.traffic[0x100].sent == 1


def test_what_makes_no_bus() -> None:
    with pytest.raises(ValueError, match="bit rate must be at least 1, not 0"):
        ArbitratedBus(0)
    with pytest.raises(ValueError, match="capacity must be at least 1, not 0"):
        ArbitratedBus(MEGA, capacity=0)
    with pytest.raises(ValueError, match="restart_ns must be at least 0, not -1"):
        ArbitratedBus(MEGA, restart_ns=-1)
    for rate in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"error rate must be 0 \.\. 1"):
            ArbitratedBus(MEGA, error_rate=rate)


def test_ideal_bus() -> None:
    bus = IdealBus()
    for at, node, frame in ((-7, 1, C), (-7, 2, A), (0, 1, B)):
        assert bus.send(at, node, frame)
        assert bus.due_ns == -7
    assert (bus.duration_ns(A), bus.traffic[0x300].pending) == (0, 1)
    assert bus.run(0) == [Delivered(-7, -7, 1, C), Delivered(-7, -7, 2, A), Delivered(0, 0, 1, B)]
    assert bus.run(5) == []
    assert [(n.sent, n.delivered, n.lost, n.latency_mean_ns) for n in bus.traffic.values()] == [(1, 1, 0, 0)] * 3
    assert (bus.busy_ns, bus.load, bus.events) == (0, 0.0, [])
    bus.set_error_rate(0.0)
    with pytest.raises(ValueError, match=r"0, not 0\.5"):
        bus.set_error_rate(0.5)
    with pytest.raises(ValueError, match="node 3"):
        bus.bus_off(3)
