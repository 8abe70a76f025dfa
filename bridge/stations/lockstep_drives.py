"""The virtual drives in a lockstep, in a process of their own: their frames really go over the buses."""

from collections.abc import Sequence
from dataclasses import replace

from echelon.bridge.can.bus import open_bus
from echelon.bridge.reports import BridgeProgress, DrivesReport
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.bridge.stations.rail import Rail, on_bus
from echelon.plan.plan import Plan
from echelon.role import Stage


class LockstepDrives:
    """The virtual drives of a plan as a role, on the buses at `urls`.  Raises ValueError or OSError if a bus cannot be had."""

    def __init__(self, plan: Plan, urls: Sequence[str]) -> None:
        self._bank = DriveBank(plan)
        self.index = self._bank.index
        self._buses = [open_bus(url) for url in urls]
        self._rail = Rail(self._buses)
        self.stages: tuple[Stage, ...] = on_bus(self._bank.stages, self._rail, is_bridge=False)

    def interrupt(self) -> None:
        """Waits no more for a bus that takes no frames."""
        self._rail.stopping.set()

    def stop(self) -> None:
        """Does nothing: drives stop when the bridge says so, or when it says nothing any more."""

    def progress(self) -> BridgeProgress:
        """Returns how they stand."""
        return BridgeProgress(note=self._rail.waiting)

    def report(self) -> DrivesReport:
        """Returns what the drives saw."""
        return replace(self._bank.report(), foreign=self._rail.foreign)

    def close(self) -> None:
        """Closes the buses."""
        for bus in self._buses:
            bus.close()
