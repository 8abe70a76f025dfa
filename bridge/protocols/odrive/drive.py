"""A virtual ODrive axis: one node, one motor, torque control.  Pure: frames and the time in, frames out.

state                  entered when                                       what the axis does
IDLE                   at power-on, after `Reboot`; by                    no torque; refuses `Set_Input_Torque` above zero
                       `Set_Axis_State(1)`; by any error
CLOSED_LOOP_CONTROL    by `Set_Axis_State(8)`, if no error is latched     follows `Set_Input_Torque`, cut to the limits; the
                       and the controller mode is TORQUE_CONTROL with     watchdog is an error
                       PASSTHROUGH

An error latches, cuts the torque and sets the state to IDLE.  `Clear_Errors` clears the errors whose cause is gone.  After an
error, even with a reboot in between, the first torque in CLOSED_LOOP_CONTROL must be zero.

The axis refuses other modes and states, setpoints other than `Set_Input_Torque`, parameters (SDO) and setting addresses.  It
accepts limits and gains of other modes without effect.  The current in `Set_Limits` limits the torque.

Firmware 0.6 is closed source.  Where it is not documented, this drive follows 0.5.6, or `ODriveConfig` has a switch.
"""

from collections import Counter
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.motor import ON_DEMAND, Fault, Motor
from echelon.bridge.protocols.odrive.codec import BROADCAST, MAX_NODE, MESSAGES, ZERO_TORQUE, Refusal, frame_id
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.enums import (
    AxisError,
    AxisState,
    Command,
    ControlMode,
    InputMode,
    ProcedureResult,
    RebootAction,
)
from echelon.plan.can_plan import DrivePlan

VERSION: Final = (2, 0, 0, 0, 0, 6, 10, 0)
"""CANSimple 2, no hardware version, firmware 0.6.10"""
ERRORS: Final = {
    Fault.OVER_TEMPERATURE: AxisError.MOTOR_OVER_TEMP,
    Fault.ENCODER_LOSS: AxisError.MISSING_ESTIMATE,
    Fault.BROWN_OUT: AxisError.DC_BUS_UNDER_VOLTAGE,
    Fault.WATCHDOG: AxisError.WATCHDOG_TIMER_EXPIRED,
    Fault.ESTOP: AxisError.ESTOP_REQUESTED,
}
_NEVER: Final = 1 << 62
_FOR_ALL: Final = (Command.ESTOP, Command.ADDRESS, Command.REBOOT, Command.CLEAR_ERRORS)
_WITHOUT_EFFECT: Final = (
    Command.SET_TRAJ_VEL_LIMIT,
    Command.SET_TRAJ_ACCEL_LIMITS,
    Command.SET_TRAJ_INERTIA,
    Command.SET_POS_GAIN,
    Command.SET_VEL_GAINS,
)


