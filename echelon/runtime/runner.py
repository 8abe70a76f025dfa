"""Runs one role over a session: in lockstep (virtual time), or paced by a clock (wall time).

In a lockstep the role moves as messages come: the handler of a message puts it into the mailbox and runs every stage that
misses nothing any more, in Zenoh's own thread.  Between messages the process sleeps.  The main thread wakes only for what
may wait for others, sending batches to those who watch, and for long stretches without waiting.

Zenoh's thread also does the sending, so it must never wait: not for the main thread (what comes while that one moves the
role is put aside for it), and not for room to put a message (`mailbox.LEAD` bounds what may be on the way to a receiver
that reads nothing; a session has room for 128 KiB).

On a wall clock it is the same, but that the main thread wakes at each instant and each deadline, and that a stage whose
deadline has come goes on with the newest it has, and counts what was late.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import gcd
from typing import Final

from echelon.messages import Message
from echelon.plan.plan import Plan
from echelon.role import Role, Stage
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.session import Publisher, Session
from echelon.runtime.turns import deadline_ns
from echelon.runtime.wire import WireError, count_refusal, data_key, decode, encode, join, watch_key

STALL_S: Final = 1.0
"""A lockstep that has not moved for so long says whom it waits for, and goes on waiting."""
BATCH_BYTES: Final = 12_000
"""Watchers get messages in batches of about this size in virtual time: far fewer deliveries."""
MAX_BATCHES: Final = 4
"""So many batches may wait for a slow watcher before the role waits, too."""
STRETCH: Final = 64
"""Stages run without a pause; what goes on for longer in Zenoh's thread is the main thread's, so that others get a word."""

OnWait = Callable[[int, list[int]], None]
"""(instant [ns], indices of the members waited for)"""


@dataclass(slots=True)
class RunnerCounts:
    """What a runner saw."""

    messages: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    """Payloads that were no messages for this role, by reason."""
    late: int = 0
    """Stages that ran at their deadline without something they wanted (wall clock)."""
    stages: int = 0
    latest_ns: int = 0
    """Largest lateness of a stage after its deadline (wall clock)."""


class Watch:
    """Gathers copies of a member's messages into batches, for those who watch the run."""

    def __init__(self, publisher: Publisher, limit: int) -> None:
        self._put, self._limit = publisher.put, limit
        self._payloads: list[bytes] = []
        self._size = 0
        self.batches: list[bytes] = []
        """Batches to be sent."""

    def add(self, payload: bytes) -> bool:
        """Takes one message; returns True if that completes a batch."""
        self._payloads.append(payload)
        self._size += len(payload)
        return self._size >= self._limit and self.close()

    def close(self) -> bool:
        """Ends the batch in progress; returns True if there was something in it."""
        if not self._payloads:
            return False
        self.batches.append(join(self._payloads))
        self._payloads.clear()
        self._size = 0
        return True

    def send(self) -> None:
        """Sends all complete batches; waits for watchers that are behind."""
        while self.batches:
            self._put(self.batches[0])
            del self.batches[0]


