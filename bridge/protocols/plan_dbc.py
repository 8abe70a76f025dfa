"""The DBC of a plan: the frames of all drives on one bus, for tools such as cantools and SavvyCAN.  Pure."""

import re
from collections.abc import Sequence
from typing import Any

from cantools.database import Database
from cantools.database.can import Node

from echelon.bridge.protocols.registry import dbc_messages, shared_messages
from echelon.plan.plan import Plan

_LONGEST = 23
"""Longest identifier of a robot: a DBC identifier has up to 32 characters, and protocols add up to 9."""


def identifiers(robots: Sequence[str]) -> list[str]:
    """Returns a valid DBC identifier for each robot's path: g1/r3 becomes g1_r3, cut to fit, made unique by a number."""
    names: list[str] = []
    for robot in robots:
        plain = re.sub(r"\W", "_", robot, flags=re.ASCII)[:_LONGEST]
        name, number = plain, 2
        while name in names:
            suffix = f"_{number}"
            name, number = plain[: _LONGEST - len(suffix)] + suffix, number + 1
        names.append(name)
    return names


def plan_dbc(plan: Plan, bus: int = 0) -> str:
    """Returns the DBC as text: messages named after robots, with their cycle times."""
    names = identifiers([robot.path for robot in plan.robots])
    messages: list[Any] = []
    for robot, name in zip(plan.robots, names, strict=True):
        if robot.drive.bus == bus:
            messages += dbc_messages(robot, name)
    messages += shared_messages(plan, bus)
    nodes = dict.fromkeys(
        node
        for message in messages
        for node in (*message.senders, *(receiver for signal in message.signals for receiver in signal.receivers))
    )
    return Database(messages, [Node(node, "") for node in nodes], version="1").as_dbc_string()


def dbc_names(plan: Plan) -> list[str]:
    """Returns the names of the DBC files in a run's folder, one for each bus."""
    if len(plan.can.buses) == 1:
        return ["torque.dbc"]
    return [f"torque-{bus.name}.dbc" for bus in plan.can.buses]
