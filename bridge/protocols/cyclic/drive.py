"""The virtual drive of both wheels of a robot in a cyclic protocol.  Pure: frames and the time in, frames out.

Each wheel has a state of its own:

state       entered when                                         what a command does there
disabled    at power-on; by a command without enable, from       with enable and zero torque: enabled; with enable and torque:
            enabled; by a command that clears, from fault        refused
enabled     by a command with enable and zero torque             sets the torque; without enable: disabled
fault       by a fault, an emergency stop, or the watchdog:      with clear: disabled if the cause is gone, otherwise refused;
            an enabled wheel without a valid command             with torque: refused

A command that clears does not enable.  `refused` counts for each wheel: a command may be accepted by one and refused by the
other.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from typing import Final

from echelon.bridge.protocols.cyclic.frames import REMOTE, Command, WheelState
from echelon.bridge.protocols.faults import LATCHING, ON_DEMAND, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.motor import Motor
from echelon.plan.can_plan import NEVER_NS, DrivePlan

FIRST_NOT_ZERO: Final = "first command not zero"
NOT_CLEARED: Final = "fault not cleared"
CAUSE_PERSISTS: Final = "cause persists"


class CyclicDrive(ABC):
    """The drive of a robot's wheels.  `motors` are the right and the left one; `identifiers` are those it listens to."""

    def __init__(self, plan: DrivePlan, identifiers: Iterable[int]) -> None:
        self.plan = plan
        self.identifiers = frozenset(identifiers)
        self.motors: tuple[Motor, ...] = (Motor(plan.motor), Motor(plan.motor))
        self.refused: Counter[str] = Counter()
        self.states = [WheelState.DISABLED, WheelState.DISABLED]
        self.faults: list[Fault | None] = [None, None]
        self._silent: set[int] = set()  # wheels at which the fault SILENT was injected
        self._now_ns: int | None = None
        self._feedback_ns = -NEVER_NS  # when the next feedback is due
        self._heard_ns = 0  # when a command last fed the watchdog
        self._pending: list[Frame] = []  # frames that became due in `mend`, which returns none

    @abstractmethod
    def decode(self, frame: Frame) -> Command | str:
        """Returns the command in a data frame with one of `identifiers`, or the reason to refuse it.  Never raises."""

    @abstractmethod
    def report(self, torques: tuple[float, float]) -> list[Frame]:
        """Returns the feedback frames of an instant: `torques` [N m], means since the last feedback, and the attributes
        `states` and `faults`."""

    @property
    def due_ns(self) -> int:
        """When `advance` must be called next; at once before the first call."""
        if self._pending or self._now_ns is None:
            return -NEVER_NS
        return min(self._feedback_ns, self._expires_ns)

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a command; returns the frames that were due before.  Commands have no answers."""
        frames = self.advance(time_ns)
        if self._silent:
            return frames
        command = REMOTE if frame.remote else self.decode(frame)
        if isinstance(command, str):
            self.refused[command] += 1
            return frames
        self._heard_ns = time_ns
        torques, enable, clear, estop = command
        for wheel in (0, 1):
            if estop:
                self._fail(time_ns, wheel, Fault.ESTOP)
            else:
                self._obey(time_ns, wheel, enable[wheel], torques[wheel], clear)
        return frames

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns the feedback that is due by then."""
        if time_ns == self._now_ns and time_ns < self._feedback_ns and not self._pending and time_ns < self._expires_ns:
            return []  # this instant is done: several frames may come at one instant
        frames, self._pending = self._pending, []
        if self._now_ns is None:
            period_ns = self.plan.period_ns
            self._feedback_ns = -(-time_ns // period_ns) * period_ns
        while True:
            expires_ns = self._expires_ns
            at_ns = min(self._feedback_ns, expires_ns, time_ns)
            self._now_ns = at_ns
            for wheel, motor in enumerate(self.motors):
                fault = motor.advance(at_ns)
                if fault is not None:
                    self._fail(at_ns, wheel, fault)
            if expires_ns <= at_ns:
                for wheel in (0, 1):
                    if self.states[wheel] is WheelState.ENABLED:
                        self._fail(at_ns, wheel, Fault.WATCHDOG)
            if self._feedback_ns <= at_ns:
                right, left = self.motors
                torques = right.mean_torque(at_ns), left.mean_torque(at_ns)
                if not self._silent:
                    frames += self.report(torques)
                self._feedback_ns += self.plan.period_ns
            elif at_ns == time_ns:
                return frames

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault of `ON_DEMAND` happen at one wheel.  `SILENT` silences the whole drive.

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
        """Takes the cause of a fault away.  A drive that was silent starts as after power-on."""
        self._pending = self._at_wheel(time_ns, wheel, fault)
        if fault is not Fault.SILENT:
            self.motors[wheel].mend(time_ns, fault)
        elif wheel in self._silent:
            self._silent.discard(wheel)
            if not self._silent:
                self.power_on(time_ns)

    def power_on(self, time_ns: int) -> None:
        """Begins anew with both wheels disabled.  Faults whose cause is still present latch again."""
        for wheel, motor in enumerate(self.motors):
            self.states[wheel], self.faults[wheel] = WheelState.DISABLED, None
            for fault in LATCHING:
                if fault in motor.causes:
                    self._fail(time_ns, wheel, fault)

    @property
    def _expires_ns(self) -> int:
        enabled = WheelState.ENABLED in self.states
        return self._heard_ns + self.plan.watchdog_ns if enabled else NEVER_NS

    def _at_wheel(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        if wheel not in (0, 1):
            raise ValueError(f"wheel must be 0 (right) or 1 (left), not {wheel!r}")
        if fault not in ON_DEMAND:
            raise ValueError(f"no fault on demand: {fault!r}; there are {', '.join(ON_DEMAND)}")
        return self.advance(time_ns)

    def _obey(self, time_ns: int, wheel: int, enable: bool, torque: float, clear: bool) -> None:
        """Applies a valid command to one wheel."""
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
                self.states[wheel], self.faults[wheel] = WheelState.DISABLED, None
        elif torque:
            self.refused[NOT_CLEARED] += 1

    def _fail(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Latches a fault; feedback reports the first one."""
        self.motors[wheel].cut(time_ns)
        if self.states[wheel] is not WheelState.FAULT and not self._silent:
            self.states[wheel], self.faults[wheel] = WheelState.FAULT, fault
