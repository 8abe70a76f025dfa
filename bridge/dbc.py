"""The DBC of the native torque frames, for `candump | cantools decode`, SavvyCAN and others. Pure: returns text."""

import math
import re
from collections.abc import Sequence

from cantools.database import Database
from cantools.database.can import Message, Node, Signal
from cantools.database.conversion import BaseConversion

from bridge.native.codec import BASE_ID, CLIPPED, ENABLE, LENGTH, MAX_ROBOTS, RAW_MAX, SATURATED, NativeCodec

_SENDER = "bridge"
_LONGEST = 32 - len("torque_")  # a DBC identifier has at most 32 characters


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
    """The DBC as text: one message `torque_<robot>` for each of `robots`, path names in the order of their numbers.

    `torque_scale` is in N m per bit, `period_ns`, if given, becomes the messages' GenMsgCycleTime (whole milliseconds,
    rounded up). Raises ValueError for a scale that is not positive and finite, or more robots than identifiers."""
    limit = NativeCodec(torque_scale).limit
    if len(robots) > MAX_ROBOTS:
        raise ValueError(f"a bus has identifiers for {MAX_ROBOTS} robots, not {len(robots)}")
    cycle = None if period_ns is None else math.ceil(period_ns / 1_000_000)
    messages, nodes = [], [Node(_SENDER, "turns wheel torques into frames")]
    for number, (robot, name) in enumerate(zip(robots, identifiers(robots), strict=True)):
        drive = f"drive_{name}"
        nodes.append(Node(drive, f"the two wheel drives of {robot}"))
        messages.append(
            Message(
                BASE_ID + number,
                f"torque_{name}",
                LENGTH,
                _signals(drive, torque_scale, limit),
                comment=f"wheel torques of {robot}, one frame per acceleration period",
                senders=[_SENDER],
                cycle_time=cycle,
            )
        )
    return Database(messages, nodes, version="1").as_dbc_string()


def _signals(drive: str, scale: float, limit: float) -> list[Signal]:
    """The fields of the frame, as `bridge.native` lays them out."""

    def torque(name: str, start: int, comment: str) -> Signal:
        return Signal(
            name,
            start,
            16,
            receivers=[drive],
            is_signed=True,
            conversion=BaseConversion.factory(scale=scale),
            minimum=-limit,
            maximum=limit,
            unit="Nm",
            comment=comment,
        )

    def field(name: str, start: int, length: int, comment: str) -> Signal:
        top = 2**length - 1
        return Signal(name, start, length, receivers=[drive], minimum=0, maximum=top, comment=comment)

    def flag(name: str, mask: int, comment: str) -> Signal:
        return field(name, 32 + mask.bit_length() - 1, 1, comment)

    return [
        torque("tau_right", 0, "torque of the right wheel"),
        torque("tau_left", 16, "torque of the left wheel"),
        flag("enable", ENABLE, "0: the drives are to give no torque"),
        flag("clipped", CLIPPED, f"a torque was cut to +-{RAW_MAX} bits"),
        flag("saturated", SATURATED, "the robot's own torque limit was reached"),
        field("counter", 40, 4, "one more with each frame, modulo 16"),
        field("crc", 56, 8, "CRC-8 SAE J1850 over the identifier (u16, little endian) and bytes 0 to 6"),
    ]
