"""CANopen frames, and the control- and statusword of a CiA 402 drive.  Little endian; identifiers of the predefined set:

    0x000        NMT command: u8 command, u8 node (0: all)
    0x080        SYNC: no data
    0x080 + node EMCY: u16 error code, u8 error register, 5 bytes of the maker's (here zero)
    0x180, 0x280, 0x380, 0x480 + node   TPDO1 .. 4, from the drive
    0x200, 0x300, 0x400, 0x500 + node   RPDO1 .. 4, to the drive
    0x580 + node SDO answer; 0x600 + node SDO request, 8 bytes each (bridge.protocols.cia402.sdo)
    0x700 + node heartbeat: u8 NMT state; with state 0 the boot-up message

The host maps the PDOs in this way:

    RPDO1  u16 controlword, i8 mode of operation          sent when it changes
    RPDO2  i16 target torque [‰ of the rated torque]      sent once per period, acts when it arrives
    TPDO1  u16 statusword, i8 mode of operation           on SYNC
    TPDO2  i32 position [counts], i16 torque [‰]          on SYNC; the torque is the mean since the last SYNC
    TPDO3  i32 velocity [counts/s]                        on SYNC
"""

import math
import struct
from enum import Enum, IntEnum
from typing import NamedTuple

from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame

NMT_ID = 0x000
SYNC_ID = 0x080
EMCY_ID = 0x080
TPDO_IDS = (0x180, 0x280, 0x380, 0x480)
RPDO_IDS = (0x200, 0x300, 0x400, 0x500)
SDO_ANSWER_ID = 0x580
SDO_REQUEST_ID = 0x600
HEARTBEAT_ID = 0x700
NODE_IDS = (EMCY_ID, *TPDO_IDS, *RPDO_IDS, SDO_ANSWER_ID, SDO_REQUEST_ID, HEARTBEAT_ID)
"""The bases of a node's identifiers, to which its node id is added."""
MAX_NODE = 126
HOST_NODE = 127
"""Node id of the host's heartbeat; drives have 1 .. 126."""
PERMILLE_MAX = 32767

MODE_NONE = 0
MODE_PROFILE_TORQUE = 4
MODE_CYCLIC_TORQUE = 10

RPDO1 = struct.Struct("<Hb")
RPDO2 = struct.Struct("<h")
TPDO1 = struct.Struct("<Hb")
TPDO2 = struct.Struct("<ih")
TPDO3 = struct.Struct("<i")
EMCY = struct.Struct("<HB5x")


class Nmt(IntEnum):
    """NMT state of a node, as in the byte of its heartbeat (bridge.protocols.cia402.node)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """NMT command of the host."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class State(Enum):
    """States of the drive (bridge.protocols.cia402.drive): their bits in the statusword, and the mask of these bits."""

    NOT_READY_TO_SWITCH_ON = (0x00, 0x4F)
    SWITCH_ON_DISABLED = (0x40, 0x4F)
    READY_TO_SWITCH_ON = (0x21, 0x6F)
    SWITCHED_ON = (0x23, 0x6F)
    OPERATION_ENABLED = (0x27, 0x6F)
    QUICK_STOP_ACTIVE = (0x07, 0x6F)
    FAULT_REACTION_ACTIVE = (0x0F, 0x4F)
    FAULT = (0x08, 0x4F)

    @property
    def bits(self) -> int:
        """The bits of this state in the statusword."""
        return self.value[0]

    @property
    def words(self) -> str:
        """The standard's name of the state."""
        return self.name.replace("_", " ")


_STATES = tuple(next((s for s in State if low & s.value[1] == s.value[0]), None) for low in range(128))

VOLTAGE_ENABLED = 1 << 4
REMOTE = 1 << 9
INTERNAL_LIMIT = 1 << 11
FOLLOWS_COMMAND = 1 << 12


def state_of(statusword: int) -> State | None:
    """Returns the state in a statusword; None if its bits stand for no state."""
    return _STATES[statusword & 0x7F]


class Command(Enum):
    """Commands in a controlword; the value is a controlword with this command."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    """From OPERATION ENABLED this is the command disable operation"""
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


_FAULT_RESET_BIT = 0x80
HALT = 1 << 8


def command_of(controlword: int, last: int) -> Command:
    """Returns the command in a controlword; `last` is the one before it, since a fault reset is a rising edge."""
    if controlword & ~last & _FAULT_RESET_BIT:
        return Command.FAULT_RESET
    if not controlword & 2:
        return Command.DISABLE_VOLTAGE
    if not controlword & 4:
        return Command.QUICK_STOP
    if not controlword & 1:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 8 else Command.SWITCH_ON


TRANSITIONS = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,  # 2
    (State.READY_TO_SWITCH_ON, Command.SWITCH_ON): State.SWITCHED_ON,  # 3
    (State.READY_TO_SWITCH_ON, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,  # 3 and 4
    (State.SWITCHED_ON, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,  # 4
    (State.OPERATION_ENABLED, Command.SWITCH_ON): State.SWITCHED_ON,  # 5
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,  # 6
    (State.READY_TO_SWITCH_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 7
    (State.READY_TO_SWITCH_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,  # 7
    (State.OPERATION_ENABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,  # 8
    (State.OPERATION_ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 9
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 10
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,  # 10
    (State.OPERATION_ENABLED, Command.QUICK_STOP): State.QUICK_STOP_ACTIVE,  # 11
    (State.QUICK_STOP_ACTIVE, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 12
    (State.FAULT, Command.FAULT_RESET): State.SWITCH_ON_DISABLED,  # 15
    (State.QUICK_STOP_ACTIVE, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,  # 16
}
"""The next state by state and command, with the standard's number of the transition.  Other commands change nothing."""


