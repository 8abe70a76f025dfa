"""The native frames as DBC messages (bridge.protocols.native.codec). Pure."""

import math
from collections import OrderedDict

from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue

from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.dbc import BRIDGE
from echelon.bridge.protocols.native.codec import (
    BASE_ID,
    CLEAR,
    CLIPPED,
    ENABLE_LEFT,
    ENABLE_RIGHT,
    ESTOP,
    FEEDBACK_ID,
    LENGTH,
    RAW_MAX,
    SATURATED,
    SPEED_SCALE,
    STATUS_EVERY,
    STATUS_ID,
    TEMPERATURE_OFFSET,
    VOLTAGE_SCALE,
    FaultCode,
    NativeCodec,
    frame_id,
)
from echelon.plan.can_plan import DrivePlan


def messages(plan: DrivePlan, name: str) -> list[Message]:
    """Returns command, feedback and status of a robot; `name` is its DBC identifier, up to 23 characters.

    The robot's number is the node id in the plan.  Raises ValueError for a torque scale that is not positive and finite, or a
    robot number out of range."""
    number = plan.node_ids[0]
    scale = NativeCodec(plan.torque_scale).scale  # NativeCodec checks it
    drive = f"drive_{name}"

    def message(base: int, kind: str, signals: list[Signal], comment: str, sender: str, every: int = 1) -> Message:
        return Message(
            frame_id(number, base),
            f"{kind}_{name}",
            LENGTH,
            signals,
            comment=comment,
            senders=[sender],
            cycle_time=math.ceil(plan.period_ns * every / 1_000_000),
        )

    def wheels(quantity: str, step: float, unit: str, what: str, receiver: str) -> list[Signal]:
        return [
            Signal(
                f"{quantity}_{side}",
                start,
                16,
                receivers=[receiver],
                is_signed=True,
                conversion=BaseConversion.factory(scale=step),
                minimum=-RAW_MAX * step,
                maximum=RAW_MAX * step,
                unit=unit,
                comment=f"{what} of the {side} wheel",
            )
            for side, start in (("right", 0), ("left", 16))
        ]

    def ends(receiver: str) -> list[Signal]:
        return [
            _field("counter", 40, 4, "one more with each frame, modulo 16", receiver),
            _field("crc", 56, 8, "CRC-8 SAE J1850 over the identifier (u16, little endian) and bytes 0 to 6", receiver),
        ]

    def flag(label: str, mask: int, comment: str) -> Signal:
        return _field(label, 32 + mask.bit_length() - 1, 1, comment, drive)

    command = [
        *wheels("tau", scale, "Nm", "wanted torque", drive),
        flag("enable_right", ENABLE_RIGHT, "0: the right wheel's drive is to give no torque"),
        flag("enable_left", ENABLE_LEFT, "0: the left wheel's drive is to give no torque"),
        flag("clear", CLEAR, "leave faults whose cause is gone"),
        flag("clipped", CLIPPED, f"a torque was cut to +-{RAW_MAX} bits"),
        flag("saturated", SATURATED, "the robot's own torque limit was reached"),
        flag("estop", ESTOP, "emergency stop: both wheels fault"),
        *ends(drive),
    ]
    feedback = [
        *wheels("mean_tau", scale, "Nm", "mean torque since the last feedback", BRIDGE),
        _choice("state_right", 32, WheelState, "what the right wheel's drive does"),
        _choice("state_left", 36, WheelState, "what the left wheel's drive does"),
        _choice("fault_right", 48, FaultCode, "what is wrong with the right wheel"),
        _choice("fault_left", 52, FaultCode, "what is wrong with the left wheel"),
        *ends(BRIDGE),
    ]
    status = [
        *wheels("speed", SPEED_SCALE, "rad/s", "speed", BRIDGE),
        _field("supply", 32, 8, "supply voltage", BRIDGE, VOLTAGE_SCALE, 0.0, "V"),
        _field("temperature", 48, 8, "the hotter winding", BRIDGE, 1.0, TEMPERATURE_OFFSET, "degC"),
        *ends(BRIDGE),
    ]
    return [
        message(BASE_ID, "torque", command, f"wheel torques of {name}, one frame per acceleration period", BRIDGE),
        message(FEEDBACK_ID, "feedback", feedback, f"what the wheels of {name} do, one frame per period", drive),
        message(STATUS_ID, "status", status, f"how the drive of {name} is", drive, STATUS_EVERY),
    ]


def _field(
    name: str,
    start: int,
    length: int,
    comment: str,
    receiver: str,
    scale: float = 1,
    offset: float = 0,
    unit: str | None = None,
) -> Signal:
    return Signal(
        name,
        start,
        length,
        receivers=[receiver],
        conversion=BaseConversion.factory(scale=scale, offset=offset),
        minimum=offset,
        maximum=offset + (2**length - 1) * scale,
        unit=unit,
        comment=comment,
    )


def _choice(name: str, start: int, kinds: type[WheelState] | type[FaultCode], comment: str) -> Signal:
    choices: OrderedDict[int, str | NamedSignalValue] = OrderedDict((kind.value, kind.name.lower()) for kind in kinds)
    conversion = BaseConversion.factory(choices=choices)
    return Signal(
        name, start, 4, receivers=[BRIDGE], conversion=conversion, minimum=0, maximum=len(choices) - 1, comment=comment
    )
