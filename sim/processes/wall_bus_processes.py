"""The bodies of the processes of a bus on a wall clock: bridge and drives on the closed path, and the referee."""

import signal
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, TypeVar

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.patient import PatientReferee
from echelon.bridge.referee.referee import Referee
from echelon.bridge.stations.waiting import AT_ONCE, FLOOD, PROGRESS_NS, Mail, RunClock, drained, wait_for
from echelon.bridge.stations.wall_bridge import WallBridge
from echelon.bridge.stations.wall_drives import WallDrives
from echelon.errors import PartRunError
from echelon.messages import Channel
from echelon.runtime.session import Session
from echelon.runtime.wire import data_key, watch_key
from echelon.sim.processes.contract import ProcessSpec, StartError, failed, finish, hear_finish, meet, tell
from echelon.sim.processes.to_process import BreakOff, Finish, Told
from echelon.sim.processes.watch import STOP, Watch

LISTEN_NS: Final = 10_000_000
"""How often the referee reads the frames that have come [ns]: others need the processors, too"""
ALONE_NS: Final = 1_000_000_000
"""How long after the end of a run the bridge waits for the order to finish before it stops the wheels by itself [ns]"""
BUSY: Final = "a machine that is too busy misses their watchdogs (echelon doctor)"
STILL: Final = 5
"""In so many periods do drives report wheels without torque before they end: the first report is a mean, the last one waits"""
_T = TypeVar("_T")


