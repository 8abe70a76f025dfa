"""The bridge on the closed torque path with its role, its buses, can.log and the DBC files."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from echelon.bridge.can.bus import Bus
from echelon.bridge.can.bus_url import listen_command
from echelon.bridge.can.canlog import CanLog
from echelon.bridge.frame_message import TimedFrame, frames_of
from echelon.bridge.protocols.plan_dbc import dbc_names, plan_dbc
from echelon.bridge.reports import BridgeProgress, CanReport, WheelsReport, stopped_text
from echelon.bridge.roles.commander import Commander
from echelon.bridge.stations.bridge import Bridge
from echelon.bridge.stations.guarding import intrusions, look, open_guarded
from echelon.bridge.stations.rail import Rail, on_bus
from echelon.bridge.stations.waiting import FLOOD, last_to_send
from echelon.bridge.timing.buses import bus_report, scheduled
from echelon.bridge.timing.fit import plan_fit
from echelon.files import write_new
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.role import Stage

LOG: Final = "can.log"
STOP_S: Final = 0.2
"""How long frames that stop wheels are tried on a bus that is full [s]"""
PAUSE_S: Final = 0.001


class ClosedBridge(Bridge):
    """The bridge of a plan with a closed torque path, on the buses at `urls`.  Without URLs, frames go only into can.log.

    `paired`: the drives are another process on the same buses, and the frames of `stages` really go over them.  Otherwise
    `take` only shows the frames on the buses.  Raises ValueError or OSError if a bus or a file cannot be opened.
    """

    def __init__(
        self, plan: Plan, urls: Sequence[str], folder: Path, *, paired: bool, role: Commander | None = None
    ) -> None:
        self.plan = plan
        self.role = role or Commander(plan)
        self.index = self.role.index
        self.buses: list[Bus] = open_guarded(plan, urls)
        self.urls = [bus.url for bus in self.buses]
        self.url = ", ".join(self.urls) or "nowhere"
        self.rail = Rail(self.buses)
        self._paired = paired
        for bus, name in enumerate(dbc_names(plan)):
            write_new(folder / name, plan_dbc(plan, bus))
        self._names = [bus.name for bus in plan.can.buses]
        self._log = CanLog(folder / LOG, self._names[0])
        self.frames = 0
        self._robots: dict[str, WheelsReport] = {}
        self._stop_ns: int | None = None
        """When the wheels were stopped"""
        self.stages: tuple[Stage, ...] = self.role.stages
        if self.buses and paired:
            self.stages = on_bus(self.stages, self.rail, is_bridge=True, said=self.log)

    def take(self, messages: Sequence[Message], copies: list[Message]) -> None:
        """Shows the frames of its own role on the buses.  Adds no copies: recorders get the messages of the role.

        Raises SystemExit if it is interrupted while a bus takes no frames."""
        for message in messages:
            if message.channel is Channel.FRAMES and message.source == self.index:
                frames = frames_of(message)
                count = self.rail.put(frames) if self.buses else len(frames)
                self.log(frames[:count])
                if count < len(frames):
                    raise SystemExit(0)

    def log(self, frames: Sequence[TimedFrame]) -> None:
        """Writes frames to can.log."""
        wall_ns, write, names = time.monotonic_ns(), self._log.write, self._names
        for time_ns, bus, _, (can_id, data, remote) in frames:
            write(time_ns, can_id, data, wall_ns, names[bus], remote)
        self.frames += len(frames)

    def stop(self) -> None:
        """Takes the torque away from all wheels and disables their drives.  Every run ends with this call."""
        self.stop_at(self.role.next_ns)

    def stop_at(self, time_ns: int) -> None:
        """Does the same as `stop`, at run time `time_ns`.  The frames do not wait in the models of the buses.

        Raises PartRunError afterwards if a user's own protocol failed at it."""
        self.send_stop(time_ns, self.log)

    def send_stop(self, time_ns: int, sent: Callable[[list[TimedFrame]], None]) -> None:
        """Sends the frames that stop all wheels; then calls `sent` with those that a bus took.  If a host hangs, it is asked
        last, after `sent` has got the frames of the others; they are in can.log then.

        A bus that is full takes them within `STOP_S`, or not at all; then the drives' own watchdogs take the torque away.
        Raises PartRunError afterwards if a user's own protocol failed at it."""
        self._robots = self.role.reports()
        self._stop_ns = time_ns
        failure: BaseException | None = None
        with last_to_send(self.rail.sending):
            for robots in self.role.in_order_of_stopping():
                frames, failed = self.role.stop(time_ns, robots)
                failure = failure or failed
                sent(send_all(self.buses, frames) if self.buses else frames)
                self._log.flush()
        if failure is not None:
            raise failure

    def interrupt(self) -> None:
        """Ends any waiting for a bus that accepts no frames."""
        self.rail.stopping.set()

    def close(self) -> None:
        """Closes log and buses, after a last look at what others sent."""
        look(self.buses, self.rail.spoken, FLOOD)
        self._log.close()
        for bus in self.buses:
            bus.close()

    def progress(self) -> BridgeProgress:
        """Returns the present state, for a live table."""
        if self._paired:  # the rail reads the frames
            for one in self.buses:
                one.guard.look_outside()
        else:
            look(self.buses, self.rail.spoken, FLOOD)
        return BridgeProgress(
            url=self.url,
            load=max(bus.load for bus in self.role.buses),
            frames=self.frames,
            stopped=stopped_text([robot.stopped for robot in self.role.robots]),
            faults=tuple(f"{robot.robot.name} {robot.host.fault}" for robot in self.role.robots if robot.host.fault),
            note=self.rail.waiting,
        )

    def report(self) -> CanReport:
        """Returns the report of the run; the wheels are as they were before `stop`."""
        fit = plan_fit(self.plan)
        buses = tuple(
            bus_report(self.plan, number, self.role.buses[number], bus.responses_ns) for number, bus in enumerate(fit)
        )
        return CanReport(
            path="closed",
            timing=self.plan.can.timing,
            url=self.url,
            listen="; ".join(command for url in self.urls if (command := listen_command(url))),
            torque_scale=self.plan.can.torque_scale,
            log_start=-self.plan.can.bring_up_ns / 1e9,
            frames=self.frames,
            load_mean=max(bus.load for bus in buses),
            fit=tuple(bus.lines[0] for bus in fit),
            advice=tuple(way for bus in fit for way in bus.advice),
            buses=buses,
            scheduled=scheduled(self.plan),
            sent=sum(bus.counts.sent for bus in self.buses),
            failed=sum(bus.counts.failed for bus in self.buses),
            dropped=sum(bus.counts.dropped for bus in self.buses),
            log_lost=self._log.counts.lost,
            log_error=str(self._log.error) if self._log.error else None,
            robots=self._robots or self.role.reports(),
            foreign=self.rail.foreign,
            intrusions=intrusions(self.plan, self.buses),
            refused=dict(self.role.refused),
            wheels_stopped=None if self._stop_ns is None else self._stop_ns / 1e9,
        )


def send_all(buses: Sequence[Bus], frames: Sequence[TimedFrame]) -> list[TimedFrame]:
    """Sends frames that stop wheels: each of them, again and again while its bus is full, for `STOP_S` in all.

    Returns those that were sent."""
    sent, until_s = [], time.monotonic() + STOP_S
    for timed in frames:
        time_ns, bus, _, (can_id, data, remote) = timed
        while not (taken := buses[bus].send(can_id, data, time_ns, remote)) and time.monotonic() < until_s:
            time.sleep(PAUSE_S)
        if taken:
            sent.append(timed)
    return sent
