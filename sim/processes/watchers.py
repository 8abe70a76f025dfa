"""Watchers, the processes that receive all messages of a run, and the recorder as the most important one.

Messages come in batches and are first put into one order of time.  In virtual time, a slow watcher slows the run.  On a wall
clock it loses messages and counts them.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from echelon.bridge.frame_message import FrameBounds, unpack
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.runtime.admission import ALWAYS, BEGIN, EARLY_NS, Admission, Refusals, why, within
from echelon.runtime.admission_rules import admissions_of
from echelon.runtime.link import LinkCounts
from echelon.runtime.session import Session
from echelon.runtime.wire import WireError, split
from echelon.sim.parts.reach import ReachWatch
from echelon.sim.processes.contract import ProcessSpec, StartError, finish, hear_finish, meet, tell, watch_keys
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.to_supervisor import Lost, RecorderProgress, RecorderReport
from echelon.sim.processes.watch import Watch
from echelon.sim.recording.recorder import Recorder
from echelon.sim.recording.time_order import TimeOrder, speakers
from echelon.sim.results.trace import TraceBuilder

PROGRESS_S: Final = 0.2
HOLD_S: Final = 0.05
"""On a wall clock, how long the recorder keeps messages back to put them in order.  With what is not yet on the disk, a killed
recorder loses 0.2 s"""
LEAD: Final = 1 << 15
"""In virtual time, how many of the longest periods a source may be ahead of the slowest one.  Members are near each other, but
copies come in batches, and some megabytes of one source may be on their way"""
LATE: Final = "after later messages"
"""Why a message is refused that has no place in the order of time any more"""
HIGH_WATER: Final = 256
"""How many batches a watcher may be behind before the run waits for it."""
WALL_HIGH_WATER: Final = 1 << 15
"""On a wall clock nothing waits: how many batches a watcher may be behind before it loses the oldest ones; some seconds"""
DRAIN_S: Final = 10.0
"""How long a watcher waits for the missing messages of a finished run."""
SILENCE_S: Final = 0.3
"""After this time without messages, a run that broke off counts as silent."""


class Reception:
    """Receives batches of copies and puts their messages into one order of time.

    A batch holds messages of the source under whose key it comes; each passes an admission (`echelon.runtime.admission`) before
    it is kept.  In virtual time a source may be `LEAD` periods ahead of the slowest one, on a wall clock not ahead of time.
    Messages wait for a silent source for `hold_s` at most; None: for ever."""

    def __init__(
        self, spec: ProcessSpec, session: Session, sources: Sequence[int], high_water: int, hold_s: float | None = None
    ) -> None:
        """Receives from some roles, given by their indices in the plan."""
        plan = spec.plan
        self._virtual = spec.virtual
        self.refusals = Refusals()
        self._hold_s = hold_s
        self._order = TimeOrder(sources, hold_s)
        admissions = admissions_of(plan, sources, self.refusals, virtual=spec.virtual, frames=FrameBounds(plan))
        self._names = {each.source: each.name for each in admissions}
        self._admissions: dict[int, dict[bytes, Admission]] = {source: {} for source in sources}
        for each in admissions:
            self._admissions[each.source][each.begin] = each
        self._latest_ns = dict.fromkeys(sources, min(each.time_ns for each in admissions))
        self._start_ns: int | None = None
        self._lead_ns = LEAD * max(link.period_ns for link in plan.links)
        keys = watch_keys(spec.run, plan, sources)
        doors = {key: partial(self._admit, source) for source, key in keys.items()}
        self._inbox = session.checked_inbox(doors, high_water)

    def begin(self, start_ns: int) -> None:
        """Says when the run begins, by `time.monotonic_ns`."""
        self._start_ns = start_ns

    def _now_ns(self) -> int:
        """Returns the run time up to which messages may be."""
        if self._virtual:
            return min(self._latest_ns.values()) + self._lead_ns
        return EARLY_NS if self._start_ns is None else time.monotonic_ns() - self._start_ns

    def _admit(self, source: int, batch: bytes) -> list[Message] | None:
        """Returns the messages of a batch that are admitted, in Zenoh's thread; None if there are none."""
        name, now_ns = self._names[source], self._now_ns()
        try:
            payloads = split(batch)
        except WireError as error:
            self.refusals.count(name, error.reason)
            return None
        messages = []
        admissions = self._admissions[source]
        for payload in payloads:
            if (admission := admissions.get(payload[:BEGIN])) is None:
                self.refusals.count(name, why(payload))
                continue
            message = admission.admit(payload, now_ns)
            if message is not None and (message.values.size or message.channel not in ALWAYS):
                messages.append(message)
        if not messages:
            return None
        self._latest_ns[source] = max(self._latest_ns[source], messages[-1].time_ns)
        return messages

    def take(self, timeout_s: float) -> list[Message]:
        """Waits up to `timeout_s` for a batch; returns the messages whose place in the order is certain by now."""
        batches = self._inbox.take(timeout_s)
        if not batches and self._hold_s is None:
            return []
        return self._order.push([message for batch in batches for message in batch], time.monotonic())

    def drain(self, expected: int | None) -> Iterator[list[Message]]:
        """Yields the last messages of a run: until `expected` messages have come in all, or (None) until it is silent."""
        deadline_s = time.monotonic() + DRAIN_S
        while (expected is None or self._order.pushed < expected) and time.monotonic() < deadline_s:
            before = self._order.pushed
            yield self.take(SILENCE_S)
            if expected is None and self._order.pushed == before:
                break
        yield self._order.rest()

    def finish(self) -> int:
        """Ends the reception; returns how many messages came after later ones had been passed on, and are left out.

        In virtual time none does by itself, so there they count as refused."""
        for source, count in self._order.refused_of.items() if self._virtual else ():
            self.refusals.count(self._names[source], LATE, count)
        return self._order.refused


