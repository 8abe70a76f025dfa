"""The observer of the native frames of one robot.  Pure."""

from echelon.bridge.protocols.cyclic import Command, CyclicObserver, Feedback
from echelon.bridge.protocols.cyclic.observe import Said
from echelon.bridge.protocols.frame import WHEELS, Frame
from echelon.bridge.protocols.native.codec import (
    BASE_ID,
    FEEDBACK_ID,
    STATUS_EVERY,
    STATUS_ID,
    NativeCodec,
    Refusal,
    decode_status,
    frame_id,
)
from echelon.bridge.protocols.native.counter import CounterCheck
from echelon.bridge.protocols.native.drive import FAULTS
from echelon.plan.can_plan import DrivePlan, EnvelopePlan


class NativeObserver(CyclicObserver):
    """Listens to the frames of the robot whose number is the node id in the plan.

    Kinds of findings, in addition to those of `CyclicObserver`:

    length, crc, value       an invalid frame
    counter repeated         a frame came twice
    counter gap              frames are missing
    torque while disabled    also: a command with torque for a wheel that it does not enable
    """

    def __init__(self, plan: DrivePlan, envelope: EnvelopePlan) -> None:
        self._command_id, self._feedback_id, self._status_id = (
            frame_id(plan.node_ids[0], base) for base in (BASE_ID, FEEDBACK_ID, STATUS_ID)
        )
        periods = {self._command_id: 1, self._feedback_id: 1, self._status_id: STATUS_EVERY}
        cyclic = {can_id: plan.period_ns * every for can_id, every in periods.items()}
        super().__init__(plan, envelope, plan.torque_scale, cyclic)
        self._codec = NativeCodec(plan.torque_scale)
        self._counters = {can_id: CounterCheck() for can_id in self.identifiers}

    def decode(self, frame: Frame, said: Said) -> Command | Feedback | None:
        """Returns a command or a feedback; keeps the wheel speeds of a status and returns None for it."""
        can_id, data, _ = frame
        if can_id == self._command_id:
            command = self._codec.decode(can_id, data)
            if isinstance(command, Refusal):
                said.append(_refused(data, command))
            elif self._counted(can_id, command.counter, said):
                enable = command.enable_right, command.enable_left
                for wheel, name in enumerate(WHEELS):
                    if not enable[wheel] and any(data[2 * wheel : 2 * wheel + 2]):
                        text = f"{name}: the command does not enable, but asks for torque"
                        said.append(("torque while disabled", text))
                return Command((command.tau_right, command.tau_left), enable, command.clear, command.estop)
        elif can_id == self._feedback_id:
            feedback = self._codec.decode_feedback(can_id, data)
            if isinstance(feedback, Refusal):
                said.append(_refused(data, feedback))
            elif self._counted(can_id, feedback.counter, said):
                right, left = feedback.faults
                return Feedback(feedback.torques, feedback.states, (FAULTS[right], FAULTS[left]))
        else:
            status = decode_status(can_id, data)
            if isinstance(status, Refusal):
                said.append(_refused(data, status))
            elif self._counted(can_id, status.counter, said):
                for reading, speed in zip(self.wheels, status.speeds, strict=True):
                    reading.speed = speed
        return None

    def _counted(self, can_id: int, counter: int, said: Said) -> bool:
        missing = self._counters[can_id].step(counter)
        if missing < 0:
            said.append(("counter repeated", f"counter {counter} again"))
        elif missing:
            said.append(("counter gap", f"{missing} frames missing before counter {counter}"))
        return missing >= 0


def _refused(data: bytes, refusal: Refusal) -> tuple[str, str]:
    return refusal.value, f"{data.hex().upper() or 'no data'} is no valid frame"
