"""`echelon doctor`: checks of this machine.  Each check really tries what a run needs, and gives advice if that fails.

No check needs root, changes the machine, or takes longer than its time limit.
"""

import importlib.metadata
import os
import platform
import shutil
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from echelon.plan.plan import Plan
from echelon.runtime.session import Session, loopback_endpoints
from echelon.sim.doctor.can_checks import check_fit, check_interfaces, check_multicast, check_tools, check_vcan
from echelon.sim.doctor.diagnosis import LIMIT_S, Diagnosis
from echelon.sim.wall_load import BUSY

PACKAGES: Final = ("eclipse-zenoh", "python-can", "numpy", "scipy", "cantools", "mcap", "pydantic")
"""Packages whose versions are shown"""
OLDEST: Final = (3, 11)
"""The oldest version of Python that works"""
SLEEPS: Final = 200
SLEEP_S: Final = 0.001
"""Waking is measured with `SLEEPS` sleeps of this time [s]"""
LATE_S: Final = 0.002
"""A process that is woken later than this cannot keep periods of a few milliseconds [s]"""
BUFFER: Final = 4 << 20
"""The size of socket buffer that the bridge asks for, which holds a burst while it waits for a processor [bytes]"""
SPACE: Final = 1 << 30
"""Recordings soon fill less free space than this [bytes]"""
HANDLING: Final = 2.0
"""Processor time that a message costs sender, receiver and recorder, as a multiple of its measured round trip.  Measured:
paper.toml with recorder and CAN takes two processors 1.3 ms for a tick of 24 messages"""


@dataclass(slots=True)
class Measured:
    """Measurements of some checks that later checks use."""

    jitter_s: float = 0.0
    """Lateness after a short sleep that 99 % of the sleeps do not exceed [s]"""
    round_trip_s: float = 0.0
    """Median time of a message there and back over Zenoh [s]"""


def examine(plan: Plan | None = None, folder: Path | None = None) -> list[Diagnosis]:
    """Makes all checks and returns their results; `folder` is the folder for recordings, by
    default the working folder.  With a `plan` it is also checked whether this machine can run it."""
    measured = Measured()
    checks: list[tuple[str, Callable[[], Diagnosis]]] = [
        ("Python", check_python),
        ("processors", check_processors),
        ("waking", lambda: check_waking(measured)),
        ("Zenoh", lambda: check_zenoh(measured)),
        ("vcan0", check_vcan),
        ("multicast", check_multicast),
        ("socket buffers", check_buffers),
        ("CAN tools", check_tools),
        ("disk", lambda: check_disk(folder or Path())),
    ]
    results = [_limited(what, check) for what, check in checks]
    results += check_interfaces()
    if {result.what for result in results if result.state != "ok"} >= {"vcan0", "multicast"}:
        results.append(Diagnosis("CAN bus", "problem", "neither vcan0 nor multicast: frames reach no other process"))
    if plan is not None:
        if plan.can.enabled:
            results += check_fit(plan)
        results.append(_limited("wall clock", lambda: check_wall_clock(plan, measured)))
    return results


def text(results: list[Diagnosis]) -> str:
    """Returns results as lines for a terminal, with a verdict at the end."""
    width = max(len(result.what) for result in results)
    lines = []
    for result in results:
        lines.append(f"{result.state:<7}  {result.what:<{width}}  {result.text}")
        lines += [f"{'':<{width + 9}}  → {advice}" for advice in result.advice]
    problems = [result.what for result in results if result.state == "problem"]
    lines.append(f"NOT USABLE: {', '.join(problems)}" if problems else "usable")
    return "\n".join(lines)


