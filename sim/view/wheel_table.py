"""The display of `echelon can`: commanded and reported torque of each wheel, and the load of each bus.

It exists as a table for a terminal, as a line of text, and as data for JSON.
"""

from collections import deque
from math import isfinite
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from echelon.bridge.protocols.frame import WHEELS, Frame
from echelon.bridge.protocols.observe import Finding, WheelReading
from echelon.bridge.referee.referee import Referee
from echelon.bridge.timing.bus_load import frame_bits
from echelon.plan.plan import Plan, RobotPlan

HALF: Final = 8
"""Number of cells of a bar on each side of zero"""
BARS_FROM: Final = 110
"""Smallest width of a terminal in which bars are shown [columns]"""
FINDINGS: Final = 5
"""How many of the last findings are shown in full"""
_SLOT_NS: Final = 100_000_000
_SLOTS: Final = 10
_EIGHTHS: Final = " ▏▎▍▌▋▊▉█"


class Rate:
    """The amount that came in the last second, in steps of 0.1 s."""

    def __init__(self) -> None:
        self._slots: deque[list[int]] = deque()
        self._begin_ns: int | None = None

    def add(self, time_ns: int, amount: int = 1) -> None:
        """Adds an amount."""
        if self._begin_ns is None:
            self._begin_ns = time_ns
        slot = time_ns // _SLOT_NS
        if self._slots and self._slots[-1][0] >= slot:
            self._slots[-1][1] += amount
        else:
            self._slots.append([slot, amount])
            if len(self._slots) > _SLOTS + 1:
                self._slots.popleft()

    def per_second(self, time_ns: int) -> float:
        """Returns the amount per second, over the last second or the time since the first amount."""
        if self._begin_ns is None:
            return 0.0
        now = time_ns // _SLOT_NS
        total = sum(amount for slot, amount in self._slots if now - _SLOTS < slot <= now)
        span_ns = (_SLOTS - 1) * _SLOT_NS + time_ns % _SLOT_NS
        return total * 1e9 / max(_SLOT_NS, min(span_ns, time_ns - self._begin_ns))


