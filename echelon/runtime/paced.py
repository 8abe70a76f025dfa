"""Runs one role paced by a clock, in real time.

A stage runs in Zenoh's thread, with the message that completes its inputs.  The main thread wakes at each instant and each
deadline.  A stage whose deadline has come runs with the newest messages that have come, and is counted as late if one was
missing (`echelon.runtime.wall_mailbox`).

In run time a stage acts in the instant in which the message arrives that completes its inputs, or at its deadline, even if the
process gets to it later.  So what it takes to compute is part of the time that its messages take.
"""

import time
from collections.abc import Callable

from echelon.messages import Message
from echelon.plan.plan import Plan
from echelon.role import Acts, Role, Stage
from echelon.runtime.admission import EARLY_NS
from echelon.runtime.arrivals import END, FLUSH_NS, ArrivalFile, pack_arrival
from echelon.runtime.runner import Runner
from echelon.runtime.session import Session
from echelon.runtime.wall_mailbox import WallMailbox, allowed_ns


class PacedRunner(Runner):
    """One role of a plan on a wall clock.  It notes the arrivals of its messages in `arrivals`, if that is given.

    At each step it calls `beat` with the present instant and the one at which it goes on at the latest, both on the monotonic
    clock [ns].  `every_ns` as for `Runner`."""

    def __init__(
        self,
        role: Role,
        plan: Plan,
        session: Session,
        run: str,
        *,
        watched: bool,
        arrivals: ArrivalFile | None = None,
        beat: Callable[[int, int], None] = lambda now_ns, due_ns: None,
        every_ns: int = 0,
    ) -> None:
        self._inbox = WallMailbox(role, plan, noted=arrivals is not None)
        self._arrivals, self._beat = arrivals, beat
        self._written_ns = 0  # run time of the last write of arrivals
        self._started = False
        self._start_ns = 0  # run time 0 in `time.monotonic_ns`
        self._has_acted = False  # the stage at `_at` has acted, and acts again when something arrives
        self._allowed_ns = [allowed_ns(plan, stage) for stage in role.stages]
        """For each stage how long after it is due it acts at the latest [ns]"""
        super().__init__(
            role,
            plan,
            session,
            run,
            self._inbox,
            watched=watched,
            batch_bytes=0,
            virtual=False,
            every_ns=every_ns,
        )

    def run(self, start_ns: int) -> None:
        """Runs the plan with run time 0 at `start_ns` of `time.monotonic_ns`.

        A stage runs in the handler of the message that completes its inputs.  At its deadline it runs with the messages that
        have come: at the end of its period, or at the deadline of its turn (`echelon.runtime.turns`).
        """
        self._start_ns, self._started = start_ns, True
        while True:
            with self._lock:
                self._take_aside()
                wake_ns = self._step()
            if self._failure is not None:
                raise self._failure
            if self._finished or self._halted:
                return
            self._write_arrivals(FLUSH_NS)
            self._rest(wake_ns)

    def _step(self) -> int:
        """Does the same as `_pace`, with a beat."""
        wake_ns = self._pace()
        self._beat(time.monotonic_ns(), wake_ns)
        return wake_ns

    def _pace(self) -> int:
        """Runs the stages that are due; returns the instant of `time.monotonic_ns` at which it must be called again, even if
        nothing is received until then."""
        mailbox, counts, start_ns = self._inbox, self.counts, self._start_ns
        while not (self._finished or self._halted):
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
                    mailbox.hasten(number, ready_ns)
                    self._act(number, stage, ready_ns)
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

    def _act(self, number: int, stage: Stage, ready_ns: int) -> None:
        """Lets a stage act with what it hears at `ready_ns`, even if that is over."""
        at_ns = self._inbox.instant(number, self._time_ns, ready_ns)
        for message in stage.run(at_ns, self._inbox.hear(number, ready_ns)):
            self._send(message)

    def _on_arrivals(self, number: int, stage: Stage) -> int | None:
        """Lets a stage act on what has arrived since its last act; returns the run time at which this must be called again, or
        None if its period is over."""
        last_ns = self._inbox.last_ns(number, self._time_ns)
        while (change_ns := self._inbox.next_act(number)) <= last_ns:
            if change_ns > time.monotonic_ns() - self._start_ns:
                return change_ns
            self._act(number, stage, change_ns)
        if time.monotonic_ns() - self._start_ns <= last_ns:
            return last_ns + 1
        self.counts.late += self._inbox.misses(number, self._time_ns)
        return None

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._start_ns if self._started else EARLY_NS

    def _take(self, message: Message) -> None:
        # what comes before the start is known counts as having come when it was sent
        self._inbox.receive(message, time.monotonic_ns() - self._start_ns if self._started else message.time_ns)

    def _go_on(self) -> None:
        if self._started and self._failure is None and not self._finished:  # its pulse rests then
            self._step()

    def _write_arrivals(self, after_ns: int) -> None:
        """Writes the arrivals that are not in the file yet, if the last time was `after_ns` ago."""
        now_ns = time.monotonic_ns() - self._start_ns
        if self._arrivals is None or now_ns - self._written_ns < after_ns:
            return
        self._written_ns = now_ns
        with self._lock:
            records, self._inbox.arrivals = bytes(self._inbox.arrivals or b""), bytearray()
        self._arrivals.write(records)

    def finish(self) -> None:
        super().finish()
        self._write_arrivals(0)
        if self._arrivals is not None:
            self._arrivals.write(pack_arrival(END, self.role.index, self._time_ns, self._time_ns))
            self._arrivals.close()

    def _rest(self, until_ns: int) -> None:
        """Sleeps until an instant of `time.monotonic_ns`, or until the main thread has work."""
        self._idle = True
        if self._stopping:
            self._idle = False  # a second order to stop must not end what is done now
            raise SystemExit(0)
        self._wake.wait(max(0, until_ns - time.monotonic_ns()) * 1e-9)
        self._wake.clear()
        self._idle = False