class Runner:
    """One role of a plan, connected.  Declares everything it sends and receives when it is made."""

    def __init__(self, role: Role, plan: Plan, session: Session, run: str, *, watched: bool, virtual: bool) -> None:
        members = plan.all_roles
        member = members[role.index]
        self.role, self.plan = role, plan
        self.mailbox = Mailbox(role, plan, paced=virtual)
        self.counts = RunnerCounts()
        channels = sorted({link.channel for link in plan.links if link.source == role.index})
        self._puts = {channel: session.publisher(data_key(run, member.path, channel)).put for channel in channels}
        self._watch: Watch | None = None
        if watched:
            watch = session.publisher(watch_key(run, member.role, member.name))
            self._watch = Watch(watch, BATCH_BYTES if virtual else 0)
        self._tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._stages = list(enumerate(role.stages))

        self._stopping = False  # asked to, by a signal
        self._idle = False  # the main thread waits and may be interrupted

        # Whoever holds the lock may touch the mailbox and move the role.
        self._lock = threading.Lock()
        self._aside: deque[bytes] = deque()  # what came while the main thread had the lock
        self._wake = threading.Event()  # there is something for the main thread
        self._in_handler = False  # the handler may move the role; otherwise that is the main thread's turn
        self._time_ns = min(stage.first_ns for stage in role.stages)
        self._at = 0
        self._moved = 0
        self._finished = False
        self._failure: BaseException | None = None
        # On a wall clock: when run time 0 is, and how long after an instant each stage may wait.
        self._start_ns: int | None = None
        self._allowed_ns: list[int] = []

        inputs = {slot_input for stage in role.stages for slot_input in stage.inputs}
        keys = sorted(data_key(run, members[one.source].path, one.channel) for one in inputs)
        session.subscribe(keys, self._receive if virtual else self._receive_paced)

    def lockstep(self, on_wait: OnWait) -> None:
        """Runs the plan in virtual time, as fast as messages come; `on_wait` is told of every wait beyond `STALL_S`."""
        last_moved = -1
        while True:
            with self._lock:
                self._take_aside()
                self._in_handler = not self._advance()
                finished = self._finished  # from here on the handler may finish it, too, with a batch still to send
            if self._failure is not None:
                raise self._failure
            if self._watch is not None:
                self._watch.send()
            if finished:
                return
            if not self._wait_for_wake():
                with self._lock:
                    missing = [] if self._finished else self.mailbox.missing(self._at, self._time_ns)
                    moved, time_ns = self._moved, self._time_ns
                    if self._watch is not None:
                        self._watch.close()
                if moved == last_moved and missing:
                    on_wait(time_ns, [link.plan.source for link in missing])
                last_moved = moved
            self._wake.clear()

    def _wait_for_wake(self) -> bool:
        """Waits until there is something for the main thread; returns False if that takes too long."""
        self._idle = True
        if self._stopping:
            raise SystemExit(0)
        woken = not self._in_handler or self._wake.wait(STALL_S)
        self._idle = False
        return woken

    def _receive(self, payload: bytes) -> None:
        """Takes a payload in Zenoh's thread, and moves the role as far as that lets it."""
        if not self._lock.acquire(blocking=False):
            self._aside.append(payload)
            self._wake.set()
            return
        try:
            if self._aside:
                self._take_aside()
            self._deliver(payload)
            if self._in_handler and self._advance():
                self._in_handler = False
                self._wake.set()
        except BaseException as error:  # nobody above would learn of it
            self._failure, self._in_handler = error, False
            self._wake.set()
        finally:
            self._lock.release()

    def _take_aside(self) -> None:
        while self._aside:
            self._deliver(self._aside.popleft())

    def _advance(self) -> bool:
        """Runs stages until one misses something; returns True if it stopped for another reason."""
        mailbox, stages, watch = self.mailbox, self._stages, self._watch
        for _ in range(STRETCH):
            if self._finished or self._failure is not None:
                return True
            number, stage = stages[self._at]
            if self._time_ns % stage.period_ns == 0:
                if mailbox.missing(number, self._time_ns):
                    return False
                if self._run_stage(number, stage, self._time_ns):
                    self._wake.set()  # a batch is complete: the main thread sends it
            self._moved += 1
            self._at += 1
            if self._at == len(stages):
                self._at = 0
                self._time_ns += self._tick_ns
                self._finished = self._time_ns > self.plan.duration_ns
                if self._finished and watch is not None:
                    watch.close()
            if watch is not None and len(watch.batches) >= MAX_BATCHES:
                return True
        return True

    def wall_clock(self, start_ns: int) -> None:
        """Runs the plan with run time 0 at `start_ns` of `time.monotonic_ns`.

        A stage runs as soon as nothing it wants is missing, in the handler of what came last; at the deadline of its turn
        (`echelon.runtime.turns`) it runs with what there is.
        """
        self._allowed_ns = [
            deadline_ns(self.plan, stage.turn, stage.depth, stage.period_ns) for stage in self.role.stages
        ]
        self._start_ns = start_ns
        while True:
            with self._lock:
                self._take_aside()
                wake_ns = self._pace()
            if self._failure is not None:
                raise self._failure
            if self._finished:
                return
            self._rest(wake_ns)

    def _pace(self) -> int:
        """Runs the stages whose time has come; returns when to come again if nothing is received until then [ns]."""
        mailbox, counts, start_ns = self.mailbox, self.counts, self._start_ns
        assert start_ns is not None
        while not self._finished:
            begins_ns = start_ns + self._time_ns
            if time.monotonic_ns() < begins_ns:
                return begins_ns
            for number, stage in self._stages[self._at :]:
                self._at = number
                if self._time_ns % stage.period_ns:
                    continue
                deadline_ns = begins_ns + self._allowed_ns[number]
                if mailbox.missing(number, self._time_ns):
                    if time.monotonic_ns() < deadline_ns:
                        return deadline_ns
                    counts.late += 1
                counts.stages += 1
                if stage.inputs:
                    counts.latest_ns = max(counts.latest_ns, time.monotonic_ns() - deadline_ns)
                self._run_stage(number, stage, self._time_ns)
            self._at = 0
            self._time_ns += self._tick_ns
            self._finished = self._time_ns > self.plan.duration_ns
            if self._watch is not None:
                self._watch.close()
                self._watch.send()
        return start_ns + self._time_ns

    def _receive_paced(self, payload: bytes) -> None:
        """Takes a payload on a wall clock, in Zenoh's thread, and moves the role as far as that lets it."""
        if not self._lock.acquire(blocking=False):
            self._aside.append(payload)
            self._wake.set()
            return
        try:
            self._take_aside()
            self._deliver(payload)
            if self._start_ns is not None and self._failure is None:
                self._pace()
        except BaseException as error:  # nobody above would learn of it
            self._failure = error
            self._wake.set()
        finally:
            self._lock.release()

    def _rest(self, until_ns: int) -> None:
        """Sleeps until an instant of `time.monotonic_ns`, or until there is something for the main thread."""
        self._idle = True
        if self._stopping:
            raise SystemExit(0)
        self._wake.wait(max(0, until_ns - time.monotonic_ns()) * 1e-9)
        self._wake.clear()
        self._idle = False

    def stop(self) -> None:
        """Breaks the run off with SystemExit in the main thread, between two messages; for a signal handler there."""
        self._stopping = True
        if self._idle:
            self._idle = False
            raise SystemExit(0)

    def finish(self) -> None:
        """Moves the role no more, and sends what is held back for those who watch."""
        with self._lock:
            self._finished = True
            for reason, count in (
                ("of no link of this role", self.mailbox.unexpected),
                ("wrong number of values", self.mailbox.misshapen),
            ):
                if count:
                    self.counts.refused[reason] = count
            if self._watch is not None:
                self._watch.close()
        if self._watch is not None:
            self._watch.send()

    def _run_stage(self, number: int, stage: Stage, time_ns: int) -> bool:
        """Runs a stage and puts what it returns; returns True if that completes a batch for the watchers."""
        complete = False
        for message in stage.run(time_ns, self.mailbox.take(number, time_ns)):
            complete |= self._send(message)
        return complete

    def _send(self, message: Message) -> bool:
        payload = encode(message)
        self.counts.messages += 1
        self._puts[message.channel](payload)
        return self._watch is not None and self._watch.add(payload)

    def _deliver(self, payload: bytes) -> None:
        try:
            message = decode(payload)
        except WireError as error:
            count_refusal(self.counts.refused, error.reason)
            return
        self.mailbox.deliver(message)