class CanTable:
    """Takes all frames of a plan's buses and shows their content.  `places` names each bus: a URL or a file."""

    def __init__(self, plan: Plan, referee: Referee, places: tuple[str, ...]) -> None:
        self.plan = plan
        self.referee = referee
        self.places = places
        self.time_ns = 0
        """Time of the last frame [ns]"""
        self._frames = [Rate() for _ in plan.can.buses]
        self._bits = [Rate() for _ in plan.can.buses]
        self._of_robot = [Rate() for _ in plan.robots]
        self._owners: list[dict[int, list[Rate]]] = [{} for _ in plan.can.buses]
        for robot, observer, rate in zip(plan.robots, referee.observers, self._of_robot, strict=True):
            for can_id in observer.identifiers:
                self._owners[robot.drive.bus].setdefault(can_id, []).append(rate)
        self._last: deque[Finding] = deque(maxlen=FINDINGS)

    def take(self, time_ns: int, bus: int, frame: Frame) -> None:
        """Takes a frame."""
        self.time_ns = max(time_ns, self.time_ns)
        self._frames[bus].add(time_ns)
        self._bits[bus].add(time_ns, frame_bits(*frame) if not (frame.remote and frame.data) else 0)
        for rate in self._owners[bus].get(frame.can_id, ()):
            rate.add(time_ns)
        found = self.referee.observe(time_ns, bus, frame)
        self._last += found if not self.referee.over else ()

    def data(self, time_ns: int) -> dict[str, Any]:
        """Returns the present state as data for JSON: SI units, None for unknown values."""
        return {
            "time": time_ns / 1e9,
            "buses": [
                {
                    "name": bus.name,
                    "url": place,
                    "frames_per_second": frames.per_second(time_ns),
                    "load": bits.per_second(time_ns) / bus.bitrate,
                }
                for bus, place, frames, bits in zip(
                    self.plan.can.buses, self.places, self._frames, self._bits, strict=True
                )
            ],
            "robots": [
                {
                    "robot": robot.name,
                    "frames_per_second": rate.per_second(time_ns),
                    "wheels": [
                        {
                            "wheel": name,
                            "commanded": _finite(wheel.commanded),
                            "reported": _finite(wheel.reported),
                            "speed": _finite(wheel.speed),
                            "state": wheel.state,
                            "fault": wheel.fault,
                            "age": _age(wheel, time_ns),
                        }
                        for name, wheel in zip(WHEELS, observer.wheels, strict=True)
                    ],
                }
                for robot, observer, rate in zip(self.plan.robots, self.referee.observers, self._of_robot, strict=True)
            ],
            "frames": self.referee.frames,
            "unknown": self.referee.unknown,
            "kinds": dict(sorted(self.referee.kinds.items())),
        }

    def line(self, time_ns: int) -> str:
        """Returns the present state in one line."""
        data = self.data(time_ns)
        parts = [f"t {data['time']:.1f} s"]
        for bus in data["buses"]:
            parts.append(f"{bus['name']} {bus['frames_per_second']:.0f} frames/s, load {100 * bus['load']:.0f} %")
        heard = sum(any(wheel["age"] is not None for wheel in robot["wheels"]) for robot in data["robots"])
        parts.append(f"{heard} of {len(data['robots'])} robots heard")
        faults = [
            f"{robot['robot']} {wheel['wheel']} {wheel['fault']}"
            for robot in data["robots"]
            for wheel in robot["wheels"]
            if wheel["fault"]
        ]
        parts.append("faults: " + (", ".join(faults) or "none"))
        parts.append("findings: " + (_counted(data["kinds"]) or "none"))
        return "  ".join(parts)

    def render(self, time_ns: int, width: int = 120) -> RenderableType:
        """Returns the present state as a table, faults in red, with bars if `width` is large enough."""
        bars = width >= BARS_FROM
        table = Table(box=None, padding=(0, 1), header_style="dim")
        for name in ("robot", "wheel"):
            table.add_column(name, no_wrap=True)
        for name in ("commanded", "reported"):
            table.add_column(f"{name}\n[N m]", justify="right", no_wrap=True)
            if bars:
                table.add_column("", no_wrap=True)
        table.add_column("speed\n[rad/s]", justify="right", no_wrap=True)
        table.add_column("state")
        table.add_column("fault")
        table.add_column("age\n[ms]", justify="right", no_wrap=True)
        table.add_column("frames\n[1/s]", justify="right", no_wrap=True)
        for robot, observer, rate in zip(self.plan.robots, self.referee.observers, self._of_robot, strict=True):
            limit = torque_limit(robot)
            for number, (name, wheel) in enumerate(zip(WHEELS, observer.wheels, strict=True)):
                cells: list[RenderableType] = ["" if number else robot.name, name]
                for torque in (wheel.commanded, wheel.reported):
                    cells += [_number(torque, 3), bar(torque, limit)] if bars else [_number(torque, 3)]
                age = _age(wheel, time_ns)
                old = age is not None and age * 1e9 > robot.drive.watchdog_ns
                cells += [
                    _number(wheel.speed, 2),
                    wheel.state or "–",
                    Text(wheel.fault, style="bold red"),
                    Text("–" if age is None else f"{1e3 * age:.0f}", style="bold red" if old else ""),
                    "" if number else f"{rate.per_second(time_ns):.0f}",
                ]
                table.add_row(*cells)
        return Group(self._heading(time_ns), table, *self._findings())

    def _heading(self, time_ns: int) -> Text:
        text = Text(f"{self.plan.name}", style="bold")
        text.append(f"   t {time_ns / 1e9:.1f} s   {self.referee.frames} frames", style="not bold")
        if self.referee.unknown:
            text.append(f", {self.referee.unknown} of others", style="not bold")
        for bus in self.data(time_ns)["buses"]:
            where = f" ({bus['url']})" if bus["url"] != bus["name"] else ""
            text.append(f"\n{bus['name']}{where}   {bus['frames_per_second']:.0f} frames/s   load ", style="not bold")
            text.append(f"{100 * bus['load']:.1f} %", style="bold red" if bus["load"] > 0.9 else "not bold")
        return text

    def _findings(self) -> list[Text]:
        kinds = self.referee.kinds
        if not kinds:
            return [Text("no findings", style="dim")]
        lines = [Text(f"{kinds.total()} findings: {_counted(kinds)}", style="bold red")]
        return lines + [Text(f"  {finding_text(finding)}", style="red") for finding in self._last]


def finding_text(finding: Finding) -> str:
    """Returns a finding in one line."""
    return f"{finding.time_ns / 1e9:.6f} s  {finding.can_id:03X}  {finding.kind}: {finding.text}"


def torque_limit(robot: RobotPlan) -> float:
    """Returns the largest torque that may be commanded to a wheel of the robot [N m]: the full length of a bar."""
    return min(robot.envelope.torque_limit, robot.torque_limit, robot.drive.motor.torque_limit)


def bar(value: float | None, limit: float) -> Text:
    """Returns a bar that begins in the middle and goes to the right for positive values; it is red beyond the limit."""
    if value is None or not isfinite(value):
        return Text(" " * (2 * HALF + 1))
    share = 0.0 if not value else max(-1.0, min(1.0, value / limit if limit else value / abs(value)))
    eighths = round(abs(share) * HALF * 8)
    whole, rest = divmod(eighths, 8)
    beyond = abs(value) > limit * 1.000001
    style = "bold red" if beyond else "cyan" if value > 0 else "yellow"
    if value < 0:  # Unicode has no eighths of a block that grow from the right, only the half ▐
        left = ("▐" if rest >= 4 else "") + "█" * whole
        return Text.assemble((left.rjust(HALF), style), ("│", "dim"), " " * HALF)
    right = "█" * whole + (_EIGHTHS[rest] if rest else "")
    return Text.assemble(" " * HALF, ("│", "dim"), (right.ljust(HALF), style))


def _age(wheel: WheelReading, time_ns: int) -> float | None:
    """Returns the age of the last report [s], or of the last command if no drive reports."""
    at_ns = wheel.commanded_ns if wheel.reported_ns is None else wheel.reported_ns
    return None if at_ns is None else max(0, time_ns - at_ns) / 1e9


def _finite(value: float | None) -> float | None:
    return value if value is not None and isfinite(value) else None


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def _counted(kinds: dict[str, int]) -> str:
    return ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items()))
