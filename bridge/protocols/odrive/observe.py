"""The observer of a robot's two ODrive axes.  Pure.

It knows only the frames, and allows for their age: a state in a heartbeat may be up to 100 ms old, and a torque report is a
mean over the period before it.

kind of finding                    meaning
command, length, not finite        an invalid frame
state                              a heartbeat with an unknown axis state
torque above limit                 a commanded torque exceeds the envelope's
torque while idle                  an axis reports torque though it was IDLE for the reported time
torque after silence               an axis reports torque though nothing fed its watchdog in time
enabled unasked                    CLOSED_LOOP_CONTROL without a `Set_Axis_State(8)` before
error while enabled                a heartbeat in CLOSED_LOOP_CONTROL with an error
"""

from dataclasses import dataclass, field
from math import tau
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.observe import Finding, WheelReading
from echelon.bridge.protocols.odrive.codec import LENGTH, MESSAGES, ZERO_TORQUE, Refusal, frame_id
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.enums import AxisState, Command, error_names
from echelon.plan.can_plan import DrivePlan, EnvelopePlan

ROUNDING: Final = 1e-6
"""Relative tolerance of limits; it is larger than the rounding of 32-bit floats"""


@dataclass(slots=True)
class _Axis:
    """One axis, by its frames."""

    wheel: WheelReading = field(default_factory=WheelReading)
    state: int | None = None
    asked: bool = False
    """A Set_Axis_State(8) was seen since the last heartbeat in CLOSED_LOOP_CONTROL"""
    idle_ns: int | None = None
    """Heartbeat since which the axis is certainly IDLE, without a request to leave it"""
    fed_ns: int | None = None
    """Time of the last frame that feeds the watchdog, or of the first frame if there was none"""


class ODriveObserver:
    """Listens to the axes of one robot; `config` is their configuration."""

    def __init__(self, plan: DrivePlan, envelope: EnvelopePlan, config: ODriveConfig | None = None) -> None:
        self.plan = plan
        self.envelope = envelope
        self._axes = (_Axis(), _Axis())
        self.wheels = (self._axes[0].wheel, self._axes[1].wheel)
        self._by_id = {
            frame_id(node, command): (axis, command)
            for node, axis in zip(plan.node_ids, self._axes, strict=True)
            for command in range(32)
        }
        self._identifiers = frozenset(self._by_id)
        periods_ns = (config or ODriveConfig()).periods_ns(plan)
        self._cyclic = {
            frame_id(node, command): period
            for node in plan.node_ids
            for command, period in {**periods_ns, Command.SET_INPUT_TORQUE: plan.period_ns}.items()
        }

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it looks at."""
        return self._identifiers

    @property
    def cyclic(self) -> dict[int, int]:
        """Cyclic identifiers with their periods [ns]."""
        return self._cyclic

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns its findings.  Frames of other robots are ignored."""
        found = self._by_id.get(frame.can_id)
        if found is None:
            return []
        axis, number = found
        wrong: list[tuple[str, str]] = []
        if axis.fed_ns is None:
            axis.fed_ns = time_ns
        message = MESSAGES.get(number)
        if message is None:
            wrong.append(("command", f"command {number:#04x} is none of CANSimple's"))
        elif message.command is Command.ESTOP:
            axis.asked = False
        elif not (frame.remote or (not frame.data and (message.reported or message.command is Command.ADDRESS))):
            values = message.decode(frame.data)
            if isinstance(values, Refusal) or (message.reported and len(frame.data) != LENGTH):
                kind = values if isinstance(values, Refusal) else Refusal.LENGTH
                wrong.append((kind, f"{message.name} with {frame.data.hex() or 'no bytes'}"))
            else:
                self._read(axis, time_ns, message.command, values, wrong)
        return [Finding(time_ns, frame.can_id, str(kind), text) for kind, text in wrong]

    def _read(
        self, axis: _Axis, time_ns: int, command: Command, values: tuple[float, ...], wrong: list[tuple[str, str]]
    ) -> None:
        wheel = axis.wheel
        if command is Command.SET_INPUT_TORQUE:
            wheel.commanded, wheel.commanded_ns = values[0], time_ns
            axis.fed_ns = time_ns
            if abs(values[0]) > self.envelope.torque_limit * (1.0 + ROUNDING):
                wrong.append(
                    ("torque above limit", f"{values[0]:.6g} N m, at most {self.envelope.torque_limit:.6g} N m")
                )
        elif command is Command.GET_TORQUES:
            wheel.reported, wheel.reported_ns = values[1], time_ns
            self._check_torque(axis, time_ns, values[1], wrong)
        elif command is Command.HEARTBEAT:
            self._heartbeat(axis, time_ns, int(values[0]), int(values[1]), wrong)
        elif command is Command.GET_ENCODER_ESTIMATES:
            wheel.speed = values[1] * tau
        elif command is Command.GET_ERROR:
            wheel.fault = error_names(int(values[0]))
        elif command is Command.SET_AXIS_STATE:
            axis.asked = values[0] == AxisState.CLOSED_LOOP_CONTROL
            axis.fed_ns = time_ns
            if axis.asked:
                axis.idle_ns = None
        elif command is Command.REBOOT:
            axis.asked = False

    def _check_torque(self, axis: _Axis, time_ns: int, torque: float, wrong: list[tuple[str, str]]) -> None:
        if abs(torque) <= ZERO_TORQUE:
            return
        since_ns = time_ns - self.plan.period_ns  # start of the reported mean
        if axis.idle_ns is not None and since_ns >= axis.idle_ns:
            wrong.append(("torque while idle", f"{torque:.6g} N m"))
        if axis.fed_ns is not None and since_ns - axis.fed_ns > self.plan.watchdog_ns:
            wrong.append(
                ("torque after silence", f"{torque:.6g} N m, {(time_ns - axis.fed_ns) / 1e6:.1f} ms after a command")
            )

    def _heartbeat(self, axis: _Axis, time_ns: int, errors: int, state: int, wrong: list[tuple[str, str]]) -> None:
        try:
            name = AxisState(state).name
        except ValueError:
            name = str(state)
            wrong.append(("state", f"{state} is no axis state"))
        axis.wheel.state, axis.wheel.fault = name, error_names(errors)
        if state == AxisState.CLOSED_LOOP_CONTROL:
            if axis.state != state and not axis.asked:
                wrong.append(("enabled unasked", "CLOSED_LOOP_CONTROL without Set_Axis_State(8)"))
            if errors:
                wrong.append(("error while enabled", error_names(errors)))
            axis.asked = False
        if state != AxisState.IDLE or axis.asked:
            axis.idle_ns = None
        elif axis.idle_ns is None:
            axis.idle_ns = time_ns
        axis.state = state
