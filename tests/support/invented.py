"""Invented messages of the paper's formation, for tests of code that only transports messages."""

from collections.abc import Iterator
from functools import cache

import numpy as np

from echelon import shipped
from echelon.messages import GROUP_FIELDS, STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.sim.parts.loading import load

METADATA = {"version": "0.1.0", "host": "any"}


@cache
def paper() -> Plan:
    """Returns the plan of the paper's scenario."""
    return load(shipped.FOLDER / "paper.toml")[1]


def invented(plan: Plan, ticks: int, seed: int = 1) -> Iterator[Message]:
    """Yields a run's messages in the order of time and source; at time 0 those of the nodes are null messages."""
    random = np.random.default_rng(seed)
    rates, robots = 2 * len(plan.robots), len(plan.robots)
    for tick in range(ticks):
        time_ns = tick * plan.robots[0].period_ns
        for robot in plan.robots:
            yield Message(Channel.STATE, robot.index, tick, time_ns, random.normal(size=len(STATE_FIELDS)))
        for node in plan.nodes:
            sizes = {Channel.COMMAND: 2 * len(node.children)}
            if node.parent is None:
                sizes = {Channel.REFERENCE: 2 * len(node.children) + rates}
            else:
                sizes[Channel.GROUP_STATE] = len(GROUP_FIELDS) + 2 * (node.robots - 1)
            for channel, size in sizes.items():
                yield Message(channel, node.index, tick, time_ns, random.normal(size=size if tick else 0))
    assert robots == 9
    assert plan.coupled
    assert not plan.avoidance.enabled
