"""The virtual drives in lockstep, in a process of their own: their frames really go over the buses."""

from collections.abc import Sequence
from dataclasses import replace

from echelon.bridge.can.bus import open_bus
from echelon.bridge.reports import BridgeProgress, DrivesReport
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.bridge.stations.rail import Rail, on_bus
from echelon.plan.plan import Plan
from echelon.role import Stage


class LockstepDrives:
    """The virtual drives of a plan as a role, on the buses at `urls`.

    Raises ValueError for an invalid URL and OSError if a bus cannot be opened."""

    def __init__(self, plan: Plan, urls: Sequence[str]) -> None:
        self._bank = DriveBank(plan)
        self.index = self._bank.index
        self._buses = [open_bus(url) for url in urls]
        self._rail = Rail(self._buses)
        self.stages: tuple[Stage, ...] = on_bus(self._bank.stages, self._rail, is_bridge=False)

    def interrupt(self) -> None:
        """Ends any waiting for a bus that accepts no frames."""
        self._rail.stopping.set()

    def stop(self) -> None:
        """Does nothing: drives stop when the bridge commands it, or by their watchdog when it is silent."""

    def progress(self) -> BridgeProgress:
        """Returns the present state, for a live table."""
        return BridgeProgress(note=self._rail.waiting)

    def report(self) -> DrivesReport:
        """Returns the report of all drives."""
        return replace(self._bank.report(), foreign=self._rail.foreign)

    def close(self) -> None:
        """Closes the buses."""
        for bus in self._buses:
            bus.close()