def next_state(state: State, controlword: int, last: int) -> State:
    """Returns the state after a controlword; `last` is the one before it.

    Outside FAULT, the bit fault reset is ignored and the other bits count."""
    command = command_of(controlword, last)
    if command is Command.FAULT_RESET and state is not State.FAULT:
        command = command_of(controlword & ~_FAULT_RESET_BIT, 0)
    return TRANSITIONS.get((state, command), state)


AUTOMATIC = {
    State.NOT_READY_TO_SWITCH_ON: State.SWITCH_ON_DISABLED,  # 1
    State.QUICK_STOP_ACTIVE: State.SWITCH_ON_DISABLED,  # 12
    State.FAULT_REACTION_ACTIVE: State.FAULT,  # 14
}
"""Transitions without a command, except 13, which leads from any state to FAULT REACTION ACTIVE."""


class ErrorCode(IntEnum):
    """Error codes of emergency messages and of object 603F."""

    NONE = 0
    UNDERVOLTAGE = 0x3220
    OVER_TEMPERATURE = 0x4310
    ENCODER = 0x7305
    HEARTBEAT = 0x8130
    RPDO_TIMEOUT = 0x8250

    @property
    def register(self) -> int:
        """The bits of this error in the error register, object 1001: bit 0, and a bit for its kind."""
        return _REGISTERS[self]


_REGISTERS = {
    ErrorCode.NONE: 0x00,
    ErrorCode.UNDERVOLTAGE: 0x05,
    ErrorCode.OVER_TEMPERATURE: 0x09,
    ErrorCode.ENCODER: 0x21,
    ErrorCode.HEARTBEAT: 0x11,
    ErrorCode.RPDO_TIMEOUT: 0x11,
}
FAULT_CODES = {
    Fault.OVER_TEMPERATURE: ErrorCode.OVER_TEMPERATURE,
    Fault.ENCODER_LOSS: ErrorCode.ENCODER,
    Fault.BROWN_OUT: ErrorCode.UNDERVOLTAGE,
}


def error_text(code: int) -> str:
    """Returns an error code as a number, with its name if it is one of `ErrorCode`."""
    try:
        return f"0x{code:04X} {ErrorCode(code).name.lower().replace('_', ' ')}"
    except ValueError:
        return f"0x{code:04X}"


class Emergency(NamedTuple):
    """The content of an emergency message."""

    code: int
    register: int


def check_node(node: int) -> int:
    """Returns a drive's node id.  Raises ValueError for one outside 1 .. 126."""
    if not 1 <= node <= MAX_NODE:
        raise ValueError(f"CANopen node id must be 1 .. {MAX_NODE}, not {node!r}")
    return node


def nmt(command: NmtCommand, node: int) -> Frame:
    """Returns the frame with an NMT command for a node; node 0 means all."""
    return Frame(NMT_ID, bytes((command, node)))


def heartbeat(node: int, state: Nmt) -> Frame:
    """Returns a node's heartbeat."""
    return Frame(HEARTBEAT_ID + node, bytes((state,)))


def heartbeat_state(data: bytes) -> Nmt | None:
    """Returns the NMT state in the data of a heartbeat; None if they are invalid."""
    try:
        return Nmt(data[0]) if len(data) == 1 else None
    except ValueError:
        return None


def emergency(node: int, code: int, register: int) -> Frame:
    """Returns a node's emergency message."""
    return Frame(EMCY_ID + node, EMCY.pack(code, register))


def emergency_of(data: bytes) -> Emergency | None:
    """Returns the content of an emergency message; None if it has the wrong length."""
    return Emergency(*EMCY.unpack(data)) if len(data) == EMCY.size else None


def rated_mnm(rated_torque: float) -> int:
    """Returns object 6076, the rated torque [mN m], for `rated_torque` [N m].

    Raises ValueError if it is not within 0.001 .. 4294967 N m."""
    if not (math.isfinite(rated_torque) and 1 <= round(rated_torque * 1000) < 1 << 32):
        raise ValueError(f"rated torque must be 0.001 N m .. 4294967 N m, not {rated_torque!r}")
    return round(rated_torque * 1000)


def permille(torque: float, rated: int) -> int:
    """Returns a torque [N m] in thousandths of the rated torque [mN m], rounded, and cut to the range of an i16."""
    return max(-PERMILLE_MAX, min(PERMILLE_MAX, round(torque * 1e6 / rated)))


def newton_metres(value: int, rated: int) -> float:
    """Returns a torque [N m], given in thousandths of the rated torque [mN m]."""
    return value * rated * 1e-6


def milliseconds(duration_ns: int) -> int:
    """Returns a time in ms for a u16 object, rounded down, but at least 1."""
    return max(1, min(0xFFFF, duration_ns // 1_000_000))
