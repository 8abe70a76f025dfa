"""Which messages are punctual, and that runs agree: a message that is called punctual is sent at its nominal instant."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from echelon.messages import Channel, Message
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.plan.punctuality import with_punctuality
from echelon.sim.engines.in_process import Engine
from support.points import time_driven
from support.runs import plan_of

MS = 1_000_000


def late(plan: Plan, chosen: Callable[[LinkPlan], bool]) -> Plan:
    """Returns a plan in which some links have a delay of 3 ms."""
    links = [replace(link, delay_min_ns=3 * MS, delay_max_ns=3 * MS) if chosen(link) else link for link in plan.links]
    return replace(plan, links=tuple(with_punctuality(links, plan.nodes)))


def unpunctual(plan: Plan) -> set[tuple[str, str]]:
    """Returns names of sources and channels of the links whose messages may be late."""
    return {(plan.formation[link.source].name, link.channel.name.lower()) for link in plan.links if not link.punctual}


DOWN = {("coordinator", "reference"), ("g1", "command"), ("g2", "command"), ("g3", "command")}
CASES: dict[str, tuple[Callable[[Plan, LinkPlan], bool], set[tuple[str, str]]]] = {
    "nothing is late": (lambda plan, link: False, set()),
    "states of g1 are late": (
        lambda plan, link: link.channel is Channel.STATE and plan.formation[link.receiver].name == "g1",
        DOWN | {("g1", "group_state")},
    ),
    "the group state of g2 is late": (
        lambda plan, link: link.channel is Channel.GROUP_STATE and plan.formation[link.source].name == "g2",
        DOWN,
    ),
    "the reference of g3 is late": (
        lambda plan, link: link.channel is Channel.REFERENCE and plan.formation[link.receiver].name == "g3",
        {("g3", "command")},
    ),
    "commands are late": (lambda plan, link: link.channel is Channel.COMMAND, set()),
}


@pytest.mark.parametrize("case", CASES)
def test_what_a_late_link_makes_late(case: str) -> None:
    chosen, expected = CASES[case]
    whole = plan_of("lab", "duration=0.1")
    plan = late(whole, lambda link: chosen(whole, link))
    assert unpunctual(plan) == expected
    sent: dict[tuple[str, str], set[int]] = {}

    def note(message: Message) -> None:
        period_ns = next(
            link.period_ns for link in plan.links if (link.source, link.channel) == (message.source, message.channel)
        )
        name = plan.formation[message.source].name, message.channel.name.lower()
        sent.setdefault(name, set()).add(message.time_ns - message.sequence * period_ns)

    Engine(plan, note).run()
    assert {name for name, after in sent.items() if after != {0}} == expected
    assert not unpunctual(late(time_driven(whole), lambda link: chosen(whole, link)))
