"""The bridge's side of the native protocol: commands a robot's drive, and learns from its feedback.

Pure: frames and the time in, frames out.  One command per cycle, whatever it says; clearing and enabling are bits of it.
"""

from collections import Counter
from typing import Final

from echelon.bridge.frame import WHEELS, Frame, recovers_after_ns
from echelon.bridge.native.codec import (
    BASE_ID,
    FEEDBACK_ID,
    STATUS_ID,
    FaultCode,
    NativeCodec,
    Refusal,
    Status,
    WheelState,
    decode_status,
    frame_id,
)
from echelon.bridge.native.counter import CounterCheck
from echelon.can_plan import NEVER_NS, DrivePlan

SILENT: Final = "silent"
REMOTE: Final = "remote"
REPEATED: Final = "counter repeated"
_DISABLED: Final = (WheelState.DISABLED, WheelState.DISABLED)
_ENABLED: Final = (WheelState.ENABLED, WheelState.ENABLED)


def fault_text(faults: tuple[FaultCode, FaultCode]) -> str:
    """Returns what is wrong with the wheels, in words; empty if nothing is."""
    named = zip(WHEELS, faults, strict=True)
    return ", ".join(f"{wheel}: {fault.name.lower().replace('_', ' ')}" for wheel, fault in named if fault)


class NativeHost:
    """The host of the drive of robot number `robot`.  Raises ValueError for a number outside 0 .. 126."""

    def __init__(self, plan: DrivePlan, robot: int) -> None:
        self._robot = robot
        self._command_id = frame_id(robot, BASE_ID)
        self._feedback_id = frame_id(robot, FEEDBACK_ID)
        self._status_id = frame_id(robot, STATUS_ID)
        self.identifiers = frozenset((self._feedback_id, self._status_id))
        self._plan = plan
        self._codec = NativeCodec(plan.torque_scale)
        self.refused: Counter[str] = Counter()
        self.torque = (0.0, 0.0)
        self.torque_ns: int | None = None
        self.status: Status | None = None
        """Speeds, supply voltage and temperature as last heard"""
        self.counter = CounterCheck()
        """Feedback by its counters: how many are missing"""
        self.clipped = 0
        """Torques that did not fit into the frame"""
        self._states = _DISABLED  # as last heard
        self._faults = (FaultCode.NONE, FaultCode.NONE)
        self._fault = ""
        self._fault_ns = 0  # when it was noticed
        self._clearing_ns: int | None = None  # since when commands clear
        self._status_counter = CounterCheck()
        self._started = True
        self._estopped = False
        self._starts = False  # `start` was called, and `poll` not yet
        self._old_until_ns = -NEVER_NS  # faults noticed by then are from before a start
        self._sent = 0

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, as far as their drive said."""
        return self._started and not self._fault and self._states == _ENABLED

    @property
    def fault(self) -> str:
        """What is wrong, in words; empty if nothing is."""
        return self._fault

    def poll(self, time_ns: int) -> list[Frame]:
        """Notices silence, and when a fault is to be cleared; sends nothing, for commands say it all."""
        if self.torque_ns is not None and time_ns - self.torque_ns >= self._plan.watchdog_ns:
            self._states = _DISABLED
            self._fail(time_ns, SILENT)
        if self._starts:
            self._starts, self._old_until_ns = False, time_ns + self._plan.watchdog_ns
        if self._fault and self._started and self._clearing_ns is None:
            recover_ns = 0 if self._fault_ns <= self._old_until_ns else recovers_after_ns(self._plan, time_ns)
            if recover_ns is not None and time_ns - self._fault_ns >= recover_ns:
                self._clearing_ns = time_ns
        return []

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the command for wheel torques [N m], finite ones; it says zero while a wheel is not enabled.

        Raises ValueError for torques that are not finite.
        """
        if self.enabled:
            return self._send(tau_right, tau_left, saturated)
        if not abs(tau_right) + abs(tau_left) < float("inf"):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        ready = self._started and not self._fault
        clear = self._clearing_ns is not None
        return self._send(0.0, 0.0, saturated, enable=ready, clear=clear, estop=self._estopped)

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns the command that disables both wheels; they stay so until `start`."""
        self._started = False
        self._states = _DISABLED
        self._clearing_ns = None
        return self._send(0.0, 0.0, enable=False)

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the command that makes both wheels fault at once; those of all cycles until `start` do, too."""
        self._started, self._estopped = False, True
        self._states = _DISABLED
        self._clearing_ns = None
        return self._send(0.0, 0.0, enable=False, estop=True)

    def start(self) -> None:
        """Lets the wheels be enabled (again), whatever was wrong until then."""
        self._started = self._starts = True
        self._estopped = False

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes feedback or status."""
        refusal: str | None
        if frame.remote:
            refusal = REMOTE
        elif frame.can_id == self._feedback_id:
            refusal = self._take_feedback(time_ns, frame)
        elif frame.can_id == self._status_id:
            refusal = self._take_status(frame)
        else:
            refusal = Refusal.ID
        if refusal is not None:
            self.refused[refusal] += 1

    def _take_feedback(self, time_ns: int, frame: Frame) -> str | None:
        feedback = self._codec.decode_feedback(frame.can_id, frame.data)
        if isinstance(feedback, Refusal):
            return feedback
        if self.counter.step(feedback.counter) < 0:
            return REPEATED
        self.torque, self.torque_ns = feedback.torques, time_ns
        self._states, self._faults = feedback.states, feedback.faults
        if WheelState.FAULT in feedback.states:
            self._fail(time_ns, fault_text(feedback.faults) or "fault")
        elif self._clearing_ns is not None and time_ns > self._clearing_ns:
            self._fault, self._clearing_ns = "", None
        return None

    def _take_status(self, frame: Frame) -> str | None:
        status = decode_status(frame.can_id, frame.data)
        if isinstance(status, Refusal):
            return status
        if self._status_counter.step(status.counter) < 0:
            return REPEATED
        self.status = status
        return None

    def _fail(self, time_ns: int, text: str) -> None:
        if not self._fault:
            self._fault_ns = time_ns
        self._fault = text

    def _send(
        self,
        tau_right: float,
        tau_left: float,
        saturated: bool = False,
        *,
        enable: bool = True,
        clear: bool = False,
        estop: bool = False,
    ) -> list[Frame]:
        data, clipped = self._codec.encode(
            self._robot,
            tau_right,
            tau_left,
            self._sent,
            enable=(enable, enable),
            saturated=saturated,
            clear=clear,
            estop=estop,
        )
        self._sent += 1
        self.clipped += clipped
        return [Frame(self._command_id, data)]
