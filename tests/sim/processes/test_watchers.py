"""Watchers get the messages of a run in order, count invalid ones, and end with all that was sent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from echelon.bridge.frame_message import TimedFrame, pack
from echelon.bridge.protocols.frame import Frame
from echelon.messages import Channel, Message
from echelon.runtime.wire import encode, join
from echelon.sim.processes import watchers
from echelon.sim.processes.to_supervisor import Lost
from echelon.sim.processes.watchers import Reception, RunRecorder
from echelon.sim.recording.mcap_reader import read_metadata, read_trace
from support.invented import METADATA, invented, paper

TICKS = 6


class Inbox:
    """Stands for the session: returns the given portions of batches one by one, then nothing."""

    def __init__(self, *portions: list[bytes]) -> None:
        self.portions = list(portions)

    def take(self, timeout_s: float | None = None) -> list[bytes]:
        """Returns the next portion."""
        return self.portions.pop(0) if self.portions else []


def batch(messages: list[Message]) -> bytes:
    """Returns a batch as members send it."""
    return join([encode(message) for message in messages])


def batches_by_source(messages: list[Message]) -> list[bytes]:
    """Returns for each source one batch with all its messages."""
    return [batch([m for m in messages if m.source == source]) for source in sorted({m.source for m in messages})]


def reception(inbox: Any) -> Reception:
    """Returns a reception for the members of the paper's scenario."""
    return Reception(inbox, range(len(paper().formation)), paper())


def keys(messages: list[Message]) -> list[tuple[int, int, int]]:
    """Returns the keys of the order of messages."""
    return [(each.time_ns, each.source, each.channel) for each in messages]


def test_batches_come_out_in_order() -> None:
    messages = list(invented(paper(), TICKS))
    received = reception(Inbox(*[[each] for each in reversed(batches_by_source(messages))]))
    out = [each for _ in range(len(paper().formation)) for each in received.take(1.0)]
    out += [each for portion in received.drain(len(messages)) for each in portion]
    assert keys(out) == sorted(keys(messages))
    assert received.refused_count == 0


def test_what_is_no_message_is_counted_and_the_rest_is_kept() -> None:
    messages = list(invented(paper(), TICKS))
    good = batches_by_source(messages)
    size = messages[0].values.size
    strangers = [Message(Channel.STATE, 99, 0, 0, np.zeros(size)), Message(Channel.COMMAND, 1, 0, 0, np.zeros(2))]
    leader, root = paper().nodes[0], paper().root  # the leader has no child nodes; the root has no parent and no robots
    for node, channel in ((leader, Channel.REFERENCE), (root, Channel.GROUP_STATE), (root, Channel.COMMAND)):
        strangers.append(Message(channel, node.index, 0, 0, np.zeros(6)))
    stranger = batch(strangers)
    odd = batch([Message(Channel.STATE, 1, 0, 0, np.zeros(2)), Message(Channel.STATE, 1, 0, 2**62, np.zeros(size))])
    received = reception(Inbox([b"\x01", join([b"\x01\x00"]), good[0][:-1], stranger, odd, *good[1:]]))
    out = [each for portion in received.drain(None) for each in portion]
    missing = set(keys(messages)) - set(keys(out))
    assert missing == set(keys([each for each in messages if each.source == 0]))  # a batch is refused as a whole
    assert received.refused == {
        "batch cut in a length": 1,
        "too short": 1,
        "batch cut in a message": 1,
        "of nobody here": 5,
        "wrong number of values": 1,
        "of another time": 1,
    }
    assert received.refused_count == 10


def test_drain_ends_with_what_is_expected_or_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = list(invented(paper(), TICKS))
    parts = [[each] for each in batches_by_source(messages)]
    inbox = Inbox(*parts, [b"not asked for"])
    assert len([m for portion in reception(inbox).drain(len(messages)) for m in portion]) == len(messages)
    assert inbox.portions == [[b"not asked for"]]
    silent = Inbox(*parts[:3], [], *parts[3:])  # a run that broke off: after a silence watchers wait no longer
    out = [m for portion in reception(silent).drain(None) for m in portion]
    assert {m.source for m in out} == {0, 1, 2}
    monkeypatch.setattr(watchers, "DRAIN_S", 0.05)  # the wait for missing messages ends
    assert keys([m for portion in reception(Inbox(*parts[:3])).drain(999) for m in portion]) == sorted(keys(out))


def test_recording_keeps_messages_trace_and_frames(tmp_path: Path) -> None:
    recording = RunRecorder(tmp_path, paper(), "scenario", METADATA)
    assert recording.progress().states is None
    messages = list(invented(paper(), TICKS))
    end_ns = messages[-1].time_ns
    timed = TimedFrame(end_ns, 0, 0, Frame(0x101, bytes(range(8))))
    frames = Message(Channel.FRAMES, len(paper().formation), 0, end_ns, pack([timed]))
    recording.add(messages)
    recording.add([])
    recording.add([frames])
    progress = recording.progress()
    assert progress.time_ns == progress.states_ns == messages[-1].time_ns
    assert (progress.messages, progress.failure) == (len(messages) + 1, None)
    recording.close([])
    result = recording.report()
    assert (result.messages, result.failure) == (len(messages) + 1, None)
    assert read_trace(tmp_path / "run.mcap", paper()).digest() == result.trace.digest()
    assert read_metadata(tmp_path / "run.mcap") == METADATA


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize("keep_going", [False, True])
def test_a_recording_ends_with_the_instant_at_which_a_state_is_not_finite(
    tmp_path: Path, value: float, keep_going: bool
) -> None:
    messages = list(invented(paper(), TICKS))
    instants = sorted({message.time_ns for message in messages})
    at_ns, lost = instants[len(instants) // 2], paper().robots[3].index
    for number, message in enumerate(messages):
        if message.channel is Channel.STATE and message.source == lost and message.time_ns >= at_ns:
            values = message.values.copy()
            values[-1] = value
            messages[number] = message._replace(values=values)
    recording = RunRecorder(tmp_path, paper(), "scenario", METADATA, keep_going=keep_going)
    recording.add(messages)
    recording.close([])
    result = recording.report()
    if keep_going or value == 1e200:  # 1e200 is finite, though its square is not
        assert (result.lost, result.stopped(paper())) == (None, None)
        assert result.messages == len(messages)
    else:
        assert recording.progress().lost == result.lost == Lost(lost, at_ns)
        assert result.stopped(paper()) == f"the state of g2/r4 is not finite from {at_ns / 1e9:g} s on"
        assert result.messages == sum(message.time_ns <= at_ns for message in messages)
        assert {int(times[-1]) for times in result.trace.times_ns} == {at_ns}
    assert read_trace(tmp_path / "run.mcap", paper()).digest() == result.trace.digest()
