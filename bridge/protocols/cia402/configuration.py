"""The objects that a host writes to a drive before it enables it."""

from typing import NamedTuple

from echelon.bridge.protocols.cia402 import objects
from echelon.bridge.protocols.cia402.codec import (
    HOST_NODE,
    MODE_CYCLIC_TORQUE,
    RPDO_IDS,
    TPDO_IDS,
    milliseconds,
    rated_mnm,
)
from echelon.bridge.protocols.cia402.sdo import Key
from echelon.plan.can_plan import DrivePlan


def heartbeat_ns(period_ns: int, watchdog_ns: int) -> int:
    """Returns the period of heartbeats [ns]: at most two fifths of the watchdog, in whole periods, but at least one period."""
    return max(1, watchdog_ns * 2 // 5 // period_ns) * period_ns


class Step(NamedTuple):
    """An object to write with `data`, or, if `read`, to read and compare with `data`."""

    key: Key
    data: bytes
    read: bool = False


def _pdo_steps(
    communication: int, mapping: int, cob_id: int, mapped: tuple[Key, ...], kind: int, timer_ms: int
) -> list[Step]:
    def u32(value: int) -> bytes:
        return value.to_bytes(4, "little")

    steps = [
        Step((communication, objects.COB_ID), u32(cob_id | objects.NOT_VALID)),
        Step((communication, objects.TRANSMISSION), bytes((kind,))),
        Step((mapping, 0), b"\0"),
    ]
    if timer_ms:
        steps.append(Step((communication, objects.EVENT_TIMER), timer_ms.to_bytes(2, "little")))
    steps += [Step((mapping, sub), u32(objects.mapping_value(key))) for sub, key in enumerate(mapped, 1)]
    return [*steps, Step((mapping, 0), bytes((len(mapped),))), Step((communication, objects.COB_ID), u32(cob_id))]


def steps(plan: DrivePlan, node: int) -> list[Step]:
    """Returns the steps that configure a drive, whatever its configuration was before."""
    watchdog = milliseconds(plan.watchdog_ns)
    beat_ns = heartbeat_ns(plan.period_ns, plan.watchdog_ns)
    beat = milliseconds(beat_ns)
    # longer than the watchdog, so that a lost host shows first by its missing torques
    host = milliseconds(plan.watchdog_ns + beat_ns)
    steps = [
        Step(objects.RATED_TORQUE, rated_mnm(plan.motor.rated_torque).to_bytes(4, "little"), read=True),
        Step(objects.PRODUCER_HEARTBEAT, beat.to_bytes(2, "little")),
        Step(objects.CONSUMER_HEARTBEAT, (HOST_NODE << 16 | host).to_bytes(4, "little")),
        Step(objects.ABORT_CONNECTION, b"\x01\0"),
        Step(objects.MODE, bytes((MODE_CYCLIC_TORQUE,))),
    ]
    for number, mapped in enumerate(objects.RPDO_MAPPED[:2]):
        index, mapping, timer = objects.RPDO_COMMUNICATION + number, objects.RPDO_MAPPING + number, number * watchdog
        steps += _pdo_steps(index, mapping, RPDO_IDS[number] + node, mapped, 255, timer)
    for number, mapped in enumerate(objects.TPDO_MAPPED[:3]):
        index, mapping = objects.TPDO_COMMUNICATION + number, objects.TPDO_MAPPING + number
        steps += _pdo_steps(index, mapping, TPDO_IDS[number] + node | objects.NO_REMOTE, mapped, 1, 0)
    return steps
