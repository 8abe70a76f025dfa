"""The virtual drives in lockstep, in a process of their own: their frames really go over the buses."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.reports import BridgeProgress, DrivesReport
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.bridge.stations.guarding import check_sender, intrusions, open_guarded
from echelon.bridge.stations.rail import Rail, on_bus
from echelon.bridge.stations.waiting import FLOOD, drained
from echelon.plan.plan import Plan
from echelon.role import Stage

STEPS: Final = 20
"""Steps in which the time passes that the watchdogs take: what a drive sends in a step goes out together"""
LONGEST_REST_NS: Final = 10_000_000_000
"""Longest time that passes so [ns].  Watchdogs may be longer, and drives send a frame in each period"""


class LockstepDrives:
    """The virtual drives of a plan as a role, on the buses at `urls`.

    Raises ValueError for an invalid URL and OSError if a bus cannot be opened."""

    def __init__(self, plan: Plan, urls: Sequence[str]) -> None:
        self._bank = DriveBank(plan)
        self.index = self._bank.index
        self._plan, self._buses = plan, open_guarded(plan, urls)
        self._rail = Rail(self._buses)
        self._of_run: DrivesReport | None = None
        """The drives' report before `stop`"""
        self._rest_ns = min(2 * max(robot.drive.watchdog_ns for robot in plan.robots), LONGEST_REST_NS)
        self.stages: tuple[Stage, ...] = on_bus(self._bank.stages, self._rail, is_bridge=False)

    def interrupt(self) -> None:
        """Ends any waiting for a bus that accepts no frames."""
        self._rail.stopping.set()

    def stop(self) -> None:
        """Takes what the bridge has still sent, then lets the drives' watchdogs expire; sends what the drives report of it.

        So who listens to the bus hears that the wheels have no torque, however the run ends.  Of watchdogs beyond half of
        `LONGEST_REST_NS` that is so only where the bridge has stopped the drives, as it does unless it was killed."""
        self._of_run = self._bank.report()
        time_ns = self._bank.next_ns
        frames = []
        for number, bus in enumerate(self._buses):
            for received in drained(bus, FLOOD):
                check_sender(bus, self._rail.spoken[number], received)
                frame = Frame(received.can_id, received.data, received.remote)
                frames += self._bank.receive(time_ns, number, frame)
        for step in range(1, STEPS + 1):
            frames += self._bank.pass_time(time_ns + step * self._rest_ns // STEPS)
        for at_ns, number, _, (can_id, data, remote) in frames:
            self._buses[number].send(can_id, data, at_ns, remote)

    def progress(self) -> BridgeProgress:
        """Returns the present state, for a live table."""
        return BridgeProgress(note=self._rail.waiting)

    def report(self) -> DrivesReport:
        """Returns the report of the run, without what the drives do in `stop`; but what others sent then counts."""
        report = self._of_run or self._bank.report()
        return replace(report, foreign=self._rail.foreign, intrusions=intrusions(self._plan, self._buses))

    def close(self) -> None:
        """Closes the buses."""
        for bus in self._buses:
            bus.close()
