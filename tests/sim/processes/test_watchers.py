"""Watchers get the messages of a run in order, count invalid ones, and end with all that was sent."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from echelon.bridge.frame_message import TimedFrame, pack
from echelon.bridge.protocols.frame import Frame
from echelon.messages import NULL, Channel, Message
from echelon.runtime.admission import AGAIN, EMPTY, FUTURE, MISSHAPEN, OF_ANOTHER, TIME, VALUES
from echelon.runtime.session import Session
from echelon.runtime.wire import encode, join
from echelon.sim.processes import watchers
from echelon.sim.processes.contract import watch_keys
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.to_supervisor import Lost
from echelon.sim.processes.watchers import LATE, LEAD, Reception, RunRecorder
from echelon.sim.recording.mcap_reader import read_metadata, read_trace
from echelon.sim.recording.time_order import speakers
from support.invented import METADATA, invented, paper

TICKS = 6


class Run:
    """Stands for the session: each `take` lets the next portion of batches through the doors; then there is nothing."""

    def __init__(self, *portions: list[tuple[int, bytes]], virtual: bool = True) -> None:
        """A portion is a list of sources and their batches."""
        self.portions = list(portions)
        plan = paper()
        sources = speakers(plan, virtual, has_bus=True)
        spec: Any = SimpleNamespace(plan=plan, run="test", virtual=virtual)
        self.doors: list[Any] = []
        self.reception = Reception(spec, cast(Session, self), sources, 8)

    def checked_inbox(self, doors: dict[str, Any], high_water: int) -> Run:
        """Takes the place of the session's method."""
        assert list(doors) == list(watch_keys("test", paper(), range(len(doors))).values())
        self.doors = list(doors.values())
        return self

    def take(self, timeout_s: float | None = None) -> list[list[Message]]:
        """Takes the place of the inbox's method."""
        portion = self.portions.pop(0) if self.portions else []
        kept = [self.doors[source](batch) for source, batch in portion]
        return [messages for messages in kept if messages is not None]


def batch(messages: list[Message]) -> bytes:
    """Returns a batch as members send it."""
    return join([encode(message) for message in messages])


def batches_by_source(messages: list[Message]) -> list[tuple[int, bytes]]:
    """Returns for each source one batch with all its messages."""
    return [(source, batch([m for m in messages if m.source == source])) for source in range(len(paper().formation))]


def keys(messages: list[Message]) -> list[tuple[int, int, int]]:
    """Returns the keys of the order of messages."""
    return [(each.time_ns, each.source, each.channel) for each in messages]


def frames_at(time_ns: int, number: int) -> Message:
    """Returns a message of the mirroring bridge with one frame."""
    timed = TimedFrame(time_ns, 0, 0, Frame(0x101, bytes(range(8))))
    return Message(Channel.FRAMES, len(paper().formation), number, time_ns, pack([timed]))


def test_batches_come_out_in_order() -> None:
    messages = list(invented(paper(), TICKS))
    run = Run(*[[each] for each in reversed(batches_by_source(messages))])
    out = [each for _ in range(len(paper().formation)) for each in run.reception.take(1.0)]
    out += [each for portion in run.reception.drain(len(messages)) for each in portion]
    assert keys(out) == sorted(keys(messages))
    assert run.reception.finish() == run.reception.refusals.total == 0


def test_what_is_refused_is_counted_by_source_and_the_rest_is_kept() -> None:
    messages = list(invented(paper(), TICKS))
    good = batches_by_source(messages)
    size, period_ns = messages[0].values.size, paper().robots[0].period_ns
    leader, root, bridge = paper().nodes[0], paper().root, len(paper().formation)
    of_others = [Message(Channel.STATE, 99, 0, 0, np.zeros(size)), Message(Channel.COMMAND, 1, 0, 0, np.zeros(2))]
    of_others.append(messages[0])  # true, but another's
    unknown = [Message(channel, leader.index, 0, 0, np.zeros(6)) for channel in (Channel.REFERENCE, Channel.STATE)]
    later = TICKS * period_ns
    odd = [
        Message(Channel.STATE, 1, TICKS, later, np.zeros(2)),
        Message(Channel.STATE, 1, TICKS, later, NULL),
        Message(Channel.STATE, 1, TICKS + 1, later, np.zeros(size)),
        Message(Channel.STATE, 1, 2**62, 2**62, np.zeros(size)),
        Message(Channel.STATE, 1, 10 * LEAD, 10 * LEAD * period_ns, np.zeros(size)),
    ]
    far = pack([TimedFrame(2**62, 0, 0, Frame(0))])
    elsewhere = pack([TimedFrame(0, 7, 0, Frame(0))])
    run = Run(
        [(0, b"\x01"), (0, join([b"\x01\x00"])), (0, good[0][1][:-1]), (1, batch(of_others)), *good[1:]],
        [(leader.index, batch(unknown)), (root.index, batch([messages[-1]])), (1, batch(odd))],
        [
            (
                bridge,
                batch(
                    [frames_at(0, 0), frames_at(0, 1)._replace(values=far), frames_at(0, 2)._replace(values=elsewhere)]
                ),
            )
        ],
        [(bridge, batch([frames_at(0, 1), frames_at(2**62, 3)]))],
    )
    out = [each for _ in range(4) for each in run.reception.take(1.0)]
    out += [each for portion in run.reception.drain(None) for each in portion]
    wanted = [each for each in messages if each.source != 0]  # a batch that is cut is refused as a whole
    assert sorted(keys(out)) == sorted(keys([*wanted, *[frames_at(0, number) for number in range(3)]]))
    assert [each.is_null for each in out if each.channel is Channel.FRAMES] == [False, True, True]
    members = paper().formation
    assert run.reception.refusals.by_source() == {
        members[0].name: {"batch cut in a length": 1, "too short": 1, "batch cut in a message": 1},
        members[1].name: {OF_ANOTHER: 3, MISSHAPEN: 1, EMPTY: 1, TIME: 2, FUTURE: 1},
        leader.name: {OF_ANOTHER: 2},
        root.name: {AGAIN: 1},
        "bridge": {VALUES: 2, AGAIN: 1, FUTURE: 1},
    }


