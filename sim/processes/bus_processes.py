"""The processes on the CAN buses of a run: bridge, virtual drives, referee.

torque path   clock      bridge                drives               referee
mirror        virtual    run_mirror_bridge     none                 none
mirror        wall       run_mirror_bridge     none                 run_wall_referee
closed        virtual    run_lockstep          run_lockstep         none
closed        wall       run_wall_bridge       run_wall_drives      run_wall_referee

The referee has sockets of its own, and judges what was on the buses.  Where it cannot (docs/architecture.md, 5.7), can.log is
judged after the run.
"""

import gc
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from echelon.bridge.frame_message import FrameBounds
from echelon.bridge.stations.closed import ClosedBridge
from echelon.bridge.stations.lockstep_drives import LockstepDrives
from echelon.bridge.stations.mirror import MirrorBridge
from echelon.bridge.stations.rail import BusError
from echelon.bridge.stations.waiting import PROGRESS_NS, RunClock
from echelon.errors import PartRunError
from echelon.messages import Message
from echelon.role import Role
from echelon.runtime.lockstep import LockstepRunner
from echelon.runtime.session import Session
from echelon.runtime.wire import encode, join, watch_key
from echelon.sim.processes.contract import Body, ProcessSpec, failed, finish, hear_finish, meet, tell
from echelon.sim.processes.to_supervisor import Said, Waiting
from echelon.sim.processes.wall_bus_processes import made, run_wall_bridge, run_wall_drives, run_wall_referee
from echelon.sim.processes.watch import STOP, Watch
from echelon.sim.processes.watchers import HIGH_WATER, Reception

PROGRESS_S: Final = PROGRESS_NS / 1e9
BATCH: Final = 16
"""Largest number of messages with frames in a batch"""
HALT_S: Final = 0.2
"""How long a bridge that must stop waits for its role to come to rest [s]"""


def body_of(spec: ProcessSpec) -> Body:
    """Returns the body of the process of a bridge, of drives or of a referee."""
    if spec.kind == "referee":
        return run_wall_referee
    if not spec.plan.can.closed:
        return run_mirror_bridge
    if spec.virtual:
        return run_lockstep
    return run_wall_bridge if spec.kind == "bridge" else run_wall_drives


def run_mirror_bridge(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs the bridge on the mirrored path: robots' states in; frames on the bus, into can.log, and to the recorder."""
    robots = [robot.index for robot in spec.plan.robots]
    hold_s = None if spec.virtual else 0.0  # on a wall clock a frozen robot must not hold up the others
    reception = Reception(spec, session, robots, HIGH_WATER, hold_s)
    publisher = session.publisher(watch_key(spec.run, "bridge", "frames"))
    clock = None if spec.virtual else RunClock()
    bridge = made(lambda: MirrorBridge(spec.plan, spec.can_urls, Path(spec.folder), clock))
    stop = watch.stops(bridge.stop)
    control.send(bridge.progress())
    start_ns = meet(spec, session, control)
    signal.signal(STOP, lambda number, frame: None)  # the watch hears of it
    reception.begin(start_ns)
    if not spec.virtual:
        watch.pulse.from_ns = start_ns
        bridge.clock = RunClock(start_ns)

    def take(messages: list[Message]) -> None:
        copies: list[Message] = []
        try:
            bridge.take(messages, copies)
        except PartRunError as error:
            end(error)
        frames = [encode(message) for message in copies]
        for at in range(0, len(frames), BATCH):
            publisher.put(join(frames[at : at + BATCH]))

    def end(why: PartRunError | None = None) -> None:
        """Stops the wheels.  From here on the bridge makes no frames, but robots must not wait for it."""
        try:
            stop()
        except PartRunError as error:
            why = why or error
        if why is not None:
            control.send(failed(why))

    said_s = time.monotonic()
    order = None
    try:
        while order is None:
            watch.pulse.at_work(PROGRESS_S)
            take(reception.take(PROGRESS_S / 2))
            if watch.asked:
                end()
            now_s = time.monotonic()
            if now_s - said_s >= PROGRESS_S:
                said_s = now_s
                bridge.flush()
                tell(control, bridge.progress())
            order = hear_finish(control)
        for messages in reception.drain(order.robot_messages):
            watch.pulse.at_work(PROGRESS_S)
            take(messages)
        end()
    finally:
        try:
            stop()
        finally:
            bridge.close()
    watch.pulse.rest()
    finish(spec, control, report=bridge.report(), refusals=reception.refusals)


def run_lockstep(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs bridge or drives on the closed path in virtual time, as a role in lockstep."""

    def make() -> ClosedBridge | LockstepDrives:
        if spec.kind == "bridge":
            return ClosedBridge(spec.plan, spec.can_urls, Path(spec.folder), paired=True)
        return LockstepDrives(spec.plan, spec.can_urls)

    station = made(make)
    control.send(station.progress())
    role: Role = station
    runner = LockstepRunner(role, spec.plan, session, spec.run, watched=spec.watched, frames=FrameBounds(spec.plan))

    def halt() -> None:
        station.interrupt()
        runner.halt(HALT_S)
        station.stop()

    stop = watch.stops(halt, at_once=True)
    meet(spec, session, control)
    signal.signal(STOP, lambda number, frame: runner.stop())
    lock = threading.Lock()  # two threads send over one pipe

    def say(what: Said) -> None:
        with lock:
            control.send(what)

    def say_if_room(what: Said) -> None:
        with lock:
            tell(control, what)

    gc.collect()
    gc.disable()
    done = threading.Event()
    teller = threading.Thread(target=_tell, args=(station, say_if_room, done), name="progress", daemon=True)
    teller.start()
    failure: BusError | PartRunError | None = None
    try:
        runner.run(lambda time_ns, sources: say_if_room(Waiting(time_ns, tuple(sources))))
    except SystemExit:  # the run breaks off, but the counts so far are still reported
        pass
    except (BusError, PartRunError) as error:
        failure = error
    finally:
        try:
            stop()  # before anything that may wait for others
        except PartRunError as error:
            failure = failure or error
        runner.finish()
        done.set()
        teller.join()
        station.close()
    if failure is not None:
        say(failed(failure))
    # Who is ordered to stop the wheels is ordered to end soon after: its report comes first.
    finish(spec, control, runner.counts, runner.mailbox.counts(), station.report(), runner.refusals, leaves=True)


def _tell(station: ClosedBridge | LockstepDrives, say: Callable[[Said], None], done: threading.Event) -> None:
    """Reports the progress of a station until the run is done."""
    while not done.wait(PROGRESS_S):
        try:
            say(station.progress())
        except OSError:  # the supervisor is gone
            return
