"""The bridge at work on a closed torque path: its role, its buses, can.log and the DBC; and what there is to tell of them."""

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from echelon.bridge.bus import Bus, open_bus
from echelon.bridge.bus_url import listen_command
from echelon.bridge.buses import bus_row, scheduled
from echelon.bridge.canlog import CanLog
from echelon.bridge.commander import Commander
from echelon.bridge.fit import plan_fit
from echelon.bridge.frame_message import TimedFrame
from echelon.bridge.on_bus import Rail, on_bus
from echelon.bridge.plan_dbc import dbc_names, plan_dbc
from echelon.plan import Plan
from echelon.plugins import PartRunError
from echelon.role import Stage

LOG: Final = "can.log"


class ClosedStation:
    """The bridge of a plan with a closed torque path.  No `urls`: frames go nowhere but into the log.

    `paired`: the drives are on the same buses, in another process; otherwise frames are only shown there.
    Raises ValueError or OSError if a bus or a file cannot be had.
    """

    def __init__(
        self, plan: Plan, urls: Sequence[str], folder: Path, *, paired: bool, role: Commander | None = None
    ) -> None:
        self.plan = plan
        self.role = role or Commander(plan)
        self.index = self.role.index
        self.buses: list[Bus] = [open_bus(url) for url in urls]
        self.urls = [bus.url for bus in self.buses]
        self.rail = Rail(self.buses)
        for bus, name in enumerate(dbc_names(plan)):
            (folder / name).write_text(plan_dbc(plan, bus), encoding="utf-8")
        # The log begins with the bringing up of the drives; run time 0 is `can.bring_up` later.
        self._names = [bus.name for bus in plan.can.buses]
        self._log = CanLog(folder / LOG, self._names[0], plan.can.bring_up_ns)
        self.frames = 0
        self.messages = 0
        self._robots: dict[str, Any] = {}
        self.stages: tuple[Stage, ...] = self.role.stages
        if self.buses and paired:
            self.stages = on_bus(self.stages, self.rail, is_bridge=True, said=self.log)

    @property
    def url(self) -> str:
        """Where the frames can be heard."""
        return ", ".join(self.urls) or "nowhere"

    def show(self, frames: Sequence[TimedFrame]) -> None:
        """Puts frames on the buses where nobody else does, in one process, and into the log."""
        if self.buses:
            self.rail.put(frames)
        self.log(frames)

    def log(self, frames: Sequence[TimedFrame]) -> None:
        """Notes frames in can.log."""
        wall_ns, write, names = time.monotonic_ns(), self._log.write, self._names
        for time_ns, bus, _, (can_id, data, remote) in frames:
            write(time_ns, can_id, data, wall_ns, names[bus], remote)
        self.frames += len(frames)

    def stop_wheels(self, time_ns: int) -> None:
        """Takes the torque away from all wheels and disables their drives: the end of every run, however it ends.

        At once, and past the models of buses that are as slow as real ones.  After that it raises PartRunError if a protocol
        that others wrote failed at it."""
        self._robots = self.role.summary()
        frames, failure = self.role.stop(time_ns)
        for _, bus, _, (can_id, data, remote) in frames if self.buses else ():
            self.buses[bus].send(can_id, data, time_ns, remote)
        self.log(frames)
        if failure:
            raise PartRunError(failure)

    def close(self) -> None:
        """Closes log and buses."""
        self._log.close()
        for bus in self.buses:
            bus.close()

    def progress(self) -> dict[str, Any]:
        """Returns what a live table shows."""
        stopped = sum((robot.stopped for robot in self.role.robots), Counter[str]())
        faults = [f"{robot.robot.name} {robot.host.fault}" for robot in self.role.robots if robot.host.fault]
        return {
            "url": self.url,
            "load": max(bus.load for bus in self.role.buses),
            "frames": self.frames,
            "stopped": ", ".join(f"{number} {reason}" for reason, number in stopped.most_common()),
            "faults": faults,
            "note": self.rail.waiting,
        }

    def result(self) -> dict[str, Any]:
        """Returns the counts of bridge, buses and log for the summary; robots as they were before `stop_wheels`."""
        robots = self._robots or self.role.summary()
        fit = plan_fit(self.plan)
        buses = [
            bus_row(self.plan, number, self.role.buses[number], bus.responses_ns) for number, bus in enumerate(fit)
        ]
        return {
            "path": "closed",
            "timing": self.plan.can.timing,
            "url": self.url,
            "listen": "; ".join(command for url in self.urls if (command := listen_command(url))),
            "torque_scale": self.plan.can.torque_scale,
            "log_start": -self.plan.can.bring_up_ns / 1e9,
            "frames": self.frames,
            "load_mean": max(row["load"] for row in buses),
            "fit": fit[0].lines[0] if len(fit) == 1 else [bus.lines[0] for bus in fit],
            "advice": [way for bus in fit for way in bus.advice],
            "buses": buses,
            "scheduled": scheduled(self.plan),
            "sent": sum(bus.counts.sent for bus in self.buses),
            "failed": sum(bus.counts.failed for bus in self.buses),
            "dropped": sum(bus.counts.dropped for bus in self.buses),
            "foreign": self.rail.foreign,
            "refused": dict(self.role.refused),
            "log_lost": self._log.counts.lost,
            "log_error": str(self._log.error) if self._log.error else None,
            "stopped": sum(sum(row["stopped"].values()) for row in robots.values()),
            "robots": robots,
        }
