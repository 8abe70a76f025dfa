"""The two CiA 402 drives of a robot, their host and a network master, on a bus without delay."""

from collections.abc import Callable, Iterable
from typing import Any

from echelon.bridge.protocols.cia402.drive import Cia402Drive
from echelon.bridge.protocols.cia402.host import Cia402Host, Master
from echelon.bridge.protocols.frame import Frame
from echelon.plan.can_plan import DrivePlan
from support.bench_drives import MS, drive_plan

NODES = (5, 6)
PERIOD_NS = 10 * MS


def plan_of(**changes: Any) -> DrivePlan:
    """Returns the plan of the drives with node ids 5 and 6, with changes."""
    return drive_plan("cia402", NODES, **changes)


class Rig:
    """Drives, host and master.  `listen` is called with every frame; a frame for which `lose` is true does not arrive."""

    def __init__(self, plan: DrivePlan) -> None:
        self.plan = plan
        self.time_ns = -200 * MS
        self.drives = [Cia402Drive(plan, wheel) for wheel in (0, 1)]
        self.host = Cia402Host(plan)
        self.master = Master(plan.period_ns, plan.watchdog_ns)
        self.listen: Callable[[int, Frame], object] = lambda time_ns, frame: None
        self.lose: Callable[[Frame], bool] = lambda frame: False

    def to_drives(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            self.listen(self.time_ns, frame)
            for drive in self.drives if not self.lose(frame) else ():
                if frame.can_id in drive.identifiers:
                    self.to_host(drive.advance(self.time_ns))
                    self.to_host(drive.receive(self.time_ns, frame))

    def to_host(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            self.listen(self.time_ns, frame)
            if not self.lose(frame):
                self.host.receive(self.time_ns, frame)

    def cycle(self, right: float = 0.0, left: float = 0.0) -> None:
        """Runs one period: SYNC ends the previous period, then the host sends the torques."""
        for drive in self.drives:
            self.to_host(drive.advance(self.time_ns))
        self.to_drives([self.master.sync()])
        self.to_drives(self.master.poll(self.time_ns))
        self.to_drives(self.host.poll(self.time_ns))
        self.to_drives(self.host.command(self.time_ns, right, left))
        self.time_ns += self.plan.period_ns

    def cycles(self, number: int, right: float = 0.0, left: float = 0.0) -> None:
        for _ in range(number):
            self.cycle(right, left)

    def bring_up(self) -> "Rig":
        for _ in range(60):
            self.cycle()
            if self.host.enabled:
                return self
        raise AssertionError(f"not enabled: {self.host.fault!r}")

    @property
    def torques(self) -> tuple[float, float]:
        right, left = (drive.motor.torque for drive in self.drives)
        return right, left
