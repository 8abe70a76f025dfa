"""Runs one role over a session: in lockstep (virtual time), or paced by a clock (wall clock).

In a lockstep the role moves as messages come.  Zenoh's thread calls the handler of a message; the handler puts the message
into the mailbox and runs every stage that misses nothing any more.  Between messages the process sleeps.  The main thread
wakes only for work that may block, which is sending batches of copies, and for long sequences of stages.

Zenoh's thread also sends, so it must never block.  It does not wait for the main thread: messages that come while the main
thread moves the role are put aside, and the main thread takes them.  It does not wait for room to put a message:
`mailbox.MAX_AHEAD` bounds the messages on their way to a receiver that reads nothing, and a session has room for 128 KiB.

On a wall clock the main thread also wakes at each instant and each deadline.  A stage whose deadline has come runs with the
newest messages that have come, and is counted as late if one was missing (`echelon.runtime.mailbox.WallMailbox`).
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
from echelon.role import Acts, Role, Stage
from echelon.runtime.mailbox import Mailbox, WallMailbox
from echelon.runtime.session import Publisher, Session
from echelon.runtime.turns import deadline_ns
from echelon.runtime.wire import WireError, count_refusal, data_key, decode, encode, join, watch_key

STALL_S: Final = 1.0
"""After this time without movement a lockstep reports which members it waits for, and goes on waiting [s]."""
BATCH_BYTES: Final = 12_000
"""Size of a batch of copies in virtual time [bytes], about; batches need far fewer deliveries than single messages."""
MAX_BATCHES: Final = 4
"""Number of batches that may wait for a slow receiver of copies; with more the role waits, too."""
STRETCH: Final = 64
"""Number of stages that run in Zenoh's thread at a stretch.  A longer sequence goes on in the main thread, so that Zenoh's
thread can receive."""

OnWait = Callable[[int, list[int]], None]
"""Called with an instant [ns] and the indices of the members that the role waits for."""


@dataclass(slots=True)
class RunnerCounts:
    """Counts of a runner."""

    messages: int = 0
    """Messages sent"""
    refused: dict[str, int] = field(default_factory=dict)
    """Received payloads that were not messages for this role, by reason"""
    late: int = 0
    """Stages that ran at their deadline with an input missing, or got nothing newer in a whole period (wall clock)"""
    stages: int = 0
    """Stages that ran (wall clock)"""
    latest_ns: int = 0
    """Largest time by which a stage ran after its deadline [ns] (wall clock)"""


class CopyBatcher:
    """Gathers copies of a member's messages into batches of about `limit` bytes, for the recorder and other observers."""

    def __init__(self, publisher: Publisher, limit: int) -> None:
        self._put, self._limit = publisher.put, limit
        self._payloads: list[bytes] = []
        self._size = 0
        self.batches: list[bytes] = []
        """Complete batches that are not sent yet"""

    def add(self, payload: bytes) -> bool:
        """Adds a copy of one message; returns True if this completes a batch."""
        self._payloads.append(payload)
        self._size += len(payload)
        return self._size >= self._limit and self.close()

    def close(self) -> bool:
        """Completes the batch in progress; returns False if it is empty."""
        if not self._payloads:
            return False
        self.batches.append(join(self._payloads))
        self._payloads.clear()
        self._size = 0
        return True

    def send(self) -> None:
        """Sends all complete batches; in lockstep it blocks while a receiver is behind."""
        while self.batches:
            self._put(self.batches[0])
            del self.batches[0]


