"""The object dictionary of a drive: all objects with their types, access rights and defaults.

`OBJECTS` has all objects.  Those whose value depends on the plan have no default there.  A `Dictionary` holds the values of one
node.  Tools read the dictionary from drive.eds (bridge.protocols.cia402.eds).
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from echelon.bridge.protocols.cia402.codec import RPDO_IDS, TPDO_IDS
from echelon.bridge.protocols.cia402.sdo import Abort, Key, SdoError

Value = int | str
Live = Callable[[], int]


class Type(Enum):
    """Data types: the standard's number, and the letter of `struct` (none for text)."""

    I8 = (2, "b")
    I16 = (3, "h")
    I32 = (4, "i")
    U8 = (5, "B")
    U16 = (6, "H")
    U32 = (7, "I")
    TEXT = (9, "")

    def __init__(self, number: int, letter: str) -> None:
        self.number = number
        self.layout = struct.Struct("<" + letter)
        self.size = self.layout.size
        """[bytes]; 0 for text"""
        top = 1 << max(8 * self.size - letter.islower(), 0)
        self.low, self.high = -top if letter.islower() else 0, top - 1

    def clip(self, value: int) -> int:
        """Returns the nearest number that the type can hold."""
        return self.low if value < self.low else self.high if value > self.high else value


@dataclass(frozen=True, slots=True)
class Object:
    """An object, or one subindex of it.

    `access` is `const`, `ro` or `rw`; `mapped` says whether a PDO may carry it; `low` and `high` limit the values."""

    index: int
    sub: int
    name: str
    type: Type
    access: str = "ro"
    default: Value | None = None
    """The first value; None: it depends on the drive"""
    mapped: bool = False
    node_added: bool = False
    """True: the node id is added to the default"""
    low: int | None = None
    high: int | None = None

    @property
    def key(self) -> Key:
        """Index and subindex."""
        return self.index, self.sub


ERROR_REGISTER: Final = (0x1001, 0)
ERRORS: Final = 0x1003
MAX_ERRORS: Final = 4
"""The number of errors in object 1003."""
SYNC_COB_ID: Final = (0x1005, 0)
CONSUMER_HEARTBEAT: Final = (0x1016, 1)
"""Node << 16 | time [ms] of the heartbeat that the drive watches."""
PRODUCER_HEARTBEAT: Final = (0x1017, 0)
COMMUNICATION_ERROR: Final = (0x1029, 1)
RPDO_COMMUNICATION: Final = 0x1400
RPDO_MAPPING: Final = 0x1600
TPDO_COMMUNICATION: Final = 0x1800
TPDO_MAPPING: Final = 0x1A00
COB_ID, TRANSMISSION, INHIBIT, EVENT_TIMER = 1, 2, 3, 5
"""Subindices of a PDO's communication parameters."""
PDOS: Final = 4
"""Number of PDOs of each direction."""
ENTRIES: Final = 8
"""Largest number of objects in a PDO."""
NOT_VALID: Final = 1 << 31
"""Bit in a PDO's COB-ID: the PDO is not used."""
NO_REMOTE: Final = 1 << 30
"""Bit in a TPDO's COB-ID: no remote frame can ask for it."""
TEMPERATURE: Final = (0x2000, 0)
ABORT_CONNECTION: Final = (0x6007, 0)
ERROR_CODE: Final = (0x603F, 0)
CONTROLWORD: Final = (0x6040, 0)
STATUSWORD: Final = (0x6041, 0)
QUICK_STOP_OPTION: Final = (0x605A, 0)
MODE: Final = (0x6060, 0)
MODE_DISPLAY: Final = (0x6061, 0)
POSITION: Final = (0x6064, 0)
VELOCITY: Final = (0x606C, 0)
TARGET_TORQUE: Final = (0x6071, 0)
MAX_TORQUE: Final = (0x6072, 0)
TORQUE_DEMAND: Final = (0x6074, 0)
RATED_CURRENT: Final = (0x6075, 0)
RATED_TORQUE: Final = (0x6076, 0)
TORQUE_ACTUAL: Final = (0x6077, 0)
CURRENT_ACTUAL: Final = (0x6078, 0)
DC_LINK_VOLTAGE: Final = (0x6079, 0)
TORQUE_SLOPE: Final = (0x6087, 0)
SUPPORTED_MODES: Final = (0x6502, 0)

RPDO_MAPPED: Final = ((CONTROLWORD, MODE), (TARGET_TORQUE,), (), ())
"""The objects in each RPDO, by default and by the host's configuration; a PDO without objects is not valid."""
TPDO_MAPPED: Final = ((STATUSWORD, MODE_DISPLAY), (POSITION, TORQUE_ACTUAL), (VELOCITY,), ())

