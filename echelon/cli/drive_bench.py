"""What `echelon drives` does: it runs the virtual drives of a scenario alone, in real time, to try a host on them.

There are no robots.  Each wheel turns freely, with the inertia and friction that the scenario gives to its drive.  The faults
of drives that the scenario schedules happen, at times counted from the start of the command.
"""

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, Final

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import listen_command
from echelon.bridge.protocols.registry import protocol_of
from echelon.bridge.stations.waiting import RunClock
from echelon.bridge.stations.wall_drives import WallDrives
from echelon.errors import UsageError
from echelon.plan.plan import Plan

LINE_S: Final = 1.0
"""Time between two lines [s]"""
SHOWN: Final = 3
"""Largest number of robots whose wheels are shown in a line"""
Facts = dict[str, Any]
"""Data for JSON"""


def serve(plan: Plan, urls: Sequence[str], seconds: float | None, as_json: bool) -> None:
    """Runs the drives for some seconds, or until Ctrl-C.  Prints what there is to command, then the state every second.

    The plan must have a closed torque path with virtual drives; `urls` has a URL for each of its buses.  Raises UsageError if a
    bus cannot be opened."""
    with ExitStack() as stack:
        try:
            buses = [stack.enter_context(open_bus(url)) for url in urls]
        except OSError as error:
            raise UsageError(str(error)) from None
        drives = WallDrives(plan, buses)
        bench = bench_facts(plan, [bus.url for bus in buses])
        print(json.dumps(bench) if as_json else "\n".join(bench_lines(bench)), flush=True)
        clock = RunClock()
        end_s = float("inf") if seconds is None else seconds
        said_s = now_s = 0.0

        def say() -> None:
            facts = state_facts(plan, drives, buses, now_s)
            print(json.dumps(facts) if as_json else state_line(facts), flush=True)

        try:
            while now_s < end_s:
                drives.serve(clock)
                now_s = clock.now() / 1e9
                if now_s >= said_s + LINE_S:
                    said_s = now_s
                    say()
        except KeyboardInterrupt:
            if not as_json:
                print()
        say()


def bench_facts(plan: Plan, urls: Sequence[str]) -> Facts:
    """Returns what a host needs to know: the buses, and each robot's protocol, bus and addresses; times in seconds."""
    buses = zip(plan.can.buses, urls, strict=True)
    return {
        "buses": [{"name": bus.name, "url": url, "listen": listen_command(url)} for bus, url in buses],
        "robots": [
            {
                "name": robot.name,
                "protocol": robot.drive.protocol.use,
                "bus": plan.can.buses[robot.drive.bus].name,
                **protocol_of(robot).addresses(robot.drive),
            }
            for robot in plan.robots
        ],
        "period": plan.robots[0].torque_period_ns / 1e9,
        "watchdog": plan.can.watchdog_ns / 1e9,
    }


def bench_lines(bench: Facts) -> list[str]:
    """Returns the result of `bench_facts` as lines for people."""
    lines = [f"bus {bus['name']}: {bus['url']}; to listen: {bus['listen']}" for bus in bench["buses"]]
    width = max(len(robot["name"]) for robot in bench["robots"])
    for robot in bench["robots"]:
        if "nodes" in robot:
            place = "nodes " + ", ".join(f"{node} {wheel}" for wheel, node in robot["nodes"].items())
        else:
            place = ", ".join(f"{kind} {can_id:#05x}" for kind, can_id in robot["identifiers"].items())
        lines.append(f"  {robot['name']:<{width}}  {robot['protocol']} on {robot['bus']}, {place}")
    period_ms, watchdog_ms = 1e3 * bench["period"], 1e3 * bench["watchdog"]
    return [*lines, f"they report every {period_ms:g} ms, and stop after {watchdog_ms:g} ms without a command"]


def state_facts(plan: Plan, drives: WallDrives, buses: Sequence[Bus], now_s: float) -> Facts:
    """Returns the state at `now_s` [s]: counts of frames, robots whose wheels turn or have torque, refused frames by reason."""
    lost, destroyed = drives.lost_and_destroyed()
    refused = sum((placed.drive.refused for placed in drives.bank.drives), Counter[str]())
    return {
        "time": now_s,
        "received": sum(bus.counts.received for bus in buses),
        "sent": sum(bus.counts.sent for bus in buses),
        "not_sent": sum(bus.counts.failed + bus.counts.dropped for bus in buses),
        "lost": lost,
        "destroyed": destroyed,
        "wheels": _wheels(plan, drives),
        "refused": dict(refused.most_common()),
    }


def _wheels(plan: Plan, drives: WallDrives) -> list[Facts]:
    """Returns torques [N m] and speeds [rad/s] of the right and the left wheel, for robots where some are not zero."""
    rows: dict[int, Facts] = {}
    for placed in drives.bank.drives:  # the drive of the right wheel comes before that of the left
        robot = placed.place.robot
        row = rows.setdefault(robot, {"robot": plan.robots[robot].name, "torques": [], "speeds": []})
        row["torques"] += [motor.torque for motor in placed.drive.motors]
        row["speeds"] += [motor.omega for motor in placed.drive.motors]
    return [row for row in rows.values() if any(row["torques"]) or any(abs(speed) > 1e-3 for speed in row["speeds"])]


def state_line(facts: Facts) -> str:
    """Returns the result of `state_facts` in one line."""
    parts = [f"{facts['time']:6.1f} s", f"{facts['received']} frames in, {facts['sent']} out"]
    for key, text in (("not_sent", "not sent"), ("lost", "lost on the bus"), ("destroyed", "destroyed on the bus")):
        if facts[key]:
            parts.append(f"{facts[key]} {text}")
    for row in facts["wheels"][:SHOWN]:
        torques, speeds = (" ".join(f"{value:.3g}" for value in row[key]) for key in ("torques", "speeds"))
        parts.append(f"{row['robot']} {torques} N m, {speeds} rad/s")
    if len(facts["wheels"]) > SHOWN:
        parts.append(f"and {len(facts['wheels']) - SHOWN} more")
    parts += [f"refused: {number} {reason}" for reason, number in list(facts["refused"].items())[:SHOWN]]
    return "  |  ".join(parts)