class Runner:
    """One role of a plan, connected to a session.  The constructor declares all that the role sends and receives.

    `watched` sends copies of its messages to observers; `virtual` is for `lockstep`, otherwise use `wall_clock`."""

    def __init__(self, role: Role, plan: Plan, session: Session, run: str, *, watched: bool, virtual: bool) -> None:
        members = plan.all_roles
        member = members[role.index]
        self.role, self.plan = role, plan
        self._of_clock = None if virtual else WallMailbox(role, plan)
        self.mailbox = self._of_clock or Mailbox(role, plan, paced=True)
        self.counts = RunnerCounts()
        channels = sorted({link.channel for link in plan.links if link.source == role.index})
        self._puts = {channel: session.publisher(data_key(run, member.path, channel)).put for channel in channels}
        self._copies: CopyBatcher | None = None
        if watched:
            publisher = session.publisher(watch_key(run, member.role, member.name))
            self._copies = CopyBatcher(publisher, BATCH_BYTES if virtual else 0)
        self._tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._stages = list(enumerate(role.stages))

        self._stopping = False  # a signal asked the run to stop
        self._idle = False  # the main thread waits and may be interrupted

        # The thread that holds the lock may use the mailbox and move the role.
        self._lock = threading.Lock()
        self._aside: deque[bytes] = deque()  # payloads that came while the main thread had the lock
        self._wake = threading.Event()  # set when the main thread has work
        self._in_handler = False  # True: the handler moves the role; False: the main thread does
        self._time_ns = min(stage.first_ns for stage in role.stages)
        self._at = 0  # the stage that runs next at this instant
        self._moved = 0  # stages passed so far, to see whether the role moves at all
        self._finished = False
        self._failure: BaseException | None = None
        # On a wall clock: run time 0 in `time.monotonic_ns`, and how long after an instant each stage may wait.
        self._start_ns: int | None = None
        self._allowed_ns: list[int] = []
        self._has_acted = False  # the stage at `_at` has acted, and acts again when something arrives
        self._changed_ns = 0  # run time of its last act

        inputs = {slot_input for stage in role.stages for slot_input in stage.inputs}
        keys = sorted(data_key(run, members[one.source].path, one.channel) for one in inputs)
        session.subscribe(keys, self._receive if virtual else self._receive_paced)

    def lockstep(self, on_wait: OnWait) -> None:
        """Runs the plan in virtual time, as fast as messages come.  After `STALL_S` without movement, and again after each
        further `STALL_S`, it calls `on_wait`.

            state             entered when                                  what happens, and what ends it
            ----------------  --------------------------------------------  ----------------------------------------------
            main thread       the start; a batch of copies is complete;     the main thread sends batches and runs stages;
                              the handler has run `STRETCH` stages          it ends when a stage misses a message
            handler           a stage misses a message                      Zenoh's thread runs the stages that a message
                                                                            completes; the main thread sleeps
            finished          the last instant of the plan is over          the main thread sends the last batch and returns
        """
        last_moved = -1
        while True:
            with self._lock:
                self._take_aside()
                self._in_handler = not self._advance()
                finished = (
                    self._finished
                )  # read under the lock: later the handler may finish, and leave a batch to send
            if self._failure is not None:
                raise self._failure
            if self._copies is not None:
                self._copies.send()
            if finished:
                return
            if not self._wait_for_wake():
                with self._lock:
                    missing = [] if self._finished else self.mailbox.missing(self._at, self._time_ns)
                    moved, time_ns = self._moved, self._time_ns
                    if self._copies is not None:
                        self._copies.close()
                if moved == last_moved and missing:
                    on_wait(time_ns, [link.plan.source for link in missing])
                last_moved = moved
            self._wake.clear()

    def _wait_for_wake(self) -> bool:
        """Waits until the main thread has work; returns False after `STALL_S` without any."""
        self._idle = True
        if self._stopping:
            raise SystemExit(0)
        woken = not self._in_handler or self._wake.wait(STALL_S)
        self._idle = False
        return woken

    def _receive(self, payload: bytes) -> None:
        """Takes a payload in Zenoh's thread in a lockstep, and runs the stages that miss nothing any more."""
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
        except BaseException as error:  # Zenoh would drop it; the main thread raises it
            self._failure, self._in_handler = error, False
            self._wake.set()
        finally:
            self._lock.release()

    def _take_aside(self) -> None:
        """Delivers the payloads that were put aside."""
        while self._aside:
            self._deliver(self._aside.popleft())

    def _advance(self) -> bool:
        """Runs stages until one misses a message, and returns False.  Returns True if it stops for another reason: the run is
        over or has failed, `STRETCH` stages have run, or `MAX_BATCHES` wait."""
        mailbox, stages, copies = self.mailbox, self._stages, self._copies
        for _ in range(STRETCH):
            if self._finished or self._failure is not None:
                return True
            number, stage = stages[self._at]
            if self._time_ns % stage.period_ns == 0:
                if mailbox.missing(number, self._time_ns):
                    return False
                if self._run_stage(number, stage):
                    self._wake.set()  # a batch is complete, and the main thread sends it
            self._moved += 1
            self._at += 1
            if self._at == len(stages):
                self._at = 0
                self._time_ns += self._tick_ns
                self._finished = self._time_ns > self.plan.duration_ns
                if self._finished and copies is not None:
                    copies.close()
            if copies is not None and len(copies.batches) >= MAX_BATCHES:
                return True
        return True

    def wall_clock(self, start_ns: int) -> None:
        """Runs the plan with run time 0 at `start_ns` of `time.monotonic_ns`.

        A stage runs in the handler of the message that completes its inputs.  At its deadline it runs with the messages that
        have come: at the end of its period, or at the deadline of its turn (`echelon.runtime.turns`).
        """
        self._allowed_ns = [
            deadline_ns(self.plan, stage.turn, stage.depth, stage.period_ns)
            if stage.acts in (Acts.IN_TURN, Acts.AT_INSTANT)
            else stage.period_ns - 1
            for stage in self.role.stages
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
        """Runs the stages that are due; returns the instant of `time.monotonic_ns` at which it must be called again, even if
        nothing is received until then."""
        mailbox, counts, start_ns = self._of_clock, self.counts, self._start_ns
        assert mailbox is not None
        assert start_ns is not None
        while not self._finished:
            due_ns = self._time_ns
            if time.monotonic_ns() - start_ns < due_ns:
                return start_ns + due_ns
            for number, stage in self._stages[self._at :]:
                self._at = number
                if due_ns % stage.period_ns:
                    continue
                if not self._has_acted:
                    deadline_ns = due_ns + self._allowed_ns[number]
                    ready_ns, missed = mailbox.ready(number, due_ns, deadline_ns)
                    now_ns = time.monotonic_ns() - start_ns
                    if now_ns < ready_ns:
                        return start_ns + ready_ns
                    counts.late += missed and due_ns < self.plan.duration_ns  # at the end nobody waits any more
                    counts.stages += 1
                    if stage.inputs:
                        counts.latest_ns = max(counts.latest_ns, now_ns - deadline_ns)
                    self._act(number, stage, now_ns)
                if stage.acts is Acts.ON_ARRIVAL and due_ns < self.plan.duration_ns:
                    self._has_acted = True
                    wake_ns = self._on_arrivals(number, stage)
                    if wake_ns is not None:
                        return start_ns + wake_ns
                    self._has_acted = False
            self._at = 0
            self._time_ns += self._tick_ns
            self._finished = self._time_ns > self.plan.duration_ns
            if self._copies is not None:
                self._copies.close()
                self._copies.send()
        return start_ns + self._time_ns

    def _act(self, number: int, stage: Stage, now_ns: int) -> None:
        """Lets a stage act now, at a run time within the period that began when it was due."""
        assert self._of_clock is not None
        at_ns = due_ns = self._time_ns
        if stage.acts in (Acts.WHEN_HEARD, Acts.ON_ARRIVAL):
            at_ns = min(max(now_ns, due_ns), due_ns + stage.period_ns - 1)
        self._changed_ns = max(at_ns, now_ns)
        for message in stage.run(at_ns, self._of_clock.take(number, self._changed_ns)):
            self._send(message)

    def _on_arrivals(self, number: int, stage: Stage) -> int | None:
        """Lets a stage act on what has arrived since its last act; returns the run time at which this must be called again, or
        None if its period is over."""
        assert self._of_clock is not None
        assert self._start_ns is not None
        end_ns = self._time_ns + stage.period_ns
        while (now_ns := time.monotonic_ns() - self._start_ns) < end_ns:
            change_ns = self._of_clock.next_change(number, self._changed_ns)
            if change_ns > now_ns:
                return min(change_ns, end_ns)
            self._act(number, stage, now_ns)
        self.counts.late += self._of_clock.misses(number, self._time_ns)
        return None

    def _receive_paced(self, payload: bytes) -> None:
        """Takes a payload in Zenoh's thread on a wall clock, and runs the stages that are due."""
        if not self._lock.acquire(blocking=False):
            self._aside.append(payload)
            self._wake.set()
            return
        try:
            self._take_aside()
            self._deliver(payload)
            if self._start_ns is not None and self._failure is None:
                self._pace()
        except BaseException as error:  # Zenoh would drop it; the main thread raises it
            self._failure = error
            self._wake.set()
        finally:
            self._lock.release()

    def _rest(self, until_ns: int) -> None:
        """Sleeps until an instant of `time.monotonic_ns`, or until the main thread has work."""
        self._idle = True
        if self._stopping:
            raise SystemExit(0)
        self._wake.wait(max(0, until_ns - time.monotonic_ns()) * 1e-9)
        self._wake.clear()
        self._idle = False

    def stop(self) -> None:
        """Ends the run early, for a signal handler in the main thread: raises SystemExit there, at once if it waits, otherwise
        before it waits again."""
        self._stopping = True
        if self._idle:
            self._idle = False
            raise SystemExit(0)

    def finish(self) -> None:
        """Stops the role for good, sends the copies that are left, and completes the counts."""
        with self._lock:
            self._finished = True
            for reason, count in (
                ("of no link of this role", self.mailbox.unexpected),
                ("wrong number of values", self.mailbox.misshapen),
            ):
                if count:
                    self.counts.refused[reason] = count
            if self._copies is not None:
                self._copies.close()
        if self._copies is not None:
            self._copies.send()

    def _run_stage(self, number: int, stage: Stage) -> bool:
        """Runs a stage that is due in a lockstep, and sends its messages; returns True if this completes a batch of copies."""
        complete = False
        for at_ns, heard in self.mailbox.acts(number, self._time_ns):
            for message in stage.run(at_ns, heard):
                complete |= self._send(message)
        return complete

    def _send(self, message: Message) -> bool:
        payload = encode(message)
        self.counts.messages += 1
        self._puts[message.channel](payload)
        return self._copies is not None and self._copies.add(payload)

    def _deliver(self, payload: bytes) -> None:
        """Puts a payload into the mailbox, or counts why it is refused."""
        try:
            message = decode(payload)
        except WireError as error:
            count_refusal(self.counts.refused, error.reason)
            return
        if self._of_clock is None:
            self.mailbox.deliver(message)
        else:
            self._of_clock.receive(message, time.monotonic_ns() - (self._start_ns or 0))
