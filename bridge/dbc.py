"""The DBC of the native frames, for `candump | cantools decode`, SavvyCAN and others. Pure: returns text."""

import re
from collections.abc import Sequence

from cantools.database import Database
from cantools.database.can import Node

from bridge.native.codec import MAX_ROBOTS, NativeCodec
from bridge.native.dbc import BRIDGE, KINDS, drive_node, make_messages

_LONGEST = 32 - len("_") - max(map(len, KINDS))  # a DBC identifier has at most 32 characters


def identifiers(robots: Sequence[str]) -> list[str]:
    """A valid DBC identifier for each robot's path name: g1/r3 becomes g1_r3, cut to fit, made unique by a number."""
    names: list[str] = []
    for robot in robots:
        plain = re.sub(r"\W", "_", robot, flags=re.ASCII)[:_LONGEST]
        name, number = plain, 2
        while name in names:
            suffix = f"_{number}"
            name, number = plain[: _LONGEST - len(suffix)] + suffix, number + 1
        names.append(name)
    return names


def torque_dbc(robots: Sequence[str], torque_scale: float, period_ns: int | None = None) -> str:
    """The DBC as text: messages `torque_<robot>`, `feedback_<robot>` and `status_<robot>` for each of `robots`, path
    names in the order of their numbers.

    `torque_scale` is in N m per bit, `period_ns`, if given, becomes the messages' GenMsgCycleTime (whole milliseconds,
    rounded up). Raises ValueError for a scale that is not positive and finite, or more robots than identifiers."""
    NativeCodec(torque_scale)  # which checks the scale
    if len(robots) > MAX_ROBOTS:
        raise ValueError(f"a bus has identifiers for {MAX_ROBOTS} robots, not {len(robots)}")
    messages, nodes = [], [Node(BRIDGE, "turns wheel torques into frames")]
    for number, (robot, name) in enumerate(zip(robots, identifiers(robots), strict=True)):
        nodes.append(Node(drive_node(name), f"the drive of both wheels of {robot}"))
        messages += make_messages(torque_scale, name, number, period_ns, robot)
    return Database(messages, nodes, version="1").as_dbc_string()