def _limited(what: str, check: Callable[[], Diagnosis]) -> Diagnosis:
    """Makes a check in a separate thread, so that a hanging check does not stop the others."""
    found: list[Diagnosis] = []

    def run() -> None:
        try:
            found.append(check())
        except Exception as error:
            found.append(Diagnosis(what, "problem", f"{type(error).__name__}: {error}"))

    thread = threading.Thread(target=run, name=what, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    return found[0] if found else Diagnosis(what, "problem", f"no answer within {LIMIT_S:g} s")


def check_python(packages: tuple[str, ...] = PACKAGES) -> Diagnosis:
    """Checks Python and the packages that a run needs."""
    versions, missing = [f"Python {platform.python_version()}"], []
    for package in packages:
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(package)
    if missing or sys.version_info < OLDEST:
        lacks = f"; not installed: {', '.join(missing)}" if missing else ""
        return Diagnosis(
            "Python", "problem", ", ".join(versions) + lacks, ("run `make setup` with Python 3.11 or newer",)
        )
    return Diagnosis("Python", "ok", ", ".join(versions))


def check_processors() -> Diagnosis:
    """Checks the number of processors and their present load."""
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    said = f"{cores} available, load {load:.2f}, Linux {platform.release()}"
    if load > cores:
        return Diagnosis("processors", "note", said, ("the machine is busy: runs on a wall clock will be late",))
    return Diagnosis("processors", "ok", said)


def check_waking(measured: Measured) -> Diagnosis:
    """Measures how late a process wakes up after a sleep of a millisecond."""
    late = []
    for _ in range(SLEEPS):
        begun_s = time.perf_counter()
        time.sleep(SLEEP_S)
        late.append(time.perf_counter() - begun_s - SLEEP_S)
    measured.jitter_s = float(np.percentile(late, 99))
    said = f"{np.median(late) * 1e6:.0f} µs late after 1 ms of sleep (median); 99 % at most {measured.jitter_s * 1e3:.2g} ms"
    if measured.jitter_s > LATE_S:
        return Diagnosis("waking", "note", said, ("use virtual time, or periods of 10 ms and more",))
    return Diagnosis("waking", "ok", said)


def check_zenoh(measured: Measured, rounds: int = 200) -> Diagnosis:
    """Connects two sessions over the loopback and measures the round trip of a message."""
    back = threading.Event()
    (endpoint,) = loopback_endpoints(1)
    with (
        Session(listen=[endpoint], connect=[], lockstep=False) as one,
        Session(listen=[], connect=[endpoint], lockstep=False) as other,
    ):
        pong = other.publisher("doctor/pong")
        other.subscribe("doctor/ping", pong.put)
        one.subscribe("doctor/pong", lambda payload: back.set())
        ping = one.publisher("doctor/ping")
        other.declare_token("doctor/here")
        if one.watch_tokens("doctor/*").wait(["doctor/here"], LIMIT_S / 2):
            return Diagnosis(
                "Zenoh",
                "problem",
                f"no connection over {endpoint}",
                ("check that the interface lo is up, and that no firewall blocks it",),
            )
        times = []
        for _ in range(rounds):
            back.clear()
            begun_s = time.perf_counter()
            ping.put(b"doctor" * 10)
            if not back.wait(LIMIT_S / 4):
                return Diagnosis("Zenoh", "problem", f"messages are lost over {endpoint}")
            times.append(time.perf_counter() - begun_s)
    measured.round_trip_s = float(np.median(times))
    return Diagnosis("Zenoh", "ok", f"sessions over {endpoint}, {measured.round_trip_s * 1e6:.0f} µs there and back")


def check_buffers(core: Path = Path("/proc/sys/net/core")) -> Diagnosis:
    """Checks the largest socket buffer, which holds a burst while a process waits for a processor."""
    try:
        most, usual = (int((core / name).read_text()) for name in ("rmem_max", "rmem_default"))
    except (OSError, ValueError) as error:
        return Diagnosis("socket buffers", "note", f"not known: {error}")
    said = f"at most {most >> 10} KiB for receiving; candump uses {usual >> 10} KiB, or what its option -r asks for"
    if most < BUFFER:
        advice = (
            f"to lose no frames in bursts: sudo sysctl -w net.core.rmem_max={BUFFER} net.core.rmem_default={BUFFER}"
        )
        return Diagnosis("socket buffers", "note", said, (advice,))
    return Diagnosis("socket buffers", "ok", said)


def check_disk(folder: Path) -> Diagnosis:
    """Checks the free space for recordings."""
    free = shutil.disk_usage(folder).free
    said = f"{free / 1e9:.3g} GB free in {folder.resolve()}"
    if free < SPACE:
        return Diagnosis("disk", "note", said, ("record to another disk with --out, or free some space",))
    return Diagnosis("disk", "ok", said)


def check_wall_clock(plan: Plan, measured: Measured, instants: int = 50) -> Diagnosis:
    """Estimates from a few instants in this process whether this machine keeps the plan's shortest period in real time."""
    from echelon.sim.engines.in_process import Engine

    period_s = min(robot.period_ns for robot in plan.robots) / 1e9
    engine = Engine(plan)
    steps = engine.instants()
    next(steps)  # the first instant contains work that is done only once
    begun_s, before = time.perf_counter(), sum(counts.sent for counts in engine.link_counts())
    done = sum(1 for _ in islice(steps, instants))
    spent_s = time.perf_counter() - begun_s
    messages = sum(counts.sent for counts in engine.link_counts()) - before
    cores = len(os.sched_getaffinity(0))
    share = (spent_s + HANDLING * measured.round_trip_s * messages) / max(done, 1) / period_s / cores
    said = f"period {period_s * 1e3:g} ms: {len(plan.all_roles)} processes take about {100 * share:.0f} % of {cores} processors"
    advice = []
    if share > BUSY:
        fit = max(1, int(len(plan.robots) * BUSY / share))
        advice.append(
            f"too much for real time, about {fit} robots fit: use longer periods, fewer robots, or --clock virtual; "
            "otherwise stages are late, and the recording is thinned"
        )
    if measured.jitter_s > period_s / 2:
        advice.append(
            f"processes wake up to {measured.jitter_s * 1e3:.2g} ms late: use periods over {2e3 * measured.jitter_s:.2g} ms"
        )
    return Diagnosis("wall clock", "note" if advice else "ok", said, tuple(advice))
