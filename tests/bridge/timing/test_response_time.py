"""Worst-case response times: the example of the paper, and simulated buses, which must never be slower."""

from collections import Counter
from dataclasses import replace
from fractions import Fraction
from itertools import product

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.arbitration import ArbitratedBus
from echelon.bridge.timing.bus_load import frame_bits, worst_case_bits
from echelon.bridge.timing.response_time import BITRATES, Stream, advice, fits, load, remedies, response_times

MS = 1_000_000
MEGA = 1_000_000
BIT = 1_000  # ns at 1 Mbit/s


def test_the_example_of_the_paper() -> None:
    # Davis, Burns, Bril, Lukkien 2007, section 3.1: 125 bits at 125 kbit/s; the second instance of the third is worst
    streams = [Stream(n, period, 125) for n, period in ((1, 2_500_000), (2, 3_500_000), (3, 3_500_000))]
    interframe = 3 * 8_000
    responses = response_times(streams[::-1], 125_000)
    assert responses == {1: 2 * MS - interframe, 2: 3 * MS - interframe, 3: 3_500_000 - interframe}
    assert load(streams, 125_000) == Fraction(34, 35)
    assert fits(streams, 125_000)
    late = [*streams[:2], replace(streams[2], period_ns=3_475_999)]
    assert response_times(late, 125_000)[3] is None
    assert not fits(late, 125_000)


def test_one_stream_alone() -> None:
    assert response_times([Stream(5, MS, 100)], MEGA) == {5: 97_000}
    assert response_times([Stream(5, MS, 100, 900_000)], MEGA) == {5: 997_000}
    assert response_times([Stream(5, MS, 100, 903_001)], MEGA) == {5: None}
    assert response_times([Stream(5, 100_000, 100)], MEGA) == {5: None}  # a full bus
    assert response_times([], MEGA) == {}


def test_what_goes_first_does_not_suffer_from_overload() -> None:
    streams = [Stream(1, MS, 500), Stream(2, MS, 400), Stream(3, MS, 200)]
    assert response_times(streams, MEGA) == {1: 897_000, 2: None, 3: None}
    assert load(streams, MEGA) == Fraction(11, 10)


Case = list[tuple[Frame, int, int]]  # frame, period and jitter in bits


@st.composite
def cases(draw: st.DrawFn, jitter: bool) -> Case:
    identifiers = draw(st.lists(st.integers(0, 0x7FF), min_size=1, max_size=5, unique=True))
    return [
        (
            Frame(can_id, draw(st.binary(max_size=8))),
            draw(st.integers(150, 1500)),
            draw(st.integers(0, 300)) if jitter else 0,
        )
        for can_id in sorted(identifiers)
    ]


def bits(frame: Frame) -> int:
    return frame_bits(frame.can_id, frame.data)


def streams_of(case: Case) -> list[Stream]:
    return [Stream(frame.can_id, period * BIT, bits(frame), jitter * BIT) for frame, period, jitter in case]


def measured(releases: list[tuple[int, int, Frame]]) -> dict[int, int]:
    """Returns the longest response of each identifier, for releases (due, queued, frame) with times in bits."""
    bus = ArbitratedBus(MEGA, capacity=10_000)
    due: dict[tuple[int, int], list[int]] = {}
    for wanted, queued, frame in sorted(releases, key=lambda release: release[1]):
        due.setdefault((frame.can_id, queued * BIT), []).append(wanted * BIT)
        bus.send(queued * BIT, frame.can_id, frame)
    worst: Counter[int] = Counter()
    for queued_ns, end_ns, node, _ in bus.run(10**10):
        worst[node] = max(worst[node], end_ns - due[node, queued_ns].pop(0))
    return worst


