"""The mailbox on a wall clock: instants are run time, and messages arrive when they really come (docs/architecture.md, 3.6 and
4.6)."""

from dataclasses import replace

from echelon.messages import Heard, Message
from echelon.plan.plan import Plan
from echelon.role import Acts, Role, Stage
from echelon.runtime.arrivals import pack_arrival
from echelon.runtime.mailbox import Act, Mailbox, heard_ns
from echelon.runtime.turns import deadline_ns


class WallMailbox(Mailbox):
    """All inputs of one role on a wall clock.  Instants are run time, and a message arrives when it really comes, or later if
    the scenario gives its link a delay.

    When a stage acts in run time depends on the instants of arrival alone, not on when the process gets to it.  If that is
    later, messages that have come until then, and had been sent by the instant of the act, count as having arrived in that
    instant (`hasten`).  So a run on a wall clock is the run in virtual time whose messages take as long (docs/architecture.md,
    4.6).
    With `noted`, the arrivals are kept for a file (echelon.runtime.arrivals)."""

    def __init__(self, role: Role, plan: Plan, *, noted: bool = False) -> None:
        super().__init__(role, replace(plan, links=tuple(replace(link, punctual=False) for link in plan.links)))
        self._numbers = {
            (link.channel, link.source): number for number, link in enumerate(plan.links) if link.receiver == role.index
        }
        self.arrivals: bytearray | None = bytearray() if noted else None
        """Arrivals that are not in the file yet"""

    def receive(self, message: Message, time_ns: int) -> None:
        """Takes a message of one of the role's links that comes at `time_ns`."""
        slot, number = self._slots[message.channel, message.source], message.sequence
        slot.newest = max(slot.newest, number)
        if number <= slot.in_use or number in slot.newer or slot.link.is_lost(number):
            return
        arrives_ns = slot.link.receive(message, time_ns)
        if arrives_ns is None:
            return
        slot.newer[number] = message
        self._note(message, arrives_ns)

    def _note(self, message: Message, arrives_ns: int) -> None:
        if self.arrivals is not None:
            number = self._numbers[message.channel, message.source]
            self.arrivals += pack_arrival(number, message.sequence, message.time_ns, arrives_ns)

    def hasten(self, stage: int, time_ns: int) -> None:
        """Lets the messages that have come for a stage count from `time_ns` on, if they had been sent by then."""
        for slot in self._stage_slots[stage]:
            for number in slot.link.hasten(time_ns):
                self._note(slot.newer[number], time_ns)

    def ready(self, stage: int, time_ns: int, deadline_ns: int) -> tuple[int, bool]:
        """Returns up to which instant messages count for a stage that is due at `time_ns` if nothing further comes, and whether
        it then misses one.

        `deadline_ns` is the deadline of its turn, for a stage that acts in turn."""
        of, slots = self._stages[stage], self._stage_slots[stage]
        expected = [slot.link.expected(time_ns) for slot in slots]
        if of.acts is Acts.IN_TURN:
            at_ns = time_ns
            for slot, number in zip(slots, expected, strict=True):
                if number > slot.in_use:
                    if number not in slot.newer:
                        return deadline_ns, True
                    at_ns = max(at_ns, slot.link.arrival(number) or at_ns)
            return min(at_ns, deadline_ns), False
        if of.acts is not Acts.WHEN_HEARD:
            return time_ns, False
        at_ns, last_ns = max(time_ns, self._acted_ns), self.last_ns(stage, time_ns)
        for slot in slots:
            at_ns = min(max(at_ns, heard_ns(slot, time_ns, at_ns, last_ns)), last_ns)
        return min(at_ns, last_ns), at_ns >= last_ns and self.misses(stage, time_ns)

    def acts_with_all(self, stage: int, time_ns: int, deadline_ns: int) -> list[Act]:
        """Returns the acts of a stage in its period from `time_ns` on, once all that arrives by `deadline_ns` has been
        received."""
        of = self._stages[stage]
        ready_ns, _ = self.ready(stage, time_ns, deadline_ns)
        acts = [(self.instant(stage, time_ns, ready_ns), self.hear(stage, ready_ns))]
        if of.acts is Acts.ON_ARRIVAL and time_ns < self._end_ns:
            while (at_ns := self.next_act(stage)) <= self.last_ns(stage, time_ns):
                acts.append((at_ns, self.hear(stage, at_ns)))
        return acts

    def instant(self, stage: int, time_ns: int, ready_ns: int) -> int:
        """Returns the instant at which a stage acts that is due at `time_ns`, and for which messages up to `ready_ns` count."""
        return time_ns if self._stages[stage].acts in (Acts.IN_TURN, Acts.AT_INSTANT) else ready_ns

    def last_ns(self, stage: int, time_ns: int) -> int:
        """Returns the last instant at which a stage may act that is due at `time_ns`."""
        return self._last_ns(self._stages[stage], time_ns)

    def hear(self, stage: int, time_ns: int) -> list[Heard]:
        """Returns what a stage hears that acts at `time_ns`."""
        self._acted_ns = time_ns
        return self.take(stage, time_ns)

    def next_act(self, stage: int) -> int:
        """Returns the first instant after its last act at which a stage hears something newer, or at which a message in use
        becomes too old; `NEVER_NS` if there is none."""
        return self.next_change(stage, self._acted_ns)

    def misses(self, stage: int, time_ns: int) -> bool:
        """Returns whether a message that is due at `time_ns` is neither in use nor here."""
        return any(slot.link.due(time_ns) > slot.in_use and not slot.newer for slot in self._stage_slots[stage])


def allowed_ns(plan: Plan, stage: Stage) -> int:
    """Returns how long after it is due a stage acts on a wall clock at the latest [ns]."""
    if stage.acts in (Acts.IN_TURN, Acts.AT_INSTANT):
        return deadline_ns(plan, stage.turn, stage.depth, stage.period_ns)
    return stage.period_ns - 1