NAMES: Final = {
    0x1003: "pre-defined error field",
    0x1016: "consumer heartbeat time",
    0x1018: "identity",
    0x1029: "error behaviour",
} | {
    base + number: f"{kind} {number + 1} {what}"
    for base, kind, what in (
        (RPDO_COMMUNICATION, "RPDO", "communication parameters"),
        (RPDO_MAPPING, "RPDO", "mapping"),
        (TPDO_COMMUNICATION, "TPDO", "communication parameters"),
        (TPDO_MAPPING, "TPDO", "mapping"),
    )
    for number in range(PDOS)
}
"""Names of the objects with subindices."""

_VARIABLES = (
    Object(0x1000, 0, "device type", Type.U32, "const", 0x0002_0192),  # a servo drive of profile 402
    Object(*ERROR_REGISTER, "error register", Type.U8, "ro", 0, mapped=True),
    Object(*SYNC_COB_ID, "COB-ID SYNC", Type.U32, "rw", 0x80, low=1, high=0x7FF),
    Object(0x1008, 0, "device name", Type.TEXT, "const", "echelon virtual drive"),
    Object(0x1014, 0, "COB-ID EMCY", Type.U32, "ro", 0x80, node_added=True),
    Object(*PRODUCER_HEARTBEAT, "producer heartbeat time [ms]", Type.U16, "rw", 100),
    Object(*TEMPERATURE, "winding temperature [0.1 deg C]", Type.I16, mapped=True),
    Object(*ABORT_CONNECTION, "abort connection option code", Type.I16, "rw", 1, low=0, high=3),
    Object(*ERROR_CODE, "error code", Type.U16, "ro", 0, mapped=True),
    Object(*CONTROLWORD, "controlword", Type.U16, "rw", 0, mapped=True),
    Object(*STATUSWORD, "statusword", Type.U16, "ro", 0, mapped=True),
    Object(*QUICK_STOP_OPTION, "quick stop option code", Type.I16, "rw", 2, low=0, high=6),
    Object(*MODE, "modes of operation", Type.I8, "rw", 0, mapped=True),
    Object(*MODE_DISPLAY, "modes of operation display", Type.I8, "ro", 0, mapped=True),
    Object(*POSITION, "position actual value [counts]", Type.I32, mapped=True),
    Object(*VELOCITY, "velocity actual value [counts/s]", Type.I32, mapped=True),
    Object(*TARGET_TORQUE, "target torque [0.001]", Type.I16, "rw", 0, mapped=True),
    Object(*MAX_TORQUE, "max torque [0.001]", Type.U16, "rw", mapped=True),
    Object(*TORQUE_DEMAND, "torque demand [0.001]", Type.I16, mapped=True),
    Object(*RATED_CURRENT, "motor rated current [mA]", Type.U32),
    Object(*RATED_TORQUE, "motor rated torque [mNm]", Type.U32),
    Object(*TORQUE_ACTUAL, "torque actual value [0.001]", Type.I16, mapped=True),
    Object(*CURRENT_ACTUAL, "current actual value [0.001]", Type.I16, mapped=True),
    Object(*DC_LINK_VOLTAGE, "DC link circuit voltage [mV]", Type.U32, mapped=True),
    Object(*TORQUE_SLOPE, "torque slope [0.001/s]", Type.U32),
    Object(*SUPPORTED_MODES, "supported drive modes", Type.U32, "const", 0x208),  # bits 3 and 9: PT, CST
)


def _array(index: int, kind: Type, access: str, names: Mapping[int, tuple[str, int]]) -> Iterator[Object]:
    yield Object(index, 0, "highest subindex", Type.U8, "const", max(names))
    for sub, (name, default) in names.items():
        yield Object(index, sub, name, kind, access, default)


def _errors() -> Iterator[Object]:
    yield Object(ERRORS, 0, "number of errors", Type.U8, "rw", 0, low=0, high=0)
    for sub in range(1, MAX_ERRORS + 1):
        yield Object(ERRORS, sub, f"error {sub}", Type.U32, "ro", 0)


