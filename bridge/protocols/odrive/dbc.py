"""DBC messages of CANSimple: the vendor's messages and signals for the nodes of a robot.  Pure."""

import re
from collections import OrderedDict

from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue

from echelon.bridge.protocols.dbc import BRIDGE
from echelon.bridge.protocols.frame import WHEELS
from echelon.bridge.protocols.odrive.codec import MESSAGES, frame_id
from echelon.bridge.protocols.odrive.codec import Message as Layout
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.enums import Command
from echelon.plan.can_plan import DrivePlan


def messages(plan: DrivePlan, robot_name: str, config: ODriveConfig | None = None) -> list[Message]:
    """Returns all messages of a robot's two axes as in the vendor's DBC, with cycle times.

    A message is named <robot>_<wheel>_<vendor's name>; the sender of reports is drive_<robot>_<wheel>."""
    robot = re.sub(r"\W", "_", robot_name, flags=re.ASCII)
    periods_ns = {**(config or ODriveConfig()).periods_ns(plan), Command.SET_INPUT_TORQUE: plan.period_ns}
    found = []
    for node, wheel in zip(plan.node_ids, WHEELS, strict=True):
        drive = f"drive_{robot}_{wheel}"
        for command, layout in MESSAGES.items():
            period_ns = periods_ns.get(layout.command)
            found.append(
                Message(
                    frame_id(node, command),
                    f"{robot}_{wheel}_{layout.name}",
                    layout.length,
                    _signals(layout, BRIDGE if layout.reported else drive),
                    senders=[drive if layout.reported else BRIDGE],
                    cycle_time=None if period_ns is None else -(-period_ns // 1_000_000),
                )
            )
    return found


def _signals(layout: Layout, receiver: str) -> list[Signal]:
    found = []
    for signal, start, bits in layout.bits():
        choices: OrderedDict[int, str | NamedSignalValue] | None = None
        if signal.choices is not None:
            choices = OrderedDict((int(choice), name) for name, choice in signal.choices.__members__.items())
        conversion = BaseConversion.factory(
            scale=signal.scale if signal.kind == "h" else 1, choices=choices, is_float=signal.kind == "f"
        )
        found.append(
            Signal(
                signal.name,
                start,
                bits,
                receivers=[receiver],
                is_signed=signal.kind == "h",
                conversion=conversion,
                unit=signal.unit or None,
            )
        )
    return found
