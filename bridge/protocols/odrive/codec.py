"""CANSimple of ODrive's firmware 0.6 in classic CAN frames.  Pure: no input or output, no clock.

An identifier has 11 bits: node << 5 | command.  Nodes are 0 .. 62; commands to node 63 are for all, and with it a host
asks which nodes are there (`ADDRESS` as a remote frame).  Data are little endian, floats IEEE 754.  `MESSAGES` has all commands
with the names and units of the vendor's DBC (odrive-cansimple-0.6.10).  A remote or an empty frame with the identifier of
a report asks for it; the node answers with a frame of the same identifier.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag, StrEnum
from math import isfinite
from typing import Any, Final, NamedTuple

from echelon.bridge.protocols.odrive.enums import (
    AxisError,
    AxisState,
    Command,
    ControlMode,
    InputMode,
    ProcedureResult,
    RebootAction,
    SdoOpcode,
)

MAX_NODE: Final = 62
BROADCAST: Final = 63
LENGTH: Final = 8
"""Bytes of every report"""
ZERO_TORQUE: Final = 1e-6
"""Torques up to this magnitude count as zero [N m]"""


class Refusal(StrEnum):
    """Why a frame from the bus is refused."""

    IDENTIFIER = "identifier"
    LENGTH = "length"
    NOT_FINITE = "not finite"


class Signal(NamedTuple):
    """A value in a message.  Values follow each other; each begins with a byte."""

    name: str
    kind: str
    """A letter of `struct`, or `?` (one bit) or `u48` (48 bits)"""
    unit: str = ""
    scale: float = 1.0
    """Value of one bit in `unit`"""
    choices: type[IntEnum | IntFlag] | None = None


_KINDS: Final = {
    "?": ("B", 1),
    "B": ("B", 8),
    "H": ("H", 16),
    "h": ("h", 16),
    "I": ("I", 32),
    "u48": ("6s", 48),
    "f": ("f", 32),
}  # letter of struct, bits


@dataclass(frozen=True, slots=True)
class Message:
    """The layout of one command's data."""

    command: Command
    name: str
    """Name in the vendor's DBC, after `AxisN_`"""
    reported: bool
    """True if the drive sends it, by itself or on request; `ADDRESS` goes both ways"""
    length: int
    """Number of bytes with which it is sent"""
    signals: tuple[Signal, ...]
    layout: struct.Struct
    raw: bool
    """True if `struct` packs and unpacks the values without conversion"""

    def encode(self, *values: float) -> bytes:
        """Returns the data for the signals' values in order.

        Raises ValueError for a value that is not finite or does not fit."""
        if len(values) != len(self.signals):
            raise ValueError(f"{self.name} has {len(self.signals)} values, not {len(values)}")
        for signal, value in zip(self.signals, values, strict=True):
            if not isfinite(value):
                raise ValueError(f"{signal.name} must be finite, not {value!r}")
        try:
            packed = values if self.raw else [_pack(signal, v) for signal, v in zip(self.signals, values, strict=True)]
            return self.layout.pack(*packed).ljust(self.length, b"\0")
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{self.name}: {values!r} do not fit: {error}") from error

    def decode(self, data: bytes) -> tuple[Any, ...] | Refusal:
        """Returns the signals' values in order, or the reason to refuse the data.  Never raises.

        A report must hold all signals.  In a command, missing bytes are zero, as in the vendor's open firmware, which clears
        its buffer before each frame."""
        size = len(data)
        if size > LENGTH:
            return Refusal.LENGTH
        if size < self.layout.size:
            if self.reported:
                return Refusal.LENGTH
            data = data.ljust(self.layout.size, b"\0")
        values = self.layout.unpack_from(data)
        for value in values:
            if value.__class__ is float and not isfinite(value):
                return Refusal.NOT_FINITE
        if self.raw:
            return values
        return tuple(_unpack(signal, value) for signal, value in zip(self.signals, values, strict=True))

    def bits(self) -> list[tuple[Signal, int, int]]:
        """Returns each signal with its first bit and its number of bits."""
        found, at = [], 0
        for signal in self.signals:
            letter, bits = _KINDS[signal.kind]
            found.append((signal, at, bits))
            at += 8 * struct.calcsize("<" + letter)
        return found


def _pack(signal: Signal, value: float) -> Any:
    if signal.kind == "u48":
        return int(value).to_bytes(6, "little")
    if signal.kind == "?":
        return bool(value)
    return value if signal.scale == 1.0 else round(value / signal.scale)


def _unpack(signal: Signal, value: Any) -> Any:
    if signal.kind == "u48":
        return int.from_bytes(value, "little")
    if signal.kind == "?":
        return value & 1
    return value if signal.scale == 1.0 else value * signal.scale


_CHOICES: Final[Mapping[str, type[IntEnum | IntFlag]]] = {
    "Axis_Error": AxisError,
    "Active_Errors": AxisError,
    "Disarm_Reason": AxisError,
    "Axis_State": AxisState,
    "Axis_Requested_State": AxisState,
    "Procedure_Result": ProcedureResult,
    "Control_Mode": ControlMode,
    "Input_Mode": InputMode,
    "Action": RebootAction,
    "Opcode": SdoOpcode,
}


