"""Paced buses on a wall clock: several models that hear each other are together only as fast as one real bus."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.stations.paced_bus import PacedBus
from echelon.bridge.timing.arbitration import ArbitratedBus
from echelon.bridge.timing.bus_load import frame_bits, worst_case_bits
from echelon.bridge.timing.bus_model import BusEventKind
from echelon.bridge.timing.ideal_bus import IdealBus

BIT = 2_000  # ns at 500 kbit/s
LONGEST = worst_case_bits(8) * BIT
OLD = 100_000_000


class Port:
    """Stands for the bus: keeps the frames that go out."""

    def __init__(self, takes: bool = True) -> None:
        self.sent: list[Frame] = []
        self.takes = takes

    def send(self, can_id: int, data: bytes, time_ns: int = 0, remote: bool = False) -> bool:
        self.sent.append(Frame(can_id, data, remote))
        return self.takes


def paced(**options: Any) -> PacedBus:
    return PacedBus(Port(), ArbitratedBus(500_000, **options), OLD)  # type: ignore[arg-type]


def bits(frame: Frame) -> int:
    return frame_bits(*frame)


def play(
    script: Sequence[tuple[int, int, Frame]], models: Sequence[PacedBus], late_ns: int
) -> list[tuple[int, int, Frame]]:
    """Sends (time, model, frame) by models that hear each other `late_ns` late; returns when each frame went out."""
    todo, heard, out = sorted(script, key=lambda item: item[0]), [], []
    while True:
        times = [due for model in models if (due := model.due_ns) is not None]
        times += [item[0] for item in todo[:1]] + [item[0] for item in heard[:1]]
        if not times:
            return out
        now = min(times)
        while heard and heard[0][0] <= now:
            at, number, frame = heard.pop(0)
            models[number].hear(now, frame, at - late_ns)
        while todo and todo[0][0] <= now:
            at, number, frame = todo.pop(0)
            assert models[number].send(at, 0, frame)
        for number, model in enumerate(models):
            for sent in model.run(now):
                out.append((now, number, sent.frame))
                heard += [(now + late_ns, other, sent.frame) for other in range(len(models)) if other != number]
        heard.sort(key=lambda item: item[0])


@st.composite
def frames(draw: st.DrawFn) -> tuple[int, int, Frame]:
    """Draws when a frame is sent, by which of three models, and the frame: no identifier has two senders."""
    model = draw(st.integers(0, 2))
    can_id = 3 * draw(st.integers(0, 0x7FF // 3 - 1)) + model
    return draw(st.integers(0, 20 * LONGEST)), model, Frame(can_id, draw(st.binary(max_size=8)), False)


scripts = st.lists(frames(), min_size=1, max_size=60)


@settings(max_examples=200)
@given(scripts, st.integers(0, LONGEST // 2))
def test_together_they_send_no_more_than_the_bit_rate_allows(
    script: list[tuple[int, int, Frame]], late_ns: int
) -> None:
    models = [paced() for _ in range(3)]
    out = play(script, models, late_ns)
    assert sorted(frame for _, _, frame in out) == sorted(frame for _, _, frame in script)  # once each
    for number, model in enumerate(models):
        assert [frame for _, of, frame in out if of == number] == model.bus.sent  # type: ignore[attr-defined]
    # Frames that begin before the models hear of each other may overlap, one of each model; later frames wait for all of them.
    # Besides, two others may have begun before the first frame was over.
    for first in range(len(out)):
        taken_ns = 0
        for time_ns, _, frame in out[first + 1 :]:
            taken_ns += bits(frame) * BIT
            over_ns = taken_ns - 3 * BIT  # the last one's interframe space comes after its end
            assert over_ns <= time_ns - out[first][0] + (3 + 2) * (LONGEST + late_ns)


def test_alone_it_is_the_model_that_it_has() -> None:
    one, model = paced(), ArbitratedBus(500_000)
    script = [(7_000 * at, 0, Frame(0x100 + at * 37 % 11, bytes(at % 9))) for at in range(50)]
    out = play(script, [one], 0)
    for at, node, frame in script:
        model.send(at, node, frame)
    assert [(at, frame) for at, _, frame in out] == [(sent.end_ns, sent.frame) for sent in model.run(1_000_000_000)]


def test_an_idle_bus_was_taken_before_a_frame_was_heard() -> None:
    """So the next frame waits for three bits only, not for the length of the heard frame."""
    one, theirs, mine = paced(), Frame(0x200, bytes(8)), Frame(0x300, b"\x01")
    one.hear(1_000_000, theirs, 1_000_000)
    one.send(1_000_000, 0, mine)
    assert play([], [one], 0) == [(1_000_000 + 3 * BIT + (bits(mine) - 3) * BIT, 0, mine)]
    assert one.model.busy_ns == (bits(theirs) + bits(mine) - 3) * BIT


def test_the_lower_identifier_goes_first() -> None:
    """A node that floods the bus with urgent frames keeps it; the others get the rest and lose nothing."""
    urgent, other = paced(), paced()
    script = [(at, 0, Frame(0x080, bytes([at % 256] * 8))) for at in range(40)]
    script += [(at, 1, Frame(0x700, bytes([at % 256] * 8))) for at in range(5)]
    out = play(script, [urgent, other], 0)
    order = [number for _, number, _ in out]
    assert sorted(order[:2]) == [0, 1]  # neither had heard of the other
    assert order[2:] == [0] * 39 + [1] * 4
    gaps = [after - before for before, after in pairwise(at for at, number, _ in out if number == 0)]
    assert max(gaps) <= LONGEST  # the urgent ones are held up by none


def test_a_flood_from_others_is_forgotten_beyond_a_queue_full() -> None:
    one = paced(capacity=10)
    for _ in range(1000):
        one.hear(0, Frame(0x001), 0)
    assert one.send(0, 0, Frame(0x500))
    (out,) = play([], [one], 0)
    assert out[0] <= 12 * LONGEST
    assert not one.model.traffic[0x500].lost


def test_what_finds_no_room_is_lost_and_counted() -> None:
    one = paced(capacity=4)
    taken = [one.send(0, 0, Frame(0x100)) for _ in range(10)]
    assert taken == [True] * 4 + [False] * 6
    assert len(play([], [one], 0)) == 4
    assert one.model.traffic[0x100].lost == 6


def test_a_controller_that_is_off_takes_nothing_and_comes_back_while_others_talk() -> None:
    one = paced()
    one.run(0)
    one.model.bus_off(0)
    assert not one.send(0, 0, Frame(0x100))
    assert one.model.traffic[0x100].lost == 1
    back_ns = None
    for at in range(1, 3000):  # between any two frames there are 20 recessive bits and more: one run of 11 each
        now = at * LONGEST
        one.hear(now, Frame(0x200, bytes(2)), now)
        one.run(now)
        if not one.model.is_off(0):
            back_ns = now
            break
    assert back_ns is not None
    assert [event.kind for event in one.model.events] == [BusEventKind.OFF, BusEventKind.RECOVERED]
    idle_bits = LONGEST // BIT - bits(Frame(0x200, bytes(2))) + 11  # with the end of each frame
    assert abs(back_ns / LONGEST - 128 / (idle_bits // 11)) <= 2
    assert one.send(back_ns, 0, Frame(0x100))
    assert len(play([], [one], 0)) == 1


def test_what_waited_when_a_controller_went_off_is_lost() -> None:
    """Frames that waited would be old when the controller is back, even if nothing is sent meanwhile."""
    one = paced(restart_ns=OLD)
    for _ in range(5):
        one.send(0, 0, Frame(0x100))
    one.run(10)
    one.model.bus_off(0)
    assert len(play([], [one], 0)) == 1  # the one on the bus
    one.run(2 * OLD)
    assert not one.model.is_off(0)
    assert one.model.traffic[0x100].lost == 4


def test_frames_heard_in_a_bunch_took_the_bus_when_they_were_sent() -> None:
    one, theirs, mine = paced(), Frame(0x200, bytes(8)), Frame(0x300, b"\x01")
    for at in range(1, 11):
        one.hear(3_000_000, theirs, at * LONGEST)
    one.send(3_000_000, 0, mine)
    assert play([], [one], 0) == [(3_000_000 + (bits(mine) - 3) * BIT, 0, mine)]
    assert one.model.busy_ns == (10 * bits(theirs) + bits(mine) - 3) * BIT


def test_after_a_standstill_what_is_old_is_not_sent() -> None:
    one = paced()
    for _ in range(3):
        one.send(0, 0, Frame(0x100))
    one.send(2 * OLD, 0, Frame(0x101))
    assert [sent.frame.can_id for sent in one.run(2 * OLD + LONGEST)] == [0x101]
    row = one.model.traffic[0x100]
    assert (row.sent, row.delivered, row.lost, row.pending) == (3, 0, 3, 0)


def test_good_frames_of_others_take_errors_back() -> None:
    one = paced(error_rate=1.0)
    one.send(0, 0, Frame(0x100))
    one.send(0, 1, Frame(0x200))
    one.run(3 * LONGEST)
    one.model.set_error_rate(0.0)
    before = one.model.counters(1)[1]
    assert before > 1
    play([], [one], 0)
    after = one.model.counters(1)[1]
    one.hear(100 * LONGEST, Frame(0x300), 100 * LONGEST)
    assert one.model.counters(1)[1] == after - 1


def test_what_the_bus_did_not_take_was_not_sent() -> None:
    one = PacedBus(Port(takes=False), ArbitratedBus(500_000), OLD)  # type: ignore[arg-type]
    one.send(0, 0, Frame(0x100))
    assert one.run(LONGEST) == []


def test_an_ideal_bus_takes_frames_at_once() -> None:
    one = PacedBus(Port(), IdealBus(), OLD)  # type: ignore[arg-type]
    one.hear(5, Frame(0x200), 5)
    one.send(5, 3, Frame(0x100))
    assert one.due_ns == 5
    assert [sent.node for sent in one.run(5)] == [3]
    assert one.due_ns is None
