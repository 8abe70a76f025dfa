"""What commands a robot's drive in a protocol with one command and one feedback per cycle.

Pure: frames and the time in, frames out.  One command per cycle, whatever it says; clearing and enabling are parts of it.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from math import isfinite
from typing import Final

from echelon.bridge.protocols.cyclic.frames import REMOTE, Command, Feedback, WheelState, fault_text
from echelon.bridge.protocols.frame import WHEELS, Frame, recovers_after_ns
from echelon.bridge.protocols.motor import Fault
from echelon.plan.can_plan import NEVER_NS, DrivePlan

SILENT: Final = "silent"
_DISABLED: Final = (WheelState.DISABLED, WheelState.DISABLED)
_ENABLED: Final = (WheelState.ENABLED, WheelState.ENABLED)
_NO_TORQUE: Final = (0.0, 0.0)


class CyclicHost(ABC):
    """The host of a robot's drive; it listens to `identifiers`."""

    def __init__(self, plan: DrivePlan, identifiers: Iterable[int]) -> None:
        self.plan = plan
        self.identifiers = frozenset(identifiers)
        self.refused: Counter[str] = Counter()
        self.torque = _NO_TORQUE
        self.torque_ns: int | None = None
        self.clipped = 0
        self._states = _DISABLED  # as last heard
        self._fault = ""
        self._fault_ns = 0  # when it was noticed
        self._clearing_ns: int | None = None  # since when commands clear
        self._started = True
        self._estopped = False
        self._starts = False  # `start` was called, and `poll` not yet
        self._old_until_ns = -NEVER_NS  # faults noticed by then are from before a start

    @abstractmethod
    def encode(self, command: Command, saturated: bool) -> list[Frame]:
        """Returns the frames of a command; torques that do not fit are cut, and may be counted in `clipped`.

        `saturated`: the robot's own torque limit was reached; a protocol may say so."""

    @abstractmethod
    def decode(self, frame: Frame) -> Feedback | str | None:
        """Returns what a data frame with one of `identifiers` says, or why it is refused; None if it is fine, but no feedback.
        Raises nothing, whatever comes."""

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
        if self.torque_ns is not None and time_ns - self.torque_ns >= self.plan.watchdog_ns:
            self._states = _DISABLED
            self._fail(time_ns, SILENT)
        if self._starts:
            self._starts, self._old_until_ns = False, time_ns + self.plan.watchdog_ns
        if self._fault and self._started and self._clearing_ns is None:
            recover_ns = 0 if self._fault_ns <= self._old_until_ns else recovers_after_ns(self.plan, time_ns)
            if recover_ns is not None and time_ns - self._fault_ns >= recover_ns:
                self._clearing_ns = time_ns
        return []

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the command for wheel torques [N m], finite ones; it says zero while a wheel is not enabled.

        Raises ValueError for torques that are not finite.
        """
        if not (isfinite(tau_right) and isfinite(tau_left)):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        if self.enabled:
            return self.mirror(tau_right, tau_left, True, saturated)
        ready = self._started and not self._fault
        clear = self._clearing_ns is not None
        return self.encode(Command(_NO_TORQUE, (ready, ready), clear, self._estopped), saturated)

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns the command that disables both wheels; they stay so until `start`."""
        self._halt()
        return self.mirror(0.0, 0.0, False)

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the command that makes both wheels fault at once; those of all cycles until `start` do, too."""
        self._halt()
        self._estopped = True
        return self.encode(Command(_NO_TORQUE, (False, False), False, True), False)

    def start(self) -> None:
        """Lets the wheels be enabled (again), whatever was wrong until then."""
        self._started = self._starts = True
        self._estopped = False

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""
        heard = REMOTE if frame.remote else self.decode(frame)
        if isinstance(heard, str):
            self.refused[heard] += 1
        elif heard is not None:
            self.torque, self.torque_ns, self._states = heard.torques, time_ns, heard.states
            if WheelState.FAULT in heard.states:
                self._fail(time_ns, _fault_text(heard.faults) or "fault")
            elif self._clearing_ns is not None and time_ns > self._clearing_ns:
                self._fault, self._clearing_ns = "", None

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the command for wheel torques [N m], finite ones, whatever the drive says."""
        torques = (tau_right, tau_left) if enable else _NO_TORQUE
        return self.encode(Command(torques, (enable, enable), False, False), saturated)

    def _halt(self) -> None:
        self._started = False
        self._states = _DISABLED
        self._clearing_ns = None

    def _fail(self, time_ns: int, text: str) -> None:
        if not self._fault:
            self._fault_ns = time_ns
        self._fault = text


def _fault_text(faults: tuple[Fault | None, Fault | None]) -> str:
    """Returns what is wrong with the wheels, in words; empty if nothing is."""
    named = zip(WHEELS, map(fault_text, faults), strict=True)
    return ", ".join(f"{wheel}: {text}" for wheel, text in named if text)
