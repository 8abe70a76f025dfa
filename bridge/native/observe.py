"""A passive listener to the native frames of one robot: what they say, and what must not be.  Pure."""

from echelon.bridge.frame import WHEELS, Frame
from echelon.bridge.native.codec import (
    BASE_ID,
    FEEDBACK_ID,
    STATUS_EVERY,
    STATUS_ID,
    FaultCode,
    Feedback,
    NativeCodec,
    Refusal,
    Torque,
    WheelState,
    decode_status,
    frame_id,
)
from echelon.bridge.native.counter import CounterCheck
from echelon.bridge.observe import Finding, WheelReading
from echelon.can_plan import DrivePlan, EnvelopePlan


class NativeObserver:
    """Listens to the frames of robot number `robot`.  Kinds of findings:

    `remote`, `length`, `crc`, `value`: no frame of the protocol; `counter repeated`, `counter gap`: frames came twice,
    or are missing; `torque above limit`: commanded or reported, beyond the envelope's by more than half a bit; `torque
    while disabled`: commanded for a wheel that the same frame does not enable, or reported by one that was not enabled
    in the time it reports of; `torque after silence`: reported though no command came for the watchdog and a period;
    `enabled with torque`: the command that enables already asks for torque; `fault left without clear`.
    """

    def __init__(self, plan: DrivePlan, envelope: EnvelopePlan, robot: int) -> None:
        self._command_id = frame_id(robot, BASE_ID)
        self._feedback_id = frame_id(robot, FEEDBACK_ID)
        self._status_id = frame_id(robot, STATUS_ID)
        self.identifiers = frozenset((self._command_id, self._feedback_id, self._status_id))
        self.cyclic = {
            self._command_id: plan.period_ns,
            self._feedback_id: plan.period_ns,
            self._status_id: plan.period_ns * STATUS_EVERY,
        }
        self.wheels = (WheelReading(), WheelReading())
        self._codec = NativeCodec(plan.torque_scale)
        self._silence_ns = plan.watchdog_ns + plan.period_ns
        self._limit = envelope.torque_limit + 0.500001 * plan.torque_scale
        self._counters = {can_id: CounterCheck() for can_id in self.identifiers}
        self._last_command: Torque | None = None
        self._last_feedback: Feedback | None = None
        self._command_ns: int | None = None
        self._begin_ns: int | None = None  # when the first frame came
        self._enabling = [True, True]  # a command enabled the wheel since the last feedback, or may have
        self._cleared = False  # a command cleared since the last feedback without fault, or may have

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns what is wrong with it.  Other robots' frames say nothing."""
        if frame.can_id not in self.identifiers:
            return []
        if self._begin_ns is None:
            self._begin_ns = time_ns
        if frame.remote:
            return [Finding(time_ns, frame.can_id, "remote", "nobody answers remote frames")]
        said: list[tuple[str, str]] = []
        if frame.can_id == self._command_id:
            command = self._codec.decode(*frame[:2])
            if isinstance(command, Refusal):
                return [_refused(time_ns, frame, command)]
            if self._counted(frame.can_id, command.counter, said):
                self._command(time_ns, command, frame.data, said)
        elif frame.can_id == self._feedback_id:
            feedback = self._codec.decode_feedback(*frame[:2])
            if isinstance(feedback, Refusal):
                return [_refused(time_ns, frame, feedback)]
            if self._counted(frame.can_id, feedback.counter, said):
                self._feedback(time_ns, feedback, said)
        else:
            status = decode_status(*frame[:2])
            if isinstance(status, Refusal):
                return [_refused(time_ns, frame, status)]
            if self._counted(frame.can_id, status.counter, said):
                for wheel, speed in zip(self.wheels, status.speeds, strict=True):
                    wheel.speed = speed
        return [Finding(time_ns, frame.can_id, kind, text) for kind, text in said]

    def _counted(self, can_id: int, counter: int, said: list[tuple[str, str]]) -> bool:
        missing = self._counters[can_id].step(counter)
        if missing < 0:
            said.append(("counter repeated", f"counter {counter} again"))
        elif missing:
            said.append(("counter gap", f"{missing} frames missing before counter {counter}"))
        return missing >= 0

    def _command(self, time_ns: int, command: Torque, data: bytes, said: list[tuple[str, str]]) -> None:
        last, self._last_command, self._command_ns = self._last_command, command, time_ns
        for wheel, name in enumerate(WHEELS):
            torque, enable = command[1 + wheel], command[3 + wheel]
            self.wheels[wheel].commanded, self.wheels[wheel].commanded_ns = torque, time_ns
            self._above(name, torque, said)
            if enable:
                self._enabling[wheel] = True
                if torque and last is not None and not last[3 + wheel]:
                    said.append(("enabled with torque", f"{name}: {torque:g} N m"))
            elif any(data[2 * wheel : 2 * wheel + 2]):
                said.append(("torque while disabled", f"{name}: the command does not enable, but asks for torque"))
        self._cleared |= command.clear

    def _feedback(self, time_ns: int, feedback: Feedback, said: list[tuple[str, str]]) -> None:
        last, self._last_feedback = self._last_feedback, feedback
        assert self._begin_ns is not None
        silent_ns = time_ns - (self._begin_ns if self._command_ns is None else self._command_ns)
        for wheel, name in enumerate(WHEELS):
            torque, state, fault = feedback.torques[wheel], feedback.states[wheel], feedback.faults[wheel]
            reading = self.wheels[wheel]
            reading.reported, reading.reported_ns, reading.state = torque, time_ns, state.name.lower()
            reading.fault = fault.name.lower().replace("_", " ") if fault is not FaultCode.NONE else ""
            self._above(name, torque, said)
            before = last.states[wheel] if last is not None else None
            if torque and silent_ns > self._silence_ns:
                said.append(("torque after silence", f"{name}: {torque:g} N m, {silent_ns / 1e9:g} s after a command"))
            idle = before is not None and WheelState.ENABLED not in (state, before) and not self._enabling[wheel]
            if torque and idle:
                said.append(("torque while disabled", f"{name}: {torque:g} N m while {reading.state}"))
            if before is WheelState.FAULT and state is not WheelState.FAULT and not self._cleared:
                said.append(("fault left without clear", f"{name}: {reading.state} after a fault"))
            self._enabling[wheel] = False
        self._cleared &= WheelState.FAULT in feedback.states

    def _above(self, name: str, torque: float, said: list[tuple[str, str]]) -> None:
        if abs(torque) > self._limit:
            said.append(("torque above limit", f"{name}: {torque:g} N m"))


def _refused(time_ns: int, frame: Frame, refusal: Refusal) -> Finding:
    return Finding(time_ns, frame.can_id, refusal.value, f"{frame.data.hex().upper() or 'no data'} is no valid frame")