def run_recorder(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs the recorder: writes messages to run.mcap and into the trace; sends progress and the trace to the supervisor."""
    plan = spec.plan
    sources = speakers(plan, spec.virtual, bool(spec.can_urls))
    high_water = HIGH_WATER if spec.virtual else WALL_HIGH_WATER
    reception = Reception(spec, session, sources, high_water, None if spec.virtual else HOLD_S)
    try:
        recording = RunRecorder(
            Path(spec.folder), plan, spec.scenario_toml, spec.metadata, spec.part_files, spec.ends_at, spec.every_ns
        )
    except OSError as error:
        raise StartError(f"{error.filename}: {error.strerror}") from None
    reception.begin(meet(spec, session, control))
    said_s = time.monotonic()
    while True:
        watch.pulse.at_work(PROGRESS_S)
        recording.add(reception.take(HOLD_S))
        recording.recorder.flush_if_due(time.monotonic_ns())
        now_s = time.monotonic()
        if now_s - said_s >= PROGRESS_S:
            said_s = now_s
            tell(control, recording.progress())
        if (order := hear_finish(control)) is not None:
            break
    watch.pulse.rest()
    for messages in reception.drain(order.messages):
        recording.add(messages)
    recording.close(order.links)
    finish(spec, control, report=recording.report(reception.finish()), refusals=reception.refusals)


class RunRecorder:
    """Writes a run's ordered messages to run.mcap and into the trace.

    With `every_ns` only the first message of each source and channel in every such time is recorded; frames all are.

    Both end where the run ends (`EndsAt`): soon after a state beyond all bounds no state is finite."""

    def __init__(
        self,
        folder: Path,
        plan: Plan,
        scenario_toml: str,
        metadata: dict[str, str],
        part_files: Mapping[str, str] = MappingProxyType({}),
        ends_at: EndsAt = EndsAt.DIVERGED,
        every_ns: int = 0,
    ) -> None:
        self._every_ns = every_ns
        self._kept: dict[tuple[int, Channel], int] = {}
        """The number of the time `every_ns` in which a message of a source and channel was last recorded"""
        self.thinned = 0
        """Messages that were not recorded by the rule of `every_ns`"""
        self.recorder = Recorder(folder / "run.mcap", plan, scenario_toml, metadata, part_files)
        self._trace = TraceBuilder(plan)
        self.messages = 0
        self.lost: Lost | None = None
        """The first state that is not finite, or beyond all bounds, or of a robot beyond its reach"""
        self._time_ns = 0
        self._bridge = len(plan.formation)
        self._ends_at = ends_at
        self._reach = ReachWatch(plan) if ends_at is EndsAt.DIVERGED else None

    def add(self, messages: Sequence[Message]) -> None:
        """Takes messages in order of time."""
        recorder, trace = self.recorder, self._trace
        if self.lost is None and self._ends_at is not EndsAt.NOWHERE:
            states = [message for message in messages if message.channel is Channel.STATE]
            self.lost = _first_lost(states)
            beyond = None if self._reach is None else self._reach.first(states)
            if beyond is not None and (self.lost is None or beyond[1] < self.lost.time_ns):
                robot, time_ns, far = beyond
                self.lost = Lost(robot, time_ns, True, far)
        if self.lost is not None:
            last_ns = self.lost.time_ns
            messages = [message for message in messages if message.time_ns <= last_ns]
        if not messages:
            return
        self.messages += len(messages)
        self._time_ns = max(self._time_ns, messages[-1].time_ns)
        for message in messages:
            if message.channel is Channel.FRAMES:
                if message.source == self._bridge:  # its messages contain the drives' frames, too
                    for timed in unpack(message.values):
                        recorder.record_frame(timed)
            elif not self._every_ns or self._keeps(message):
                trace.add(message)
                recorder.record(message)

    def _keeps(self, message: Message) -> bool:
        """Returns whether a message is recorded by the rule of `every_ns`; counts those that are not."""
        number, of = message.time_ns // self._every_ns, (message.source, message.channel)
        if self._kept.get(of) == number:
            self.thinned += 1
            return False
        self._kept[of] = number
        return True

    def progress(self) -> RecorderProgress:
        """Returns the progress of the recording."""
        states_ns, states = self._trace.last() or (0, None)
        return RecorderProgress(self._time_ns, self.messages, states_ns, states, self._failure, self.lost)

    def close(self, links: Sequence[LinkCounts]) -> None:
        """Writes the links' counts and ends the recording."""
        self.recorder.record_links(self._time_ns, links)
        self.recorder.close()

    def report(self, late: int = 0) -> RecorderReport:
        """Returns the report with the trace; `late` is the number of messages that came too late to be recorded."""
        trace, late = self._trace.build(), late + self._trace.surplus
        return RecorderReport(trace, self.messages, late, self._failure, self.lost, self.thinned)

    @property
    def _failure(self) -> str | None:
        return self.recorder.failure or self._trace.failure


def _first_lost(states: Sequence[Message]) -> Lost | None:
    """Returns the first state that is not finite or beyond all bounds; None if all are within."""
    if not states or within(np.concatenate([state.values for state in states])):
        return None
    for state in states:
        if not within(state.values):
            return Lost(state.source, state.time_ns, bool(np.isfinite(state.values).all()))
    return None  # only their sum is beyond
