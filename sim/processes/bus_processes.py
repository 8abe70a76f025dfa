"""The processes on the CAN buses of a run: bridge, virtual drives, referee.

torque path   clock      bridge                drives               referee
mirror        virtual    run_mirror_bridge     none                 none
mirror        wall       run_mirror_bridge     none                 run_wall_referee if a bus is a SocketCAN interface
closed        virtual    run_lockstep          run_lockstep         none
closed        wall       run_wall_bridge       run_wall_drives      run_wall_referee if a bus is a SocketCAN interface

Without a referee, can.log is judged after the run.
"""

import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, TypeVar

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.referee import Referee
from echelon.bridge.stations.closed import ClosedBridge
from echelon.bridge.stations.lockstep_drives import LockstepDrives
from echelon.bridge.stations.mirror import MirrorBridge
from echelon.bridge.stations.rail import BusError
from echelon.bridge.stations.waiting import PROGRESS_NS, Mail, RunClock, drained, wait_for
from echelon.bridge.stations.wall_bridge import WallBridge
from echelon.bridge.stations.wall_drives import WallDrives
from echelon.errors import PartRunError
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.role import Role
from echelon.runtime.lockstep import LockstepRunner
from echelon.runtime.session import Session
from echelon.runtime.wire import data_key, encode, join, watch_key
from echelon.sim.processes.contract import Body, ProcessSpec, StartError, finish, hear_finish, meet
from echelon.sim.processes.to_supervisor import Failed, PartFailed, Report, Said, Waiting
from echelon.sim.processes.watchers import HIGH_WATER, Reception

PROGRESS_S: Final = PROGRESS_NS / 1e9
BATCH: Final = 16
"""Largest number of messages with frames in a batch"""
_T = TypeVar("_T")


def body_of(spec: ProcessSpec) -> Body:
    """Returns the body of the process of a bridge, of drives or of a referee."""
    if spec.kind == "referee":
        return run_wall_referee
    if not spec.plan.can.closed:
        return run_mirror_bridge
    if spec.virtual:
        return run_lockstep
    return run_wall_bridge if spec.kind == "bridge" else run_wall_drives