@pytest.mark.slow
@settings(max_examples=300)
@given(cases(jitter=True), st.data())
def test_nothing_measured_exceeds_the_bound(case: Case, data: st.DataObject) -> None:
    bounds = response_times(streams_of(case), MEGA)
    releases = []
    for frame, period, jitter in case:
        offset = data.draw(st.integers(0, 1500))
        for n in range(12_000 // period):
            delay = data.draw(st.sampled_from([0, jitter, jitter // 2])) if jitter else 0
            releases.append((offset + n * period, offset + n * period + delay, frame))
    worst = measured(releases)
    for can_id, bound in bounds.items():
        assert bound is None or worst[can_id] <= bound


@pytest.mark.slow
@settings(max_examples=300)
@given(cases(jitter=False), st.integers(0, 4))
def test_the_bound_is_reached(case: Case, at: int) -> None:
    """All frames of higher priority are queued with the frame, just after the longest of lower priority has started."""
    assume(at < len(case))
    own, lower = case[at][0].can_id, case[at + 1 :]
    # a frame that starts a bit earlier blocks for a bit less
    streams = [replace(stream, bits=stream.bits - (stream.can_id > own)) for stream in streams_of(case)]
    bound = response_times(streams, MEGA)[own]
    assume(bound is not None)
    releases = [(n * period, n * period, frame) for frame, period, _ in case[: at + 1] for n in range(40_000 // period)]
    if lower:
        longest = max((frame for frame, _, _ in lower), key=bits)
        releases.append((-1, -1, longest))
    assert measured(releases)[own] == bound
    whole = response_times(streams_of(case), MEGA)[own]
    assert bound is not None
    assert whole is None or whole >= bound


def test_no_offsets_of_three_streams_exceed_the_bound_and_some_reach_it() -> None:
    case: Case = [(Frame(1), 150, 0), (Frame(2, b"\x55"), 190, 0), (Frame(3, b"\x55\x55"), 300, 0)]
    bounds = response_times(streams_of(case), MEGA)
    worst: Counter[int] = Counter()
    for offsets in product(range(0, 150, 3), range(0, 190, 5), [0]):
        releases = [
            (offset + n * period, offset + n * period, frame)
            for offset, (frame, period, _) in zip(offsets, case, strict=True)
            for n in range(10)
        ]
        for can_id, response in measured(releases).items():
            worst[can_id] = max(worst[can_id], response)
    for can_id, bound in bounds.items():
        assert bound is not None
        assert bound - 8 * BIT <= worst[can_id] <= bound


def robots_of(number: int, period_ns: int = MS, slow: bool = True) -> dict[str, list[Stream]]:
    """Returns robots, each with a command, a feedback and a slow stream."""
    return {
        f"r{k}": [
            Stream(0x100 + k, period_ns),
            Stream(0x200 + k, period_ns, worst_case_bits(6)),
            *([Stream(0x600 + k, 100 * MS, worst_case_bits(1))] if slow else []),
        ]
        for k in range(number)
    }


SYNC = Stream(0x80, MS, worst_case_bits(0))


@pytest.mark.parametrize("shared", [[], [SYNC]])
@pytest.mark.parametrize(("number", "bitrate"), [(2, 125_000), (4, 250_000), (7, 500_000), (9, 1_000_000), (27, MEGA)])
def test_remedies_help_and_a_little_less_does_not(number: int, bitrate: int, shared: list[Stream]) -> None:
    robots = robots_of(number)
    every = [stream for group in robots.values() for stream in group] + shared
    assert not fits(every, bitrate)
    ways = remedies(robots, bitrate, shared)

    def bus_fits(names: tuple[str, ...]) -> bool:
        return fits([stream for name in names for stream in robots[name]] + shared, bitrate)

    if ways.buses is None:
        assert not bus_fits(("r0",))
    else:
        assert [name for bus in ways.buses for name in bus] == list(robots)
        assert all(bus_fits(bus) for bus in ways.buses)
        # robots differ in their identifiers only: with one bus less, some bus has at least this many robots
        least = -(-number // (len(ways.buses) - 1))
        names = list(robots)
        assert not any(bus_fits(tuple(names[n : n + least])) for n in range(number - least + 1))
        assert max(map(len, ways.buses)) - min(map(len, ways.buses)) <= 1

    def stretched(times: int) -> list[Stream]:
        return [replace(stream, period_ns=times * MS) if stream.period_ns == MS else stream for stream in every]

    assert ways.stretch is not None
    assert fits(stretched(ways.stretch), bitrate)
    assert not fits(stretched(ways.stretch - 1), bitrate)
    if ways.bitrate is None:
        assert not any(fits(every, rate) for rate in BITRATES if rate >= bitrate)
    else:
        assert fits(every, ways.bitrate)
        assert not any(fits(every, rate) for rate in BITRATES if bitrate <= rate < ways.bitrate)


def test_advice_in_words() -> None:
    assert advice(robots_of(3), MEGA) == []
    assert advice(robots_of(3), 500_000) == [
        "fits over 3 buses of 500 kbit/s: r0; r1; r2",
        "fits with longer periods: 2 ms instead of 1 ms",
        "fits at 1 Mbit/s",
    ]
    assert advice({**robots_of(6, 2 * MS, slow=False), "fast": [Stream(0, MS // 2)]}, MEGA) == [
        "fits over 2 buses of 1 Mbit/s: r0 … r2; r3 … fast",
        "fits with longer periods: 1 ms instead of 0.5 ms, 4 ms instead of 2 ms",
    ]
    alone = {"loud": [Stream(1, 100_000), Stream(2, 10**12, 200_000, 10**12)]}
    assert advice(alone, MEGA) == ["fits neither over several buses, nor with longer periods, nor at 1 Mbit/s"]


@given(st.lists(st.integers(1, 8), min_size=1, max_size=6))
def test_unequal_robots_keep_their_order_on_the_fewest_buses(sizes: list[int]) -> None:
    robots = {str(k): [Stream(0x10 * k + n, 2 * MS) for n in range(size)] for k, size in enumerate(sizes)}
    ways = remedies(robots, MEGA)
    assert ways.buses is not None
    assert [name for bus in ways.buses for name in bus] == list(robots)
    names = list(robots)

    def bus_fits(begin: int, end: int) -> bool:
        return fits([stream for name in names[begin:end] for stream in robots[name]], MEGA)

    fewest = [0]  # buses for the first n robots, by dynamic programming
    for end in range(1, len(names) + 1):
        fewest.append(1 + min(fewest[begin] for begin in range(end) if bus_fits(begin, end)))
    assert len(ways.buses) == fewest[-1]


def test_refused() -> None:
    for name, bad in (("can_id", -1), ("period_ns", 0), ("bits", 3), ("jitter_ns", -1)):
        with pytest.raises(ValueError, match=f"{name} must be at least .*, not {bad}"):
            replace(Stream(1, 1), **{name: bad})
    with pytest.raises(ValueError, match="0x7 has more"):
        response_times([Stream(7, MS), Stream(5, MS), Stream(7, 2 * MS)], MEGA)
