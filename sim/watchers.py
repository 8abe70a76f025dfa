"""The processes that watch a run: the recorder, and the bridge that puts torques on the CAN bus.

Both receive members' messages in batches and put them into one order of time first.  In virtual time a watcher that is
slow slows the run; on a wall clock it loses, and says so.
"""

import time
from collections.abc import Iterable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from echelon.bridge.frame_message import unpack
from echelon.layout import said_by
from echelon.messages import Channel, Message
from echelon.plan import Plan
from echelon.session import Inbox, Session
from echelon.sim.joining import ProcessSpec, Result, StartError, meet, resources
from echelon.sim.merge import TimeOrder
from echelon.sim.recorder import Recorder
from echelon.sim.trace import TraceBuilder
from echelon.wire import WireError, count_refusal, decode, encode, join, split, watch_key

PROGRESS_S: Final = 0.2
SLACK_NS: Final = 60_000_000_000
"""So long after its end a run on a wall clock may still say something."""
HIGH_WATER: Final = 256
"""Batches a watcher may be behind before the run waits for it."""
DRAIN_S: Final = 10.0
"""How long to wait for what a finished run still owes."""
SILENCE_S: Final = 0.3
"""How long to wait for what a broken run may still have sent."""


class Reception:
    """Batches from the session, in one order of time."""

    def __init__(self, inbox: Inbox, sources: Iterable[int], plan: Plan) -> None:
        self._inbox = inbox
        self._order = TimeOrder(sources)
        self._sizes = said_by(plan)
        self._from_ns, self._until_ns = -plan.can.bring_up_ns, plan.duration_ns + SLACK_NS
        self.refused: dict[str, int] = {}

    def take(self, timeout_s: float) -> list[Message]:
        """Waits for a batch; returns the messages that can go now."""
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
        """Yields what still comes at the end of a run: all that is `expected`, or (None) until it is silent."""
        deadline_s = time.monotonic() + DRAIN_S
        while (expected is None or self._order.pushed < expected) and time.monotonic() < deadline_s:
            before = self._order.pushed
            yield self.take(SILENCE_S)
            if expected is None and self._order.pushed == before:
                break
        yield self._order.rest()

    @property
    def refused_count(self) -> int:
        """Batches that were no messages, and messages of unknown sources or out of their source's order."""
        return sum(self.refused.values()) + self._order.refused


def run_recorder(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The recorder process: messages to run.mcap and into the trace; progress, then the trace, to the supervisor."""
    plan = spec.plan
    # The bridge's messages come after the members'; drives say something of their own only where time is virtual.
    on_bus = len(plan.bus_roles) if spec.virtual else 1
    sources = range(len(plan.formation) + (on_bus if plan.can.closed else bool(spec.can_urls)))
    reception = Reception(session.inbox(watch_key(spec.run, "*", "**"), HIGH_WATER), sources, plan)
    try:
        recording = Recording(Path(spec.folder), plan, spec.scenario_toml, spec.metadata)
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
            control.send(("progress", recording.progress()))
        if control.poll():
            _, finish = control.recv()
            break
    for messages in reception.drain(finish["expected"]):
        recording.add(messages)
    recording.close(finish["links"])
    cpu_s, resident = resources()
    extra = recording.result() | {"refused": reception.refused_count}
    control.send(("done", Result(spec.name, cpu_s, resident, extra=extra)))
    control.recv()


class Recording:
    """Where a run's messages go once they are in order: run.mcap and the trace."""

    def __init__(self, folder: Path, plan: Plan, scenario_toml: str, metadata: dict[str, str]) -> None:
        self.recorder = Recorder(folder / "run.mcap", plan, scenario_toml, metadata)
        self._trace = TraceBuilder(plan)
        self.messages = 0
        self._time_ns = 0
        self._bridge = len(plan.formation)

    def add(self, messages: list[Message]) -> None:
        """Takes messages in order of time."""
        recorder, trace = self.recorder, self._trace
        for message in messages:
            self.messages += 1
            if message.channel is Channel.FRAMES:
                if message.source == self._bridge:  # which tells of the drives' frames, too
                    for timed in unpack(message.values):
                        recorder.record_frame(timed)
            else:
                trace.add(message)
                recorder.record(message)
        if messages:
            self._time_ns = messages[-1].time_ns

    def progress(self) -> dict[str, Any]:
        """Returns what a live table shows: run time, robots' last states, messages, a failure if there is one."""
        last = self._trace.last()
        return {
            "time_ns": self._time_ns,
            "states": None if last is None else last[1],
            "states_ns": 0 if last is None else last[0],
            "messages": self.messages,
            "failure": self.recorder.failure,
        }

    def close(self, links: list[Any]) -> None:
        """Writes the links' counts and ends the recording."""
        self.recorder.record_links(self._time_ns, links)
        self.recorder.close()

    def result(self) -> dict[str, Any]:
        """Returns the trace, and what became of the recording."""
        return {"trace": self._trace.build(), "failure": self.recorder.failure, "messages": self.messages}


def run_bridge(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The bridge process: robots' torques to frames, on the bus, in can.log, and to the recorder."""
    from echelon.bridge.station import Station  # python-can and cantools, for this process alone

    plan = spec.plan
    robots = [robot.index for robot in plan.robots]
    reception = Reception(session.inbox(watch_key(spec.run, "robot", "**"), HIGH_WATER), robots, plan)
    publisher = session.publisher(watch_key(spec.run, "bridge", "frames"))
    try:
        station = Station(plan, spec.can_urls, Path(spec.folder))
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    control.send(("bus", station.url))
    meet(spec, session, control)

    def put(messages: list[Message]) -> None:
        frames = [encode(message) for message in station.put(messages)]
        for at in range(0, len(frames), 16):
            publisher.put(join(frames[at : at + 16]))

    said_s = time.monotonic()
    while True:
        put(reception.take(PROGRESS_S / 2))
        now_s = time.monotonic()
        if now_s - said_s >= PROGRESS_S:
            said_s = now_s
            station.flush()
            control.send(("progress", station.progress()))
        if control.poll():
            _, finish = control.recv()
            break
    for messages in reception.drain(finish["robot_messages"]):
        put(messages)
    station.close()
    cpu_s, resident = resources()
    control.send(("done", Result(spec.name, cpu_s, resident, extra=station.result())))
    control.recv()
