"""A trace holds the robots' states, and its digest depends on nothing else."""

from __future__ import annotations

import pickle
import random

import numpy as np
import pytest

from echelon.messages import STATE_FIELDS, Channel
from echelon.sim.results.trace import Digest, Trace, TraceBuilder
from support.invented import invented, paper

FIELDS = len(STATE_FIELDS)


def trace_of_times(*times: list[int]) -> Trace:
    """Returns a trace whose robots have states at these instants; each state tells robot and instant."""
    arrays = tuple(np.array(each, dtype=np.int64) for each in times)
    states = tuple(
        np.repeat(100.0 * robot + each[:, None], FIELDS, axis=1).astype(float) for robot, each in enumerate(arrays)
    )
    return Trace(paper(), arrays, states)


def test_the_order_in_which_robots_speak_does_not_matter() -> None:
    messages = [each for each in invented(paper(), 20) if each.channel is Channel.STATE]
    shuffled = sorted(messages, key=lambda each: (each.sequence // 7, random.Random(each.source).random()))
    by_robot = sorted(messages, key=lambda each: each.source)
    digests = set()
    for order in (messages, shuffled, by_robot):
        builder = TraceBuilder(paper())
        for message in order:
            builder.add(message)
        digests.add(builder.build().digest())
    assert len(digests) == 1


@pytest.mark.parametrize("pieces", [1, 3, 50])
def test_a_digest_may_be_fed_in_pieces(pieces: int) -> None:
    trace = trace_of_times(list(range(50)), list(range(50)))
    digest = Digest(2)
    for robot in (1, 0):
        for piece in np.array_split(trace.states[robot], pieces):
            digest.update(robot, piece)
    assert digest.hexdigest() == trace.digest()


def test_a_digest_tells_apart() -> None:
    trace = trace_of_times([0, 1, 2], [0, 1, 2])
    one_bit = tuple(states.copy() for states in trace.states)
    one_bit[1][2, 3] = np.nextafter(one_bit[1][2, 3], np.inf)
    swapped = trace.states[::-1]
    shorter = tuple(states[:-1] for states in trace.states)
    others = [Trace(trace.plan, trace.times_ns, states).digest() for states in (one_bit, swapped, shorter)]
    assert len({trace.digest(), *others}) == 4


def test_common_instants() -> None:
    times, states = trace_of_times([0, 1, 2, 3, 4], [0, 2, 4, 6], [0, 2, 3, 4, 5]).common()
    assert times.tolist() == [0, 2, 4]
    assert states.shape == (3, 3, FIELDS)
    assert states[:, :, 0].tolist() == [[0, 100, 200], [2, 102, 202], [4, 104, 204]]


def test_common_of_the_same_and_of_nothing() -> None:
    same = trace_of_times([0, 1], [0, 1])
    times, states = same.common()
    assert times.tolist() == [0, 1]
    assert np.array_equal(states[:, 1], same.states[1])
    times, states = TraceBuilder(paper()).build().common()
    assert (times.shape, states.shape) == ((0,), (0, 9, FIELDS))


@pytest.mark.parametrize("times", [([*range(20)],) * 3, ([*range(20)], [*range(0, 40, 2)], [*range(1, 50)])])
@pytest.mark.parametrize("overlap", [0, 1])
def test_windows_are_the_whole_in_pieces(
    times: tuple[list[int], ...], overlap: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("echelon.sim.results.trace.WINDOW", 3)
    trace = trace_of_times(*times)
    whole_ns, states = trace.common((4, 0))
    covered: list[int] = []
    for part, window in trace.windows((4, 0), overlap=overlap):
        assert np.array_equal(window, states[part])
        assert part.start == (covered[-1] + 1 - overlap if covered else 0)
        covered = list(range(part.stop))
    assert covered == list(range(len(whole_ns)))
    assert np.array_equal(trace.common_ns(), whole_ns)


def test_a_trace_in_a_file_reaches_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echelon.large_arrays.LARGE", 1)
    builder = TraceBuilder(paper())
    for message in invented(paper(), 20):
        builder.add(message)
    trace = builder.build()
    assert trace.in_file is not None
    pickled = pickle.dumps(trace)
    assert len(pickled) < len(pickle.dumps(paper())) + 2000  # no states
    assert pickle.loads(pickled).digest() == trace.digest()


def test_last_is_known_when_all_have_spoken() -> None:
    builder = TraceBuilder(paper())
    messages = list(invented(paper(), 3))
    for message in messages[:8]:
        builder.add(message)
    assert builder.last() is None
    for message in messages[8:]:
        builder.add(message)
    last = builder.last()
    assert last is not None
    time_ns, states = last
    assert time_ns == 2 * paper().robots[0].period_ns
    wanted = [each.values for each in messages if each.channel is Channel.STATE][-9:]
    assert np.array_equal(states, np.array(wanted))
