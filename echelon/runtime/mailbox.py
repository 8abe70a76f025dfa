"""The mailbox: takes messages in any order, and says when each stage of a role acts, and with which messages
(docs/architecture.md, 3.3 and 4.6).  This module is about virtual time; on a wall clock there is `wall_mailbox`.

A stage is *due* at each multiple of its period, its nominal instant.  When it acts depends on its `Acts`:

    Acts         in virtual time                                             on a wall clock
    -----------  ----------------------------------------------------------  -----------------------------------------------
    IN_TURN      at the nominal instant, with what has arrived               when no message that should have arrived is
                                                                             missing, at the latest at its turn's deadline
    AT_INSTANT   at the nominal instant, with what has arrived               the same
    WHEN_HEARD   once in its period: at the first instant at which every     the same
                 input has something newer than at the last act, at the
                 latest in the last nanosecond of the period
    ON_ARRIVAL   at the nominal instant, and again at each instant of its    the same
                 period at which something newer arrives, or at which what
                 is in use becomes too old

An input of WHEN_HEARD is not waited for if no message is due on it that is newer than the one used last.  Only messages that
are due by the nominal instant count for an act.  So messages are exchanged as if there were no delays, and no stage waits for
another in a circle.  A role's stages act in their order: none acts before the stage before it has acted.

In virtual time the link knows from the number of a message whether it is lost and how long it takes.  So the mailbox knows
which messages are still missing, and a stage gets the same messages at the same instants whatever the order, the speed and the
process in which they came.  This makes the lockstep.

A message older than its link's timeout is not used: the stage gets None (policy `hold_then_stop`) or zeros (policy `zero`).
"""

from dataclasses import dataclass, field
from math import gcd
from typing import Final

import numpy as np

from echelon.messages import Heard, Message
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.role import Acts, Input, Role, Stage
from echelon.runtime.link import Link, LinkCounts

MAX_AHEAD: Final = 32
"""Number of periods by which a role in a lockstep may be ahead of any of its sources.  On a link with delay or loss a role
needs no new messages for a while; without this limit it would run far ahead, and its messages would pile up at its sources."""

Act = tuple[int, list[Heard]]
"""The instant of an act [ns], and the messages in use then, one for each input of the stage"""


@dataclass(slots=True)
class _Slot:
    """One input of a role: its link and the messages that have come."""

    link: Link
    plan: LinkPlan
    prompt: bool
    first_ns: int
    period_ns: int
    timeout_ns: int
    clocks_are_true: bool
    """As in `plan`; they stand here because they are read at every message"""
    ahead_ns: int | None
    """How far the role may be ahead of the newest message that has come, even if the link loses that message.  None: no limit;
    so on a prompt link, where the role waits for every message anyway"""
    current: Message | None = None
    """The message in use"""
    in_use: int = -1
    """The number of `current`"""
    newer: dict[int, Message] = field(default_factory=dict)
    """Messages that have come with a number above `in_use`, by number, without those that the link loses"""
    newest: int = -1
    """The largest number of a message that has come"""


