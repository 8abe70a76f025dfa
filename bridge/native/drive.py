"""A virtual drive that speaks the native protocol: one drive for both wheels of a robot (bridge.native.codec).

Pure: frames and the time in, frames out.  What a wheel does not accept is counted in `refused`, part by part: a command
may be good for one wheel and refused for the other.
"""

from collections import Counter
from math import tau
from typing import Final

from echelon.bridge.frame import Frame
from echelon.bridge.motor import LATCHING, ON_DEMAND, Fault, Motor
from echelon.bridge.native.codec import (
    BASE_ID,
    FEEDBACK_ID,
    STATUS_EVERY,
    STATUS_ID,
    FaultCode,
    Feedback,
    NativeCodec,
    Refusal,
    Status,
    WheelState,
    encode_status,
    frame_id,
)
from echelon.bridge.native.counter import CounterCheck
from echelon.can_plan import DrivePlan

CODES: Final = {
    Fault.OVER_TEMPERATURE: FaultCode.OVER_TEMPERATURE,
    Fault.ENCODER_LOSS: FaultCode.ENCODER_LOSS,
    Fault.BROWN_OUT: FaultCode.BROWN_OUT,
    Fault.WATCHDOG: FaultCode.WATCHDOG,
    Fault.ESTOP: FaultCode.ESTOP,
}
REMOTE: Final = "remote"
REPEATED: Final = "counter repeated"
FIRST_NOT_ZERO: Final = "first command not zero"
NOT_CLEARED: Final = "fault not cleared"
CAUSE_PERSISTS: Final = "cause persists"
_AT_ONCE: Final = -(1 << 62)
_NEVER: Final = 1 << 62