def test_in_virtual_time_what_comes_after_later_messages_is_refused() -> None:
    """A leader sends a command of long after, then the state of its group of now."""
    messages = list(invented(paper(), TICKS))
    leader, period_ns = paper().nodes[0], paper().robots[0].period_ns
    number = TICKS + 10
    command = Message(Channel.COMMAND, leader.index, number, number * period_ns, np.zeros(2 * len(leader.children)))
    others = [each for each in batches_by_source(messages) if each[0] != leader.index]
    others.append((len(paper().formation), batch([frames_at(number * period_ns, 0)])))
    first = [
        message for message in messages if message.source == leader.index and message.channel is Channel.GROUP_STATE
    ]
    run = Run([(leader.index, batch([command])), *others], [(leader.index, batch(first[:1]))])
    assert run.reception.take(1.0)
    assert run.reception.take(1.0) == []
    assert run.reception.finish() == 1
    assert run.reception.refusals.by_source() == {leader.name: {LATE: 1}}


def test_on_a_wall_clock_nothing_is_from_the_future(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchers, "time", SimpleNamespace(monotonic_ns=lambda: 7_000_000_000))
    period_ns = paper().robots[0].period_ns
    number = 1_000_000_000 // period_ns
    state = Message(Channel.STATE, 0, number, number * period_ns, np.zeros(16))
    later = state._replace(sequence=number + 1, time_ns=state.time_ns + period_ns)
    run = Run([(0, batch([state, later]))], virtual=False)
    run.reception.begin(6_000_000_000)
    assert [message.sequence for message in run.take()[0]] == [number]
    assert run.reception.refusals.by_source() == {paper().robots[0].name: {FUTURE: 1}}


def test_drain_ends_with_what_is_expected_or_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = list(invented(paper(), TICKS))
    parts = [[each] for each in batches_by_source(messages)]
    run = Run(*parts, [(0, b"not asked for")])
    assert len([m for portion in run.reception.drain(len(messages)) for m in portion]) == len(messages)
    assert run.portions == [[(0, b"not asked for")]]
    silent = Run(*parts[:3], [], *parts[3:])  # a run that broke off: after a silence watchers wait no longer
    out = [m for portion in silent.reception.drain(None) for m in portion]
    assert {m.source for m in out} == {0, 1, 2}
    monkeypatch.setattr(watchers, "DRAIN_S", 0.05)  # the wait for missing messages ends
    assert keys([m for portion in Run(*parts[:3]).reception.drain(999) for m in portion]) == sorted(keys(out))


def test_recording_keeps_messages_trace_and_frames(tmp_path: Path) -> None:
    recording = RunRecorder(tmp_path, paper(), "scenario", METADATA)
    assert recording.progress().states is None
    messages = list(invented(paper(), TICKS))
    end_ns = messages[-1].time_ns
    recording.add(messages)
    recording.add([])
    recording.add([frames_at(end_ns, 0)])
    progress = recording.progress()
    assert progress.time_ns == progress.states_ns == messages[-1].time_ns
    assert (progress.messages, progress.failure) == (len(messages) + 1, None)
    recording.close([])
    result = recording.report()
    assert (result.messages, result.failure) == (len(messages) + 1, None)
    assert read_trace(tmp_path / "run.mcap", paper()).digest() == result.trace.digest()
    assert read_metadata(tmp_path / "run.mcap") == METADATA


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200, 1e14])
@pytest.mark.parametrize("ends_at", EndsAt)
def test_a_recording_ends_with_the_instant_at_which_a_state_is_not_finite(
    tmp_path: Path, value: float, ends_at: EndsAt
) -> None:
    messages = list(invented(paper(), TICKS))
    instants = sorted({message.time_ns for message in messages})
    at_ns, lost = instants[len(instants) // 2], paper().robots[3].index
    for number, message in enumerate(messages):
        if message.channel is Channel.STATE and message.source == lost and message.time_ns >= at_ns:
            values = message.values.copy()
            values[-1] = value
            messages[number] = message._replace(values=values)
    recording = RunRecorder(tmp_path, paper(), "scenario", METADATA, ends_at=ends_at)
    recording.add(messages)
    recording.close([])
    result = recording.report()
    if ends_at is EndsAt.NOWHERE or value == 1e14:  # large, but within the bounds
        assert (result.lost, result.stopped(paper())) == (None, None)
        assert result.messages == len(messages)
    else:
        assert recording.progress().lost == result.lost == Lost(lost, at_ns, value == 1e200)
        what = "beyond all bounds" if value == 1e200 else "not finite"
        assert result.stopped(paper()) == f"the state of g2/r4 is {what} from {at_ns / 1e9:g} s on"
        assert result.messages == sum(message.time_ns <= at_ns for message in messages)
        assert {int(times[-1]) for times in result.trace.times_ns} == {at_ns}
    assert read_trace(tmp_path / "run.mcap", paper()).digest() == result.trace.digest()