def _message(command: Command, name: str, sender: str, length: int, *rows: str) -> Message:
    """Makes a message from a row of the table; a signal is written as its kind, name and unit."""
    signals = []
    for row in rows:
        kind, signal, unit = (*row.split(maxsplit=2), "")[:3]
        signals.append(Signal(signal, kind, unit, 0.001 if kind == "h" else 1.0, _CHOICES.get(signal)))
    layout = struct.Struct("<" + "".join(_KINDS[signal.kind][0] for signal in signals))
    raw = all(signal.kind not in ("?", "h", "u48") for signal in signals)
    return Message(command, name, sender == "drive", length, tuple(signals), layout, raw)


_VERSION: Final = (
    *("B Protocol_Version", "B Hw_Version_Major", "B Hw_Version_Minor", "B Hw_Version_Variant"),
    *("B Fw_Version_Major", "B Fw_Version_Minor", "B Fw_Version_Revision", "B Fw_Version_Unreleased"),
)
_HEARTBEAT: Final = ("I Axis_Error", "B Axis_State", "B Procedure_Result", "? Trajectory_Done_Flag")
_RX_SDO: Final = ("B Opcode", "H Endpoint_ID", "B Reserved", "I Value")
_TX_SDO: Final = ("B Reserved0", "H Endpoint_ID", "B Reserved1", "I Value")
_POS: Final = ("f Input_Pos rev", "h Vel_FF rev/s", "h Torque_FF Nm")
_TRAJ: Final = ("f Traj_Accel_Limit rev/s^2", "f Traj_Decel_Limit rev/s^2")
_GAINS: Final = ("f Vel_Gain Nm / (rev/s)", "f Vel_Integrator_Gain Nm / rev")
_TABLE: Final = (
    _message(Command.GET_VERSION, "Get_Version", "drive", 8, *_VERSION),
    _message(Command.HEARTBEAT, "Heartbeat", "drive", 8, *_HEARTBEAT),
    _message(Command.ESTOP, "Estop", "host", 0),
    _message(Command.GET_ERROR, "Get_Error", "drive", 8, "I Active_Errors", "I Disarm_Reason"),
    _message(Command.RX_SDO, "RxSdo", "host", 8, *_RX_SDO),
    _message(Command.TX_SDO, "TxSdo", "drive", 8, *_TX_SDO),
    _message(Command.ADDRESS, "Address", "host", 8, "B Node_ID", "u48 Serial_Number"),
    _message(Command.SET_AXIS_STATE, "Set_Axis_State", "host", 8, "I Axis_Requested_State"),
    _message(
        Command.GET_ENCODER_ESTIMATES, "Get_Encoder_Estimates", "drive", 8, "f Pos_Estimate rev", "f Vel_Estimate rev/s"
    ),
    _message(Command.SET_CONTROLLER_MODE, "Set_Controller_Mode", "host", 8, "I Control_Mode", "I Input_Mode"),
    _message(Command.SET_INPUT_POS, "Set_Input_Pos", "host", 8, *_POS),
    _message(Command.SET_INPUT_VEL, "Set_Input_Vel", "host", 8, "f Input_Vel rev/s", "f Input_Torque_FF Nm"),
    _message(Command.SET_INPUT_TORQUE, "Set_Input_Torque", "host", 8, "f Input_Torque Nm"),
    _message(Command.SET_LIMITS, "Set_Limits", "host", 8, "f Velocity_Limit rev/s", "f Current_Limit A"),
    _message(Command.SET_TRAJ_VEL_LIMIT, "Set_Traj_Vel_Limit", "host", 8, "f Traj_Vel_Limit rev/s"),
    _message(Command.SET_TRAJ_ACCEL_LIMITS, "Set_Traj_Accel_Limits", "host", 8, *_TRAJ),
    _message(Command.SET_TRAJ_INERTIA, "Set_Traj_Inertia", "host", 8, "f Traj_Inertia Nm/(rev/s^2)"),
    _message(Command.GET_IQ, "Get_Iq", "drive", 8, "f Iq_Setpoint A", "f Iq_Measured A"),
    _message(
        Command.GET_TEMPERATURE, "Get_Temperature", "drive", 8, "f FET_Temperature deg C", "f Motor_Temperature deg C"
    ),
    _message(Command.REBOOT, "Reboot", "host", 1, "B Action"),
    _message(
        Command.GET_BUS_VOLTAGE_CURRENT, "Get_Bus_Voltage_Current", "drive", 8, "f Bus_Voltage V", "f Bus_Current A"
    ),
    _message(Command.CLEAR_ERRORS, "Clear_Errors", "host", 1, "B Identify"),
    _message(Command.SET_ABSOLUTE_POSITION, "Set_Absolute_Position", "host", 8, "f Position rev"),
    _message(Command.SET_POS_GAIN, "Set_Pos_Gain", "host", 8, "f Pos_Gain (rev/s) / rev"),
    _message(Command.SET_VEL_GAINS, "Set_Vel_Gains", "host", 8, *_GAINS),
    _message(Command.GET_TORQUES, "Get_Torques", "drive", 8, "f Torque_Target Nm", "f Torque_Estimate Nm"),
    _message(Command.GET_POWERS, "Get_Powers", "drive", 8, "f Electrical_Power W", "f Mechanical_Power W"),
    _message(Command.ENTER_DFU_MODE, "Enter_DFU_Mode", "host", 0),
)
MESSAGES: Final[Mapping[int, Message]] = {int(message.command): message for message in _TABLE}
"""Layouts by command"""


def frame_id(node: int, command: int) -> int:
    """Returns the identifier of a node's command.  Raises ValueError for a node outside 0 .. 63."""
    if not 0 <= node <= BROADCAST:
        raise ValueError(f"node must be 0 .. {BROADCAST}, not {node!r}")
    return node << 5 | command