def run_mirror_bridge(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs the bridge on the mirrored path: robots' states in; frames on the bus, into can.log, and to the recorder."""
    robots = [robot.index for robot in spec.plan.robots]
    reception = Reception(session.inbox(watch_key(spec.run, "robot", "**"), HIGH_WATER), robots, spec.plan)
    publisher = session.publisher(watch_key(spec.run, "bridge", "frames"))
    bridge = _made(lambda: MirrorBridge(spec.plan, spec.can_urls, Path(spec.folder)))
    control.send(bridge.progress())
    meet(spec, session, control)

    def take(messages: list[Message]) -> None:
        frames = [encode(message) for message in bridge.take(messages)]
        for at in range(0, len(frames), BATCH):
            publisher.put(join(frames[at : at + BATCH]))

    said_s = time.monotonic()
    while True:
        take(reception.take(PROGRESS_S / 2))
        now_s = time.monotonic()
        if now_s - said_s >= PROGRESS_S:
            said_s = now_s
            bridge.flush()
            control.send(bridge.progress())
        if (order := hear_finish(control)) is not None:
            break
    for messages in reception.drain(order.robot_messages):
        take(messages)
    bridge.stop()
    bridge.close()
    finish(spec, control, report=bridge.report())


def run_lockstep(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs bridge or drives on the closed path in virtual time, as a role in lockstep."""

    def make() -> ClosedBridge | LockstepDrives:
        if spec.kind == "bridge":
            return ClosedBridge(spec.plan, spec.can_urls, Path(spec.folder), paired=True)
        return LockstepDrives(spec.plan, spec.can_urls)

    station = _made(make)
    control.send(station.progress())
    role: Role = station
    runner = LockstepRunner(role, spec.plan, session, spec.run, watched=spec.watched)
    meet(spec, session, control)

    def leave(number: int, frame: object) -> None:
        station.interrupt()
        runner.stop()

    signal.signal(signal.SIGTERM, leave)
    lock = threading.Lock()  # two threads send over one pipe

    def say(what: Said) -> None:
        with lock:
            control.send(what)

    gc.collect()
    gc.disable()
    done = threading.Event()
    teller = threading.Thread(target=_tell, args=(station, say, done), name="progress", daemon=True)
    teller.start()
    failure: Failed | PartFailed | None = None
    try:
        runner.run(lambda time_ns, sources: say(Waiting(time_ns, tuple(sources))))
    except SystemExit:  # the run breaks off, but the counts so far are still reported
        pass
    except BusError as error:
        failure = Failed(str(error))
    except PartRunError as error:
        failure = PartFailed(str(error))
    finally:
        runner.finish()
        done.set()
        teller.join()
        try:
            station.stop()
        except PartRunError as error:
            failure = failure or PartFailed(str(error))
        station.close()
    if failure is not None:
        say(failure)
        raise SystemExit(1)
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(0))
    report: Report = station.report()
    finish(spec, control, runner.counts, runner.mailbox.counts(), report)


def _tell(station: ClosedBridge | LockstepDrives, say: Callable[[Said], None], done: threading.Event) -> None:
    """Reports the progress of a station until the run is done."""
    while not done.wait(PROGRESS_S):
        try:
            say(station.progress())
        except OSError:  # the supervisor is gone
            return


def run_wall_bridge(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs the bridge on the closed path on a wall clock."""
    plan = spec.plan
    assert plan.bridge is not None
    bridge_key = data_key(spec.run, plan.bridge.path, Channel.WHEELS)
    watch = session.publisher(watch_key(spec.run, "bridge", "bridge")).put if spec.watched else None
    wheels = session.publisher(bridge_key).put
    bridge = _made(lambda: WallBridge(plan, spec.can_urls, Path(spec.folder), wheels, watch))
    session.subscribe(_torque_keys(spec.run, plan), bridge.mail.receive)
    control.send(bridge.progress())
    clock = bridge.clock = RunClock(meet(spec, session, control))
    said_ns = -1 << 62
    try:
        while hear_finish(control) is None:
            wait_for([control, *bridge.sources], bridge.due_ns - clock.now())
            bridge.serve()
            now_ns = clock.now()
            if now_ns - said_ns >= PROGRESS_NS:
                said_ns = now_ns
                control.send(bridge.progress())
    finally:
        try:
            bridge.stop()
        finally:
            bridge.close()
    finish(spec, control, report=bridge.report())


def run_wall_drives(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs the virtual drives on a wall clock."""
    buses = _open_buses(spec.can_urls)
    drives = WallDrives(spec.plan, buses)
    mail = Mail(spec.plan, wakes=False)  # wheel speeds are read with the next frame, which is early enough
    session.subscribe(_torque_keys(spec.run, spec.plan), mail.receive)
    clock = RunClock(meet(spec, session, control))
    until_ns: int | None = None
    while until_ns is None or clock.now() < until_ns:
        drives.serve(clock, [control])
        for message in mail.take():
            drives.bank.turn(clock.now(), message)
        if until_ns is None and hear_finish(control) is not None:
            # if the bridge did not stop the drives, wait until their watchdogs have
            until_ns = clock.now() + (2 * spec.plan.can.watchdog_ns if drives.bank.turning else 0)
    for bus in buses:
        bus.close()
    finish(spec, control, report=drives.report())


def run_wall_referee(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs the referee on a wall clock: it listens to the buses only."""
    buses = _open_buses(spec.can_urls)
    # processes wait for a processor, so a frame is late only by a time that a drive's watchdog would almost notice
    referee = Referee(spec.plan, tolerance_ns=spec.plan.can.watchdog_ns // 2)
    clock = RunClock(meet(spec, session, control))
    while hear_finish(control) is None:
        wait_for([control, *buses], PROGRESS_NS)
        for number, bus in enumerate(buses):
            for received in drained(bus):
                frame = Frame(received.can_id, received.data, received.remote)
                referee.observe(clock.of(received.time_ns), number, frame)
    referee.finish(clock.now())
    for bus in buses:
        bus.close()
    finish(spec, control, report=referee.report("bus"))


def _torque_keys(run: str, plan: Plan) -> list[str]:
    return [data_key(run, robot.path, Channel.TORQUE) for robot in plan.robots]


def _made(make: Callable[[], _T]) -> _T:
    """Calls `make` and returns its result.  Raises StartError if a bus or a file cannot be opened."""
    try:
        return make()
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None


def _open_buses(urls: Sequence[str]) -> list[Bus]:
    return _made(lambda: [open_bus(url) for url in urls])