class ODriveDrive:
    """The axis of one `wheel` (0 right, 1 left) of a robot.

    Raises ValueError for another wheel, or a node id outside 0 .. 62."""

    def __init__(self, plan: DrivePlan, wheel: int, config: ODriveConfig | None = None) -> None:
        if wheel not in (0, 1):
            raise ValueError(f"wheel must be 0 (right) or 1 (left), not {wheel!r}")
        node = plan.node_ids[wheel]
        if not 0 <= node <= MAX_NODE:
            raise ValueError(f"node must be 0 .. {MAX_NODE}, not {node!r}")
        self.plan = plan
        self.wheel = wheel
        self.config = config or ODriveConfig()
        self.motor = Motor(plan.motor)
        self.motors: tuple[Motor, ...] = (self.motor,)
        self.refused: Counter[str] = Counter()
        self.serial_number = 0xEC_00_00_00_00_00 | plan.bus << 8 | node
        self._node = node
        self._ids = [frame_id(node, command) for command in range(32)]
        self._identifiers = frozenset([*self._ids, *(frame_id(BROADCAST, command) for command in _FOR_ALL)])
        self._periods_ns = self.config.periods_ns(plan)
        self._due_ns: dict[Command, int] = {}
        self._next_ns = 0  # the smallest of _due_ns
        self._pending: list[Frame] = []  # frames that the next `advance` returns
        self._started = False
        self._mean = 0.0
        self._zero_first = False
        self._silent = False
        self._power_on()

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""
        return self._identifiers

    @property
    def due_ns(self) -> int:
        """When `advance` must be called next; 0 before the first call."""
        return min(self._next_ns, self._deadline_ns) if self._watched else self._next_ns

    @property
    def state(self) -> AxisState:
        """IDLE or CLOSED_LOOP_CONTROL; UNDEFINED while silent"""
        return AxisState.UNDEFINED if self._silent else self._state

    @property
    def errors(self) -> AxisError:
        """Latched errors"""
        return self._errors

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a frame; returns the immediate answers."""
        if not self._started:
            self._start(time_ns)
        if self._silent:
            return []
        can_id, data, remote = frame
        if can_id not in self._identifiers:
            return self._refuse(Refusal.IDENTIFIER)
        message = MESSAGES.get(can_id & 31)
        if message is None:
            return self._refuse("command")
        command = message.command
        answers: list[Frame] = []
        if command is Command.ESTOP:  # an emergency stop is obeyed even if the frame is invalid otherwise
            self._latch(time_ns, AxisError.ESTOP_REQUESTED)
        elif (message.reported or command is Command.ADDRESS) and (remote or not data):
            if command is Command.TX_SDO:
                return self._refuse("sdo")
            answers.append(self._report(time_ns, command))
        elif message.reported:
            return self._refuse("report")
        elif remote:
            return self._refuse("remote")
        else:
            values = message.decode(data)
            if isinstance(values, Refusal):
                return self._refuse(values)
            if reason := self._execute(time_ns, command, values):
                return self._refuse(reason)
        if self.config.every_frame_feeds:
            self._feed(time_ns)
        return answers

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns the frames that the axis sends by itself up to and including `time_ns`."""
        if not self._started:
            self._start(time_ns)
        frames, self._pending = self._pending, []
        while (due_ns := self.due_ns) <= time_ns:
            self._pass(due_ns)
            if self._next_ns <= due_ns:
                self._report_due(due_ns, frames)
        self._pass(time_ns)
        return frames

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault happen; returns the frames that are due.

        Raises ValueError for the other wheel, and for a fault that only the bus can cause."""
        self._check(wheel, fault)
        frames = self.advance(time_ns)
        if fault is Fault.SILENT:
            self.motor.cut(time_ns)
            self._power_on()
            self._silent = self._zero_first = True
        else:
            self.motor.inject(time_ns, fault)
            if fault in ERRORS and not self._silent:
                self._latch(time_ns, ERRORS[fault])
        return frames

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Takes the cause of a fault away.  A latched error stays until `Clear_Errors`."""
        self._check(wheel, fault)
        self._pending = self.advance(time_ns)
        if fault is Fault.SILENT:
            self._silent = False
            self._find_causes()
        else:
            self.motor.mend(time_ns, fault)

    def _check(self, wheel: int, fault: Fault) -> None:
        if wheel != self.wheel:
            raise ValueError(f"this drive has wheel {self.wheel}, not {wheel!r}")
        if fault not in ON_DEMAND:
            raise ValueError(f"fault must be one of {', '.join(ON_DEMAND)}, not {fault!r}")

    def _power_on(self) -> None:
        self._state = AxisState.IDLE
        self._errors = self._disarm_reason = AxisError.NONE
        self._result = ProcedureResult.SUCCESS
        self._modes = (int(ControlMode.POSITION_CONTROL), int(InputMode.PASSTHROUGH))
        self._target = 0.0
        self._limit = self.plan.motor.torque_limit
        self._offset = 0.0  # added to the position [rev]
        self._watched = False
        self._deadline_ns = 0

    def _start(self, time_ns: int) -> None:
        self._started = True
        # the next multiples of the periods; an instant that is one counts
        self._due_ns = {command: -(-time_ns // period) * period for command, period in self._periods_ns.items()}
        self._next_ns = min(self._due_ns.values(), default=_NEVER)
        self.motor.advance(time_ns)

    def _pass(self, time_ns: int) -> None:
        """Advances the motor to an instant, and latches an error of the motor or of the watchdog."""
        fault = self.motor.advance(time_ns)
        if fault is not None and not self._silent:
            self._latch(time_ns, ERRORS[fault])
        if self._watched and self._deadline_ns <= time_ns:
            self._latch(time_ns, AxisError.WATCHDOG_TIMER_EXPIRED)

    def _latch(self, time_ns: int, error: AxisError) -> None:
        self._errors |= error
        self._zero_first = True
        if self._state is AxisState.CLOSED_LOOP_CONTROL:
            self._result = ProcedureResult.DISARMED
            self._disarm_reason |= error
        self._disarm(time_ns)

    def _disarm(self, time_ns: int) -> None:
        self.motor.cut(time_ns)
        self._state = AxisState.IDLE
        self._target = 0.0
        self._watched = False

    def _find_causes(self) -> None:
        for fault in self.motor.causes:
            self._errors |= ERRORS[fault]

    def _feed(self, time_ns: int) -> None:
        self._deadline_ns = time_ns + self.plan.watchdog_ns
        self._watched = self.config.enable_watchdog and self._state is AxisState.CLOSED_LOOP_CONTROL

    def _refuse(self, reason: str) -> list[Frame]:
        self.refused[str(reason)] += 1
        return []

    def _execute(self, time_ns: int, command: Command, values: tuple[float, ...]) -> str:
        """Executes a command; returns the reason if it is refused, otherwise ""."""
        if command is Command.SET_INPUT_TORQUE:
            return self._set_torque(time_ns, values[0])
        if command is Command.SET_AXIS_STATE:
            return self._set_state(time_ns, int(values[0]))
        if command is Command.SET_CONTROLLER_MODE:
            return self._set_modes((int(values[0]), int(values[1])))
        if command is Command.CLEAR_ERRORS:
            self._errors = self._disarm_reason = AxisError.NONE
            self._result = ProcedureResult.SUCCESS
            self._find_causes()
        elif command is Command.SET_LIMITS:
            if not min(values) >= 0.0:
                return "limit"
            self._limit = values[1] * self.plan.motor.torque_constant
            if self._state is AxisState.CLOSED_LOOP_CONTROL:
                self.motor.set_torque(time_ns, self._limited())
        elif command is Command.SET_ABSOLUTE_POSITION:
            self._offset = values[0] - self.motor.position
        elif command is Command.REBOOT:
            if values[0] != RebootAction.reboot:
                return "reboot action"
            self._disarm(time_ns)
            self._power_on()
            self._find_causes()
        elif command in (Command.SET_INPUT_POS, Command.SET_INPUT_VEL):
            return "setpoint of another mode"
        elif command not in _WITHOUT_EFFECT:
            return "sdo" if command is Command.RX_SDO else command.name.lower().replace("_", " ")
        return ""

    def _set_torque(self, time_ns: int, torque: float) -> str:
        if self._state is not AxisState.CLOSED_LOOP_CONTROL:
            # a host sends zeros while it waits for the axis to be enabled: they are no fault
            return "" if abs(torque) <= ZERO_TORQUE else "torque while idle"
        if self._zero_first and abs(torque) > ZERO_TORQUE:
            return "first command not zero"
        self._zero_first = False
        self._target = torque
        self.motor.set_torque(time_ns, self._limited())
        self._feed(time_ns)
        return ""

    def _limited(self) -> float:
        return max(-self._limit, min(self._limit, self._target))

    def _set_state(self, time_ns: int, state: int) -> str:
        if state == AxisState.IDLE:
            self._disarm(time_ns)
        elif state != AxisState.CLOSED_LOOP_CONTROL:
            self._result = ProcedureResult.INVALID_STATE
            return "state"
        elif self._errors:
            self._result = ProcedureResult.DISARMED
            return "state with an error"
        elif self._modes != (ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH):
            self._result = ProcedureResult.INVALID_STATE
            return "state without torque control"
        else:
            self._state = AxisState.CLOSED_LOOP_CONTROL
            self._feed(time_ns)
        self._result = ProcedureResult.SUCCESS
        return ""

    def _set_modes(self, modes: tuple[int, int]) -> str:
        if modes != (ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH):
            self._result = ProcedureResult.INVALID_STATE
            return "controller mode"
        self._modes = modes
        return ""

    def _report_due(self, time_ns: int, frames: list[Frame]) -> None:
        for command, due_ns in self._due_ns.items():
            if due_ns <= time_ns:
                self._due_ns[command] = due_ns + self._periods_ns[command]
                if command is Command.GET_TORQUES:
                    self._mean = self.motor.mean_torque(time_ns)
                if not self._silent:
                    frames.append(self._report(time_ns, command))
        self._next_ns = min(self._due_ns.values(), default=_NEVER)

    def _report(self, time_ns: int, command: Command) -> Frame:
        motor = self.motor
        values: tuple[float, ...]
        if command is Command.GET_TORQUES:
            if command not in self._periods_ns:
                self._mean = motor.mean_torque(time_ns)
            values = (self._limited(), self._mean)
        elif command is Command.GET_ENCODER_ESTIMATES:
            values = (motor.position + self._offset, motor.velocity)
        elif command is Command.HEARTBEAT:
            values = (self._errors, self._state, self._result, 0)
        elif command is Command.GET_ERROR:
            values = (self._errors, self._disarm_reason)
        elif command is Command.GET_IQ:
            values = (motor.current_setpoint, motor.current)
        elif command is Command.GET_TEMPERATURE:
            values = (motor.plan.ambient, motor.temperature)
        elif command is Command.GET_VERSION:
            values = VERSION
        elif command is Command.ADDRESS:
            values = (self._node, self.serial_number)
        else:
            mechanical = motor.torque * motor.omega
            electrical = mechanical + motor.plan.resistance * motor.current**2
            values = (electrical, mechanical)
            if command is Command.GET_BUS_VOLTAGE_CURRENT:
                values = (motor.bus_voltage, electrical / motor.bus_voltage)
        return Frame(self._ids[command], MESSAGES[command].encode(*values))
