"""What runs a role over a session, in lockstep (`echelon.runtime.lockstep`) or paced by a clock (`echelon.runtime.paced`).

Zenoh's thread calls the handler of a message; the handler puts the message into the mailbox and lets the role act on it.  The
main thread sleeps in between.  Zenoh's thread also sends, so it must never block.  It does not wait for the main thread:
messages that come while the main thread moves the role are put aside, and the main thread takes them.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from functools import partial
from math import gcd

from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.role import Role
from echelon.runtime.admission import Admission, Fits, Refusals
from echelon.runtime.admission_rules import admissions_into
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.session import Publisher, Session
from echelon.runtime.wire import data_key, encode, join, watch_key


@dataclass(slots=True)
class RunnerCounts:
    """Counts of a runner."""

    messages: int = 0
    """Messages sent"""
    thinned: int = 0
    """Messages that were not copied to recorders, by rule (wall clock)"""
    late: int = 0
    """Stages that ran at their deadline with an input missing, or got nothing newer in a whole period (wall clock)"""
    stages: int = 0
    """Stages that ran (wall clock)"""
    latest_ns: int = 0
    """Largest time by which a stage ran after its deadline [ns] (wall clock)"""


class CopyBatcher:
    """Gathers copies of a member's messages into batches, for the recorder and other observers.

    A batch is complete when it has `limit` bytes or is closed.  If the process is killed before it is sent, it is lost."""

    def __init__(self, publisher: Publisher, limit: int) -> None:
        self._put, self._limit = publisher.put, limit
        self._payloads: list[bytes] = []
        self._size = 0
        self.batches: list[bytes] = []
        """Complete batches that are not sent yet"""

    def add(self, payload: bytes) -> bool:
        """Adds a copy of a message; returns True if this completes a batch."""
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


class Runner(ABC):
    """One role of a plan, connected to a session.  The constructor declares all that the role sends and receives.

    `watched` sends copies of its messages to observers, in batches of at most about `batch_bytes`.  With `every_ns` only the
    first message of each channel in every such time is copied, and the others are counted as thinned.
    `frames` are the bounds of frames that it receives."""

    def __init__(
        self,
        role: Role,
        plan: Plan,
        session: Session,
        run: str,
        mailbox: Mailbox,
        *,
        watched: bool,
        batch_bytes: int,
        virtual: bool,
        frames: Fits | None = None,
        every_ns: int = 0,
    ) -> None:
        members = plan.all_roles
        member = members[role.index]
        self.role, self.plan = role, plan
        self._mailbox = mailbox
        self.counts = RunnerCounts()
        channels = sorted({link.channel for link in plan.links if link.source == role.index})
        self._puts = {channel: session.publisher(data_key(run, member.path, channel)).put for channel in channels}
        self._copies: CopyBatcher | None = None
        if watched:
            publisher = session.publisher(watch_key(run, member.role, member.name))
            self._copies = CopyBatcher(publisher, batch_bytes)
        self._every_ns = every_ns
        self._copied: dict[Channel, int] = {}
        """The number of the time `every_ns` in which a message of a channel was last copied"""
        self._tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._stages = list(enumerate(role.stages))

        self._stopping = False  # a signal asked the run to stop
        self._idle = False  # the main thread waits and may be interrupted

        # The thread that holds the lock may use the mailbox and move the role.
        self._lock = threading.Lock()
        self._aside: deque[Message] = deque()  # messages that came while the main thread had the lock
        self._wake = threading.Event()  # set when the main thread has work
        self._time_ns = min(stage.first_ns for stage in role.stages)
        self._at = 0  # the stage that runs next at this instant
        self._finished = False
        self._halted = False  # the run breaks off
        self._failure: BaseException | None = None

        self.refusals = Refusals()
        for admission in admissions_into(plan, role.index, self.refusals, virtual=virtual, frames=frames):
            key = data_key(run, members[admission.source].path, admission.channel)
            session.subscribe(key, partial(self._receive, admission))

    @property
    def mailbox(self) -> Mailbox:
        """The mailbox of the role."""
        return self._mailbox

    @abstractmethod
    def _now_ns(self) -> int:
        """Returns the run time at which the role is, for the admission of messages."""

    @abstractmethod
    def _take(self, message: Message) -> None:
        """Puts a message into the mailbox."""

    @abstractmethod
    def _go_on(self) -> None:
        """Moves the role in Zenoh's thread, after a message."""

    def _receive(self, admission: Admission, payload: bytes) -> None:
        """Takes a payload in Zenoh's thread, and moves the role as far as that lets it.

        Only this thread admits messages, so it needs no lock for that."""
        message = admission.admit(payload, self._now_ns())
        if message is None:
            return
        if not self._lock.acquire(blocking=False):
            self._aside.append(message)
            self._wake.set()
            return
        try:
            if self._aside:
                self._take_aside()
            self._take(message)
            self._go_on()
        except BaseException as error:  # Zenoh would drop it; the main thread raises it
            self._failure = error
            self._wake.set()
        finally:
            self._lock.release()

    def _take_aside(self) -> None:
        """Puts the messages into the mailbox that were put aside."""
        while self._aside:
            self._take(self._aside.popleft())

    def _send(self, message: Message) -> bool:
        """Sends a message; returns True if that completes a batch of copies."""
        payload = encode(message)
        self.counts.messages += 1
        self._puts[message.channel](payload)
        if self._copies is None:
            return False
        if self._every_ns:
            number = message.time_ns // self._every_ns
            if number == self._copied.get(message.channel):
                self.counts.thinned += 1
                return False
            self._copied[message.channel] = number
        return self._copies.add(payload)

    def stop(self) -> None:
        """Ends the run early, for a signal handler in the main thread: raises SystemExit there, at once if it waits, otherwise
        before it waits again."""
        self._stopping = True
        if self._idle:
            self._idle = False
            raise SystemExit(0)

    def halt(self, timeout_s: float) -> None:
        """Stops the role for good, from any thread.  If it is in the middle of a stage for longer than `timeout_s`, it stops
        after that stage."""
        locked = self._lock.acquire(timeout=timeout_s)
        self._halted = True
        self._wake.set()
        if locked:
            self._lock.release()

    def finish(self) -> None:
        """Stops the role for good, and sends the copies that are left."""
        with self._lock:
            self._finished = True
            if self._copies is not None:
                self._copies.close()
        if self._copies is not None:
            self._copies.send()
