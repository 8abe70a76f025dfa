"""The CANopen frames of a robot's drives for `echelon dbc`, with the PDOs as its host maps them.  Pure."""

import re
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from enum import IntEnum
from math import ceil

from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue

from echelon.bridge.cia402.codec import (
    EMCY,
    EMCY_ID,
    HEARTBEAT_ID,
    MODE_CYCLIC_TORQUE,
    MODE_NONE,
    MODE_PROFILE_TORQUE,
    RPDO1,
    RPDO2,
    RPDO_IDS,
    TPDO1,
    TPDO2,
    TPDO3,
    TPDO_IDS,
    ErrorCode,
    Nmt,
    rated_mnm,
)
from echelon.bridge.cia402.configuration import heartbeat_ns
from echelon.bridge.frame import WHEELS
from echelon.can_plan import DrivePlan

Choices = OrderedDict[int, str | NamedSignalValue]
HOST = "bridge"
"""Who commands."""
CONTROLWORD_BITS = {
    0: "switch_on",
    1: "enable_voltage",
    2: "quick_stop_off",
    3: "enable_operation",
    7: "fault_reset",
    8: "halt",
}
STATUSWORD_BITS = {
    0: "ready_to_switch_on",
    1: "switched_on",
    2: "operation_enabled",
    3: "fault",
    4: "voltage_enabled",
    5: "quick_stop_off",
    6: "switch_on_disabled",
    7: "warning",
    9: "remote",
    10: "target_reached",
    11: "internal_limit",
    12: "follows_command",
}
_MODES = {MODE_NONE: "none", MODE_PROFILE_TORQUE: "profile torque", MODE_CYCLIC_TORQUE: "cyclic synchronous torque"}


def messages(plan: DrivePlan, robot_name: str) -> list[Message]:
    """Returns the messages of both drives.

    They are called <robot>_<wheel>_<kind>, and the sender of reports drive_<robot>_<wheel>."""
    robot = re.sub(r"\W", "_", robot_name, flags=re.ASCII)
    period_ns, beat_ns = plan.period_ns, heartbeat_ns(plan.period_ns, plan.watchdog_ns)
    torque, turn = rated_mnm(plan.motor.rated_torque) * 1e-6, 1 / plan.motor.encoder_counts
    found = []
    for node, wheel in zip(plan.node_ids, WHEELS, strict=True):
        drive = f"drive_{robot}_{wheel}"
        modes = _choices(_MODES)
        control = [*_flags(CONTROLWORD_BITS, drive), _number("mode", 16, 8, drive, choices=modes)]
        target = [_number("target_torque", 0, 16, drive, torque, "Nm")]
        status = [*_flags(STATUSWORD_BITS, HOST), _number("mode", 16, 8, HOST, choices=modes)]
        motion = [_number("position", 0, 32, HOST, turn, "rev"), _number("torque", 32, 16, HOST, torque, "Nm")]
        velocity = [_number("velocity", 0, 32, HOST, turn, "rev/s")]
        code = _number("error_code", 0, 16, HOST, signed=False, choices=_choices(_names(ErrorCode)))
        error = [code, _number("error_register", 16, 8, HOST, signed=False)]
        beat = [_number("state", 0, 8, HOST, signed=False, choices=_choices(_names(Nmt)))]
        for kind, base, length, signals, every_ns in (
            ("RPDO1", RPDO_IDS[0], RPDO1.size, control, None),
            ("RPDO2", RPDO_IDS[1], RPDO2.size, target, period_ns),
            ("TPDO1", TPDO_IDS[0], TPDO1.size, status, period_ns),
            ("TPDO2", TPDO_IDS[1], TPDO2.size, motion, period_ns),
            ("TPDO3", TPDO_IDS[2], TPDO3.size, velocity, period_ns),
            ("EMCY", EMCY_ID, EMCY.size, error, None),
            ("heartbeat", HEARTBEAT_ID, 1, beat, beat_ns),
        ):
            found.append(
                Message(
                    base + node,
                    f"{robot}_{wheel}_{kind}",
                    length,
                    signals,
                    senders=[HOST if base in RPDO_IDS else drive],
                    cycle_time=None if every_ns is None else ceil(every_ns / 1_000_000),
                )
            )
    return found


def _number(
    name: str,
    start: int,
    bits: int,
    receiver: str,
    scale: float = 1,
    unit: str | None = None,
    signed: bool = True,
    choices: Choices | None = None,
) -> Signal:
    conversion = BaseConversion.factory(scale=scale, choices=choices)
    return Signal(name, start, bits, receivers=[receiver], is_signed=signed, conversion=conversion, unit=unit)


def _flags(names: Mapping[int, str], receiver: str) -> list[Signal]:
    return [_number(name, bit, 1, receiver, signed=False) for bit, name in names.items()]


def _choices(names: Mapping[int, str]) -> Choices:
    return OrderedDict(names)


def _names(kinds: Iterable[IntEnum]) -> dict[int, str]:
    return {kind.value: kind.name.lower().replace("_", " ") for kind in kinds}
