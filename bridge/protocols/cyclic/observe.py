"""The observer of one robot in a cyclic protocol.  Pure."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

from echelon.bridge.protocols.cyclic.frames import REMOTE, Command, Feedback, WheelState, fault_text
from echelon.bridge.protocols.frame import WHEELS, Frame
from echelon.bridge.protocols.observe import Finding, WheelReading
from echelon.plan.can_plan import DrivePlan, EnvelopePlan

Said = list[tuple[str, str]]
"""The findings of one frame: kind and text of each."""


class CyclicObserver(ABC):
    """Listens to a robot's frames, those of `cyclic` (identifiers with their periods [ns]).

    Kinds of findings, in addition to those of `decode`:

    remote                      a remote frame, which cyclic protocols do not answer
    torque above limit          a commanded or reported torque exceeds the envelope's by more than half a `resolution` [N m]
    torque while disabled       a wheel reports torque though it was not enabled in the reported time
    torque after silence        a wheel reports torque though no command came for the watchdog and a period
    enabled with torque         the first command that enables a wheel already wants torque
    fault left without clear    a wheel leaves the fault state though no command cleared it
    """

    def __init__(self, plan: DrivePlan, envelope: EnvelopePlan, resolution: float, cyclic: Mapping[int, int]) -> None:
        self.plan = plan
        self.cyclic = dict(cyclic)
        self.identifiers = frozenset(cyclic)
        self.wheels = (WheelReading(), WheelReading())
        self._silence_ns = plan.watchdog_ns + plan.period_ns
        self._limit = envelope.torque_limit + 0.500001 * resolution
        self._last_command: Command | None = None
        self._last_feedback: Feedback | None = None
        self._command_ns: int | None = None
        self._begin_ns: int | None = None  # when the first frame came
        self._enabling = [True, True]  # since the last feedback, a command may have enabled the wheel
        self._cleared = False  # since the last feedback without fault, a command may have cleared faults

    @abstractmethod
    def decode(self, frame: Frame, said: Said) -> Command | Feedback | None:
        """Returns the command or feedback in a data frame with one of `identifiers`; None if it is neither.

        Adds its findings to `said`.  Never raises."""

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns its findings.  Frames of other robots are ignored."""
        if frame.can_id not in self.identifiers:
            return []
        if self._begin_ns is None:
            self._begin_ns = time_ns
        if frame.remote:
            return [Finding(time_ns, frame.can_id, REMOTE, "nobody answers remote frames")]
        said: Said = []
        heard = self.decode(frame, said)
        if isinstance(heard, Command):
            self._command(time_ns, heard, said)
        elif heard is not None:
            self._feedback(time_ns, heard, said)
        return [Finding(time_ns, frame.can_id, kind, text) for kind, text in said]

    def _command(self, time_ns: int, command: Command, said: Said) -> None:
        last, self._last_command, self._command_ns = self._last_command, command, time_ns
        for wheel, name in enumerate(WHEELS):
            torque = command.torques[wheel]
            self.wheels[wheel].commanded, self.wheels[wheel].commanded_ns = torque, time_ns
            self._above(name, torque, said)
            if command.enable[wheel]:
                self._enabling[wheel] = True
                if torque and last is not None and not last.enable[wheel]:
                    said.append(("enabled with torque", f"{name}: {torque:g} N m"))
        self._cleared |= command.clear

    def _feedback(self, time_ns: int, feedback: Feedback, said: Said) -> None:
        last, self._last_feedback = self._last_feedback, feedback
        assert self._begin_ns is not None
        silent_ns = time_ns - (self._begin_ns if self._command_ns is None else self._command_ns)
        for wheel, name in enumerate(WHEELS):
            torque, state = feedback.torques[wheel], feedback.states[wheel]
            reading = self.wheels[wheel]
            reading.reported, reading.reported_ns, reading.state = torque, time_ns, state.name.lower()
            reading.fault = fault_text(feedback.faults[wheel]) or ("fault" if state is WheelState.FAULT else "")
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

    def _above(self, name: str, torque: float, said: Said) -> None:
        if abs(torque) > self._limit:
            said.append(("torque above limit", f"{name}: {torque:g} N m"))
