"""What a referee checks of a robot's torques, whatever the protocol: commands against the envelope, reports against both.

Kinds of findings are those of bridge.referee.referee.  Pure.
"""

from collections import deque
from math import inf
from typing import Final

from echelon.bridge.protocols.frame import WHEELS
from echelon.bridge.protocols.registry import cyclic_of, make_observer, protocol_of
from echelon.plan.plan import Plan, RobotPlan

_WINDOW_NS: Final = 250_000_000


class WheelCheck:
    """One robot: its observer, and what its wheels were last asked for; drives may be late by `late_ns`."""

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
        # Frames wait for the bus: of two that are further apart here the envelope may have seen the first no more.
        window_ns = _WINDOW_NS - 2 * drive.period_ns - late_ns
        self._windows = [Extremes(window_ns) for _ in WHEELS] if self.envelope.window_limit < inf else []
        self._begin_ns: int | None = None

    def silent(self, time_ns: int) -> bool:
        """True if at this time some wheel had no command for its watchdog and a period."""
        wait_ns = self.plan.drive.watchdog_ns + self.plan.drive.period_ns
        commanded = [wheel.commanded_ns for wheel in self._wheels]
        return any(time_ns - (self._begin_ns or 0 if at is None else at) > wait_ns for at in commanded)

    def check(self, time_ns: int, sampled_ns: int) -> tuple[list[tuple[str, str]], bool]:
        """Looks at what the frame that the observer has just taken said of the wheels, in a report that was made at
        `sampled_ns` at the earliest; returns what is wrong, and whether it was a command for no torque."""
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
        # what both have in common: the torque falls to it, then rises from it
        common = max(0.0, min(torque, before), min(-torque, -before))
        if abs(torque) - common > rise * 1.000001 + self._bit:
            said.append(("rise above limit", f"{name}: from {before:g} to {torque:g} N m, by at most {rise:g}"))
        if abs(before) - common > fall * 1.000001 + self._bit:
            said.append(("fall above limit", f"{name}: from {before:g} to {torque:g} N m, by at most {fall:g}"))

    def _check_spread(
        self, time_ns: int, name: str, window: "Extremes", torque: float, said: list[tuple[str, str]]
    ) -> None:
        if not torque:
            window.forget()  # the gate may go to zero from anywhere, and begins anew from there
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
        if sampled_ns - self._begin_ns > self._effect_ns:  # who begins to listen does not know what was before
            least, most = commands.range(sampled_ns)
            room = self._bit + 1e-6 + 1e-5 * max(-least, most)
            if not least - room <= torque <= most + room:
                text = f"{name}: reported {torque:g} N m, commanded were {least:g} to {most:g} N m"
                said.append(("torque not commanded", text))


class Extremes:
    """The smallest and the largest torque [N m] that one wheel was asked for in a stretch of time."""

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._highs: deque[tuple[int, float]] = deque()  # each less than those before it
        self._lows: deque[tuple[int, float]] = deque()  # likewise, negated

    def add(self, time_ns: int, torque: float) -> None:
        """Takes a torque."""
        for window, value in ((self._highs, torque), (self._lows, -torque)):
            while window and window[-1][1] <= value:
                window.pop()
            window.append((time_ns, value))

    def range(self, time_ns: int) -> tuple[float, float]:
        """Returns both for the stretch that ends at a time; zeros if there was no torque in it."""
        for window in (self._highs, self._lows):
            while window and window[0][0] < time_ns - self._length_ns:
                window.popleft()
        return (-self._lows[0][1], self._highs[0][1]) if self._highs else (0.0, 0.0)

    def forget(self) -> None:
        """Begins anew."""
        self._highs.clear()
        self._lows.clear()


class Commands:
    """What one wheel was asked for in the time that may still have an effect."""

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
        """Returns the smallest and the largest torque that may still have an effect; zero always may."""
        least, most = self._extremes.range(time_ns)
        return min(0.0, least), max(0.0, most)
