"""Watchers, the processes that receive all messages of a run, and the recorder as the most important one.

Messages come in batches and are first put into one order of time.  In virtual time, a slow watcher slows the run.  On a wall
clock it loses messages and counts them.
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import isfinite
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Final

from echelon.bridge.frame_message import unpack
from echelon.messages import Channel, Message
from echelon.plan.layout import message_sizes
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.runtime.session import Inbox, Session
from echelon.runtime.wire import WireError, count_refusal, decode, split, watch_key
from echelon.sim.processes.contract import ProcessSpec, StartError, finish, hear_finish, meet
from echelon.sim.processes.to_supervisor import Lost, RecorderProgress, RecorderReport
from echelon.sim.recording.recorder import Recorder
from echelon.sim.recording.time_order import TimeOrder, speakers
from echelon.sim.results.trace import TraceBuilder

PROGRESS_S: Final = 0.2
SLACK_NS: Final = 60_000_000_000
"""On a wall clock, messages with times up to this long after the end of the run are accepted."""
HIGH_WATER: Final = 256
"""How many batches a watcher may be behind before the run waits for it."""
WALL_HIGH_WATER: Final = 1 << 15
"""On a wall clock nothing waits: how many batches a watcher may be behind before it loses the oldest ones; some seconds"""
DRAIN_S: Final = 10.0
"""How long a watcher waits for the missing messages of a finished run."""
SILENCE_S: Final = 0.3
"""After this time without messages, a run that broke off counts as silent."""


class Reception:
    """Receives batches from the session and puts their messages into one order of time."""

    def __init__(self, inbox: Inbox, sources: Iterable[int], plan: Plan) -> None:
        self._inbox = inbox
        self._order = TimeOrder(sources)
        self._sizes = message_sizes(plan)
        self._from_ns, self._until_ns = -plan.can.bring_up_ns, plan.duration_ns + SLACK_NS
        self.refused: dict[str, int] = {}

    def take(self, timeout_s: float) -> list[Message]:
        """Waits up to `timeout_s` for a batch; returns the messages whose place in the order is certain by now."""
        messages: list[Message] = []
        for batch in self._inbox.take(timeout_s):
            messages.extend(self._unpack(batch))
        if not messages:
            return []
        return self._order.push(messages)

    def _unpack(self, batch: bytes) -> Iterator[Message]:
        try:
            for payload in split(batch):
                message = decode(payload)
                size = self._sizes.get((message.source, message.channel), -1)
                if size is not None and message.values.size not in (0, size):
                    count_refusal(self.refused, "wrong number of values" if size >= 0 else "of nobody here")
                elif self._from_ns <= message.time_ns <= self._until_ns:
                    yield message
                else:
                    count_refusal(self.refused, "of another time")
        except WireError as error:
            count_refusal(self.refused, error.reason)

    def drain(self, expected: int | None) -> Iterator[list[Message]]:
        """Yields the last messages of a run: until `expected` messages have come in all, or (None) until it is silent."""
        deadline_s = time.monotonic() + DRAIN_S
        while (expected is None or self._order.pushed < expected) and time.monotonic() < deadline_s:
            before = self._order.pushed
            yield self.take(SILENCE_S)
            if expected is None and self._order.pushed == before:
                break
        yield self._order.rest()

    @property
    def refused_count(self) -> int:
        """Number of invalid batches, and of messages from unknown sources or out of order."""
        return sum(self.refused.values()) + self._order.refused


def run_recorder(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs the recorder: writes messages to run.mcap and into the trace; sends progress and the trace to the supervisor."""
    plan = spec.plan
    sources = speakers(plan, spec.virtual, bool(spec.can_urls))
    high_water = HIGH_WATER if spec.virtual else WALL_HIGH_WATER
    reception = Reception(session.inbox(watch_key(spec.run, "*", "**"), high_water), sources, plan)
    try:
        recording = RunRecorder(
            Path(spec.folder), plan, spec.scenario_toml, spec.metadata, spec.part_files, spec.keep_going
        )
    except OSError as error:
        raise StartError(f"{error.filename}: {error.strerror}") from None
    meet(spec, session, control)
    said_s = time.monotonic()
    while True:
        recording.add(reception.take(PROGRESS_S / 2))
        now_s = time.monotonic()
        if now_s - said_s >= PROGRESS_S:
            said_s = now_s
            recording.recorder.flush_if_due(time.monotonic_ns())
            control.send(recording.progress())
        if (order := hear_finish(control)) is not None:
            break
    for messages in reception.drain(order.messages):
        recording.add(messages)
    recording.close(order.links)
    finish(spec, control, report=recording.report(reception.refused_count))


class RunRecorder:
    """Writes a run's ordered messages to run.mcap and into the trace.

    Both end with the first instant at which a robot's state is not finite, since soon after that no state is.  With
    `keep_going` they go on to the end."""

    def __init__(
        self,
        folder: Path,
        plan: Plan,
        scenario_toml: str,
        metadata: dict[str, str],
        part_files: Mapping[str, str] = MappingProxyType({}),
        keep_going: bool = False,
    ) -> None:
        self.recorder = Recorder(folder / "run.mcap", plan, scenario_toml, metadata, part_files)
        self._trace = TraceBuilder(plan)
        self.messages = 0
        self.lost: Lost | None = None
        """The first state that is not finite"""
        self._time_ns = 0
        self._bridge = len(plan.formation)
        self._keep_going = keep_going

    def add(self, messages: Sequence[Message]) -> None:
        """Takes messages in order of time."""
        recorder, trace = self.recorder, self._trace
        for message in messages:
            if self.lost is not None and message.time_ns > self.lost.time_ns:
                return
            self.messages += 1
            self._time_ns = message.time_ns
            if message.channel is Channel.STATE and not self._keep_going and self.lost is None and _is_lost(message):
                self.lost = Lost(message.source, message.time_ns)
            if message.channel is Channel.FRAMES:
                if message.source == self._bridge:  # its messages contain the drives' frames, too
                    for timed in unpack(message.values):
                        recorder.record_frame(timed)
            else:
                trace.add(message)
                recorder.record(message)

    def progress(self) -> RecorderProgress:
        """Returns the progress of the recording."""
        states_ns, states = self._trace.last() or (0, None)
        return RecorderProgress(self._time_ns, self.messages, states_ns, states, self._failure, self.lost)

    def close(self, links: Sequence[LinkCounts]) -> None:
        """Writes the links' counts and ends the recording."""
        self.recorder.record_links(self._time_ns, links)
        self.recorder.close()

    def report(self, refused: int = 0) -> RecorderReport:
        """Returns the report with the trace; `refused` is the number of messages that were refused before."""
        trace, refused = self._trace.build(), refused + self._trace.surplus
        return RecorderReport(trace, self.messages, refused, self._failure, self.lost)

    @property
    def _failure(self) -> str | None:
        return self.recorder.failure or self._trace.failure


def _is_lost(message: Message) -> bool:
    """Returns whether a value of a message is not finite."""
    return not all(map(isfinite, message.values.tolist()))
