"""The mailbox: between messages as they come and a role's stages as they want them.

Data flow makes the lockstep: at time t a stage needs, of each input, exactly the message its link says is in use at t.
The link knows that number without having seen the message, so the mailbox can say what is still missing, and a stage
that runs has heard the same whatever the order, the speed or the process in which messages came.

A message that is older than its link's timeout (policy `hold_then_stop`) is as if it had not come.
"""

from dataclasses import dataclass, field
from math import gcd
from typing import Final

from echelon.messages import Heard, Message
from echelon.plan.plan import LinkPlan, Plan
from echelon.role import Input, Role
from echelon.runtime.link import Link, LinkCounts

LEAD: Final = 32
"""Periods by which a role in a lockstep may be ahead of any of its sources.  A link that is late or loses would let it run
on without them, and what it sends would pile up in front of them."""
SLACK: Final = 4 * LEAD
"""Messages that an input may hold beyond those in flight before it looks for lost ones among them."""


@dataclass(slots=True)
class _Slot:
    """One input: its link, the message in use with its number, and the newer ones that have come, by number."""

    link: Link
    plan: LinkPlan
    many: int
    """More messages than this cannot all be in flight: those that the link loses are then forgotten."""
    lead_ns: int | None
    """How far the role may be ahead of the newest message that has come, whatever the link does with it; None: no limit, or
    an ideal link, where the role waits for every message anyway."""
    current: Message | None = None
    in_use: int = -1
    newer: dict[int, Message] = field(default_factory=dict)
    newest: int = -1


class Mailbox:
    """All inputs of one role; with `paced`, the role also misses something while it is `LEAD` ahead of a source."""

    def __init__(self, role: Role, plan: Plan, *, paced: bool = False) -> None:
        names = [one.name for one in plan.all_roles]
        tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._slots = {
            (link.channel, link.source): _Slot(
                Link(link, plan.seed, names[link.source], names[role.index]),
                link,
                2 * (link.delay_max_ns // link.period_ns) + SLACK,
                max(LEAD * min(tick_ns, link.period_ns), 2 * tick_ns, 2 * link.period_ns)
                if paced and not link.ideal
                else None,
            )
            for link in plan.links_into(role.index)
        }
        self._stage_slots = [[self._slot(slot_input) for slot_input in stage.inputs] for stage in role.stages]
        self.unexpected = 0
        """Messages that no link of this role accounts for."""
        self.misshapen = 0
        """Messages with a number of values that their channel does not have."""

    def _slot(self, slot_input: Input) -> _Slot:
        return self._slots[slot_input.channel, slot_input.source]

    def deliver(self, message: Message) -> None:
        """Takes a message, in whatever order it comes."""
        slot = self._slots.get((message.channel, message.source))
        if slot is None:
            self.unexpected += 1
        elif message.values.size != slot.plan.size and message.values.size and slot.plan.size is not None:
            self.misshapen += 1
        elif message.sequence > slot.in_use:
            slot.newer[message.sequence] = message
            if message.sequence > slot.newest:
                slot.newest = message.sequence

    def missing(self, stage: int, time_ns: int) -> list[Link]:
        """Returns the links whose message in use at `time_ns` has not come; empty if the stage can run."""
        waiting = []
        for slot in self._stage_slots[stage]:
            link = slot.link
            number = link.newest(time_ns)
            if (number > slot.in_use and number not in slot.newer) or (
                slot.lead_ns is not None and link.sent_ns(slot.newest) < time_ns - slot.lead_ns
            ):
                waiting.append(link)
        return waiting

    def take(self, stage: int, time_ns: int) -> list[Heard]:
        """Returns what the stage hears at `time_ns`.

        In a lockstep nothing is missing by then.  On a wall clock something may be: then the newest that has come is
        used instead, as the link's policy has it.
        """
        heard: list[Heard] = []
        for slot in self._stage_slots[stage]:
            link, newer = slot.link, slot.newer
            number = link.newest(time_ns)
            if newer:
                if number not in newer and number > slot.in_use:
                    number = self._newest_come(slot, time_ns)
                message = newer.pop(number, None)
                if message is not None:
                    if newer:  # those that this one overtakes
                        for overtaken in range(slot.in_use + 1, number):
                            newer.pop(overtaken, None)
                    slot.current, slot.in_use = message, number
                elif len(newer) > slot.many:
                    slot.newer = {each: newer[each] for each in newer if link.fate(each) is not None}
            current = slot.current
            if current is None or not current.values.size or time_ns - current.time_ns > slot.plan.timeout_ns:
                heard.append(None)
            else:
                link.note_use(time_ns, current.sequence, current.time_ns)
                heard.append(current)
        return heard

    @staticmethod
    def _newest_come(slot: _Slot, time_ns: int) -> int:
        """Returns the number of the newest message that has come and that the link lets arrive by now, or -1."""
        return max((number for number in slot.newer if slot.link.arrived(number, time_ns)), default=-1)

    def counts(self) -> list[LinkCounts]:
        """Returns the counts of every link into this role."""
        return [slot.link.counts() for slot in self._slots.values()]
