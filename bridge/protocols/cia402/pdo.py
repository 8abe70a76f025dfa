"""Process data objects (PDOs): their configuration in the object dictionary, and which changes of it are allowed.

transmission type    a TPDO is sent                                             an RPDO acts
0                    on SYNC, if its values have changed                        with the next SYNC
1 .. 240             on every n-th SYNC, n being the type                       with the next SYNC
254, 255             when a state in it changes, but not before its inhibit     when it arrives
                     time is over, and when its event timer expires
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

from echelon.bridge.protocols.cia402.objects import (
    COB_ID,
    EVENT_TIMER,
    INHIBIT,
    NO_REMOTE,
    NOT_VALID,
    OBJECTS,
    PDOS,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    TRANSMISSION,
    Dictionary,
)
from echelon.bridge.protocols.cia402.sdo import Abort, Key, SdoError

SYNCHRONOUS_MAX = 240
BY_ITSELF = (254, 255)
MAX_BITS = 64
COMMUNICATION = (
    *range(RPDO_COMMUNICATION, RPDO_COMMUNICATION + PDOS),
    *range(TPDO_COMMUNICATION, TPDO_COMMUNICATION + PDOS),
)
MAPPING = (*range(RPDO_MAPPING, RPDO_MAPPING + PDOS), *range(TPDO_MAPPING, TPDO_MAPPING + PDOS))
_MAPPING_OFFSET = RPDO_MAPPING - RPDO_COMMUNICATION
# identifiers that PDOs must not use
_RESERVED = (
    *range(0x001, 0x080),
    *range(0x101, 0x181),
    *range(0x581, 0x600),
    *range(0x601, 0x680),
    *range(0x6E0, 0x800),
)


class Pdo(NamedTuple):
    """The configuration of one PDO."""

    number: int
    """Number, counted from 0"""
    can_id: int
    transmission: int
    inhibit_ns: int
    timer_ns: int
    """Event timer [ns]; 0: none"""
    keys: tuple[Key, ...]
    layout: struct.Struct

    @property
    def synchronous(self) -> bool:
        """Whether it is sent, or acts, with SYNC."""
        return self.transmission <= SYNCHRONOUS_MAX


def pdos(od: Dictionary, communication: int, mapping: int) -> tuple[Pdo, ...]:
    """Returns the valid PDOs of one direction."""
    found = []
    for number in range(PDOS):
        cob_id = od[communication + number, COB_ID]
        if cob_id & NOT_VALID or not od[mapping + number, 0]:
            continue
        keys = tuple(_key(od[mapping + number, sub]) for sub in range(1, od[mapping + number, 0] + 1))
        inhibit = od[communication + number, INHIBIT] if communication == TPDO_COMMUNICATION else 0
        found.append(
            Pdo(
                number,
                cob_id & 0x7FF,
                od[communication + number, TRANSMISSION],
                inhibit * 100_000,
                od[communication + number, EVENT_TIMER] * 1_000_000,
                keys,
                struct.Struct("<" + "".join(OBJECTS[key].type.layout.format[1:] for key in keys)),
            )
        )
    return tuple(found)


def pack(pdo: Pdo, values: Sequence[int]) -> bytes:
    """Returns the data of a PDO with these values of its objects; a value out of range is clipped."""
    fitting = [OBJECTS[key].type.clip(value) for key, value in zip(pdo.keys, values, strict=True)]
    return pdo.layout.pack(*fitting)


def check_change(od: Dictionary, key: Key, value: int) -> None:
    """Raises SdoError if an object of a PDO's configuration must not get this value now."""
    index, sub = key
    if index in COMMUNICATION:
        if sub == COB_ID:
            _check_cob_id(od[key], value)
        elif sub == TRANSMISSION and not (value <= SYNCHRONOUS_MAX or value in BY_ITSELF):
            raise SdoError(Abort.VALUE)
    elif index in MAPPING:
        if not od[index - _MAPPING_OFFSET, COB_ID] & NOT_VALID or (sub and od[index, 0]):
            raise SdoError(Abort.DEVICE_STATE)
        if sub:
            _check_entry(value, receives=index < TPDO_MAPPING)
        else:
            entries = [od[index, entry] for entry in range(1, value + 1)]
            if 0 in entries:
                raise SdoError(Abort.NOT_MAPPABLE)
            if sum(entry & 0xFF for entry in entries) > MAX_BITS:
                raise SdoError(Abort.MAPPING_TOO_LONG)


def _check_cob_id(old: int, new: int) -> None:
    can_id = new & ~(NOT_VALID | NO_REMOTE)
    if new & NOT_VALID and can_id == 0:
        return
    if can_id > 0x7FF or can_id == 0 or can_id in _RESERVED:
        raise SdoError(Abort.VALUE)
    if not (old | new) & NOT_VALID and (old ^ new) & 0x7FF:
        raise SdoError(Abort.DEVICE_STATE)


def _check_entry(value: int, receives: bool) -> None:
    entry = OBJECTS.get(_key(value))
    if value == 0:
        return
    if entry is None or not entry.mapped or entry.type.size * 8 != value & 0xFF or (receives and entry.access != "rw"):
        raise SdoError(Abort.NOT_MAPPABLE)


def _key(value: int) -> Key:
    return value >> 16, value >> 8 & 0xFF
