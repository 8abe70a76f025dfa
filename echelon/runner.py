"""Runs one role over a session: in lockstep (virtual time), or paced by a clock (wall time).

The loop is the same: for every instant, for every stage that is due, wait for what the mailbox misses, run the stage,
put what it returns.  In a lockstep it waits as long as it takes and says whom it waits for; on a wall clock it waits
until the stage's deadline, counts what was late, and goes on with the newest it has.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import gcd
from typing import Final

from echelon.mailbox import Mailbox
from echelon.messages import Channel, Message
from echelon.plan import Plan
from echelon.role import Role, Stage
from echelon.session import Inbox, Publisher, Session
from echelon.wire import WireError, data_key, decode, encode, join, watch_key

STALL_S: Final = 1.0
"""A lockstep that has waited this long for one message says so, and goes on waiting."""
BATCH_BYTES: Final = 12_000
"""Watchers get messages in batches of about this size in virtual time: far fewer deliveries, far under the limit."""

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
    """Sends copies of a member's messages to those who watch the run, in batches."""

    def __init__(self, publisher: Publisher, limit: int) -> None:
        self._publisher, self._limit = publisher, limit
        self._payloads: list[bytes] = []
        self._size = 0

    def add(self, payload: bytes) -> None:
        """Takes one message; sends the batch if it is full."""
        self._payloads.append(payload)
        self._size += len(payload)
        if self._size >= self._limit:
            self.flush()

    def flush(self) -> None:
        """Sends what has gathered."""
        if self._payloads:
            self._publisher.put(join(self._payloads))
            self._payloads.clear()
            self._size = 0


class Runner:
    """One role of a plan, connected.  Declares everything it sends and receives when it is made."""

    def __init__(self, role: Role, plan: Plan, session: Session, run: str, *, watched: bool, virtual: bool) -> None:
        members = plan.members
        self.role, self.plan = role, plan
        self.mailbox = Mailbox(role, plan)
        self.counts = RunnerCounts()
        inputs = {slot_input for stage in role.stages for slot_input in stage.inputs}
        keys = sorted(data_key(run, members[one.source].path, one.channel) for one in inputs)
        self._inbox: Inbox = session.subscribe(keys)
        channels = sorted({link.channel for link in plan.links if link.source == role.index})
        path = members[role.index].path
        self._publishers: dict[Channel, Publisher] = {
            channel: session.publisher(data_key(run, path, channel)) for channel in channels
        }
        self._watch: Watch | None = None
        if watched:
            key = watch_key(run, members[role.index].name)
            self._watch = Watch(session.publisher(key), BATCH_BYTES if virtual else 0)
        self._tick_ns = gcd(*[stage.period_ns for stage in role.stages])

    def lockstep(self, on_wait: OnWait) -> None:
        """Runs the plan in virtual time, as fast as messages come; `on_wait` is told of every wait beyond `STALL_S`."""
        mailbox, inbox = self.mailbox, self._inbox
        stages = list(enumerate(self.role.stages))
        for time_ns in range(0, self.plan.duration_ns + 1, self._tick_ns):
            for number, stage in stages:
                if time_ns % stage.period_ns:
                    continue
                while missing := mailbox.missing(number, time_ns):
                    payloads = inbox.take(len(missing), STALL_S)
                    self._deliver(payloads)
                    if not payloads:
                        self.flush()
                        on_wait(time_ns, [link.plan.source for link in missing])
                self._run_stage(number, stage, time_ns)
        self.flush()

    def wall_clock(self, start_ns: int) -> None:
        """Runs the plan with run time 0 at `start_ns` of `time.monotonic_ns`.

        Within a period, stages have deadlines in the order of their levels; the last ends with the period.
        """
        levels = max(node.depth for node in self.plan.nodes) * 2 + 3
        mailbox, inbox, counts = self.mailbox, self._inbox, self.counts
        stages = list(enumerate(self.role.stages))
        for time_ns in range(0, self.plan.duration_ns + 1, self._tick_ns):
            _sleep_until(start_ns + time_ns)
            for number, stage in stages:
                if time_ns % stage.period_ns:
                    continue
                deadline_ns = start_ns + time_ns + self._tick_ns * stage.level // levels
                self._deliver(inbox.take(0))
                while missing := mailbox.missing(number, time_ns):
                    left_ns = deadline_ns - time.monotonic_ns()
                    if left_ns <= 0:
                        counts.late += 1
                        break
                    self._deliver(inbox.take(len(missing), left_ns * 1e-9))
                counts.stages += 1
                counts.latest_ns = max(counts.latest_ns, time.monotonic_ns() - deadline_ns if stage.level else 0)
                self._run_stage(number, stage, time_ns)
            self.flush()

    def _run_stage(self, number: int, stage: Stage, time_ns: int) -> None:
        for message in stage.run(time_ns, self.mailbox.take(number, time_ns)):
            self._send(message)

    def _send(self, message: Message) -> None:
        payload = encode(message)
        self.counts.messages += 1
        self._publishers[message.channel].put(payload)
        if self._watch is not None:
            self._watch.add(payload)

    def _deliver(self, payloads: list[bytes]) -> None:
        for payload in payloads:
            try:
                message = decode(payload)
            except WireError as error:
                self.counts.refused[error.reason] = self.counts.refused.get(error.reason, 0) + 1
                continue
            self.mailbox.deliver(message)

    def flush(self) -> None:
        """Sends what is held back for those who watch."""
        if self._watch is not None:
            self._watch.flush()


def _sleep_until(instant_ns: int) -> None:
    """Sleeps until an instant of `time.monotonic_ns`, if that is still to come."""
    left_ns = instant_ns - time.monotonic_ns()
    if left_ns > 0:
        time.sleep(left_ns * 1e-9)
