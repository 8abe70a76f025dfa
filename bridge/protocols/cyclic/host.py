"""The host of a robot's drive in a cyclic protocol.  Pure: frames and the time in, frames out.

There is exactly one command per cycle; enabling, clearing and the emergency stop are flags in it:

state       entered when                                       what the commands say
stopped     `stop` or `estop` is called                        no enable; after `estop` the emergency stop
bring-up    at first; `start` is called; a fault is cleared    enable with zero torque, until feedback says that both wheels
                                                               are enabled
enabled     feedback says that both wheels are enabled         enable with the wanted torques
fault       feedback reports a fault, or none came for the     no enable; clear from `recovers_after_ns` later on, at once
            watchdog's time                                    for faults from before a `start`; a later feedback without
                                                               fault ends it
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from math import isfinite
from typing import Final

from echelon.bridge.protocols.cyclic.frames import REMOTE, Command, Feedback, WheelState, fault_text
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import WHEELS, Frame, recovers_after_ns
from echelon.plan.can_plan import NEVER_NS, DrivePlan

SILENT: Final = "silent"
_DISABLED: Final = (WheelState.DISABLED, WheelState.DISABLED)
_ENABLED: Final = (WheelState.ENABLED, WheelState.ENABLED)
_NO_TORQUE: Final = (0.0, 0.0)
_BOTH: Final = (True, True)


class CyclicHost(ABC):
    """The host of a robot's drive; `identifiers` are those it listens to."""

    def __init__(self, plan: DrivePlan, identifiers: Iterable[int]) -> None:
        self.plan = plan
        self.identifiers = frozenset(identifiers)
        self.refused: Counter[str] = Counter()
        self.torque = _NO_TORQUE
        self.torque_ns: int | None = None
        self.clipped = 0
        self.enabled = False
        """True while both wheels take torque, by the last feedback"""
        self._states = _DISABLED  # as last reported
        self._fault = ""
        self._fault_ns = 0  # when the fault was noticed
        self._clearing_ns: int | None = None  # since when commands clear; None: they do not
        self._started = True
        self._estopped = False
        self._starts = False  # `start` was called, but `poll` was not called since
        self._old_until_ns = -NEVER_NS  # faults noticed up to this instant are from before `start`

    @abstractmethod
    def encode(self, command: Command, saturated: bool) -> list[Frame]:
        """Returns the frames of a command.  Torques beyond the range of a frame are cut and may be counted in `clipped`.

        `saturated`: the robot's own torque limit was reached; a frame may carry this as information."""

    @abstractmethod
    def decode(self, frame: Frame) -> Feedback | str | None:
        """Returns the feedback in a data frame with one of `identifiers`, or the reason to refuse it.

        Returns None for a valid frame that is no feedback.  Never raises."""

    @property
    def fault(self) -> str:
        """The present fault in words; empty without one."""
        return self._fault

    def poll(self, time_ns: int) -> list[Frame]:
        """Checks for silence and for a fault that may be cleared now.  Returns no frames: the command carries everything."""
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
        """Returns the command for wheel torques [N m].  It says zero until both wheels are enabled.

        Raises ValueError for torques that are not finite.
        """
        if not isfinite(tau_right + tau_left) and not (isfinite(tau_right) and isfinite(tau_left)):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        if self.enabled:
            # a command at every period of every robot: made in half the time of Command(…)
            return self.encode(tuple.__new__(Command, ((tau_right, tau_left), _BOTH, False, False)), saturated)
        ready, clear = self._started and not self._fault, self._clearing_ns is not None
        return self.encode(Command(_NO_TORQUE, (ready, ready), clear, self._estopped), saturated)

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns the command that disables both wheels.  They stay disabled until `start`."""
        self._halt()
        return self.mirror(0.0, 0.0, False)

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the command with the emergency stop.  All commands until `start` repeat it."""
        self._halt()
        self._estopped = True
        return self.encode(Command(_NO_TORQUE, (False, False), False, True), False)

    def start(self) -> None:
        """Lets the wheels be enabled (again), whatever was wrong before."""
        self._started = self._starts = True
        self._estopped = False
        self._decide()

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
            self._decide()

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the command for finite wheel torques [N m], whatever the drive reported."""
        torques = (tau_right, tau_left) if enable else _NO_TORQUE
        return self.encode(Command(torques, (enable, enable), False, False), saturated)

    def _decide(self) -> None:
        self.enabled = self._started and not self._fault and self._states == _ENABLED

    def _halt(self) -> None:
        self._started = self.enabled = False
        self._states = _DISABLED
        self._clearing_ns = None

    def _fail(self, time_ns: int, text: str) -> None:
        if not self._fault:
            self._fault_ns = time_ns
        self._fault, self.enabled = text, False


def _fault_text(faults: tuple[Fault | None, Fault | None]) -> str:
    """Returns the faults of the wheels in words; "" without any."""
    named = zip(WHEELS, map(fault_text, faults), strict=True)
    return ", ".join(f"{wheel}: {text}" for wheel, text in named if text)
