"""Where `echelon can` and `echelon referee` get frames from: buses, or the can.log of a run's folder.

source      frames                                    their times
`listen`    that come on buses, from now on           counted from the call on, by the kernel's stamps
`read_log`  of a run that is over, as fast as read    run time
`replay`    of a run that is over, at their instants  run time
`follow`    of a run that goes on, as it writes them  run time
"""

import select
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import interface_is_up, resolve_url
from echelon.bridge.can.log_files import read_lines
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.log import PlanLog, read_run_log
from echelon.bridge.stations.closed import LOG
from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.sim.run_state import goes_on

TICK_S: Final = 0.1
"""After this time without a frame a source yields the time alone [s]"""
_AT_ONCE: Final = 256
"""How many frames of a bus are read before another bus has its turn"""
_AT_ONCE_BYTES: Final = 1 << 20
"""How much of a growing log is read at once [bytes]"""
_PAUSE_S: Final = 0.02
"""Pause after an error of a bus, so that the bus can come back [s]"""


class Heard(NamedTuple):
    """A frame on a bus; or, without a frame, the news that time has passed."""

    time_ns: int
    """Time of the frame [ns]; see the module for what it counts from"""
    bus: int
    """Number of the bus in the plan"""
    frame: Frame | None


def open_buses(plan: Plan, wanted: str | None) -> list[Bus]:
    """Opens the buses of a plan, in its order.

    `wanted` is what `--can` says: a URL for each bus, with commas between them.  Without it the scenario's URLs are used.
    Raises UsageError if a bus cannot be opened, or is one that other processes cannot use."""
    buses: list[Bus] = []
    try:
        for url in _urls(plan, wanted):
            full = resolve_url(url)
            kind, _, name = full.partition(":")
            if kind == "socketcan" and not interface_is_up(name):
                raise UsageError(f"--can {url}: there is no network interface {name} that is up")
            buses.append(open_bus(full))
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from None
    return buses


def _urls(plan: Plan, wanted: str | None) -> list[str]:
    """Returns the URL of each bus.  Raises UsageError."""
    names = [bus.name for bus in plan.can.buses]
    urls = wanted.split(",") if wanted else [bus.url for bus in plan.can.buses]
    if len(urls) != len(names):
        raise UsageError(
            f"--can {wanted}: must have a URL for each bus of the scenario ({', '.join(names)}), with commas between"
        )
    for number, url in enumerate(urls):
        if url == "auto":
            if not interface_is_up(f"vcan{number}"):
                raise UsageError(
                    f"{names[number]}: the scenario does not say where this bus is, and there is no vcan{number}; give --can "
                    "with what run.json in the run's folder says of `buses`, e.g. --can udp_multicast:239.74.163.2:43113"
                )
            urls[number] = f"socketcan:vcan{number}"
        elif url.partition(":")[0] == "virtual":
            raise UsageError(
                f"{url}: is a bus inside one process, where nobody else can listen; give --can socketcan:… or udp_multicast:…"
            )
    return urls


def listen(buses: Sequence[Bus], seconds: float | None) -> Iterator[Heard]:
    """Yields the frames that come on buses, for some seconds or (None) for ever.

    An error of a bus is said once on standard error; listening goes on, also on an interface that is removed and comes back."""
    start_ns, start_s = time.time_ns(), time.monotonic()
    errors = [0] * len(buses)
    while seconds is None or time.monotonic() - start_s < seconds:
        select.select(list(buses), [], [], TICK_S)
        for number, bus in enumerate(buses):  # all of them: nothing wakes a socket whose interface is gone
            for _ in range(_AT_ONCE):
                received = bus.recv(0.0)
                if received is None:
                    break
                time_ns = max(0, received.time_ns - start_ns)
                yield Heard(time_ns, number, Frame(received.can_id, received.data, received.remote))
            if bus.counts.recv_failed > errors[number]:
                if not errors[number]:
                    print(f"echelon: {bus.url}: {bus.error}", file=sys.stderr, flush=True)
                errors[number] = bus.counts.recv_failed
                time.sleep(_PAUSE_S)
        yield Heard(max(0, time.time_ns() - start_ns), 0, None)


def read_log(folder: Path, plan: Plan) -> Iterator[tuple[int, int, Frame]]:
    """Yields the frames of a run's can.log: run time [ns], number of the bus, frame.

    Raises UsageError if the log cannot be read."""
    try:
        yield from read_run_log(folder / LOG, plan)
    except OSError as error:
        raise UsageError(f"{folder / LOG}: {error.strerror}") from None


def replay(folder: Path, plan: Plan, speed: float, seconds: float | None) -> Iterator[Heard]:
    """Yields the frames of a run's can.log at the instants at which they were sent, `speed` times as fast.

    Ends with the log, or after some seconds of real time.  Raises UsageError if the log cannot be read."""
    start_s, first_ns = time.monotonic(), 0
    for count, (time_ns, bus, frame) in enumerate(read_log(folder, plan)):
        first_ns = first_ns if count else time_ns
        due_s = start_s + (time_ns - first_ns) * 1e-9 / speed
        while (ahead_s := due_s - time.monotonic()) > 0:
            if seconds is not None and time.monotonic() - start_s >= seconds:
                return
            time.sleep(min(ahead_s, TICK_S))
            yield Heard(round(time_ns - max(0.0, due_s - time.monotonic()) * speed * 1e9), 0, None)
        yield Heard(time_ns, bus, frame)


def follow(folder: Path, plan: Plan, seconds: float | None) -> Iterator[Heard]:
    """Yields the frames of the can.log of a run that goes on, as they are written.

    Ends with the run, or after some seconds of real time.  Raises UsageError if the log cannot be read."""
    path, start_s, time_ns = folder / LOG, time.monotonic(), 0
    while not path.exists() and goes_on(folder):
        yield Heard(0, 0, None)
        time.sleep(TICK_S)
    try:
        with path.open("rb") as log:
            rest, over = b"", False
            while not over and (seconds is None or time.monotonic() - start_s < seconds):
                over = not goes_on(folder)  # asked before the log is read, so that nothing written in between is missed
                *lines, rest = (rest + log.read(_AT_ONCE_BYTES)).split(b"\n")
                for time_ns, bus, frame in PlanLog(read_lines(lines), plan).frames():
                    yield Heard(time_ns, bus, frame)
                if lines:
                    over = False
                    continue
                yield Heard(time_ns, 0, None)
                time.sleep(0 if over else TICK_S)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
