"""The contract between supervisor and processes: the specification of a process, how it joins a run, how it ends.

step     what happens
start    the supervisor starts the process with its `ProcessSpec`
ready    the process has declared its subscribers, has seen the tokens of its peers, and says `Ready`
run      the supervisor says `Start` when all are ready; members run to the end, others until `Finish`
done     the process says `Done` with its counts and waits
end      the supervisor says `End` when all are done; the process closes its session
"""

import os
import resource
import select
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from echelon.errors import PartRunError
from echelon.plan.plan import Plan
from echelon.runtime.admission import Refusals
from echelon.runtime.credentials import Credentials
from echelon.runtime.link import LinkCounts
from echelon.runtime.runner import RunnerCounts
from echelon.runtime.session import Session
from echelon.runtime.wire import SCHEMA_VERSION, token_key, watch_key
from echelon.sim.observing import Gate
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.to_process import Finish, Start
from echelon.sim.processes.to_supervisor import Done, Failed, PartFailed, Ready, Report, Said
from echelon.sim.processes.watch import STOP, Watch

FINISHING: Final = ("bridge", "drives", "referee", "recorder", "observers")
"""Kinds of processes that get the order to finish, in this order.  Bridge and drives in lockstep do not need it: they are
members and end with the run."""
READY_TIMEOUT_S: Final = 60.0
"""How long a process waits for its peers [s]: on a busy machine, or one processor for all, imports take their time"""


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """Everything that a process of a run needs to know."""

    run: str
    """Name of the run, which no other run has"""
    kind: str
    """`robot`, `leader`, `coordinator`, `recorder`, `observers`, `bridge`, `drives` or `referee`"""
    name: str
    index: int
    """Index of its role in the plan; for recorder, referee and the bridge of a mirrored path a number that is not used"""
    plan: Plan
    virtual: bool
    """True: virtual time; False: a wall clock"""
    listen: tuple[str, ...]
    """Endpoints at which its session waits for connections"""
    connect: tuple[str, ...]
    """Endpoints of other processes to which its session connects"""
    peers: tuple[tuple[str, str], ...]
    """(kind, name) of the processes whose tokens it waits for"""
    credentials: Credentials
    """Its secrets, and who the processes at these endpoints are"""
    gate: Gate | None = None
    """Where the process `observers` lets observers in"""
    watched: bool = True
    """True: its messages also go to watchers"""
    member: bool = True
    """True: it ends by itself when the run is over.  False: it waits for the order to finish"""
    recorded: bool = False
    """True: the run is recorded into `folder`"""
    folder: str = ""
    can_urls: tuple[str, ...] = ()
    """A URL for each bus of the plan; empty: no bus"""
    scenario_toml: str = ""
    metadata: dict[str, str] = field(default_factory=dict)
    ends_at: EndsAt = EndsAt.DIVERGED
    """Where the run ends before its duration is over"""
    part_files: dict[str, str] = field(default_factory=dict)
    """Texts of the files of users' parts, by their names in the run's folder"""
    every_ns: int = 0
    """On a wall clock: of each channel only the first message in every such time is copied, or recorded [ns]; 0: all"""


Body = Callable[[ProcessSpec, Session, Connection, Watch], None]
"""The function that a process runs once it has its session."""


class StartError(Exception):
    """This process cannot start; the text says why, for the user."""


def failed(error: Exception) -> Failed | PartFailed:
    """Returns what the supervisor is told of a failure that is not this program's: that of a user's part, or another."""
    return PartFailed(str(error)) if isinstance(error, PartRunError) else Failed(str(error))


def meet(spec: ProcessSpec, session: Session, control: Connection) -> int:
    """Shows the token of this process, waits for its peers and for `Start`; returns the start instant [ns].

    Must be called after all subscribers are declared, since the token says so to others.  Raises StartError that names the
    missing peers, and those with another schema version, and SystemExit if the run breaks off before it has begun.
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
    if not isinstance(told, Start):
        raise SystemExit(0)
    return told.start_ns


def tell(control: Connection, said: Said) -> None:
    """Sends a message to the supervisor if there is room for it: who drives wheels must not wait for a supervisor that stands
    still."""
    if select.select((), (control,), (), 0)[1]:
        control.send(said)


def watch_keys(run: str, plan: Plan, sources: Sequence[int]) -> dict[int, str]:
    """Returns the keys of the copies of roles, given by their indices in the plan.

    Where torque is mirrored, the index after the last node is the bridge's."""
    keys = {one.index: watch_key(run, one.role, one.name) for one in plan.all_roles}
    return {source: keys[source] if source in keys else watch_key(run, "bridge", "frames") for source in sources}


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
    refusals: Refusals | None = None,
    leaves: bool = False,
) -> None:
    """Sends the counts of this process and waits for `End`; if it `leaves`, `STOP` ends it, too, once they are sent.

    A process that closed its session earlier would look dead to its neighbours."""
    cpu_s, memory = resources()
    refused = {} if refusals is None else refusals.by_source()
    control.send(Done(spec.name, cpu_s, memory, runner, tuple(links), report, refused))
    if leaves:
        signal.signal(STOP, lambda number, frame: os._exit(0))
    control.recv()


def resources() -> tuple[float, int]:
    """Returns the CPU time [s] of this process so far, and its memory [bytes]: its own, and its share of what it has in common
    with other processes (PSS)."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    kilobytes = next(line.split()[1] for line in lines if line.startswith("Pss:"))
    return usage.ru_utime + usage.ru_stime, 1024 * int(kilobytes)
