"""The processes between robots and their wheels, in virtual time: the bridge and the virtual drives, each at its place in
the lockstep, with their frames going over the real bus."""

import gc
import os
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from echelon.bridge.bus import open_bus
from echelon.bridge.closed import ClosedStation
from echelon.bridge.drive_bank import DriveBank
from echelon.bridge.on_bus import BusError, Rail, on_bus
from echelon.plugins import PartRunError
from echelon.role import Role, Stage
from echelon.runner import Runner
from echelon.session import Session
from echelon.sim.joining import ProcessSpec, Result, StartError, meet, resources

PROGRESS_S: Final = 0.2


class DrivesStation:
    """The virtual drives of a plan, on real buses.  Raises ValueError or OSError if a bus cannot be had."""

    def __init__(self, spec: ProcessSpec) -> None:
        self.role = DriveBank(spec.plan)
        self.index = self.role.index
        self.buses = [open_bus(url) for url in spec.can_urls]
        self.rail = Rail(self.buses)
        self.stages: tuple[Stage, ...] = on_bus(self.role.stages, self.rail, is_bridge=False)

    def progress(self) -> dict[str, Any]:
        """Returns what a live table shows."""
        return {"drives_note": self.rail.waiting}

    def result(self) -> dict[str, Any]:
        """Returns what the drives saw."""
        return self.role.result() | {"foreign": self.rail.foreign, "buses": self.role.lost_rows()}

    def close(self) -> None:
        """Closes the buses."""
        for bus in self.buses:
            bus.close()


def run_station(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """Runs bridge or drives through a whole run in virtual time."""
    station: ClosedStation | DrivesStation
    try:
        if spec.kind == "bridge":
            station = ClosedStation(spec.plan, spec.can_urls, Path(spec.folder), paired=True)
            control.send(("bus", station.url))
        else:
            station = DrivesStation(spec)
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    role: Role = station
    runner = Runner(role, spec.plan, session, spec.run, watched=spec.watched, virtual=True)
    meet(spec, session, control)

    def leave(number: int, frame: object) -> None:
        station.rail.stopping.set()
        runner.stop()

    signal.signal(signal.SIGTERM, leave)
    lock = threading.Lock()  # two threads say something over one pipe

    def say(message: tuple[Any, ...]) -> None:
        with lock:
            control.send(message)

    gc.collect()
    gc.disable()
    done = threading.Event()
    teller = threading.Thread(target=_tell, args=(station, say, done), name="progress", daemon=True)
    teller.start()
    failure = ""
    try:
        runner.lockstep(lambda time_ns, sources: say(("waiting", time_ns, sources)))
    except SystemExit:  # the run breaks off; what was counted so far is to be told
        pass
    except (BusError, PartRunError) as error:
        failure = str(error)
    finally:
        runner.finish()
        done.set()
        teller.join()
        try:
            if isinstance(station, ClosedStation):
                station.stop_wheels(station.role.next_ns)
        except PartRunError as error:
            failure = failure or str(error)
        station.close()
    if failure:
        say(("failed", failure))
        raise SystemExit(1)
    cpu_s, resident = resources()
    links = tuple(runner.mailbox.counts())
    say(("done", Result(spec.name, cpu_s, resident, runner.counts, links, station.result())))
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(0))
    control.recv()


def _tell(
    station: ClosedStation | DrivesStation, say: Callable[[tuple[Any, ...]], None], done: threading.Event
) -> None:
    """Tells how things stand, until the run is done."""
    while not done.wait(PROGRESS_S):
        try:
            say(("progress", station.progress()))
        except OSError:  # nobody is there any more to be told
            return
