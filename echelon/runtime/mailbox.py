"""The mailbox: takes messages in any order, and hands each stage of a role the messages in use at its instant.

At time t a stage needs from each input the message that the link says is in use at t.  The link knows its number without
having seen the message.  So the mailbox knows which messages are still missing, and a stage gets the same messages whatever
the order, the speed and the process in which they came.  This makes the lockstep (docs/architecture.md, 3.3).

A message older than its link's timeout (policy `hold_then_stop`) is not used: the stage gets None.
"""

from dataclasses import dataclass, field
from math import gcd
from typing import Final

from echelon.messages import Heard, Message
from echelon.plan.plan import Plan
from echelon.role import Input, Role
from echelon.runtime.link import Link, LinkCounts

MAX_AHEAD: Final = 32
"""Number of periods by which a role in a lockstep may be ahead of any of its sources.  On a link with delay or loss a role
needs no new messages for a while; without this limit it would run far ahead, and its messages would pile up at its sources."""
SLACK: Final = 4 * MAX_AHEAD
"""Number of messages that an input holds beyond those in flight before it removes messages that its link loses."""


@dataclass(slots=True)
class _Slot:
    """One input of a role: its link and the messages that have come."""

    link: Link
    ideal: bool
    first_ns: int
    period_ns: int
    timeout_ns: int
    size: int | None
    """As in the plan of the link; they stand here because they are read at every message"""
    capacity: int
    """If `newer` holds more messages than this, some of them are lost ones, and these are removed"""
    ahead_ns: int | None
    """How far the role may be ahead of the newest message that has come, even if the link loses that message.  None: no limit;
    so on an ideal link, where the role waits for every message anyway"""
    current: Message | None = None
    """The message in use"""
    in_use: int = -1
    """The number of `current`"""
    newer: dict[int, Message] = field(default_factory=dict)
    """Messages that have come with a number above `in_use`, by number"""
    newest: int = -1
    """The largest number of a message that has come"""


class Mailbox:
    """All inputs of one role.  With `paced`, a link also counts as missing while the role is `MAX_AHEAD` periods ahead of its
    source."""

    def __init__(self, role: Role, plan: Plan, *, paced: bool = False) -> None:
        names = [one.name for one in plan.all_roles]
        tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._slots = {
            (link.channel, link.source): _Slot(
                Link(link, plan.seed, names[link.source], names[role.index]),
                link.ideal,
                link.first_ns,
                link.period_ns,
                link.timeout_ns,
                link.size,
                2 * (link.delay_max_ns // link.period_ns) + SLACK,
                max(MAX_AHEAD * min(tick_ns, link.period_ns), 2 * tick_ns, 2 * link.period_ns)
                if paced and not link.ideal
                else None,
            )
            for link in plan.links_into(role.index)
        }
        self._stage_slots = [[self._slot(slot_input) for slot_input in stage.inputs] for stage in role.stages]
        self.unexpected = 0
        """How many messages came that belong to no link of this role."""
        self.misshapen = 0
        """How many messages came with a wrong number of values for their link."""

    def _slot(self, slot_input: Input) -> _Slot:
        return self._slots[slot_input.channel, slot_input.source]

    def deliver(self, message: Message) -> None:
        """Takes a message; the order does not matter.  Messages of no link and of a wrong size are counted and dropped."""
        slot = self._slots.get((message.channel, message.source))
        if slot is None:
            self.unexpected += 1
        elif message.values.size != slot.size and message.values.size and slot.size is not None:
            self.misshapen += 1
        elif message.sequence > slot.in_use:
            slot.newer[message.sequence] = message
            if message.sequence > slot.newest:
                slot.newest = message.sequence

    def missing(self, stage: int, time_ns: int) -> list[Link]:
        """Returns the links whose message in use at `time_ns` has not come; the list is empty if the stage can run."""
        waiting = []
        for slot in self._stage_slots[stage]:
            number = (time_ns - slot.first_ns) // slot.period_ns if slot.ideal else slot.link.newest(time_ns)
            if (number > slot.in_use and number not in slot.newer) or (
                slot.ahead_ns is not None and slot.link.sent_ns(slot.newest) < time_ns - slot.ahead_ns
            ):
                waiting.append(slot.link)
        return waiting

    def take(self, stage: int, time_ns: int) -> list[Heard]:
        """Returns the messages in use at `time_ns`, one for each input of the stage; None where no message is in use.

        In a lockstep no message is missing when this is called.  On a wall clock one may be missing; then the newest message
        that has come takes its place, unless it is older than the timeout of the link.
        """
        heard: list[Heard] = []
        for slot in self._stage_slots[stage]:
            link, newer = slot.link, slot.newer
            if slot.ideal:  # as `Link.newest`, without the call
                link.latest = number = (time_ns - slot.first_ns) // slot.period_ns
            else:
                number = link.newest(time_ns)
            if newer:
                if number not in newer and number > slot.in_use:
                    number = self._newest_come(slot, time_ns)
                message = newer.pop(number, None)
                if message is not None:
                    if newer:  # forget the messages that this one overtakes
                        for overtaken in range(slot.in_use + 1, number):
                            newer.pop(overtaken, None)
                    slot.current, slot.in_use = message, number
                elif len(newer) > slot.capacity:
                    slot.newer = {each: newer[each] for each in newer if link.fate(each) is not None}
            current = slot.current
            if current is None or not current.values.size or time_ns - current.time_ns > slot.timeout_ns:
                heard.append(None)
            else:
                link.note_use(time_ns, current.sequence, current.time_ns)
                heard.append(current)
        return heard

    @staticmethod
    def _newest_come(slot: _Slot, time_ns: int) -> int:
        """Returns the number of the newest message that has come and has arrived by the rules of its link, or -1."""
        return max((number for number in slot.newer if slot.link.arrived(number, time_ns)), default=-1)

    def counts(self) -> list[LinkCounts]:
        """Returns the counts of every link into this role."""
        return [slot.link.counts() for slot in self._slots.values()]
