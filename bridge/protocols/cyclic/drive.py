"""The virtual drive of both wheels of a robot, in a protocol with one command and one feedback per cycle.

A wheel is enabled by a command that enables it and asks for no torque; one that asks for torque at once is refused, for that
wheel.  A fault is left by a command that clears and finds its cause gone; that command does not enable.  Without a valid
command for the watchdog's time an enabled wheel faults.

Pure: frames and the time in, frames out.  What a wheel does not accept is counted in `refused`, part by part: a command may be
good for one wheel and refused for the other.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from typing import Final

from echelon.bridge.protocols.cyclic.frames import REMOTE, Command, WheelState
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.motor import LATCHING, ON_DEMAND, Fault, Motor
from echelon.plan.can_plan import NEVER_NS, DrivePlan

FIRST_NOT_ZERO: Final = "first command not zero"
NOT_CLEARED: Final = "fault not cleared"
CAUSE_PERSISTS: Final = "cause persists"


class CyclicDrive(ABC):
    """The drive of a robot's wheels; `motors` are the right and the left one.  It listens to `identifiers`."""

    def __init__(self, plan: DrivePlan, identifiers: Iterable[int]) -> None:
        self.plan = plan
        self.identifiers = frozenset(identifiers)
        self.motors: tuple[Motor, ...] = (Motor(plan.motor), Motor(plan.motor))
        self.refused: Counter[str] = Counter()
        self.states = [WheelState.DISABLED, WheelState.DISABLED]
        self.faults: list[Fault | None] = [None, None]
        self._silent: set[int] = set()  # wheels for which it was made silent
        self._now_ns: int | None = None
        self._feedback_ns = -NEVER_NS  # when the next one is due
        self._heard_ns = 0  # when a command fed the watchdog
        self._pending: list[Frame] = []  # what was due when nobody could be told

    @abstractmethod
    def decode(self, frame: Frame) -> Command | str:
        """Returns what a data frame with one of `identifiers` says, or why it is refused.  Raises nothing, whatever comes."""

    @abstractmethod
    def report(self, torques: tuple[float, float]) -> list[Frame]:
        """Returns the feedback of an instant; `torques` are means since the last one [N m], `states` and `faults` are the
        drive's own."""

    @property
    def due_ns(self) -> int:
        """When it next has something to do on its own: at once before the first call."""
        if self._pending or self._now_ns is None:
            return -NEVER_NS
        return min(self._feedback_ns, self._expires_ns)

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a command; answers nothing, but for what was due before."""
        frames = self.advance(time_ns)
        if self._silent:
            return frames
        command = REMOTE if frame.remote else self.decode(frame)
        if isinstance(command, str):
            self.refused[command] += 1
            return frames
        self._heard_ns = time_ns
        for wheel in (0, 1):
            if command.estop:
                self._fail(time_ns, wheel, Fault.ESTOP)
            else:
                self._obey(time_ns, wheel, command.enable[wheel], command.torques[wheel], command.clear)
        return frames

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns feedback due by then."""
        frames, self._pending = self._pending, []
        if self._now_ns is None:
            period_ns = self.plan.period_ns
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
                right, left = self.motors
                torques = right.mean_torque(at_ns), left.mean_torque(at_ns)
                if not self._silent:
                    frames += self.report(torques)
                self._feedback_ns += self.plan.period_ns
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
                self.power_on(time_ns)

    def power_on(self, time_ns: int) -> None:
        """Begins anew, with no wheel enabled; what causes a fault still does."""
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
                self.states[wheel], self.faults[wheel] = WheelState.DISABLED, None
        elif torque:
            self.refused[NOT_CLEARED] += 1

    def _fail(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Latches a fault; the first one is the one that is told."""
        self.motors[wheel].cut(time_ns)
        if self.states[wheel] is not WheelState.FAULT and not self._silent:
            self.states[wheel], self.faults[wheel] = WheelState.FAULT, fault
