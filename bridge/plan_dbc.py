"""The DBC of a plan: every frame of every robot's drives on one bus, for candump, cantools, SavvyCAN.  Pure."""

from typing import Any

from cantools.database import Database
from cantools.database.can import Node

from bridge.dbc import identifiers
from bridge.protocols import dbc_messages
from echelon.plan import Plan


def plan_dbc(plan: Plan, bus: int = 0) -> str:
    """Returns the DBC as text: messages named after robots, with their cycle times."""
    names = identifiers([robot.path for robot in plan.robots])
    messages: list[Any] = []
    for robot, name in zip(plan.robots, names, strict=True):
        if robot.drive.bus == bus:
            messages += dbc_messages(robot.drive, name, robot.index)
    nodes = dict.fromkeys(
        node
        for message in messages
        for node in (*message.senders, *(receiver for signal in message.signals for receiver in signal.receivers))
    )
    return Database(messages, [Node(node, "") for node in nodes], version="1").as_dbc_string()


def dbc_names(plan: Plan) -> list[str]:
    """Returns the names of the files that a run leaves, bus by bus."""
    if len(plan.can.buses) == 1:
        return ["torque.dbc"]
    return [f"torque-{bus.name}.dbc" for bus in plan.can.buses]
