"""The state of a virtual ODrive axis, and what commands do to it.  Pure.

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

Firmware 0.6 is closed source.  Where it is not documented, the axis follows 0.5.6, or `ODriveConfig` has a switch.
"""

from typing import Final

from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.motor import Motor
from echelon.bridge.protocols.odrive.codec import ZERO_TORQUE
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

ERRORS: Final = {
    Fault.OVER_TEMPERATURE: AxisError.MOTOR_OVER_TEMP,
    Fault.ENCODER_LOSS: AxisError.MISSING_ESTIMATE,
    Fault.BROWN_OUT: AxisError.DC_BUS_UNDER_VOLTAGE,
    Fault.WATCHDOG: AxisError.WATCHDOG_TIMER_EXPIRED,
    Fault.ESTOP: AxisError.ESTOP_REQUESTED,
}
_WITHOUT_EFFECT: Final = (
    Command.SET_TRAJ_VEL_LIMIT,
    Command.SET_TRAJ_ACCEL_LIMITS,
    Command.SET_TRAJ_INERTIA,
    Command.SET_POS_GAIN,
    Command.SET_VEL_GAINS,
)


class Axis:
    """The state of an axis with its motor."""

    state: AxisState
    errors: AxisError
    """Latched errors"""
    disarm_reason: AxisError
    """Errors that ended CLOSED_LOOP_CONTROL"""
    result: ProcedureResult
    """Result of the last procedure, as heartbeats report it"""
    offset: float
    """Offset of the reported position [rev]"""
    watched: bool
    """Whether the watchdog runs"""
    deadline_ns: int
    """When the watchdog expires [ns], if it runs"""

    def __init__(self, plan: DrivePlan, config: ODriveConfig, motor: Motor) -> None:
        self._plan = plan
        self._config = config
        self._motor = motor
        self.zero_first = False
        """Whether the next torque must be zero, since there was an error"""
        self.power_on()

    def power_on(self) -> None:
        """Begins as after power-on."""
        self.state = AxisState.IDLE
        self.errors = self.disarm_reason = AxisError.NONE
        self.result = ProcedureResult.SUCCESS
        self._modes = (int(self._config.control_mode), int(InputMode.PASSTHROUGH))
        self._target = 0.0
        self._limit = self._plan.motor.torque_limit
        self.offset = 0.0
        self.watched = False
        self.deadline_ns = 0

    def latch(self, time_ns: int, error: AxisError) -> None:
        """Latches an error, which disarms the axis."""
        self.errors |= error
        self.zero_first = True
        if self.state is AxisState.CLOSED_LOOP_CONTROL:
            self.result = ProcedureResult.DISARMED
            self.disarm_reason |= error
        self.disarm(time_ns)

    def disarm(self, time_ns: int) -> None:
        """Cuts the torque and sets the state to IDLE."""
        self._motor.cut(time_ns)
        self.state = AxisState.IDLE
        self._target = 0.0
        self.watched = False

    def find_causes(self) -> None:
        """Adds the errors whose cause is present."""
        for fault in self._motor.causes:
            self.errors |= ERRORS[fault]

    def feed(self, time_ns: int) -> None:
        """Feeds the watchdog."""
        self.deadline_ns = time_ns + self._plan.watchdog_ns
        self.watched = self._config.enable_watchdog and self.state is AxisState.CLOSED_LOOP_CONTROL

    def execute(self, time_ns: int, command: Command, values: tuple[float, ...]) -> str:
        """Executes a command with decoded values; returns the reason if it is refused, otherwise an empty text."""
        if command is Command.SET_INPUT_TORQUE:
            return self._set_torque(time_ns, values[0])
        if command is Command.SET_AXIS_STATE:
            return self._set_state(time_ns, int(values[0]))
        if command is Command.SET_CONTROLLER_MODE:
            return self._set_modes((int(values[0]), int(values[1])))
        if command is Command.CLEAR_ERRORS:
            self.errors = self.disarm_reason = AxisError.NONE
            self.result = ProcedureResult.SUCCESS
            self.find_causes()
        elif command is Command.SET_LIMITS:
            if not min(values) >= 0.0:
                return "limit"
            self._limit = values[1] * self._plan.motor.torque_constant
            if self.state is AxisState.CLOSED_LOOP_CONTROL:
                self._motor.set_torque(time_ns, self.limited_torque())
        elif command is Command.SET_ABSOLUTE_POSITION:
            self.offset = values[0] - self._motor.position
        elif command is Command.REBOOT:
            if values[0] != RebootAction.reboot:
                return "reboot action"
            self.disarm(time_ns)
            self.power_on()
            self.find_causes()
        elif command in (Command.SET_INPUT_POS, Command.SET_INPUT_VEL):
            return "setpoint of another mode"
        elif command not in _WITHOUT_EFFECT:
            return "sdo" if command is Command.RX_SDO else command.name.lower().replace("_", " ")
        return ""

    def _set_torque(self, time_ns: int, torque: float) -> str:
        """Takes a torque [N m]."""
        if self.state is not AxisState.CLOSED_LOOP_CONTROL:
            # a host sends zeros while it waits until the axis is enabled: that is not wrong
            return "" if abs(torque) <= ZERO_TORQUE else "torque while idle"
        if self.zero_first and abs(torque) > ZERO_TORQUE:
            return "first command not zero"
        self.zero_first = False
        self._target = torque
        self._motor.set_torque(time_ns, self.limited_torque())
        self.feed(time_ns)
        return ""

    def limited_torque(self) -> float:
        """Returns the torque setpoint, cut to the limit [N m]."""
        return max(-self._limit, min(self._limit, self._target))

    def _set_state(self, time_ns: int, state: int) -> str:
        if state == AxisState.IDLE:
            self.disarm(time_ns)
        elif state != AxisState.CLOSED_LOOP_CONTROL:
            self.result = ProcedureResult.INVALID_STATE
            return "state"
        elif self.errors:
            self.result = ProcedureResult.DISARMED
            return "state with an error"
        elif self._modes != (ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH):
            self.result = ProcedureResult.INVALID_STATE
            return "state without torque control"
        else:
            self.state = AxisState.CLOSED_LOOP_CONTROL
            self.feed(time_ns)
        self.result = ProcedureResult.SUCCESS
        return ""

    def _set_modes(self, modes: tuple[int, int]) -> str:
        if modes != (ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH):
            self.result = ProcedureResult.INVALID_STATE
            return "controller mode"
        self._modes = modes
        return ""
