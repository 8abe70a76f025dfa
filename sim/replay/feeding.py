"""Feeding a recording's messages to roles: what each role sends when it hears what was said then.

Each role is alone.  Its mailbox gets the recorded messages of its sources, whatever other roles say today, so a difference
stays where it begins.  The mailbox and its links decide which message is in use, from the scenario's seed, the link and the
number of the message, as in a run in virtual time (docs/architecture.md, 3.3 and 4.2).

A role keeps its own state: a robot moves from its start under the recorded commands, and its motion adds up.
"""

from collections.abc import Iterator, Sequence
from math import gcd

import numpy as np

from echelon.messages import NULL, Channel, Message
from echelon.plan.plan import LinkPlan, Plan
from echelon.role import Role
from echelon.runtime.mailbox import Mailbox
from echelon.sim.engines.in_process import make_role
from echelon.sim.results.recorded import Recorded, Series


class _Source:
    """The recorded messages of one link into a role, delivered in order of their numbers."""

    def __init__(self, link: LinkPlan, recorded: Recorded) -> None:
        key = link.source, link.channel
        self._link, self._series, self._nulls = link, recorded.series.get(key), recorded.nulls.get(key, {})
        self._number = self._row = 0

    def deliver(self, mailbox: Mailbox, until_ns: int) -> None:
        """Delivers the messages that are due up to `until_ns`; one that was not recorded is missing."""
        link = self._link
        while link.first_ns + self._number * link.period_ns <= until_ns:
            if (message := self._next()) is not None:
                mailbox.deliver(message)
            self._number += 1

    def _next(self) -> Message | None:
        """Returns the message with the present number, if it was recorded."""
        series, row, number, link = self._series, self._row, self._number, self._link
        if series is not None and row < len(series.sequences) and series.sequences[row] == number:
            self._row += 1
            return Message(link.channel, link.source, number, int(series.times_ns[row]), series.values[row])
        if (time_ns := self._nulls.get(number)) is not None:
            return Message(link.channel, link.source, number, time_ns, NULL)
        return None


class _Replayed:
    """One role with its mailbox, its recorded sources, and what it has sent.

    Messages are delivered a period ahead: the mailbox hands them out when their links say."""

    def __init__(self, plan: Plan, recorded: Recorded, index: int) -> None:
        self.role: Role = make_role(plan, index)
        self._mailbox = Mailbox(self.role, plan)
        self._sources = [_Source(link, recorded) for link in plan.links_into(index)]
        self._stages = list(enumerate(self.role.stages))
        self.tick_ns = gcd(*[stage.period_ns for stage in self.role.stages])
        self._ahead_ns = max(stage.period_ns for stage in self.role.stages) - 1
        self._sent: dict[Channel, list[Message]] = {}

    def advance(self, time_ns: int) -> None:
        """Runs the stages of an instant."""
        for source in self._sources:
            source.deliver(self._mailbox, time_ns + self._ahead_ns)
        for number, stage in self._stages:
            if time_ns % stage.period_ns == 0 and time_ns >= stage.first_ns:
                for at_ns, heard in self._mailbox.acts(number, time_ns):
                    for message in stage.run(at_ns, heard):
                        if not message.is_null:
                            self._sent.setdefault(message.channel, []).append(message)

    def series(self) -> Iterator[Series]:
        """Yields the messages with values that the role has sent, channel by channel."""
        for channel, messages in self._sent.items():
            yield Series(
                self.role.index,
                channel,
                np.array([message.sequence for message in messages], np.int64),
                np.array([message.time_ns for message in messages], np.int64),
                np.array([message.values for message in messages]),
            )


class Feeding:
    """Roles of `plan` that are fed a recording's messages up to `until_ns`, exclusive.

    Raises PartRunError while it runs if a part that is not built in fails."""

    def __init__(self, plan: Plan, recorded: Recorded, indices: Sequence[int], until_ns: int) -> None:
        self._plan, self._recorded, self._indices, self._until_ns = plan, recorded, indices, until_ns
        self.series: dict[tuple[int, Channel], Series] = {}
        """What the roles that are done have sent, by source and channel"""

    def instants(self) -> Iterator[int]:
        """Runs all roles, one after the other; yields each instant [ns] when it is done."""
        for index in self._indices:
            one = _Replayed(self._plan, self._recorded, index)
            for time_ns in range(0, self._until_ns, one.tick_ns):
                one.advance(time_ns)
                yield time_ns
            self.series |= {(each.source, each.channel): each for each in one.series()}
