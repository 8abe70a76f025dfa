"""A virtual ODrive axis on the bus: one node, one motor, torque control.  Pure: frames and the time in, frames out.

The states of the axis and its commands are in `odrive.axis`.
"""

from collections import Counter
from typing import Final

from echelon.bridge.protocols.faults import ON_DEMAND, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.motor import Motor
from echelon.bridge.protocols.odrive.axis import ERRORS, Axis
from echelon.bridge.protocols.odrive.codec import BROADCAST, MAX_NODE, MESSAGES, Refusal, frame_id
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.enums import AxisError, AxisState, Command
from echelon.plan.can_plan import DrivePlan

VERSION: Final = (2, 0, 0, 0, 0, 6, 10, 0)
"""CANSimple 2, no hardware version, firmware 0.6.10"""
_NEVER: Final = 1 << 62
_FOR_ALL: Final = (Command.ESTOP, Command.ADDRESS, Command.REBOOT, Command.CLEAR_ERRORS)
"""Commands that are obeyed from the broadcast address, too"""


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
        self._axis = Axis(plan, self.config, self.motor)
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
        self._silent = False

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""
        return self._identifiers

    @property
    def due_ns(self) -> int:
        """When `advance` must be called next; 0 before the first call."""
        axis = self._axis
        return min(self._next_ns, axis.deadline_ns) if axis.watched else self._next_ns

    @property
    def state(self) -> AxisState:
        """IDLE or CLOSED_LOOP_CONTROL; UNDEFINED while silent"""
        return AxisState.UNDEFINED if self._silent else self._axis.state

    @property
    def errors(self) -> AxisError:
        """Latched errors"""
        return self._axis.errors

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
            self._axis.latch(time_ns, AxisError.ESTOP_REQUESTED)
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
            if reason := self._axis.execute(time_ns, command, values):
                return self._refuse(reason)
        if self.config.every_frame_feeds:
            self._axis.feed(time_ns)
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
            self._axis.power_on()
            self._silent = self._axis.zero_first = True
        else:
            self.motor.inject(time_ns, fault)
            if fault in ERRORS and not self._silent:
                self._axis.latch(time_ns, ERRORS[fault])
        return frames

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Removes the cause of a fault.  A latched error stays until `Clear_Errors`."""
        self._check(wheel, fault)
        self._pending = self.advance(time_ns)
        if fault is Fault.SILENT:
            self._silent = False
            self._axis.find_causes()
        else:
            self.motor.mend(time_ns, fault)

    def _check(self, wheel: int, fault: Fault) -> None:
        if wheel != self.wheel:
            raise ValueError(f"this drive has wheel {self.wheel}, not {wheel!r}")
        if fault not in ON_DEMAND:
            raise ValueError(f"fault must be one of {', '.join(ON_DEMAND)}, not {fault!r}")

    def _start(self, time_ns: int) -> None:
        """Begins to send reports; called by the first call with a time."""
        self._started = True
        # the next multiples of the periods; an instant that is one counts
        self._due_ns = {command: -(-time_ns // period) * period for command, period in self._periods_ns.items()}
        self._next_ns = min(self._due_ns.values(), default=_NEVER)
        self.motor.advance(time_ns)

    def _pass(self, time_ns: int) -> None:
        """Advances the motor to an instant, and latches an error of the motor or of the watchdog."""
        fault = self.motor.advance(time_ns)
        if fault is not None and not self._silent:
            self._axis.latch(time_ns, ERRORS[fault])
        if self._axis.watched and self._axis.deadline_ns <= time_ns:
            self._axis.latch(time_ns, AxisError.WATCHDOG_TIMER_EXPIRED)

    def _refuse(self, reason: str) -> list[Frame]:
        """Counts a refused frame; returns no answers."""
        self.refused[str(reason)] += 1
        return []

    def _report_due(self, time_ns: int, frames: list[Frame]) -> None:
        """Adds the cyclic reports that are due to `frames`."""
        for command, due_ns in self._due_ns.items():
            if due_ns <= time_ns:
                self._due_ns[command] = due_ns + self._periods_ns[command]
                if command is Command.GET_TORQUES:
                    self._mean = self.motor.mean_torque(time_ns)
                if not self._silent:
                    frames.append(self._report(time_ns, command))
        self._next_ns = min(self._due_ns.values(), default=_NEVER)

    def _report(self, time_ns: int, command: Command) -> Frame:
        """Returns a report of the axis: cyclic, or on request."""
        motor, axis = self.motor, self._axis
        values: tuple[float, ...]
        if command is Command.GET_TORQUES:
            if command not in self._periods_ns:
                self._mean = motor.mean_torque(time_ns)
            values = (axis.limited_torque(), self._mean)
        elif command is Command.GET_ENCODER_ESTIMATES:
            values = (motor.position + axis.offset, motor.velocity)
        elif command is Command.HEARTBEAT:
            values = (axis.errors, axis.state, axis.result, 0)
        elif command is Command.GET_ERROR:
            values = (axis.errors, axis.disarm_reason)
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
