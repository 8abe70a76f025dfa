"""Speed of the CAN bus compared with python-can alone, and of runs with a closed torque path: `python -m bench.can`.

*Sent* are the torques of lab.toml's nine robots through envelope, host and bus; the comparison is a plain loop that sends the
same frames with python-can's `bus.send(can.Message(…))`.  *Received* are bursts of frames, by our bus and by python-can's.  The
bus is vcan0 if that is up, otherwise multicast.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from math import sin
from pathlib import Path
from typing import Any, Final

import can
import numpy as np

from bench.product import Row, table
from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import resolve_url
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.registry import drive_places, make_drive
from echelon.bridge.roles.commander import RobotChannel
from echelon.messages import TORQUE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.planning.loading import effective_toml
from echelon.shipped import shipped
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import load
from echelon.sim.processes.supervisor import Supervisor

CYCLES: Final = 500
"""Torque periods that are sent, with nine frames each"""
BURST: Final = 100
"""Frames of a burst; every receive buffer can hold them"""
BRING_UP: Final = 50
"""Periods after which all drives are enabled"""
NEVER_NS: Final = 1 << 62


def lab(*overrides: str) -> tuple[Any, Plan]:
    """Returns scenario and plan of lab.toml with a closed torque path; `overrides` are as for `--set`."""
    return load(shipped()["lab"], ["can.path=closed", "claims=[]", *overrides])


class Robots:
    """The bridge's side of lab.toml's robots, with enabled drives.  After the bring-up the drives send nothing, and the hosts
    do not wait for them."""

    def __init__(self) -> None:
        plan = lab()[1]
        assert plan.bridge is not None
        self.period_ns = plan.bridge.period_ns
        self.robots = [
            RobotChannel(replace(robot, drive=replace(robot.drive, watchdog_ns=NEVER_NS))) for robot in plan.robots
        ]
        self.cycle = 0
        drives = [make_drive(plan, place) for place in drive_places(plan)]
        for _ in range(BRING_UP):
            time_ns = self.cycle * self.period_ns
            for robot, drive in zip(self.robots, drives, strict=True):
                for frame in drive.advance(time_ns):
                    robot.host.receive(time_ns, frame)
                for frame in robot.frames(time_ns, None):
                    drive.receive(time_ns, frame)
            self.cycle += 1
        if not all(robot.host.enabled for robot in self.robots):
            raise RuntimeError("drives are not enabled")

    def torques(self, cycles: int) -> list[tuple[int, list[Message]]]:
        """Returns the torque messages of all robots in the next cycles: for each cycle its instant [ns] and the messages."""
        said = []
        for cycle in range(self.cycle, self.cycle + cycles):
            time_ns = cycle * self.period_ns
            values = np.zeros(len(TORQUE_FIELDS))
            values[:3] = sin(0.01 * cycle), -0.5, 1.0
            said.append(
                (time_ns, [Message(Channel.TORQUE, n, cycle, time_ns, values) for n in range(len(self.robots))])
            )
        self.cycle += cycles
        return said

    def send(self, bus: Bus, cycles: int) -> tuple[float, list[Frame]]:
        """Sends the torques of `cycles` cycles on a bus; returns frames per second, and the frames."""
        said, sent = self.torques(cycles), list[Frame]()
        begun_s = time.perf_counter()
        for time_ns, messages in said:
            for robot, message in zip(self.robots, messages, strict=True):
                for frame in robot.frames(time_ns, message):
                    bus.send(frame.can_id, frame.data, time_ns, frame.remote)
                    sent.append(frame)
        took_s = time.perf_counter() - begun_s
        if any(robot.stopped for robot in self.robots):
            raise RuntimeError("the envelope stopped torques")
        return len(sent) / took_s, sent


def plain_bus(url: str) -> can.BusABC:
    """Returns the bus at a URL, opened with python-can alone."""
    interface, _, rest = url.partition(":")
    if interface == "socketcan":
        return can.Bus(interface=interface, channel=rest, ignore_config=True)
    group, _, port = rest.rpartition(":")
    return can.Bus(interface=interface, channel=group, port=int(port), hop_limit=0, fd=False, ignore_config=True)


def plain_send(bus: can.BusABC, frames: list[Frame]) -> float:
    """Sends frames with python-can alone; returns frames per second."""
    begun_s = time.perf_counter()
    for can_id, data, remote in frames:
        bus.send(can.Message(arbitration_id=can_id, data=data, is_remote_frame=remote, is_extended_id=False))
    return len(frames) / (time.perf_counter() - begun_s)


def receive(take: Callable[[], Any], sender: Bus, frames: list[Frame]) -> float:
    """Sends frames in bursts and receives each burst by `take`; returns frames per second of the receiving alone."""
    took_s = 0.0
    for at in range(0, len(frames), BURST):
        burst = frames[at : at + BURST]
        for can_id, data, _ in burst:
            sender.send(can_id, data)
        begun_s = time.perf_counter()
        for _ in burst:
            if take() is None:
                raise RuntimeError("a frame did not come")
        took_s += time.perf_counter() - begun_s
    return len(frames) / took_s


def bus_rates(url: str, cycles: int = CYCLES) -> dict[str, float]:
    """Returns frames per second of all ways to send and to receive on a bus, measured one after the other."""
    robots = Robots()
    with open_bus(url) as bus:
        bridge, frames = robots.send(bus, cycles)
        if bus.counts.sent != len(frames):
            raise RuntimeError(f"{len(frames) - bus.counts.sent} frames were not sent: {bus.error}")
    with open_bus(url) as bus:
        begun_s = time.perf_counter()
        for can_id, data, _ in frames:
            bus.send(can_id, data)
        alone = len(frames) / (time.perf_counter() - begun_s)
    with plain_bus(url) as plain:
        plainly = plain_send(plain, frames)
    rates = {"bridge": bridge, "send": alone, "plain send": plainly}
    with open_bus(url) as sender, open_bus(url) as bus:
        rates["recv"] = receive(lambda: bus.recv(1.0), sender, frames)
    with open_bus(url) as sender, plain_bus(url) as plain:
        rates["plain recv"] = receive(lambda: plain.recv(1.0), sender, frames)
    return rates


def closed_in_process(seconds: float) -> float:
    """Runs lab.toml with a closed torque path in this process, without a bus; returns run time over wall time."""
    engine = Engine(lab(f"duration={seconds}")[1])
    begun_s = time.perf_counter()
    engine.run()
    return seconds / (time.perf_counter() - begun_s)


def closed_processes(url: str, seconds: float) -> float:
    """Runs lab.toml with a closed torque path as processes, with recording and buses; returns ticks per second."""
    scenario, plan = lab(f"duration={seconds}")
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        outcome = Supervisor(
            plan,
            Path(folder),
            run=f"bench-{time.monotonic_ns():x}",
            virtual=True,
            can_urls=(url,),
            scenario_toml=effective_toml(scenario),
        ).run()
    if outcome.failure:
        raise RuntimeError(outcome.failure)
    # bringing up the drives is part of the run
    return (plan.duration_ns + plan.can.bring_up_ns) / plan.robots[0].period_ns / outcome.wall_s


def measure(repeats: int, seconds: float) -> list[Row]:
    """Measures everything `repeats` times, each kind in turn; `seconds` is the duration of the runs."""
    url = resolve_url("auto")
    where = url.split(":")[0].replace("socketcan", "vcan0").replace("udp_multicast", "multicast")
    rates: list[dict[str, float]] = []
    alone, processes = [], []
    for _ in range(repeats):
        rates.append(bus_rates(url))
        alone.append(closed_in_process(seconds))
        processes.append(closed_processes(url, seconds))

    def row(what: str, key: str) -> Row:
        return Row(what, "frames/s", tuple(one[key] for one in rates))

    def ratio(what: str, key: str, to: str) -> Row:
        return Row(what, "×", tuple(one[key] / one[to] for one in rates))

    return [
        row(f"{where}: torques through envelope, host, bus", "bridge"),
        row(f"{where}: our bus alone", "send"),
        row(f"{where}: python-can, the same frames", "plain send"),
        ratio("envelope, host, bus, of python-can's rate", "bridge", "plain send"),
        row(f"{where}: received by our bus", "recv"),
        row(f"{where}: received by python-can", "plain recv"),
        ratio("received, of python-can's rate", "recv", "plain recv"),
        Row("lab.toml, closed path, in one process", "× real time", tuple(alone)),
        Row("lab.toml, closed path, as processes", "ticks/s", tuple(processes)),
    ]


def main() -> int:
    """Measures and prints; returns the exit code, 0."""
    parser = argparse.ArgumentParser(prog="python -m bench.can", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeat", type=int, default=5, help="how often (default 5)")
    parser.add_argument("--seconds", type=float, default=3.0, help="run time of lab.toml (default 3)")
    parser.add_argument("--only-bus", action="store_true", help="no runs")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    if options.only_bus:
        url = resolve_url("auto")
        found = [bus_rates(url) for _ in range(options.repeat)]
        rows = [Row(key, "frames/s", tuple(one[key] for one in found)) for key in found[0]]
    else:
        rows = measure(options.repeat, options.seconds)
    print(json.dumps([asdict(row) for row in rows]) if options.json else table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
