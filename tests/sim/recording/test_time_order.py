"""Messages of many sources are released in one order of time, whatever the order of arrival of their batches."""

from __future__ import annotations

import random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from echelon.messages import Channel, Message
from echelon.sim.recording.time_order import TimeOrder


def message(source: int, time_ns: int, channel: Channel = Channel.STATE) -> Message:
    """Returns a message with source, time and channel only."""
    return Message(channel, source, time_ns, time_ns, np.empty(0))


def keys(messages: list[Message]) -> list[tuple[int, int, int]]:
    """Returns the keys of the order of messages."""
    return [(each.time_ns, each.source, each.channel) for each in messages]


sources = st.lists(
    st.tuples(st.sampled_from([1, 2, 5]), st.sets(st.sampled_from([Channel.STATE, Channel.COMMAND]), min_size=1)),
    min_size=1,
    max_size=4,
)
"""Period and channels of each source"""


@given(sources, st.integers(0, 12), st.randoms(use_true_random=False), st.integers(1, 7))
def test_order_does_not_depend_on_batches(
    sources: list[tuple[int, set[Channel]]], duration: int, choose: random.Random, longest: int
) -> None:
    streams = [
        [message(source, time_ns, channel) for time_ns in range(0, duration + 1, period) for channel in channels]
        for source, (period, channels) in enumerate(sources)
    ]
    everything = sorted((each for stream in streams for each in stream), key=lambda m: (m.time_ns, m.source, m.channel))
    order = TimeOrder(range(len(sources)))
    released: list[Message] = []
    left = [list(stream) for stream in streams]
    while any(left):
        batch: list[Message] = []
        for _ in range(choose.randint(1, longest)):
            if any(left):
                batch.append(choose.choice([stream for stream in left if stream]).pop(0))
        released += order.push(batch)
        # the released messages are the beginning of the whole order, and no source can send a message within it any more
        assert keys(released) == keys(everything[: len(released)])
        if released:
            assert all(stream[0].time_ns > released[-1].time_ns for stream in left if stream)
    assert order.pushed == len(everything)
    assert keys(released + order.rest()) == keys(everything)
    assert (order.refused, order.rest()) == (0, [])


def test_nothing_passes_a_source_that_may_still_speak() -> None:
    order = TimeOrder([0, 1])
    assert order.push([message(0, time_ns) for time_ns in range(6)]) == []
    assert keys(order.push([message(1, 0), message(1, 1)])) == [(0, 0, 1), (0, 1, 1)]


def test_strangers_and_latecomers_are_refused() -> None:
    order = TimeOrder([0, 1])
    assert order.push([message(7, 0)]) == []
    order.push([message(0, time_ns) for time_ns in range(4)])
    assert len(order.push([message(1, time_ns) for time_ns in range(4)])) == 6
    assert order.push([message(1, 2)]) == []
    assert (order.refused, order.pushed) == (2, 8)


def test_on_a_wall_clock_nothing_waits_for_longer_than_the_hold() -> None:
    order = TimeOrder([0, 1], hold_s=0.05)
    assert order.push([message(0, 1), message(1, 1)], 10.0) == []
    assert keys(order.push([message(0, 2), message(1, 2)], 10.01)) == [(1, 0, 1), (1, 1, 1)]
    assert order.push([message(0, 3)], 10.02) == []  # source 1 is silent from here on
    assert keys(order.push([message(0, 4)], 10.03)) == []
    assert keys(order.push([], 10.065)) == [(2, 0, 1), (2, 1, 1)]
    assert keys(order.push([], 10.075)) == [(3, 0, 1)]
    assert keys(order.push([message(0, 5), message(0, 6)], 10.09)) == [(4, 0, 1)]
    # it speaks again: what it owes comes behind the order, in its own order, and nothing is lost
    assert keys(order.push([message(1, 3), message(1, 4), message(1, 5)], 10.10)) == [(3, 1, 1), (4, 1, 1)]
    assert keys(order.push([], 10.16)) == [(5, 0, 1), (5, 1, 1), (6, 0, 1)]
    assert (order.pushed, order.refused) == (11, 0)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3)), max_size=60), st.sampled_from([0.0, 0.05, 1.0]))
def test_with_a_hold_everything_is_released_once_and_in_the_order_of_its_source(
    steps: list[tuple[int, int]], hold_s: float
) -> None:
    order, said, released, now_s = TimeOrder([0, 1, 2], hold_s), [0, 0, 0], list[Message](), 0.0
    sent = []
    for source, more in steps:
        now_s += 0.02
        batch = []
        for _ in range(more):
            said[source] += 1
            batch.append(message(source, said[source]))
        sent += batch
        released += order.push(batch, now_s)
        if hold_s == 0.0:
            assert len(released) == len(sent)
    released += order.rest()
    assert sorted(keys(released)) == sorted(keys(sent))
    for source in range(3):
        times = [one.time_ns for one in released if one.source == source]
        assert times == sorted(times)
    assert order.refused == 0


def test_rest_is_in_order_too() -> None:
    order = TimeOrder([0, 1])
    order.push([message(1, 3), message(1, 4)])
    order.push([message(1, 5, Channel.COMMAND), message(1, 5)])
    assert keys(order.rest()) == [(3, 1, 1), (4, 1, 1), (5, 1, 1), (5, 1, 4)]
    assert order.rest() == []
