"""DBC messages of a robot's CANopen frames, with the PDOs as the host maps them.  Pure."""

import re
from math import ceil

from cantools.database.can import Message, Signal

from echelon.bridge.protocols.cia402.codec import (
    EMCY,
    EMCY_ID,
    HEARTBEAT_ID,
    HOST_NODE,
    MODE_CYCLIC_TORQUE,
    MODE_NONE,
    MODE_PROFILE_TORQUE,
    NMT_ID,
    RPDO1,
    RPDO2,
    RPDO_IDS,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO1,
    TPDO2,
    TPDO3,
    TPDO_IDS,
    ErrorCode,
    Nmt,
    NmtCommand,
    rated_mnm,
)
from echelon.bridge.protocols.cia402.configuration import heartbeat_ns
from echelon.bridge.protocols.cia402.sdo import LENGTH
from echelon.bridge.protocols.dbc import BRIDGE, flags, names, number
from echelon.bridge.protocols.frame import WHEELS
from echelon.plan.can_plan import DrivePlan

DRIVES = "drives"
"""The DBC node that receives frames for all drives of a bus."""
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
_COMMANDS = (*RPDO_IDS, SDO_REQUEST_ID)


def messages(plan: DrivePlan, robot_name: str) -> list[Message]:
    """Returns the messages of both drives.

    A message is named <robot>_<wheel>_<kind>; the sender of reports is drive_<robot>_<wheel>."""
    robot = re.sub(r"\W", "_", robot_name, flags=re.ASCII)
    period_ns, beat_ns = plan.period_ns, heartbeat_ns(plan.period_ns, plan.watchdog_ns)
    torque, turn = rated_mnm(plan.motor.rated_torque) * 1e-6, 1 / plan.motor.encoder_counts
    found = []
    for node, wheel in zip(plan.node_ids, WHEELS, strict=True):
        drive = f"drive_{robot}_{wheel}"
        control = [*flags(CONTROLWORD_BITS, drive), number("mode", 16, 8, drive, choices=_MODES)]
        target = [number("target_torque", 0, 16, drive, torque, "Nm")]
        status = [*flags(STATUSWORD_BITS, BRIDGE), number("mode", 16, 8, BRIDGE, choices=_MODES)]
        motion = [number("position", 0, 32, BRIDGE, turn, "rev"), number("torque", 32, 16, BRIDGE, torque, "Nm")]
        velocity = [number("velocity", 0, 32, BRIDGE, turn, "rev/s")]
        code = number("error_code", 0, 16, BRIDGE, signed=False, choices=names(ErrorCode))
        error = [code, number("error_register", 16, 8, BRIDGE, signed=False)]
        beat = [number("state", 0, 8, BRIDGE, signed=False, choices=names(Nmt))]
        for kind, base, length, signals, every_ns in (
            ("RPDO1", RPDO_IDS[0], RPDO1.size, control, None),
            ("RPDO2", RPDO_IDS[1], RPDO2.size, target, period_ns),
            ("TPDO1", TPDO_IDS[0], TPDO1.size, status, period_ns),
            ("TPDO2", TPDO_IDS[1], TPDO2.size, motion, period_ns),
            ("TPDO3", TPDO_IDS[2], TPDO3.size, velocity, period_ns),
            ("EMCY", EMCY_ID, EMCY.size, error, None),
            ("SDO_request", SDO_REQUEST_ID, LENGTH, _sdo(drive), None),
            ("SDO_answer", SDO_ANSWER_ID, LENGTH, _sdo(BRIDGE), None),
            ("heartbeat", HEARTBEAT_ID, 1, beat, beat_ns),
        ):
            found.append(
                Message(
                    base + node,
                    f"{robot}_{wheel}_{kind}",
                    length,
                    signals,
                    senders=[BRIDGE if base in _COMMANDS else drive],
                    cycle_time=None if every_ns is None else ceil(every_ns / 1_000_000),
                )
            )
    return found


def shared_messages(period_ns: int, watchdog_ns: int) -> list[Message]:
    """Returns the messages that the host sends to all drives of a bus."""
    command = number("command", 0, 8, DRIVES, signed=False, choices=names(NmtCommand))
    node = number("node", 8, 8, DRIVES, signed=False, choices={0: "all"})
    beat = number("state", 0, 8, DRIVES, signed=False, choices=names(Nmt))
    beat_ms = ceil(heartbeat_ns(period_ns, watchdog_ns) / 1_000_000)
    return [
        Message(NMT_ID, "NMT", 2, [command, node], senders=[BRIDGE]),
        Message(SYNC_ID, "SYNC", 0, [], senders=[BRIDGE], cycle_time=ceil(period_ns / 1_000_000)),
        Message(HEARTBEAT_ID + HOST_NODE, "bridge_heartbeat", 1, [beat], senders=[BRIDGE], cycle_time=beat_ms),
    ]


def _sdo(receiver: str) -> list[Signal]:
    """Returns the fields of an SDO message; segments have other ones."""
    fields = (("command", 0, 8), ("index", 8, 16), ("subindex", 24, 8), ("data", 32, 32))
    return [number(name, start, bits, receiver, signed=False) for name, start, bits in fields]