def run_wall_bridge(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs the bridge on the closed path on a wall clock.

    When the run is over and nobody orders it to finish, since the supervisor stands still, it stops the wheels by itself.
    It also stops them, and tells the supervisor why, if drives are in fault when the run begins, or if a user's protocol
    fails."""
    plan = spec.plan
    assert plan.bridge is not None
    bridge_key = data_key(spec.run, plan.bridge.path, Channel.WHEELS)
    copies = session.publisher(watch_key(spec.run, "bridge", "bridge")).put if spec.watched else None
    wheels = session.publisher(bridge_key).put
    bridge = made(lambda: WallBridge(plan, spec.can_urls, Path(spec.folder), wheels, copies))
    _hear_torques(spec, session, bridge.mail)
    stop = watch.stops(bridge.stop)
    control.send(bridge.progress())
    watch.pulse.from_ns = meet(spec, session, control)
    clock = bridge.clock = RunClock(watch.pulse.from_ns)
    bridge.mail.now = clock.now
    signal.signal(STOP, lambda number, frame: None)  # the watch hears of it

    def serve() -> Finish | None:
        """Serves the buses until the end of the run; returns the order to finish, if it has come."""
        said_ns, begun = -1 << 62, False
        while clock.now() < plan.duration_ns + ALONE_NS:
            left_ns = min(max(bridge.due_ns - clock.now(), 0), PROGRESS_NS)
            now_ns = time.monotonic_ns()
            watch.pulse.beat(now_ns, now_ns + left_ns)
            wait_for([control, watch, *bridge.sources], left_ns)
            if watch.asked:
                return None
            now_ns = clock.now()
            bridge.serve()
            # what drives have reported until the watchdog's time is read, unless somebody floods the bus
            if not begun and now_ns >= plan.can.watchdog_ns * (2 if bridge.behind else 1):
                begun = True
                if faults := bridge.faults_of_start():
                    raise StartError(f"{faults}: drives must be free of faults when a run begins; {BUSY}")
            if now_ns - said_ns >= PROGRESS_NS:
                said_ns = now_ns
                tell(control, bridge.progress())
            if (order := hear_finish(control)) is not None:
                return order
        return None

    order: Finish | None = None
    failure: StartError | PartRunError | None = None
    try:
        try:
            order = serve()
        except (StartError, PartRunError) as error:
            failure = error
        try:
            stop()
        except PartRunError as error:
            failure = failure or error
        if failure is not None:
            control.send(failed(failure))
        watch.pulse.rest()
        while order is None:
            wait_for([control], PROGRESS_NS)
            order = hear_finish(control)
    finally:
        try:
            stop()
        finally:
            bridge.close()
    finish(spec, control, report=bridge.report(), refusals=bridge.mail.refusals)


def run_wall_drives(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs the virtual drives on a wall clock.

    They end after the bridge has stopped them, or their watchdogs have, also when the supervisor is gone."""
    buses = _open_buses(spec.can_urls)
    drives = WallDrives(spec.plan, buses)
    mail = Mail(spec.plan, spec.index, wakes=False)  # wheel speeds are read with the next frame, which is early enough
    _hear_torques(spec, session, mail)
    watch.pulse.from_ns = meet(spec, session, control)
    clock = RunClock(watch.pulse.from_ns)
    mail.now = clock.now
    signal.signal(STOP, lambda number, frame: None)  # the watch hears of it
    until_ns: int | None = None
    period_ns = max(robot.drive.period_ns for robot in spec.plan.robots)
    periods, period_from_ns = 0, 0  # periods in which the drives have reported that the wheels have no torque
    while until_ns is None or (periods < STILL and clock.now() < until_ns):
        now_ns = time.monotonic_ns()
        watch.pulse.beat(now_ns, now_ns + PROGRESS_NS)
        drives.serve(clock, [control, watch] if until_ns is None else [])
        for message in mail.take():
            drives.bank.turn(clock.now(), message)
        if until_ns is None and (watch.asked or _is_over(control)):
            # if the bridge did not stop the drives, wait until their watchdogs have
            until_ns = clock.now() + 2 * spec.plan.can.watchdog_ns
        elif until_ns is not None and not drives.bank.turning and clock.now() - period_from_ns >= period_ns:
            periods, period_from_ns = periods + 1, clock.now()
    watch.pulse.rest()
    for bus in buses:
        bus.close()
    finish(spec, control, report=drives.report(), refusals=mail.refusals)


def _is_over(control: Connection) -> bool:
    """Returns whether the order to finish has come, or the supervisor is gone."""
    try:
        return hear_finish(control) is not None
    except (EOFError, OSError):
        return True


def run_wall_referee(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs the referee on a wall clock: it listens to the buses only."""
    buses = _open_buses(spec.can_urls)
    # processes wait for a processor, so a frame is late only by a time that a drive's watchdog would almost notice
    tolerance_ns = spec.plan.can.watchdog_ns // 2
    referee = PatientReferee(Referee(spec.plan, tolerance_ns=tolerance_ns), spec.plan.duration_ns)
    watch.pulse.from_ns = meet(spec, session, control)
    clock = RunClock(watch.pulse.from_ns)
    order: Told | None = None
    while not isinstance(order, Finish):
        watch.pulse.at_work(PROGRESS_NS / 1e9)
        wait_for([control], LISTEN_NS)  # not for each frame: the kernel stamps them
        order = control.recv() if control.poll() else None
        if isinstance(order, BreakOff):
            referee.hold()
        most = FLOOD if isinstance(order, Finish) else AT_ONCE  # at the end everything that has come
        counts = []
        for number, bus in enumerate(buses):
            frames = [
                (clock.of(received.time_ns), number, Frame(received.can_id, received.data, received.remote))
                for received in drained(bus, most)
            ]
            referee.hear(clock.now(), frames)
            counts.append(len(frames))
    watch.pulse.rest()
    report = referee.finish(clock.now(), order.wheels_stopped_ns)
    # robots must not be blamed for what the referee did not hear: then can.log is judged instead
    deaf = any(bus.missed for bus in buses) or max(counts) == FLOOD
    for bus in buses:
        bus.close()
    finish(spec, control, report=None if deaf else report)


def _hear_torques(spec: ProcessSpec, session: Session, mail: Mail) -> None:
    """Lets the robots' torques come into a mailbox."""
    for robot, door in mail.doors().items():
        session.subscribe(data_key(spec.run, spec.plan.robots[robot].path, Channel.TORQUE), door)


def made(make: Callable[[], _T]) -> _T:
    """Calls `make` and returns its result.  Raises StartError if a bus or a file cannot be opened."""
    try:
        return make()
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None


def _open_buses(urls: Sequence[str]) -> list[Bus]:
    return made(lambda: [open_bus(url) for url in urls])
