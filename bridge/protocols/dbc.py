"""Signals of DBC messages, as protocols make them: little endian, numbered by their first bit.  Pure."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Final

from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue

BRIDGE: Final = "bridge"
"""Who sends commands and hears feedback."""


def number(
    name: str,
    start: int,
    bits: int,
    receiver: str,
    scale: float = 1,
    unit: str | None = None,
    signed: bool = True,
    choices: Mapping[int, str] | None = None,
) -> Signal:
    """Returns a signal of whole numbers, each `scale` in `unit`, or one of `choices`."""
    named: OrderedDict[int, str | NamedSignalValue] | None = None if choices is None else OrderedDict(choices)
    conversion = BaseConversion.factory(scale=scale, choices=named)
    return Signal(name, start, bits, receivers=[receiver], is_signed=signed, conversion=conversion, unit=unit)


def flags(names: Mapping[int, str], receiver: str) -> list[Signal]:
    """Returns a signal of one bit for each name, by the number of its bit."""
    return [number(name, bit, 1, receiver, signed=False) for bit, name in names.items()]


def names(kinds: Iterable[IntEnum]) -> dict[int, str]:
    """Returns what the values of an enumeration mean, in lower case."""
    return {kind.value: kind.name.lower().replace("_", " ") for kind in kinds}
