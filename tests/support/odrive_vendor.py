"""CANSimple frames encoded and decoded with cantools and the vendor's DBC (from the package odrive-can)."""

from typing import Any

from cantools.database.can import Database, Message
from odrive_can import get_dbc

from echelon.bridge.protocols.frame import Frame

VENDOR: Database = get_dbc()
"""Axes 0 to 7"""
BROADCAST = 63


def vendor(command: int, axis: int = 0) -> Message:
    """Returns the DBC's message for a command."""
    return VENDOR.get_message_by_frame_id(axis << 5 | command)


def frame(axis: int, name: str, **values: Any) -> Frame:
    """Returns the frame of a message by the DBC; values that are not given are 0.  Axis 63 stands for all axes."""
    message = VENDOR.get_message_by_name(f"Axis{0 if axis == BROADCAST else axis}_{name}")
    filled = {signal.name: 0 for signal in message.signals} | values
    return Frame(axis << 5 | message.frame_id & 31, message.encode(filled) if filled else b"")


def request(axis: int, name: str, remote: bool = True) -> Frame:
    """Returns the frame that asks for a report."""
    return frame(axis, name)._replace(data=b"", remote=remote)


def heard(frame: Frame, choices: bool = True) -> tuple[int, str, dict[str, Any]]:
    """Returns axis, name and values of a frame."""
    message = VENDOR.get_message_by_frame_id(frame.can_id)
    assert len(frame.data) == message.length
    assert not frame.remote
    values = message.decode(frame.data, decode_choices=choices)
    assert isinstance(values, dict)
    axis, name = message.name.removeprefix("Axis").split("_", 1)
    return int(axis), name, {key: str(v) if hasattr(v, "name") else v for key, v in values.items()}


def last(frames: list[Frame], name: str) -> dict[str, Any]:
    """Returns the values of the last frame of a name."""
    found = [values for _, other, values in map(heard, frames) if other == name]
    assert found, f"no {name}"
    return found[-1]
