"""When the stages of a plan act in the long run, and which messages they use then, with constant delays.

The acts follow from the links alone, whatever the messages say.  So the mailboxes of the run (`echelon.runtime.mailbox`) are
given messages without content, hyperperiod after hyperperiod, until every stage does in one hyperperiod what it did in those
before it.  That pattern then repeats for ever: all delays are constant, and every message that was on its way when the
pattern began has arrived.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import Final, NamedTuple

import numpy as np

from echelon.controller.prediction.gains import PredictionError
from echelon.messages import Channel, Heard, Message
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan
from echelon.role import Acts, Input, Stage
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.turns import Turn

LONGEST: Final = 5000
"""Longest delay of a link [hyperperiods]: a message on its way is a number of the linear run for each of them"""
MOST: Final = 1000
"""Hyperperiods after which the search for the pattern ends, beside those that messages need"""
NONE: Final = -(1 << 62)
"""Stands for no message"""
_CONTENT: Final = np.zeros(1)


class Act(NamedTuple):
    """One act of a stage."""

    after_ns: int
    """How long after the instant at which the stage was due [ns]"""
    used: tuple[int, ...]
    """Number of the message used from each input, or `NONE`; the first message of the hyperperiod has number 0"""


@dataclass(frozen=True, slots=True)
class TimedStage:
    """A stage as far as its timing goes."""

    turn: Turn
    level: int
    """Its place in the order of an instant"""
    period_ns: int
    member: int
    """Index of its role"""
    inputs: tuple[Input, ...]
    acts: Acts
    says: tuple[tuple[Channel, int], ...]
    """What it sends: channels, with the periods of their messages [ns]"""


Schedule = list[dict[int, list[Act]]]
"""For each stage its acts, by the instant at which it is due in the hyperperiod [ns]"""


def schedule(plan: Plan, stages: Sequence[TimedStage]) -> Schedule:
    """Returns the acts of stages in one hyperperiod in the long run; `stages` are in the order of their levels.

    Raises PredictionError if a stage uses no message of an input, or if there is no pattern."""
    longest_ns = max((link.delay_max_ns for link in plan.links), default=0)
    if longest_ns > LONGEST * plan.root.period_ns:
        raise PredictionError(
            f"delays of up to {longest_ns / 1e9:g} s are too long to compute with: {LONGEST} periods at most"
        )
    run = _DryRun(plan, stages)
    same, needed = 0, 2 + -(-longest_ns // plan.root.period_ns)
    last: Schedule | None = None
    for _ in range(3 * needed + MOST):
        found = run.next_hyperperiod()
        same = same + 1 if found == last else 0
        last = found
        if same >= needed:
            _check(plan, stages, found)
            return found
    raise PredictionError("stages do not act in a pattern that repeats")


class _DryRun:
    """Stages that send messages without content, one hyperperiod after the other."""

    def __init__(self, plan: Plan, stages: Sequence[TimedStage]) -> None:
        self._stages = stages
        self._hyperperiod_ns = plan.root.period_ns
        self._tick_ns = gcd(*(stage.period_ns for stage in stages))
        self._now_ns = 0
        links = tuple(replace(link, size=None, blackouts=()) for link in plan.links)
        plan = replace(plan, links=links, duration_ns=NEVER_NS)
        self._periods = {(link.source, link.channel): link.period_ns for link in plan.links}
        of_member: dict[int, list[TimedStage]] = {}
        for stage in stages:
            of_member.setdefault(stage.member, []).append(stage)
        boxes = {member: Mailbox(_DryRole(member, _stages_of(own)), plan) for member, own in of_member.items()}
        self._boxes = [(boxes[stage.member], of_member[stage.member].index(stage)) for stage in stages]
        self._receivers: dict[tuple[int, Channel], list[Mailbox]] = {}
        for link in plan.links:
            if link.receiver in boxes:
                self._receivers.setdefault((link.source, link.channel), []).append(boxes[link.receiver])

    def next_hyperperiod(self) -> Schedule:
        """Returns the acts of the next hyperperiod."""
        found: Schedule = [{} for _ in self._stages]
        begin_ns = self._now_ns
        for due_ns in range(begin_ns, begin_ns + self._hyperperiod_ns, self._tick_ns):
            for stage, (box, number), acts in zip(self._stages, self._boxes, found, strict=True):
                if due_ns % stage.period_ns:
                    continue
                acts[due_ns - begin_ns] = [
                    Act(at_ns - due_ns, tuple(self._number(message, begin_ns) for message in heard))
                    for at_ns, heard in box.acts(number, due_ns)
                ]
                for channel, period_ns in stage.says:
                    if due_ns % period_ns == 0:
                        sent_ns = due_ns + acts[due_ns - begin_ns][0].after_ns
                        message = Message(channel, stage.member, due_ns // period_ns, sent_ns, _CONTENT)
                        for receiver in self._receivers.get((stage.member, channel), ()):
                            receiver.deliver(message)
        self._now_ns += self._hyperperiod_ns
        return found

    def _number(self, message: Heard, begin_ns: int) -> int:
        """Returns the number of a message as it is counted in the hyperperiod that begins at `begin_ns`."""
        if message is None:
            return NONE
        return message.sequence - begin_ns // self._periods[message.source, message.channel]


@dataclass(frozen=True, slots=True)
class _DryRole:
    """A role whose stages do nothing."""

    index: int
    stages: tuple[Stage, ...]


def _stages_of(own: Sequence[TimedStage]) -> tuple[Stage, ...]:
    """Returns stages that do nothing."""
    return tuple(
        Stage(stage.turn, stage.period_ns, stage.inputs, lambda time_ns, heard: (), acts=stage.acts) for stage in own
    )


def _check(plan: Plan, stages: Sequence[TimedStage], found: Schedule) -> None:
    """Raises PredictionError if a stage uses no message of an input."""
    names = [one.name for one in plan.all_roles]
    links = {(link.source, link.receiver, link.channel): link for link in plan.links}
    for stage, acts in zip(stages, found, strict=True):
        for act in (act for some in acts.values() for act in some):
            for heard, number in zip(stage.inputs, act.used, strict=True):
                if number == NONE:
                    link = links[heard.source, stage.member, heard.channel]
                    raise PredictionError(
                        f"{heard.channel.name.lower()} from {names[heard.source]} to {names[stage.member]} is older than "
                        f"its timeout of {link.timeout_ns / 1e9:g} s when it would be used"
                    )
