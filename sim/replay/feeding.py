"""Feeding a recording's messages to roles: what each role sends when it hears what was said then.

Each role is alone.  Its mailbox gets the recorded messages of its sources, whatever other roles say today, so a difference
stays where it begins.  The mailbox and its links decide which message is in use, from the scenario's seed, the link and the
number of the message, as in a run in virtual time (docs/architecture.md, 3.3 and 4.2).  Of a run on a wall clock the recorded
instants of arrival decide.

A role keeps its own state: a robot moves from its start under the recorded commands, and its motion adds up.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from math import gcd

import numpy as np

from echelon.messages import NULL, Channel, Message
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.role import Role, Stage
from echelon.runtime.mailbox import Act, Mailbox
from echelon.runtime.wall_mailbox import WallMailbox, allowed_ns
from echelon.sim.engines.in_process import make_role
from echelon.sim.results.arrivals import Arrivals
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


class _Replayed(ABC):
    """One role with what it has sent."""

    def __init__(self, plan: Plan, index: int) -> None:
        self.role: Role = make_role(plan, index)
        self.tick_ns = gcd(*[stage.period_ns for stage in self.role.stages])
        self._sent: dict[Channel, list[Message]] = {}

    def advance(self, time_ns: int) -> None:
        """Runs the stages of an instant."""
        for number, stage in enumerate(self.role.stages):
            if time_ns % stage.period_ns == 0 and time_ns >= stage.first_ns:
                for at_ns, heard in self._acts(number, stage, time_ns):
                    for message in stage.run(at_ns, heard):
                        if not message.is_null:
                            self._sent.setdefault(message.channel, []).append(message)

    @abstractmethod
    def _acts(self, number: int, stage: Stage, time_ns: int) -> Iterable[Act]:
        """Returns the acts of a stage that is due at an instant."""

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


class _InVirtualTime(_Replayed):
    """A role that hears what was said when the links of the plan say.

    Messages are delivered a period ahead: the mailbox hands them out when their links say."""

    def __init__(self, plan: Plan, recorded: Recorded, index: int) -> None:
        super().__init__(plan, index)
        self._mailbox = Mailbox(self.role, plan)
        self._sources = [_Source(link, recorded) for link in plan.links_into(index)]
        self._ahead_ns = max(stage.period_ns for stage in self.role.stages) - 1

    def advance(self, time_ns: int) -> None:
        for source in self._sources:
            source.deliver(self._mailbox, time_ns + self._ahead_ns)
        super().advance(time_ns)

    def _acts(self, number: int, stage: Stage, time_ns: int) -> Iterable[Act]:
        return self._mailbox.acts(number, time_ns)


class _OnAWallClock(_Replayed):
    """A role that hears what was said when it arrived then, whatever the links of the plan say."""

    def __init__(self, plan: Plan, recorded: Recorded, arrivals: Arrivals, index: int) -> None:
        super().__init__(plan, index)
        self._mailbox = WallMailbox(self.role, without_delays(plan))
        self._allowed_ns = [allowed_ns(plan, stage) for stage in self.role.stages]
        self._coming = deque(sorted(_arriving(recorded, arrivals, index), key=lambda each: each[0]))

    def _acts(self, number: int, stage: Stage, time_ns: int) -> Iterable[Act]:
        deadline_ns, coming = time_ns + self._allowed_ns[number], self._coming
        while coming and coming[0][0] <= deadline_ns:
            arrived_ns, message = coming.popleft()
            self._mailbox.receive(message, arrived_ns)
        return self._mailbox.acts_with_all(number, time_ns, deadline_ns)


def without_delays(plan: Plan) -> Plan:
    """Returns a plan whose links deliver everything at once; policies and timeouts stay."""
    return replace(
        plan,
        links=tuple(
            replace(
                link,
                delay_min_ns=0,
                delay_max_ns=0,
                delays=None,
                loss=0.0,
                bursts=None,
                loss_of_message=False,
                duplicates=0.0,
                fifo=False,
                blackouts=(),
            )
            for link in plan.links
        ),
    )


def _arriving(recorded: Recorded, arrivals: Arrivals, index: int) -> Iterator[tuple[int, Message]]:
    """Yields the recorded messages that arrived at a member, each with its instant of arrival [ns]."""
    for number, one in arrivals.links.items():
        link = recorded.plan.links[number]
        if link.receiver == index:
            for message_number, arrived_ns in zip(one.numbers.tolist(), one.counted_ns.tolist(), strict=True):
                message = recorded.message(link.source, link.channel, message_number)
                if message is not None:
                    yield arrived_ns, message


class Feeding:
    """Roles of `plan` that are fed a recording's messages; each role up to an instant of its own, exclusive (`until_ns`, by its
    index).

    Raises PartRunError while it runs if a part that is not built in fails."""

    def __init__(self, plan: Plan, recorded: Recorded, until_ns: Mapping[int, int]) -> None:
        self._plan, self._recorded, self._until_ns = plan, recorded, until_ns
        self.series: dict[tuple[int, Channel], Series] = {}
        """What the roles that are done have sent, by source and channel"""

    def instants(self) -> Iterator[int]:
        """Runs all roles, one after the other; yields each instant [ns] when it is done."""
        arrivals = self._recorded.arrivals
        for index, until_ns in self._until_ns.items():
            one: _Replayed
            if arrivals is None:
                one = _InVirtualTime(self._plan, self._recorded, index)
            else:
                one = _OnAWallClock(self._plan, self._recorded, arrivals, index)
            for time_ns in range(0, until_ns, one.tick_ns):
                one.advance(time_ns)
                yield time_ns
            self.series |= {(each.source, each.channel): each for each in one.series()}
