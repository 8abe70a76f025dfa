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


def test_rest_is_in_order_too() -> None:
    order = TimeOrder([0, 1])
    order.push([message(1, 3), message(1, 4)])
    order.push([message(1, 5, Channel.COMMAND), message(1, 5)])
    assert keys(order.rest()) == [(3, 1, 1), (4, 1, 1), (5, 1, 1), (5, 1, 4)]
    assert order.rest() == []
