"""The referee's checks of a robot's torques, the same for every protocol.  Pure.

Commands are compared with the envelope; reported torques are compared with the envelope and with the commands.  The kinds of
findings are listed in bridge.referee.referee.
"""

from collections import deque
from math import inf
from typing import Final

from echelon.bridge.protocols.frame import WHEELS
from echelon.bridge.protocols.registry import cyclic_of, make_observer, protocol_of
from echelon.plan.plan import Plan, RobotPlan

_WINDOW_NS: Final = 250_000_000


class WheelCheck:
    """One robot: its observer and the last commands to its wheels.  Drives may react late by `late_ns`."""

    def __init__(self, plan: Plan, robot: RobotPlan, late_ns: int = 0) -> None:
        self.plan = robot
        self.name = robot.name
        self.envelope = robot.envelope
        self.observer = make_observer(robot, plan.can.closed)
        self.cyclic = cyclic_of(robot, self.observer, plan.can.closed)
        drive, motor = robot.drive, robot.drive.motor
        self._bit = protocol_of(robot).resolution(drive) * 1.000001
        slew_ns = 2e9 * motor.torque_limit / motor.torque_slew
        self._effect_ns = drive.watchdog_ns + 2 * drive.period_ns + round(1e10 * motor.lag + slew_ns) + late_ns
        self._wheels = [Commands(self._effect_ns) for _ in WHEELS]
        # Frames wait for the bus.  So this window is shorter than the envelope's 250 ms by the longest wait: two frames within
        # it were within the envelope's window, too.
        window_ns = _WINDOW_NS - 2 * drive.period_ns - late_ns
        self._windows = [Extremes(window_ns) for _ in WHEELS] if self.envelope.window_limit < inf else []
        self._begin_ns: int | None = None

    @property
    def memory_ns(self) -> int:
        """For how long a command can be part of a finding [ns]."""
        return max(self._effect_ns, _WINDOW_NS) + 2 * self.plan.drive.period_ns

    def silent(self, time_ns: int) -> bool:
        """Returns whether at this time some wheel has had no command for its watchdog and a period."""
        wait_ns = self.plan.drive.watchdog_ns + self.plan.drive.period_ns
        commanded = [wheel.commanded_ns for wheel in self._wheels]
        return any(time_ns - (self._begin_ns or 0 if at is None else at) > wait_ns for at in commanded)

    def check(self, time_ns: int, sampled_ns: int) -> tuple[list[tuple[str, str]], bool]:
        """Checks the frame that the observer has just taken.  A report in it was made at `sampled_ns` at the earliest.

        Returns kind and text of each finding, and whether the frame was a command for zero torque."""
        said: list[tuple[str, str]] = []
        stops = False
        if self._begin_ns is None:
            self._begin_ns = time_ns
        for wheel, (name, commands, reading) in enumerate(zip(WHEELS, self._wheels, self.observer.wheels, strict=True)):
            if reading.commanded_ns != commands.commanded_ns and reading.commanded is not None:
                commands.commanded_ns, stops = time_ns, not reading.commanded
                if time_ns < 0 and reading.commanded:
                    said.append(("torque before the run", f"{name}: commanded {reading.commanded:g} N m"))
                self._check_change(name, commands.torque, reading.commanded, said)
                if self._windows:
                    self._check_spread(time_ns, name, self._windows[wheel], reading.commanded, said)
                commands.add(time_ns, reading.commanded)
            if reading.reported_ns != commands.reported_ns and reading.reported is not None:
                commands.reported_ns = time_ns
                if reading.reported:
                    self._check_report(time_ns, sampled_ns, name, commands, reading.reported, said)
        return said, stops

    def _check_change(self, name: str, before: float | None, torque: float, said: list[tuple[str, str]]) -> None:
        rise, fall = self.envelope.rise_limit, self.envelope.fall_limit
        if before is None or not torque or rise == fall == inf:
            return
        # the torque falls to the common part of both, then rises from there; it is 0 if the sign changes
        common = max(0.0, min(torque, before), min(-torque, -before))
        if abs(torque) - common > rise * 1.000001 + self._bit:
            said.append(("rise above limit", f"{name}: from {before:g} to {torque:g} N m, by at most {rise:g}"))
        if abs(before) - common > fall * 1.000001 + self._bit:
            said.append(("fall above limit", f"{name}: from {before:g} to {torque:g} N m, by at most {fall:g}"))

    def _check_spread(
        self, time_ns: int, name: str, window: "Extremes", torque: float, said: list[tuple[str, str]]
    ) -> None:
        if not torque:
            window.forget()  # the envelope may go to zero from anywhere, and its window begins anew there
        window.add(time_ns, torque)
        least, most = window.range(time_ns)
        spread, limit = most - least, self.envelope.window_limit
        if spread > limit * 1.000001 + self._bit:
            said.append(("window above limit", f"{name}: {spread:g} N m apart within 250 ms, at most {limit:g}"))

    def _check_report(
        self,
        time_ns: int,
        sampled_ns: int,
        name: str,
        commands: "Commands",
        torque: float,
        said: list[tuple[str, str]],
    ) -> None:
        assert self._begin_ns is not None
        if abs(torque) > self.envelope.torque_limit * 1.000001 + self._bit:
            said.append(("torque above limit", f"{name}: reported {torque:g} N m"))
        if time_ns < 0 and abs(torque) > self._bit + 1e-6:
            said.append(("torque before the run", f"{name}: reported {torque:g} N m"))
        if (
            sampled_ns - self._begin_ns > self._effect_ns
        ):  # before, a command that was not heard may still have an effect
            least, most = commands.range(sampled_ns)
            room = self._bit + 1e-6 + 1e-5 * max(-least, most)
            if not least - room <= torque <= most + room:
                text = f"{name}: reported {torque:g} N m, commanded were {least:g} to {most:g} N m"
                said.append(("torque not commanded", text))


class Extremes:
    """The smallest and the largest torque [N m] that one wheel was commanded within the last `length_ns`."""

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._highs: deque[tuple[int, float]] = deque()  # falling values: the first is the largest in the window
        self._lows: deque[tuple[int, float]] = deque()  # the same for negated torques

    def add(self, time_ns: int, torque: float) -> None:
        """Takes a torque."""
        for window, value in ((self._highs, torque), (self._lows, -torque)):
            while window and window[-1][1] <= value:
                window.pop()
            window.append((time_ns, value))

    def range(self, time_ns: int) -> tuple[float, float]:
        """Returns the smallest and the largest torque of the window that ends at a time; zeros if it holds none."""
        for window in (self._highs, self._lows):
            while window and window[0][0] < time_ns - self._length_ns:
                window.popleft()
        return (-self._lows[0][1], self._highs[0][1]) if self._highs else (0.0, 0.0)

    def forget(self) -> None:
        """Empties the window."""
        self._highs.clear()
        self._lows.clear()


class Commands:
    """The commands to one wheel that may still have an effect: those of the last `effect_ns`."""

    def __init__(self, effect_ns: int) -> None:
        self.commanded_ns: int | None = None
        self.reported_ns: int | None = None
        self.torque: float | None = None
        self._extremes = Extremes(effect_ns)

    def add(self, time_ns: int, torque: float) -> None:
        """Takes a command [N m]."""
        self.torque = torque
        self._extremes.add(time_ns, torque)

    def range(self, time_ns: int) -> tuple[float, float]:
        """Returns the smallest and the largest torque that may still have an effect; zero is always between them."""
        least, most = self._extremes.range(time_ns)
        return min(0.0, least), max(0.0, most)
