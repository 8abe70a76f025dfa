"""The bridge's side of the native protocol: commands a robot's drive, and reads its feedback."""

from echelon.bridge.protocols.cyclic import Command, CyclicHost, Feedback
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import (
    BASE_ID,
    FEEDBACK_ID,
    STATUS_ID,
    NativeCodec,
    Refusal,
    Status,
    decode_status,
    frame_id,
)
from echelon.bridge.protocols.native.counter import CounterCheck
from echelon.bridge.protocols.native.drive import FAULTS, REPEATED
from echelon.plan.can_plan import DrivePlan


class NativeHost(CyclicHost):
    """The host of the robot whose number is the node id in the plan.  Raises ValueError for one outside 0 .. 126."""

    def __init__(self, plan: DrivePlan) -> None:
        self._robot = plan.node_ids[0]
        self._command_id = frame_id(self._robot, BASE_ID)
        self._feedback_id = frame_id(self._robot, FEEDBACK_ID)
        self._status_id = frame_id(self._robot, STATUS_ID)
        super().__init__(plan, [self._feedback_id, self._status_id])
        self._codec = NativeCodec(plan.torque_scale)
        self.status: Status | None = None
        """The last status: speeds, supply voltage, temperature"""
        self.counter = CounterCheck()
        """Missing and repeated feedback"""
        self._status_counter = CounterCheck()
        self._sent = 0

    def encode(self, command: Command, saturated: bool) -> list[Frame]:
        """Returns the frame of a command, with the next counter."""
        (tau_right, tau_left), enable, clear, estop = command
        data, clipped = self._codec.encode(
            self._robot, tau_right, tau_left, self._sent, enable=enable, saturated=saturated, clear=clear, estop=estop
        )
        self._sent += 1
        self.clipped += clipped
        return [Frame(self._command_id, data)]

    def decode(self, frame: Frame) -> Feedback | str | None:
        """Returns a feedback, or the reason to refuse a frame; keeps a status and returns None for it."""
        if frame.can_id == self._feedback_id:
            said = self._codec.decode_feedback(frame.can_id, frame.data)
            if isinstance(said, Refusal):
                return said
            if self.counter.step(said.counter) < 0:
                return REPEATED
            return Feedback(said.torques, said.states, (FAULTS[said.faults[0]], FAULTS[said.faults[1]]))
        status = decode_status(frame.can_id, frame.data) if frame.can_id == self._status_id else Refusal.ID
        if isinstance(status, Refusal):
            return status
        if self._status_counter.step(status.counter) < 0:
            return REPEATED
        self.status = status
        return None
