"""`echelon drives`: the virtual drives of a scenario alone, on a bus and a wall clock.  A bench to try hosts on.

There are no robots: the wheels stand on a bench, each with the inertia and friction of its drive's table.  Faults that
the scenario has for its drives happen, counted from the start.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Final

from echelon.bridge.bus import Bus, open_bus
from echelon.bridge.bus_url import listen_command
from echelon.bridge.drive_bank import DriveBank
from echelon.bridge.stations.waiting import RunClock
from echelon.bridge.stations.wall_drives import WallDrives
from echelon.drives import identifiers
from echelon.plan import Plan, RobotPlan

LINE_S: Final = 1.0
"""Between two lines."""
SHOWN: Final = 3
"""Robots whose wheels a line tells of, at most."""


def describe(plan: Plan, urls: Sequence[str]) -> list[str]:
    """Returns what there is to command, and where, in lines for people."""
    lines = [
        f"bus {bus.name}: {url}; to listen: {listen_command(url)}"
        for bus, url in zip(plan.can.buses, urls, strict=True)
    ]
    width = max(len(robot.name) for robot in plan.robots)
    lines += [f"  {robot.name:<{width}}  {_place(plan, robot)}" for robot in plan.robots]
    watchdog_ms = plan.can.watchdog_ns / 1e6
    assert plan.drives is not None
    period_ms = plan.drives.period_ns / 1e6
    lines.append(f"they report every {period_ms:g} ms, and stop after {watchdog_ms:g} ms without a command")
    return lines


def _place(plan: Plan, robot: RobotPlan) -> str:
    drive, bus = robot.drive, plan.can.buses[robot.drive.bus].name
    if drive.protocol != "native":
        return f"{drive.protocol} on {bus}, nodes {drive.node_ids[0]} right, {drive.node_ids[1]} left"
    command, feedback, status = sorted(identifiers(drive, robot.index)[0])
    return f"native on {bus}, command {command:#05x}, feedback {feedback:#05x}, status {status:#05x}"


def run_drives(plan: Plan, urls: Sequence[str], seconds: float | None, say: Callable[[str], None]) -> None:
    """Serves the buses for some seconds, or until interrupted; says what is there, then a line per second.

    The plan has a closed torque path with virtual drives.  Raises ValueError or OSError if a bus cannot be had."""
    with ExitStack() as stack:
        buses = [stack.enter_context(open_bus(url)) for url in urls]
        drives = WallDrives(plan, buses)
        for line in describe(plan, [bus.url for bus in buses]):
            say(line)
        clock = RunClock()
        end_s = float("inf") if seconds is None else seconds
        said_s = now_s = 0.0
        try:
            while now_s < end_s:
                drives.serve(clock)
                now_s = clock.now() / 1e9
                if now_s >= said_s + LINE_S:
                    said_s = now_s
                    say(line_of(plan, drives, buses, now_s))
        except KeyboardInterrupt:
            say("")
        say(line_of(plan, drives, buses, now_s))


def line_of(plan: Plan, drives: WallDrives, buses: Sequence[Bus], now_s: float) -> str:
    """Returns how things stand in one line: frames, wheels that turn or have torque, what was refused."""
    bank = drives.bank
    received, sent = (sum(getattr(bus.counts, what) for bus in buses) for what in ("received", "sent"))
    parts = [f"{now_s:6.1f} s", f"{received} frames in, {sent} out"]
    if failed := sum(bus.counts.failed + bus.counts.dropped for bus in buses):
        parts.append(f"{failed} not sent")
    for what, number in zip(("lost", "destroyed"), drives.lost_and_destroyed(), strict=True):
        if number:
            parts.append(f"{number} {what} on the bus")
    wheels = _wheels(plan, bank)
    parts += wheels[:SHOWN]
    if len(wheels) > SHOWN:
        parts.append(f"and {len(wheels) - SHOWN} more")
    refused = sum((placed.drive.refused for placed in bank.drives), Counter[str]())
    parts += [f"refused: {number} {reason}" for reason, number in refused.most_common(SHOWN)]
    return "  |  ".join(parts)


def _wheels(plan: Plan, bank: DriveBank) -> list[str]:
    """Returns torques and speeds, right and left, of the robots where there are any."""
    of_robot: dict[int, list[tuple[float, float]]] = {}
    for placed in bank.drives:  # the right wheel's before the left one's
        rows = of_robot.setdefault(placed.place.robot, [])
        rows += [(motor.torque, motor.omega) for motor in placed.drive.motors]
    return [
        f"{plan.robots[robot].name} {torques[0]:.3g} {torques[1]:.3g} N m, {speeds[0]:.3g} {speeds[1]:.3g} rad/s"
        for robot, rows in of_robot.items()
        for torques, speeds in [tuple(zip(*rows, strict=True))]
        if any(torques) or any(abs(speed) > 1e-3 for speed in speeds)
    ]
