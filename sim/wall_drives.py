"""The virtual drives, and the referee, on a wall clock."""

from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from echelon.bridge.bus import Bus, open_bus
from echelon.bridge.buses import bus_row, make_buses
from echelon.bridge.disturbances import Disturbances
from echelon.bridge.drive_bank import DriveBank
from echelon.bridge.fit import plan_fit
from echelon.bridge.frame import Frame
from echelon.bridge.frame_message import TimedFrame
from echelon.bridge.paced_bus import PacedBus
from echelon.bridge.referee import Referee
from echelon.messages import Channel
from echelon.plan import Plan, on_wall_clock
from echelon.session import Session
from echelon.sim.joining import ProcessSpec, Result, StartError, meet, resources
from echelon.sim.wall import PROGRESS_NS, Mail, RunClock, drained, wait_for
from echelon.wire import data_key


def run_wall_drives(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The process of the virtual drives of a run on a wall clock."""
    try:
        buses = [open_bus(url) for url in spec.can_urls]
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    drives = WallDrives(spec.plan, buses)
    mail = Mail(spec.plan, wakes=False)  # how shafts turn is early enough with the next frame
    session.subscribe([data_key(spec.run, robot.path, Channel.TORQUE) for robot in spec.plan.robots], mail.receive)
    clock = RunClock(meet(spec, session, control))
    until_ns: int | None = None
    while until_ns is None or clock.now() < until_ns:
        drives.serve(clock, [control])
        for message in mail.take():
            drives.bank.turn(clock.now(), message)
        if until_ns is None and control.poll():
            control.recv()
            # Until the drives stopped by themselves if nobody stopped them.
            until_ns = clock.now() + (2 * spec.plan.can.watchdog_ns if drives.bank.turning else 0)
    for bus in buses:
        bus.close()
    cpu_s, resident = resources()
    control.send(("done", Result(spec.name, cpu_s, resident, extra=drives.result())))
    control.recv()


def run_wall_referee(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The process of the referee of a run on a wall clock: it hears the buses, and nobody else."""
    try:
        buses = [open_bus(url) for url in spec.can_urls]
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    # Processes wait for their turn; only what a drive's watchdog would notice, too, is late.
    referee = Referee(spec.plan, tolerance_ns=spec.plan.can.watchdog_ns // 2)
    clock = RunClock(meet(spec, session, control))
    while True:
        wait_for([control, *buses], PROGRESS_NS)
        for number, bus in enumerate(buses):
            for received in drained(bus):
                frame = Frame(received.can_id, received.data, received.remote)
                referee.observe(clock.of(received.time_ns), number, frame)
        if control.poll():
            control.recv()
            break
    referee.finish(clock.now())
    for bus in buses:
        bus.close()
    cpu_s, resident = resources()
    extra = referee.summary() | {"source": "bus"}
    control.send(("done", Result(spec.name, cpu_s, resident, extra=extra)))
    control.recv()


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
        """When there is something to do without anything having come."""
        due_ns = min(self.bank.due_ns, self._disturbances.due_ns)
        return min([due_ns, *(end_ns for bus in self._buses if (end_ns := bus.due_ns) is not None)])

    def serve(self, clock: RunClock, also: Sequence[Any] = ()) -> None:
        """Waits for what comes next, a frame or an instant of their own, and lets the drives work; `also` ends the wait too."""
        wait_for([*also, *(paced.bus for paced in self._buses)], self.due_ns - clock.now())
        for number, paced in enumerate(self._buses):
            for received in drained(paced.bus):
                now_ns = clock.now()
                frame = Frame(received.can_id, received.data, received.remote)
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

    def result(self) -> dict[str, Any]:
        """Returns what there is to say of them for a run's summary."""
        counts = [paced.bus.counts for paced in self._buses]
        result = self.bank.result() | {"failed": sum(count.failed + count.dropped for count in counts)}
        if self.plan.can.paced:
            fit = plan_fit(self.plan)
            result["buses"] = [
                bus_row(self.plan, number, paced.model, fit[number].responses_ns)
                for number, paced in enumerate(self._buses)
            ]
        return result

    def lost_and_destroyed(self) -> tuple[int, int]:
        """Returns how many frames a paced bus lost, and how many it destroyed, which were sent again."""
        rows = [row for paced in self._buses for row in paced.model.traffic.values()]
        return sum(row.lost for row in rows), sum(row.retransmitted for row in rows)
