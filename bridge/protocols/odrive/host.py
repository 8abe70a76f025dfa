"""The host of a robot's two ODrive axes: brings them up as ros2_control's ODrive interface does, and commands torques.

    Set_Controller_Mode(TORQUE_CONTROL, PASSTHROUGH), Clear_Errors where there are some, Set_Axis_State(8),
    and Set_Input_Torque every cycle: zeros until both heartbeats say CLOSED_LOOP_CONTROL, and once more then

and again after 200 ms without success.  An error, silence, or a state that was not asked for is a fault, and so is no
torque at all where some is commanded, which shows sooner than the next heartbeat does: torques are zero for both wheels
from then on.  What was wrong before an axis was first enabled is cleared at once; what goes wrong later
only after `recover_ns`, or by `start`.
"""

from collections import Counter
from dataclasses import dataclass
from math import isfinite
from typing import Final

from echelon.bridge.protocols.frame import WHEELS, Frame, recovers_after_ns
from echelon.bridge.protocols.odrive.codec import LENGTH, MESSAGES, ZERO_TORQUE, Refusal, frame_id
from echelon.bridge.protocols.odrive.enums import AxisState, Command, ControlMode, InputMode, error_names
from echelon.plan.can_plan import DrivePlan

RETRY_NS: Final = 200_000_000
"""Two heartbeats: so long an answer may take"""
SETTLE_NS: Final = 50_000_000
"""Between the mode of an axis and the request to take torque, which has the lower identifier: on a busy bus it would be there
first, and the axis close its loop in another mode"""
SILENT: Final = "silent"
NO_TORQUE: Final = "gives no torque"
_HEARD: Final = (Command.HEARTBEAT, Command.GET_ERROR, Command.GET_ENCODER_ESTIMATES, Command.GET_TORQUES)
_TORQUE: Final = MESSAGES[Command.SET_INPUT_TORQUE]


@dataclass(slots=True)
class _Axis:
    """What is known of one axis."""

    node: int
    state: int = AxisState.UNDEFINED
    errors: int = 0
    closed: bool = False
    """It takes torque, by its last heartbeat"""
    fresh: bool = True
    """Not enabled since `start`: what is wrong is of the past"""
    fault: str = ""
    fault_ns: int = 0
    pushed_ns: int | None = None
    """Since then its commands are not zero"""
    heard_ns: int | None = None
    prepared_ns: int | None = None
    """When it was told its mode, and is yet to be asked to take torque"""
    asked_ns: int | None = None
    torque: float = 0.0
    torque_ns: int | None = None

    @property
    def asked(self) -> bool:
        """True if it was asked to take torque, and again since what went wrong, if anything did."""
        return self.asked_ns is not None and (self.fresh or not self.fault or self.asked_ns >= self.fault_ns)

    def bring_up(self, time_ns: int) -> list[Frame]:
        """Returns what is due of two steps: mode, and errors cleared; then the request to take torque."""
        if self.prepared_ns is not None:
            if time_ns - self.prepared_ns < SETTLE_NS:
                return []
            self.prepared_ns, self.asked_ns = None, time_ns
            return [self.send(Command.SET_AXIS_STATE, AxisState.CLOSED_LOOP_CONTROL)]
        self.prepared_ns = time_ns
        frames = [self.send(Command.SET_CONTROLLER_MODE, ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH)]
        return [*frames, self.send(Command.CLEAR_ERRORS, 0)] if self.errors else frames

    def forget(self) -> None:
        """What it was asked is void."""
        self.prepared_ns = self.asked_ns = None

    def send(self, command: Command, *values: float) -> Frame:
        return Frame(frame_id(self.node, command), MESSAGES[command].encode(*values))

    def fail(self, time_ns: int, fault: str) -> None:
        if not self.fault:
            self.fault_ns = time_ns
        self.fault = fault
        self.closed = False


