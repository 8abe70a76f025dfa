"""A virtual drive with the native protocol, for both wheels of a robot (bridge.protocols.native.codec)."""

from math import tau
from typing import Final

from echelon.bridge.protocols.cyclic import Command, CyclicDrive
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import (
    BASE_ID,
    FEEDBACK_ID,
    STATUS_EVERY,
    STATUS_ID,
    FaultCode,
    Feedback,
    NativeCodec,
    Refusal,
    Status,
    encode_status,
    frame_id,
)
from echelon.bridge.protocols.native.counter import CounterCheck
from echelon.plan.can_plan import DrivePlan

CODES: Final = {
    None: FaultCode.NONE,
    Fault.OVER_TEMPERATURE: FaultCode.OVER_TEMPERATURE,
    Fault.ENCODER_LOSS: FaultCode.ENCODER_LOSS,
    Fault.BROWN_OUT: FaultCode.BROWN_OUT,
    Fault.WATCHDOG: FaultCode.WATCHDOG,
    Fault.ESTOP: FaultCode.ESTOP,
}
FAULTS: Final = {code: fault for fault, code in CODES.items()}
REPEATED: Final = "counter repeated"


class NativeDrive(CyclicDrive):
    """The drive of the robot whose number is the node id in the plan.  Raises ValueError for one outside 0 .. 126.

    bridge.protocols.cyclic.drive has the states of a wheel."""

    def __init__(self, plan: DrivePlan) -> None:
        self._robot = plan.node_ids[0]
        super().__init__(plan, [frame_id(self._robot, BASE_ID)])
        self._feedback_id = frame_id(self._robot, FEEDBACK_ID)
        self._status_id = frame_id(self._robot, STATUS_ID)
        self._codec = NativeCodec(plan.torque_scale)
        self.counter = CounterCheck()
        """Missing and repeated commands"""
        self._sent = 0  # number of feedback frames

    def decode(self, frame: Frame) -> Command | str:
        """Returns a command, or the reason to refuse it; one that repeats the last counter is refused."""
        said = self._codec.decode(frame.can_id, frame.data) if frame.can_id in self.identifiers else Refusal.ID
        if isinstance(said, Refusal):
            return said
        if self.counter.step(said.counter) < 0:
            return REPEATED
        torques, enable = (said.tau_right, said.tau_left), (said.enable_right, said.enable_left)
        return Command(torques, enable, said.clear, said.estop)

    def report(self, torques: tuple[float, float]) -> list[Frame]:
        """Returns the feedback of an instant, every tenth time with the status."""
        right, left = self.motors
        states, faults = (self.states[0], self.states[1]), (CODES[self.faults[0]], CODES[self.faults[1]])
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

    def power_on(self, time_ns: int) -> None:
        """Begins anew and accepts any counter next."""
        self.counter.forget()
        super().power_on(time_ns)
