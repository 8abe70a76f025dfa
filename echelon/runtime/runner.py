"""What runs a role over a session, in lockstep (`echelon.runtime.lockstep`) or paced by a clock (`echelon.runtime.paced`).

Zenoh's thread calls the handler of a message; the handler puts the message into the mailbox and lets the role act on it.  The
main thread sleeps in between.  Zenoh's thread also sends, so it must never block.  It does not wait for the main thread:
messages that come while the main thread moves the role are put aside, and the main thread takes them.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from math import gcd

from echelon.messages import Message
from echelon.plan.plan import Plan
from echelon.role import Role
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.session import Publisher, Session
from echelon.runtime.wire import WireError, count_refusal, data_key, decode, encode, join, watch_key


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


class Runner(ABC):
    """One role of a plan, connected to a session.  The constructor declares all that the role sends and receives.

    `watched` sends copies of its messages to observers, in batches of about `batch_bytes`."""

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
            self._copies = CopyBatcher(session.publisher(watch_key(run, member.role, member.name)), batch_bytes)
        self._tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._stages = list(enumerate(role.stages))

        self._stopping = False  # a signal asked the run to stop
        self._idle = False  # the main thread waits and may be interrupted

        # The thread that holds the lock may use the mailbox and move the role.
        self._lock = threading.Lock()
        self._aside: deque[bytes] = deque()  # payloads that came while the main thread had the lock
        self._wake = threading.Event()  # set when the main thread has work
        self._time_ns = min(stage.first_ns for stage in role.stages)
        self._at = 0  # the stage that runs next at this instant
        self._finished = False
        self._failure: BaseException | None = None

        inputs = {slot_input for stage in role.stages for slot_input in stage.inputs}
        keys = sorted(data_key(run, members[one.source].path, one.channel) for one in inputs)
        session.subscribe(keys, self._receive)

    @property
    def mailbox(self) -> Mailbox:
        """The mailbox of the role."""
        return self._mailbox

    @abstractmethod
    def _take(self, message: Message) -> None:
        """Puts a message into the mailbox."""

    @abstractmethod
    def _go_on(self) -> None:
        """Moves the role in Zenoh's thread, after a message."""

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
            self._go_on()
        except BaseException as error:  # Zenoh would drop it; the main thread raises it
            self._failure = error
            self._wake.set()
        finally:
            self._lock.release()

    def _take_aside(self) -> None:
        """Delivers the payloads that were put aside."""
        while self._aside:
            self._deliver(self._aside.popleft())

    def _deliver(self, payload: bytes) -> None:
        """Puts a payload into the mailbox, or counts why it is refused."""
        try:
            message = decode(payload)
        except WireError as error:
            count_refusal(self.counts.refused, error.reason)
            return
        self._take(message)

    def _send(self, message: Message) -> bool:
        """Sends a message; returns True if that completes a batch of copies."""
        payload = encode(message)
        self.counts.messages += 1
        self._puts[message.channel](payload)
        return self._copies is not None and self._copies.add(payload)

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
                ("of no link of this role", self._mailbox.unexpected),
                ("wrong number of values", self._mailbox.misshapen),
            ):
                if count:
                    self.counts.refused[reason] = count
            if self._copies is not None:
                self._copies.close()
        if self._copies is not None:
            self._copies.send()
