"""The virtual drives on a wall clock."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from echelon.bridge.can.bus import Bus
from echelon.bridge.frame_message import TimedFrame
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.reports import BusReport, DrivesReport
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.bridge.stations.guarding import check_sender, intrusions
from echelon.bridge.stations.paced_bus import PacedBus
from echelon.bridge.stations.waiting import RunClock, drained, wait_for
from echelon.bridge.timing.buses import bus_report, make_buses
from echelon.bridge.timing.disturbances import Disturbances
from echelon.bridge.timing.fit import plan_fit
from echelon.plan.plan import Plan, on_wall_clock


class WallDrives:
    """The virtual drives of a plan on a wall clock, on all its buses."""

    def __init__(self, plan: Plan, buses: Sequence[Bus]) -> None:
        self.plan = on_wall_clock(plan)
        self.bank = DriveBank(self.plan)
        models = make_buses(self.plan, part=1)
        self._buses = [
            PacedBus(bus, model, self.plan.can.watchdog_ns) for bus, model in zip(buses, models, strict=True)
        ]
        self._disturbances = Disturbances(self.plan, models, bridge=False)

    @property
    def due_ns(self) -> int:
        """When the drives must work even if no frame comes."""
        due_ns = min(self.bank.due_ns, self._disturbances.due_ns)
        return min([due_ns, *(end_ns for bus in self._buses if (end_ns := bus.due_ns) is not None)])

    def serve(self, clock: RunClock, also: Sequence[Any] = ()) -> None:
        """Waits for a frame, for one of `also`, or until `due_ns`; then lets the drives work."""
        wait_for([*also, *(paced.bus for paced in self._buses)], self.due_ns - clock.now())
        for number, paced in enumerate(self._buses):
            for received in drained(paced.bus):
                now_ns = clock.now()
                frame = Frame(received.can_id, received.data, received.remote)
                check_sender(paced.bus, paced.spoken, received)
                paced.hear(now_ns, frame, clock.of(received.time_ns))
                self._send(self.bank.receive(now_ns, number, frame))
        now_ns = clock.now()
        self._send(self.bank.pass_time(now_ns))
        for paced in self._buses:
            paced.run(now_ns)
        self._disturbances.apply(now_ns)
        if self.plan.can.paced:
            for placed in self.bank.drives:
                placed.is_off = self._buses[placed.place.bus].model.is_off(placed.place.node)

    def _send(self, frames: Sequence[TimedFrame]) -> None:
        for time_ns, bus, node, frame in frames:
            self._buses[bus].send(time_ns, node, frame)

    def report(self) -> DrivesReport:
        """Returns the report of all drives.  It reports on buses only if they are paced."""
        counts = [paced.bus.counts for paced in self._buses]
        buses: tuple[BusReport, ...] = ()
        if self.plan.can.paced:
            fit = plan_fit(self.plan)
            buses = tuple(
                bus_report(self.plan, number, paced.model, fit[number].responses_ns)
                for number, paced in enumerate(self._buses)
            )
        failed = sum(count.failed + count.dropped for count in counts)
        others = intrusions(self.plan, [paced.bus for paced in self._buses])
        return replace(self.bank.report(), failed=failed, buses=buses, intrusions=others)

    def lost_and_destroyed(self) -> tuple[int, int]:
        """Returns how many frames the paced buses lost, and how many attempts were destroyed."""
        rows = [row for paced in self._buses for row in paced.model.traffic.values()]
        return sum(row.lost for row in rows), sum(row.retransmitted for row in rows)
