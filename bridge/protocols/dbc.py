"""Signals of DBC messages, placed by the number of a bit.  Pure."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Final

from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue

BRIDGE: Final = "bridge"
"""The DBC node that sends commands and receives feedback."""


def number(
    name: str,
    start: int,
    bits: int,
    receiver: str,
    scale: float = 1,
    unit: str | None = None,
    signed: bool = True,
    choices: Mapping[int, str] | None = None,
    big_endian: bool = False,
) -> Signal:
    """Returns a signal of whole numbers.  One bit is `scale` in `unit`; `choices` names single values.

    Bit 0 is the lowest bit of byte 0, bit 7 its highest, bit 8 the lowest of byte 1.  `start` is the least significant bit of
    the signal, or the most significant one if it is `big_endian`: 7 for a signal that begins with byte 0, 23 with byte 2."""
    named: OrderedDict[int, str | NamedSignalValue] | None = None if choices is None else OrderedDict(choices)
    conversion = BaseConversion.factory(scale=scale, choices=named)
    return Signal(
        name,
        start,
        bits,
        byte_order="big_endian" if big_endian else "little_endian",
        receivers=[receiver],
        is_signed=signed,
        conversion=conversion,
        unit=unit,
    )


def flags(names: Mapping[int, str], receiver: str) -> list[Signal]:
    """Returns a signal of one bit for each name; `names` are by the number of the bit."""
    return [number(name, bit, 1, receiver, signed=False) for bit, name in names.items()]


def names(kinds: Iterable[IntEnum]) -> dict[int, str]:
    """Returns the names of an enumeration's values in lower case, by value."""
    return {kind.value: kind.name.lower().replace("_", " ") for kind in kinds}
