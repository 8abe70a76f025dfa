"""What supervisor and processes of a run agree on: what a process is told at its start, how it joins, how it ends."""

import os
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.runtime.runner import RunnerCounts
from echelon.runtime.session import Session
from echelon.runtime.wire import SCHEMA_VERSION, token_key
from echelon.sim.processes.to_process import Finish, Start
from echelon.sim.processes.to_supervisor import Done, Ready, Report

READY_TIMEOUT_S: Final = 20.0


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """Everything a process of a run needs to know."""

    run: str
    kind: str
    """`robot`, `leader`, `coordinator`, `recorder`, `bridge` or `drives`"""
    name: str
    index: int
    plan: Plan
    virtual: bool
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    peers: tuple[tuple[str, str], ...]
    """(kind, name) of the processes whose tokens it waits for"""
    watched: bool = True
    member: bool = True
    """It is done when the run is; otherwise it is told when to finish"""
    folder: str = ""
    can_urls: tuple[str, ...] = ()
    """One per bus of the plan; none: no bus"""
    scenario_toml: str = ""
    metadata: dict[str, str] = field(default_factory=dict)
    keep_going: bool = False
    """The run goes on though a robot's state is not finite"""
    part_files: dict[str, str] = field(default_factory=dict)
    """Texts of the files that parts come from, by their names in the folder"""


Body = Callable[[ProcessSpec, Session, Connection], None]
"""What a process does once it has its session."""


class StartError(Exception):
    """What this process needs cannot be had; the text is for the user."""


def meet(spec: ProcessSpec, session: Session, control: Connection) -> int:
    """Shows that this process is ready, waits for its peers and for the start; returns the start instant [ns].

    To be called when all subscribers are declared: the token stands for them.  Raises StartError naming who is
    missing, and who speaks another schema version.
    """
    tokens = session.watch_tokens(f"echelon/{spec.run}/@alive/**")
    session.declare_token(token_key(spec.run, spec.kind, spec.name, f"{os.getpid()}-{time.monotonic_ns()}"))
    wanted = {token_key(spec.run, kind, name, "*"): name for kind, name in spec.peers}
    missing = tokens.wait(wanted, READY_TIMEOUT_S)
    if missing:
        others = {key.split("/")[3] for key in tokens.alive()} - {str(SCHEMA_VERSION)}
        note = f"; some here speak schema version {', '.join(sorted(others))}, not {SCHEMA_VERSION}" if others else ""
        raise StartError(f"not there after {READY_TIMEOUT_S:g} s: {', '.join(wanted[key] for key in missing)}{note}")
    control.send(Ready())
    told = control.recv()
    assert isinstance(told, Start)
    return told.start_ns


def hear_finish(control: Connection) -> Finish | None:
    """Returns the order to finish if it has come."""
    told = control.recv() if control.poll() else None
    return told if isinstance(told, Finish) else None


def finish(
    spec: ProcessSpec,
    control: Connection,
    runner: RunnerCounts | None = None,
    links: Sequence[LinkCounts] = (),
    report: Report | None = None,
) -> None:
    """Says what this process counted, and waits until everyone is done: a link that closes early would look like a death to
    its neighbours."""
    cpu_s, resident = resources()
    control.send(Done(spec.name, cpu_s, resident, runner, tuple(links), report))
    control.recv()


def resources() -> tuple[float, int]:
    """Returns the CPU time [s] and the resident memory [bytes] of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return usage.ru_utime + usage.ru_stime, pages * resource.getpagesize()
