"""The host of a robot's two ODrive axes: it brings them up as ros2_control's ODrive interface does, and commands torques.

Each axis is in one of these states:

state       entered when                                       what the host sends
prepare     at first; `start` is called; `RETRY_NS` after a    Set_Controller_Mode(TORQUE_CONTROL, PASSTHROUGH), and
            request without success                            Clear_Errors if there are errors
request     `SETTLE_NS` after prepare                          Set_Axis_State(8)
closed      a heartbeat says CLOSED_LOOP_CONTROL after the     nothing more; torques flow when both axes are closed
            request
fault       an error; silence for the watchdog's time; IDLE    nothing until it may recover, then prepare; an axis that was
            without request; zero torque is reported though    not closed since `start` recovers at once, others after
            torque is commanded                                `recovers_after_ns`
stopped     `stop` or `estop` is called                        Set_Axis_State(1) or Estop, again while a heartbeat says
                                                               CLOSED_LOOP_CONTROL

Set_Input_Torque is sent in every cycle: zeros until both axes are closed, one more zero then, and zeros after a fault of either
axis.
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
"""How long the host waits for success before it tries again: two periods of the heartbeat"""
SETTLE_NS: Final = 50_000_000
"""Pause between Set_Controller_Mode and Set_Axis_State.  The latter has the lower identifier: without the pause it could arrive
first on a busy bus, and the axis would close its loop in another mode"""
SILENT: Final = "silent"
NO_TORQUE: Final = "gives no torque"
_HEARD: Final = (Command.HEARTBEAT, Command.GET_ERROR, Command.GET_ENCODER_ESTIMATES, Command.GET_TORQUES)
_TORQUE: Final = MESSAGES[Command.SET_INPUT_TORQUE]


@dataclass(slots=True)
class _Axis:
    """The host's view of one axis."""

    node: int
    state: int = AxisState.UNDEFINED
    errors: int = 0
    closed: bool = False
    """The axis takes torque, by its last heartbeat"""
    fresh: bool = True
    """The axis was not enabled since `start`, so its faults are from before"""
    fault: str = ""
    fault_ns: int = 0
    pushed_ns: int | None = None
    """Since when its commanded torques are not zero; None: they are"""
    gives: bool = False
    """It has reported torque since torque is commanded"""
    zero_ns: int | None = None
    """Since when it reports zero torque though torque is commanded; None: it does not"""
    heard_ns: int | None = None
    prepared_ns: int | None = None
    """When its mode was sent, if Set_Axis_State has yet to follow"""
    asked_ns: int | None = None
    torque: float = 0.0
    torque_ns: int | None = None

    @property
    def asked(self) -> bool:
        """True if it was requested to take torque, and requested again since its last fault."""
        return self.asked_ns is not None and (self.fresh or not self.fault or self.asked_ns >= self.fault_ns)

    def bring_up(self, time_ns: int) -> list[Frame]:
        """Returns the frames of the next step of the bring-up: mode and clearing of errors, or the request to take torque."""
        if self.prepared_ns is not None:
            if time_ns - self.prepared_ns < SETTLE_NS:
                return []
            self.prepared_ns, self.asked_ns = None, time_ns
            return [self.send(Command.SET_AXIS_STATE, AxisState.CLOSED_LOOP_CONTROL)]
        self.prepared_ns = time_ns
        frames = [self.send(Command.SET_CONTROLLER_MODE, ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH)]
        return [*frames, self.send(Command.CLEAR_ERRORS, 0)] if self.errors else frames

    def forget(self) -> None:
        """Forgets the requests, so that the bring-up begins anew."""
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
        """The command that stopped axes get: `Set_Axis_State` with IDLE, or `Estop`"""
        self._zero_first = True

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""
        return self._identifiers

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, by what their drives reported."""
        right, left = self._axes
        return right.closed and left.closed

    @property
    def fault(self) -> str:
        """The present faults of the axes in words; empty without any."""
        return "; ".join(f"{wheel}: {axis.fault}" for wheel, axis in zip(WHEELS, self._axes, strict=True) if axis.fault)

    @property
    def torque(self) -> tuple[float, float]:
        """The last reported torques of the right and the left wheel [N m]; zeros before the first report."""
        right, left = self._axes
        return right.torque, left.torque

    @property
    def torque_ns(self) -> int | None:
        """When the older of the two reports came [ns]; None before both have come."""
        right, left = (axis.torque_ns for axis in self._axes)
        return None if right is None or left is None else min(right, left)

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns all due frames except torques: they bring axes up, clear faults and enable again."""
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
        """Returns the frames for wheel torques [N m], cut to the limit of the motors.

        It sends zeros until both axes are closed.  Raises ValueError for a torque that is not finite."""
        limit = self.plan.motor.torque_limit
        if not self.enabled:
            limit = 0.0
        elif self._zero_first:
            self._zero_first, limit = False, 0.0
        frames = []
        for axis, can_id, torque in zip(self._axes, self._torque_ids, (tau_right, tau_left), strict=True):
            if not isfinite(torque):
                raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
            torque = max(-limit, min(limit, torque)) + 0.0  # + 0.0 turns -0.0 into 0.0
            if abs(torque) <= ZERO_TORQUE:
                axis.pushed_ns = None
            elif axis.pushed_ns is None:
                axis.pushed_ns, axis.gives, axis.zero_ns = time_ns, False, None
            frames.append(Frame(can_id, _TORQUE.encode(torque)))
        return frames

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives.  They stay disabled until `start`."""
        self._halt(Command.SET_AXIS_STATE)
        frames = [axis.send(Command.SET_INPUT_TORQUE, 0.0) for axis in self._axes]
        return frames + [self._halt_frame(axis) for axis in self._axes]

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns Estop for both axes: they latch an error and take the torque away.  `start` clears and enables them."""
        self._halt(Command.ESTOP)
        return [self._halt_frame(axis) for axis in self._axes]

    def start(self) -> None:
        """Lets `poll` enable the drives (again), whatever was wrong before.  A new host is started already."""
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
            if values == (0.0, 0.0):
                self._zero_torque(axis, time_ns)
            elif axis.pushed_ns is not None:
                axis.gives, axis.zero_ns = True, None
            axis.torque, axis.torque_ns = values[1], time_ns
        elif command is Command.HEARTBEAT:
            self._heartbeat(axis, time_ns, values[0], values[1])
        elif command is Command.GET_ERROR and values[0]:
            self._error(axis, time_ns, values[0])

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the frames for finite wheel torques [N m], whatever the axes reported."""
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
            axis.forget()  # the bring-up began before the error was known, without `Clear_Errors`: begin anew
        axis.errors = errors
        axis.fail(time_ns, error_names(errors))

    def _zero_torque(self, axis: _Axis, time_ns: int) -> None:
        """Finds a disarmed axis, which reports exactly zero torque: that shows before its next heartbeat.

        Three periods allow for commands that are delayed or lost.  After a standstill of host or drive, reports from before the
        command come all at once.  So one report counts only if it comes by itself, from an axis that gave torque; otherwise it
        takes reports over two periods."""
        if axis.pushed_ns is None or not axis.closed:
            return
        if axis.zero_ns is None:
            axis.zero_ns = time_ns
        period_ns = self.plan.period_ns
        alone = axis.torque_ns is None or time_ns - axis.torque_ns >= period_ns // 2
        sure = (axis.gives and alone) or time_ns - axis.zero_ns >= 2 * period_ns
        if sure and time_ns - axis.pushed_ns >= 3 * period_ns:
            axis.fail(time_ns, NO_TORQUE)

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
