"""The virtual drives, and the referee, on a wall clock."""

import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from bridge.bus import Bus, open_bus
from bridge.drive_bank import DriveBank
from bridge.frame import Frame
from bridge.frame_message import TimedFrame
from bridge.referee import Referee
from echelon.messages import Channel
from echelon.session import Session
from echelon.wire import data_key
from sim.joining import ProcessSpec, Result, StartError, meet, resources
from sim.wall import PROGRESS_NS, Mail, drained, epoch_ns_of, wait_for


def run_wall_drives(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The process of the virtual drives of a run on a wall clock."""
    try:
        buses = [open_bus(url) for url in spec.can_urls]
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    bank, mail = (
        DriveBank(spec.plan),
        Mail(spec.plan, wakes=False),
    )  # how shafts turn is early enough with the next frame
    session.subscribe([data_key(spec.run, robot.path, Channel.TORQUE) for robot in spec.plan.robots], mail.receive)
    start_ns = meet(spec, session, control)
    until_ns: int | None = None
    while until_ns is None or time.monotonic_ns() < until_ns:
        serve(bank, buses, start_ns, [control])
        for message in mail.take():
            bank.turn(time.monotonic_ns() - start_ns, message)
        if until_ns is None and control.poll():
            control.recv()
            # Until the drives stopped by themselves if nobody stopped them.
            until_ns = time.monotonic_ns() + (2 * spec.plan.can.watchdog_ns if bank.turning else 0)
    for bus in buses:
        bus.close()
    cpu_s, resident = resources()
    failed = sum(bus.counts.failed + bus.counts.dropped for bus in buses)
    control.send(("done", Result(spec.name, cpu_s, resident, extra=bank.result() | {"failed": failed})))
    control.recv()


def run_wall_referee(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The process of the referee of a run on a wall clock: it hears the buses, and nobody else."""
    try:
        buses = [open_bus(url) for url in spec.can_urls]
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    # Processes wait for their turn; only what a drive's watchdog would notice, too, is late.
    referee = Referee(spec.plan, tolerance_ns=spec.plan.can.watchdog_ns // 2)
    start_ns = meet(spec, session, control)
    epoch_ns = epoch_ns_of(start_ns)
    while True:
        wait_for([control, *buses], PROGRESS_NS)
        for number, bus in enumerate(buses):
            for received in drained(bus):
                frame = Frame(received.can_id, received.data, received.remote)
                referee.observe(received.time_ns - epoch_ns, number, frame)
        if control.poll():
            control.recv()
            break
    referee.finish(time.monotonic_ns() - start_ns)
    for bus in buses:
        bus.close()
    cpu_s, resident = resources()
    extra = referee.summary() | {"source": "bus"}
    control.send(("done", Result(spec.name, cpu_s, resident, extra=extra)))
    control.recv()


def serve(bank: DriveBank, buses: Sequence[Bus], start_ns: int, also: Sequence[Any] = ()) -> None:
    """Waits for what comes next, a frame or an instant of the drives' own, and lets them work; `also` ends the wait too."""
    wait_for([*also, *buses], bank.due_ns - (time.monotonic_ns() - start_ns))
    for number, bus in enumerate(buses):
        for received in drained(bus):
            now_ns = time.monotonic_ns() - start_ns
            _send(buses, bank.receive(now_ns, number, Frame(received.can_id, received.data, received.remote)))
    _send(buses, bank.pass_time(time.monotonic_ns() - start_ns))


def _send(buses: Sequence[Bus], frames: Sequence[TimedFrame]) -> None:
    for _, bus, _, (can_id, data, remote) in frames:
        buses[bus].send(can_id, data, remote=remote)