class ODriveHost:
    """Commands the axes of one robot.  Raises ValueError if both have the same node."""

    def __init__(self, plan: DrivePlan) -> None:
        if plan.node_ids[0] == plan.node_ids[1]:
            raise ValueError(f"the wheels of a robot must be two nodes, not {plan.node_ids!r}")
        self.plan = plan
        self.refused: Counter[str] = Counter()
        self.clipped = 0
        self._axes = tuple(_Axis(node) for node in plan.node_ids)
        self._by_id = {frame_id(axis.node, command): (axis, command) for axis in self._axes for command in _HEARD}
        self._identifiers = frozenset(self._by_id)
        self._torque_ids = tuple(frame_id(axis.node, Command.SET_INPUT_TORQUE) for axis in self._axes)
        self._started = True
        self._halts = Command.SET_AXIS_STATE
        """What halts an axis that is not started: `Set_Axis_State` with IDLE, or `Estop`"""
        self._zero_first = True

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it listens to."""
        return self._identifiers

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, as far as their drives said."""
        right, left = self._axes
        return right.closed and left.closed

    @property
    def fault(self) -> str:
        """What a drive reports to be wrong, in words; empty if nothing is."""
        return "; ".join(f"{wheel}: {axis.fault}" for wheel, axis in zip(WHEELS, self._axes, strict=True) if axis.fault)

    @property
    def torque(self) -> tuple[float, float]:
        """Torque of the right and left wheel as the drives last reported it [N m]; zeros before the first report."""
        right, left = self._axes
        return right.torque, left.torque

    @property
    def torque_ns(self) -> int | None:
        """When the older of the two reports came; None before both have."""
        right, left = (axis.torque_ns for axis in self._axes)
        return None if right is None or left is None else min(right, left)

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns what is due besides torques: to bring axes up, or clear a fault and enable anew."""
        frames: list[Frame] = []
        for axis in self._axes:
            heard_ns = axis.heard_ns
            if heard_ns is not None and time_ns - heard_ns >= self.plan.watchdog_ns and axis.fault != SILENT:
                axis.fail(time_ns, SILENT)
            if axis.closed or (axis.asked_ns is not None and time_ns - axis.asked_ns < RETRY_NS):
                continue
            if not self._started:
                if axis.state == AxisState.CLOSED_LOOP_CONTROL:  # the frame of `stop` or `estop` was lost
                    frames.append(self._halt_frame(axis))
                    axis.asked_ns = time_ns
            elif axis.fresh or not axis.fault or self._may_recover(axis, time_ns):
                frames += axis.bring_up(time_ns)
        return frames

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m]; zeros are sent while a drive is not enabled.

        They are limited to what the motors can give.  Raises ValueError for a torque that is not finite."""
        limit = self.plan.motor.torque_limit
        if not self.enabled:
            limit = 0.0
        elif self._zero_first:
            self._zero_first, limit = False, 0.0
        frames = []
        for axis, can_id, torque in zip(self._axes, self._torque_ids, (tau_right, tau_left), strict=True):
            if not isfinite(torque):
                raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
            torque = max(-limit, min(limit, torque)) + 0.0  # and no -0.0
            if abs(torque) <= ZERO_TORQUE:
                axis.pushed_ns = None
            elif axis.pushed_ns is None:
                axis.pushed_ns = time_ns
            frames.append(Frame(can_id, _TORQUE.encode(torque)))
        return frames

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives; they stay so until `start`."""
        self._halt(Command.SET_AXIS_STATE)
        frames = [axis.send(Command.SET_INPUT_TORQUE, 0.0) for axis in self._axes]
        return frames + [self._halt_frame(axis) for axis in self._axes]

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns frames after which the drives have an error and no torque; `start` clears and enables them."""
        self._halt(Command.ESTOP)
        return [self._halt_frame(axis) for axis in self._axes]

    def start(self) -> None:
        """Lets `poll` enable the drives (again), whatever was wrong before.  A new host is started."""
        self._started = True
        for axis in self._axes:
            axis.fresh = True
            axis.forget()

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""
        found = self._by_id.get(frame.can_id)
        if found is None:
            self.refused[Refusal.IDENTIFIER.value] += 1
            return
        if frame.remote or len(frame.data) != LENGTH:
            self.refused["remote" if frame.remote else Refusal.LENGTH.value] += 1
            return
        axis, command = found
        values = MESSAGES[command].decode(frame.data)
        if isinstance(values, Refusal):
            self.refused[values.value] += 1
            return
        axis.heard_ns = time_ns
        if command is Command.GET_TORQUES:
            axis.torque, axis.torque_ns = values[1], time_ns
            # exactly none is what an axis reports that gives none; commands may take their time, or one be lost
            pushed = axis.pushed_ns is not None and time_ns - axis.pushed_ns >= 3 * self.plan.period_ns
            if axis.closed and pushed and values == (0.0, 0.0):
                axis.fail(time_ns, NO_TORQUE)
        elif command is Command.HEARTBEAT:
            self._heartbeat(axis, time_ns, values[0], values[1])
        elif command is Command.GET_ERROR and values[0]:
            self._error(axis, time_ns, values[0])

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m], finite ones, whatever the axes say."""
        torques = (tau_right, tau_left) if enable else (0.0, 0.0)
        return [Frame(can_id, _TORQUE.encode(torque)) for can_id, torque in zip(self._torque_ids, torques, strict=True)]

    def _halt_frame(self, axis: _Axis) -> Frame:
        return axis.send(Command.ESTOP) if self._halts is Command.ESTOP else axis.send(self._halts, AxisState.IDLE)

    def _halt(self, command: Command) -> None:
        self._started, self._halts = False, command
        for axis in self._axes:
            axis.closed = False
            axis.forget()

    def _may_recover(self, axis: _Axis, time_ns: int) -> bool:
        after_ns = recovers_after_ns(self.plan, time_ns)
        return after_ns is not None and time_ns - axis.fault_ns >= after_ns

    def _error(self, axis: _Axis, time_ns: int, errors: int) -> None:
        if not axis.errors:
            axis.forget()  # asked without knowing: `Clear_Errors` was missing
        axis.errors = errors
        axis.fail(time_ns, error_names(errors))

    def _heartbeat(self, axis: _Axis, time_ns: int, errors: int, state: int) -> None:
        axis.state = state
        if errors:
            self._error(axis, time_ns, errors)
            return
        axis.errors = 0
        if state != AxisState.CLOSED_LOOP_CONTROL:
            if axis.closed or axis.fault == NO_TORQUE:
                axis.fail(time_ns, f"in state {state} unasked")
        elif self._started and not axis.closed and axis.asked:
            axis.closed, axis.fresh, axis.fault = True, False, ""
            self._zero_first = True
        if axis.fresh:
            axis.fault = ""