class NativeDrive:
    """The drive of the wheels of robot number `robot`; `motors` are the right and the left one.

    Raises ValueError for a number outside 0 .. 126.
    """

    def __init__(self, plan: DrivePlan, robot: int) -> None:
        self._robot = robot
        self._command_id = frame_id(robot, BASE_ID)
        self._feedback_id = frame_id(robot, FEEDBACK_ID)
        self._status_id = frame_id(robot, STATUS_ID)
        self._plan = plan
        self._codec = NativeCodec(plan.torque_scale)
        self.motors: tuple[Motor, ...] = (Motor(plan.motor), Motor(plan.motor))
        self.refused: Counter[str] = Counter()
        self.identifiers = frozenset((self._command_id,))
        self.counter = CounterCheck()
        """Commands by their counters: how many are missing"""
        self.states = [WheelState.DISABLED, WheelState.DISABLED]
        self.faults = [FaultCode.NONE, FaultCode.NONE]
        self._silent: set[int] = set()  # wheels for which it was made silent
        self._now_ns: int | None = None
        self._feedback_ns = _AT_ONCE  # when the next one is due
        self._heard_ns = 0  # when a command fed the watchdog
        self._sent = 0  # feedback frames
        self._pending: list[Frame] = []  # what was due when nobody could be told

    @property
    def due_ns(self) -> int:
        """When it next has something to do on its own: at once before the first call."""
        if self._pending or self._now_ns is None:
            return _AT_ONCE
        return min(self._feedback_ns, self._expires_ns)

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a command; answers nothing, but for what was due before."""
        frames = self.advance(time_ns)
        if self._silent:
            return frames
        if frame.remote:
            self.refused[REMOTE] += 1
            return frames
        command = self._codec.decode(frame.can_id, frame.data) if frame.can_id == self._command_id else Refusal.ID
        if isinstance(command, Refusal):
            self.refused[command] += 1
            return frames
        if self.counter.step(command.counter) < 0:
            self.refused[REPEATED] += 1
            return frames
        self._heard_ns = time_ns
        if command.estop:
            for wheel in (0, 1):
                self._fail(time_ns, wheel, Fault.ESTOP)
            return frames
        self._obey(time_ns, 0, command.enable_right, command.tau_right, command.clear)
        self._obey(time_ns, 1, command.enable_left, command.tau_left, command.clear)
        return frames

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns feedback and status due by then."""
        frames, self._pending = self._pending, []
        if self._now_ns is None:
            period_ns = self._plan.period_ns
            self._feedback_ns = -(-time_ns // period_ns) * period_ns
        while True:
            at_ns = min(self._feedback_ns, self._expires_ns, time_ns)
            self._now_ns = at_ns
            for wheel, motor in enumerate(self.motors):
                fault = motor.advance(at_ns)
                if fault is not None:
                    self._fail(at_ns, wheel, fault)
            if self._expires_ns <= at_ns:
                for wheel in (0, 1):
                    if self.states[wheel] is WheelState.ENABLED:
                        self._fail(at_ns, wheel, Fault.WATCHDOG)
            if self._feedback_ns <= at_ns:
                frames += self._report(at_ns)
                self._feedback_ns += self._plan.period_ns
            elif at_ns == time_ns:
                return frames

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault of `ON_DEMAND` happen at one wheel; `SILENT` concerns the whole drive.

        Raises ValueError for another fault or wheel.
        """
        frames = self._at_wheel(time_ns, wheel, fault)
        if fault is Fault.SILENT:
            self._silent.add(wheel)
            for motor in self.motors:
                motor.cut(time_ns)
            self.states = [WheelState.DISABLED, WheelState.DISABLED]
        else:
            self.motors[wheel].inject(time_ns, fault)
            if fault in LATCHING:
                self._fail(time_ns, wheel, fault)
        return frames

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Takes the cause of a fault away.  A drive that was silent is as after power-on."""
        self._pending = self._at_wheel(time_ns, wheel, fault)
        if fault is not Fault.SILENT:
            self.motors[wheel].mend(time_ns, fault)
        elif wheel in self._silent:
            self._silent.discard(wheel)
            if not self._silent:
                self._power_on(time_ns)

    @property
    def _expires_ns(self) -> int:
        enabled = WheelState.ENABLED in self.states
        return self._heard_ns + self._plan.watchdog_ns if enabled else _NEVER

    def _at_wheel(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        if wheel not in (0, 1):
            raise ValueError(f"wheel must be 0 (right) or 1 (left), not {wheel!r}")
        if fault not in ON_DEMAND:
            raise ValueError(f"no fault on demand: {fault!r}; there are {', '.join(ON_DEMAND)}")
        return self.advance(time_ns)

    def _obey(self, time_ns: int, wheel: int, enable: bool, torque: float, clear: bool) -> None:
        """Does with one wheel what a valid command says."""
        motor, state = self.motors[wheel], self.states[wheel]
        if state is WheelState.ENABLED:
            if enable:
                motor.set_torque(time_ns, torque)
            else:
                motor.cut(time_ns)
                self.states[wheel] = WheelState.DISABLED
        elif state is WheelState.DISABLED:
            if enable and torque:
                self.refused[FIRST_NOT_ZERO] += 1
            elif enable:
                motor.set_torque(time_ns, 0.0)
                self.states[wheel] = WheelState.ENABLED
        elif clear:
            if motor.causes:
                self.refused[CAUSE_PERSISTS] += 1
            else:
                self.states[wheel], self.faults[wheel] = WheelState.DISABLED, FaultCode.NONE
        elif torque:
            self.refused[NOT_CLEARED] += 1

    def _fail(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Latches a fault; the first one is the one that is told."""
        self.motors[wheel].cut(time_ns)
        if self.states[wheel] is not WheelState.FAULT and not self._silent:
            self.states[wheel], self.faults[wheel] = WheelState.FAULT, CODES[fault]

    def _power_on(self, time_ns: int) -> None:
        self.counter.forget()
        for wheel, motor in enumerate(self.motors):
            self.states[wheel], self.faults[wheel] = WheelState.DISABLED, FaultCode.NONE
            for fault in LATCHING:
                if fault in motor.causes:
                    self._fail(time_ns, wheel, fault)

    def _report(self, time_ns: int) -> list[Frame]:
        """Returns the feedback of an instant, and the status with every tenth."""
        right, left = self.motors
        torques = right.mean_torque(time_ns), left.mean_torque(time_ns)
        if self._silent:
            return []
        states, faults = (self.states[0], self.states[1]), (self.faults[0], self.faults[1])
        feedback = Feedback(self._robot, torques, states, faults, self._sent)
        frames = [Frame(self._feedback_id, self._codec.encode_feedback(feedback))]
        if self._sent % STATUS_EVERY == 0:
            status = Status(
                self._robot,
                (right.velocity * tau, left.velocity * tau),
                min(right.bus_voltage, left.bus_voltage),
                max(right.temperature, left.temperature),
                self._sent // STATUS_EVERY,
            )
            frames.append(Frame(self._status_id, encode_status(status)))
        self._sent += 1
        return frames