def _communication(number: int) -> Iterator[Object]:
    """Yields the communication parameters of RPDO and TPDO `number` (from 0)."""
    for index, ids, mapped, flags in (
        (RPDO_COMMUNICATION, RPDO_IDS, RPDO_MAPPED, 0),
        (TPDO_COMMUNICATION, TPDO_IDS, TPDO_MAPPED, NO_REMOTE),
    ):
        cob_id = ids[number] | flags | (0 if mapped[number] else NOT_VALID)
        receives = index == RPDO_COMMUNICATION
        yield Object(index + number, 0, "highest subindex", Type.U8, "const", EVENT_TIMER)
        yield Object(index + number, COB_ID, "COB-ID", Type.U32, "rw", cob_id, node_added=True)
        yield Object(index + number, TRANSMISSION, "transmission type", Type.U8, "rw", 255 if receives else 1)
        if not receives:
            yield Object(index + number, INHIBIT, "inhibit time [0.1 ms]", Type.U16, "rw", 0)
        timer = None if receives and number == 1 else 0  # that of RPDO2 is the watchdog of the plan
        yield Object(index + number, EVENT_TIMER, "event timer [ms]", Type.U16, "rw", timer)


def mapping_value(key: Key) -> int:
    """Returns the mapping entry of an object: index, subindex, length in bits."""
    return key[0] << 16 | key[1] << 8 | _SIZES[key] * 8


def _mapping(number: int) -> Iterator[Object]:
    for index, mapped in ((RPDO_MAPPING, RPDO_MAPPED[number]), (TPDO_MAPPING, TPDO_MAPPED[number])):
        yield Object(index + number, 0, "number of objects", Type.U8, "rw", len(mapped), low=0, high=ENTRIES)
        for sub in range(1, ENTRIES + 1):
            value = mapping_value(mapped[sub - 1]) if sub <= len(mapped) else 0
            yield Object(index + number, sub, f"object {sub}", Type.U32, "rw", value)


_SIZES = {entry.key: entry.type.size for entry in _VARIABLES}
_ALL = [
    *_VARIABLES,
    *_errors(),
    *_array(0x1016, Type.U32, "rw", {1: ("host", 0)}),
    *_array(0x1018, Type.U32, "const", {1: ("vendor", 0), 2: ("product", 1), 3: ("revision", 1), 4: ("serial", 0)}),
    *_array(0x1029, Type.U8, "rw", {1: ("communication error", 1)}),
    *(entry for number in range(PDOS) for entry in (*_communication(number), *_mapping(number))),
]
OBJECTS: Final = {entry.key: entry for entry in sorted(_ALL, key=lambda entry: entry.key)}
INDICES: Final = frozenset(index for index, _ in OBJECTS)


class Dictionary:
    """The objects of one node.  `values` come from the plan and survive a reset, like stored parameters."""

    def __init__(self, node: int, values: Mapping[Key, int]) -> None:
        self._defaults: dict[Key, Value] = {}
        for key, entry in OBJECTS.items():
            value = values.get(key, entry.default if entry.default is not None else 0)
            self._defaults[key] = value + node if entry.node_added and isinstance(value, int) else value
        self.live: dict[Key, Live] = {}
        """Functions that return the present value of an object when it is read."""
        self._values = dict(self._defaults)

    def reset(self, first: int = 0, last: int = 0xFFFF) -> None:
        """Sets the objects from index `first` to `last` to their first values."""
        self._values |= {key: value for key, value in self._defaults.items() if first <= key[0] <= last}

    def __getitem__(self, key: Key) -> int:
        """Returns the value of an object that is a number."""
        live = self.live.get(key)
        value = self._values[key] if live is None else live()
        assert isinstance(value, int)
        return value

    def __setitem__(self, key: Key, value: int) -> None:
        self._values[key] = value

    def read(self, key: Key) -> bytes:
        """Returns the bytes of an object, for SDO.  Raises SdoError if there is no such object."""
        entry = find(key)
        value = self._values[key]
        return value.encode() if isinstance(value, str) else entry.type.layout.pack(entry.type.clip(self[key]))

    def parse(self, key: Key, data: bytes) -> int:
        """Returns the value of the bytes that SDO writes.  Raises SdoError for a read-only object, a wrong length or value."""
        entry = find(key)
        if entry.access != "rw":
            raise SdoError(Abort.READ_ONLY)
        if len(data) != entry.type.size:
            raise SdoError(Abort.LENGTH)
        value: int = entry.type.layout.unpack(data)[0]
        if (entry.low is not None and value < entry.low) or (entry.high is not None and value > entry.high):
            raise SdoError(Abort.VALUE)
        return value


def find(key: Key) -> Object:
    """Returns the object of a key.  Raises SdoError if there is none."""
    entry = OBJECTS.get(key)
    if entry is None:
        raise SdoError(Abort.NO_SUBINDEX if key[0] in INDICES else Abort.NO_OBJECT)
    return entry