class Mailbox:
    """All inputs of one role in virtual time.  With `paced`, a link also counts as missing while the role is `MAX_AHEAD`
    periods ahead of its source."""

    def __init__(self, role: Role, plan: Plan, *, paced: bool = False) -> None:
        names = [one.name for one in plan.all_roles]
        tick_ns = gcd(*[stage.period_ns for stage in role.stages])
        self._slots = {
            (link.channel, link.source): _Slot(
                Link(link, plan.seed, names[link.source], names[role.index]),
                link,
                link.prompt,
                link.first_ns,
                link.period_ns,
                link.timeout_ns,
                link.clocks_are_true,
                max(MAX_AHEAD * min(tick_ns, link.period_ns), 2 * tick_ns, 2 * link.period_ns)
                if paced and not link.prompt
                else None,
            )
            for link in plan.links_into(role.index)
        }
        self._stages = role.stages
        self._end_ns = plan.duration_ns
        self._stage_slots = [[self._slot(slot_input) for slot_input in stage.inputs] for stage in role.stages]
        heard_at_once = [all(slot.prompt for slot in slots) for slots in self._stage_slots]
        self.prompt = [all(heard_at_once[: number + 1]) for number in range(len(heard_at_once))]
        """For each stage, whether its inputs and those of the stages before it are all on prompt links.  Then it acts at its
        nominal instants"""
        self._acted_ns = -1 << 62
        """Instant of the role's last act"""

    def _slot(self, slot_input: Input) -> _Slot:
        return self._slots[slot_input.channel, slot_input.source]

    def deliver(self, message: Message) -> None:
        """Takes a message of one of the role's links; the order does not matter.  What comes from other processes has passed an
        `echelon.runtime.admission`."""
        slot = self._slots[message.channel, message.source]
        number = message.sequence
        if number > slot.newest:
            slot.newest = number
        if number > slot.in_use and (slot.prompt or not slot.link.is_lost(number)):  # else it is of no use
            slot.newer[number] = message

    def is_complete(self, stage: int, time_ns: int) -> bool:
        """Returns whether nothing is missing that the stage needs for its period from `time_ns` on, so that it can run."""
        if not self.prompt[stage]:
            return not self.missing(stage, time_ns)
        for slot in self._stage_slots[stage]:  # as `missing`, up to the first message
            number = (time_ns - slot.first_ns) // slot.period_ns
            if number > slot.in_use and number not in slot.newer:
                return False
        return True

    def missing(self, stage: int, time_ns: int) -> list[Link]:
        """Returns the links that miss a message which the stage needs for its period from `time_ns` on."""
        waiting = []
        until_ns = self._last_ns(self._stages[stage], time_ns)
        for slot in self._stage_slots[stage]:
            link = slot.link
            if slot.prompt:
                number = (time_ns - slot.first_ns) // slot.period_ns
                if number > slot.in_use and number not in slot.newer:
                    waiting.append(link)
            elif not link.take_up(time_ns, until_ns, slot.newer, slot.in_use) or (
                slot.ahead_ns is not None and link.sent_ns(slot.newest) < time_ns - slot.ahead_ns
            ):
                waiting.append(slot.link)
        return waiting

    def acts(self, stage: int, time_ns: int) -> list[Act]:
        """Returns the acts of a stage in its period from `time_ns` on.  In a lockstep no message is missing when this is
        called."""
        if self.prompt[stage]:
            return [(time_ns, self.take(stage, time_ns))]
        of, slots = self._stages[stage], self._stage_slots[stage]
        last_ns = self._last_ns(of, time_ns)
        for slot in slots:
            if not slot.prompt:
                slot.link.take_up(time_ns, last_ns, slot.newer, slot.in_use)
        at_ns = max(time_ns, self._acted_ns)
        if of.acts is Acts.WHEN_HEARD:
            for slot in slots:
                at_ns = min(max(at_ns, heard_ns(slot, time_ns, at_ns, last_ns)), last_ns)
            at_ns = min(at_ns, last_ns)
        acts = [(at_ns, self.take(stage, at_ns))]
        if of.acts is Acts.ON_ARRIVAL:
            while (at_ns := self.next_change(stage, at_ns)) <= last_ns:
                acts.append((at_ns, self.take(stage, at_ns)))
        self._acted_ns = acts[-1][0]
        return acts

    def _last_ns(self, stage: Stage, time_ns: int) -> int:
        """Returns the last instant at which a stage may act that is due at `time_ns`: none acts after the end of the run."""
        if stage.acts in (Acts.IN_TURN, Acts.AT_INSTANT):
            return time_ns
        return max(time_ns, min(time_ns + stage.period_ns - 1, self._end_ns))

    def take(self, stage: int, time_ns: int) -> list[Heard]:
        """Returns the messages in use at `time_ns`, one for each input of the stage; None where no message is in use."""
        heard: list[Heard] = []
        for slot in self._stage_slots[stage]:
            newer, link = slot.newer, slot.link
            if slot.prompt:  # as `Link.newest`, without the call
                link.latest = number = (time_ns - slot.first_ns) // slot.period_ns
            else:
                number = link.newest(time_ns)
            if newer and number > slot.in_use:
                message = newer.pop(number, None)
                if message is not None:
                    if newer:  # forget the messages that this one overtakes
                        for overtaken in range(slot.in_use + 1, number):
                            newer.pop(overtaken, None)
                    slot.current, slot.in_use = message, number
            current = slot.current
            if current is None or not current.values.size:
                heard.append(None)
            elif slot.timeout_ns < NEVER_NS and slot.timeout_ns < (
                time_ns - current.time_ns if slot.clocks_are_true else slot.plan.read_age_ns(time_ns, current.time_ns)
            ):
                zeros = slot.plan.policy == "zero"
                heard.append(current._replace(values=np.zeros(current.values.size)) if zeros else None)
            else:
                link.note_use(time_ns, current.sequence, current.time_ns)
                heard.append(current)
        return heard

    def next_change(self, stage: int, time_ns: int) -> int:
        """Returns the first instant after `time_ns` at which a stage hears something newer, or at which a message in use
        becomes too old; `NEVER_NS` if there is none."""
        return min((_change_ns(slot, time_ns) for slot in self._stage_slots[stage]), default=NEVER_NS)

    def counts(self) -> list[LinkCounts]:
        """Returns the counts of every link into this role."""
        return [slot.link.counts() for slot in self._slots.values()]


def heard_ns(slot: _Slot, time_ns: int, at_ns: int, last_ns: int) -> int:
    """Returns the first instant from `at_ns` on at which an input has something newer than is in use, at the latest `last_ns`.

    It is `at_ns` if nothing newer is due at `time_ns`."""
    link = slot.link
    if link.due(time_ns) <= slot.in_use:
        return at_ns
    if slot.prompt or link.latest > slot.in_use:
        return at_ns
    arrives_ns = link.next_arrival(slot.in_use)
    return last_ns if arrives_ns is None else max(at_ns, arrives_ns)


def _change_ns(slot: _Slot, time_ns: int) -> int:
    """Returns the first instant after `time_ns` at which an input changes; `NEVER_NS` if there is none."""
    arrives_ns = slot.link.next_arrival(slot.in_use)
    change_ns = NEVER_NS if arrives_ns is None else arrives_ns
    current = slot.current
    if current is not None and current.values.size and slot.timeout_ns < NEVER_NS:
        expires_ns = slot.plan.expires_ns(current.time_ns)
        if time_ns < expires_ns < change_ns:
            return expires_ns
    return change_ns
