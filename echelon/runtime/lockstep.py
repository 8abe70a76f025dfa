"""Runs one role in lockstep: in virtual time, as fast as messages come.

The role moves as messages come: Zenoh's thread runs every stage that misses nothing any more.  Between messages the process
sleeps.  The main thread wakes only for work that may block, which is sending batches of copies, and for long sequences of
stages.  Zenoh's thread does not wait for room to put a message: `mailbox.MAX_AHEAD` bounds the messages on their way to a
receiver that reads nothing, and a session has room for 128 KiB.
"""

from collections.abc import Callable
from typing import Final

from echelon.messages import Message
from echelon.plan.plan import Plan
from echelon.role import Role
from echelon.runtime.admission import Fits
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.runner import Runner
from echelon.runtime.session import Session

STALL_S: Final = 1.0
"""After this time without movement a lockstep reports which members it waits for, and goes on waiting [s]."""
BATCH_BYTES: Final = 12_000
"""Size of a batch of copies in virtual time [bytes], about; batches need far fewer deliveries than single messages."""
BATCH_S: Final = 0.08
"""Wall time after which a batch is sent even if it is small [s].  Copies that are not sent are lost if the process is killed:
with those on their way into the recording this must stay below 0.2 s."""
MAX_BATCHES: Final = 2
"""Number of batches that may wait for a slow receiver of copies; with more the role waits, too."""
STRETCH: Final = 64
"""Number of stages that run in Zenoh's thread at a stretch.  A longer sequence goes on in the main thread, so that Zenoh's
thread can receive."""

OnWait = Callable[[int, list[int]], None]
"""Called with an instant [ns] and the indices of the members that the role waits for."""


class LockstepRunner(Runner):
    """One role of a plan in virtual time."""

    def __init__(
        self, role: Role, plan: Plan, session: Session, run: str, *, watched: bool, frames: Fits | None = None
    ) -> None:
        self._in_handler = False  # True: the handler moves the role; False: the main thread does
        self._moved = 0  # stages passed so far, to see whether the role moves at all
        mailbox = Mailbox(role, plan, paced=True)
        super().__init__(
            role,
            plan,
            session,
            run,
            mailbox,
            watched=watched,
            batch_bytes=BATCH_BYTES,
            virtual=True,
            frames=frames,
        )

    def run(self, on_wait: OnWait) -> None:
        """Runs the plan in virtual time, as fast as messages come.  After `STALL_S` without movement, and again after each
        further `STALL_S`, it calls `on_wait`.

            state             entered when                                  what happens, and what ends it
            ----------------  --------------------------------------------  ----------------------------------------------
            main thread       the start; a batch of copies is complete;     the main thread sends batches and runs stages;
                              the handler has run `STRETCH` stages;         it ends when a stage misses a message
                              after `BATCH_S`
            handler           a stage misses a message                      Zenoh's thread runs the stages that a message
                                                                            completes; the main thread sleeps
            finished          the last instant of the plan is over          the main thread sends the last batch and returns
        """
        wait_s = STALL_S if self._copies is None else min(BATCH_S, STALL_S)
        moved, still = -1, 0
        while True:
            with self._lock:
                self._take_aside()
                self._in_handler = not self._advance()
                # read under the lock: later the handler may finish, and leave a batch to send
                finished = self._finished or self._halted
            if self._failure is not None:
                raise self._failure
            if self._copies is not None:
                self._copies.send()
            if finished:
                return
            if not self._wait_for_wake(wait_s):
                with self._lock:
                    missing = [] if self._finished else self._mailbox.missing(self._at, self._time_ns)
                    still = still + 1 if moved == self._moved else 0
                    moved, time_ns = self._moved, self._time_ns
                    if self._copies is not None:
                        self._copies.close()
                if still * wait_s >= STALL_S and missing:
                    still = 0
                    on_wait(time_ns, [link.plan.source for link in missing])
            self._wake.clear()

    def _wait_for_wake(self, wait_s: float) -> bool:
        """Waits until the main thread has work; returns False if it has none for `wait_s`."""
        self._idle = True
        if self._stopping:
            self._idle = False  # a second order to stop must not end what is done now
            raise SystemExit(0)
        woken = not self._in_handler or self._wake.wait(wait_s)
        self._idle = False
        return woken

    def _now_ns(self) -> int:
        return self._time_ns

    def _take(self, message: Message) -> None:
        self._mailbox.deliver(message)

    def _go_on(self) -> None:
        if self._in_handler and self._advance():
            self._in_handler = False
            self._wake.set()

    def _advance(self) -> bool:
        """Runs stages until one misses a message, and returns False.  Returns True if it stops for another reason: the run is
        over or has failed, `STRETCH` stages have run, or `MAX_BATCHES` wait."""
        mailbox, stages, copies = self._mailbox, self._stages, self._copies
        for _ in range(STRETCH):
            if self._finished or self._halted or self._failure is not None:
                return True
            number, stage = stages[self._at]
            if self._time_ns % stage.period_ns == 0:
                if not mailbox.is_complete(number, self._time_ns):
                    return False
                for at_ns, heard in mailbox.acts(number, self._time_ns):
                    for message in stage.run(at_ns, heard):
                        if self._send(message):
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
