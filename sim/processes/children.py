"""The processes of a run, from the supervisor's side: their list and connections, their start, their messages and their end."""

import os
import signal
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from echelon.plan.plan import Plan, RobotPlan
from echelon.runtime.credentials import Credentials, Identity, new_identity
from echelon.runtime.session import loopback_endpoints
from echelon.runtime.wire import data_key, run_keys, token_key, watch_key
from echelon.sim.observing import Gate
from echelon.sim.parts.foreign_parts import runs_text
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.process import main
from echelon.sim.processes.to_supervisor import Done

PRELOAD: Final = ["echelon.sim.processes.process", "echelon.bridge.protocols.protocol"]
"""Modules that each process needs, the second one because the plan holds the protocols of drives"""
ENVIRONMENT: Final = {"PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment variables of the processes.  The matrices of a formation are small, so threads of numpy would only cost time."""
LAST_WORDS: Final = 4000
"""How many bytes of a process's standard error are kept."""
ROLES: Final = ("robot", "leader", "coordinator")
"""Kinds of processes that may run parts written by users"""
NOBODY: Final = Credentials(Identity("", "", "", ()))
"""Credentials before `introduced` has made them"""
FINISHING: Final = ("bridge", "drives", "referee", "recorder", "observers")
"""Kinds of processes that get the order to finish, in this order.  Bridge and drives in lockstep do not need it: they are
members and end with the run."""


@dataclass(slots=True)
class Child:
    """A started process, with the supervisor's ends of its pipes and what has come over them."""

    spec: ProcessSpec
    process: ForkServerProcess
    control: Connection
    words: Connection
    """The pipe with its standard error"""
    heard_s: float
    ready: bool = False
    done: Done | None = None
    waiting_for: list[int] = field(default_factory=list)
    waiting_ns: int = -1
    said: deque[bytes] = field(default_factory=lambda: deque(maxlen=64))

    @property
    def name(self) -> str:
        """The name of the process in the run."""
        return self.spec.name

    @property
    def kind_and_name(self) -> str:
        """The kind and the name of the process, as `robot g1/r1`; once if they are the same."""
        return self.name if self.name == self.spec.kind else f"{self.spec.kind} {self.name}"

    @property
    def is_member(self) -> bool:
        """True: it ends by itself when the run is over.  False: it waits for the order to finish."""
        return self.spec.member

    def hear_words(self) -> None:
        """Reads what has come from its standard error."""
        try:
            while data := os.read(self.words.fileno(), 65536):
                self.said.append(data)
        except BlockingIOError:
            return
        self.words.close()

    def last_words(self) -> str:
        """Returns the end of its standard error."""
        return b"".join(self.said)[-LAST_WORDS:].decode(errors="replace").strip()

    def ending(self) -> str:
        """Returns in words how the process ended."""
        code = self.process.exitcode
        if code is None:
            return "does not answer"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def runs(self) -> str:
        """Returns in words which users' parts the process runs; "" if none."""
        return runs_text(self.spec.plan, self.spec.index) if self.spec.kind in ROLES else ""

    def state(self) -> str:
        """Returns the kernel's state of the process: running, sleeping, stopped, …

        It is running if one of its threads is: a role works in Zenoh's thread while the main thread sleeps."""
        states = list(_thread_states(self.process.pid or 0))
        return "running" if "running" in states else states[0] if states else "gone"


def _thread_states(pid: int) -> Iterator[str]:
    """Yields the kernel's states of a process's threads, the main thread's first; nothing if there is no such process."""
    try:
        for thread in sorted(Path(f"/proc/{pid}/task").iterdir(), key=lambda path: int(path.name)):
            text = (thread / "status").read_text()
            state = next((line for line in text.splitlines() if line.startswith("State:")), "State: ? (unknown)")
            yield state.partition("(")[2].rstrip(")")
    except OSError:
        return


def last_words_of(children: Sequence[Child]) -> str:
    """Returns the ends of the standard error of several processes, each under a heading; "" if there is nothing."""
    said = [f"\n--- last words of {child.name}:\n{words}" for child in children if (words := child.last_words())]
    return "".join(said)


def warm_up() -> None:
    """Starts the fork server, which imports the processes' modules in the background.  Call it early."""
    context = get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    from multiprocessing import forkserver, resource_tracker, util

    # In Python 3.11.0 any user could give the fork server work through a socket without a file (CVE-2022-42919).
    setattr(util, "abstract_sockets_supported", False)  # noqa: B010  a constant, for type checkers
    with _on_its_own():
        resource_tracker.ensure_running()  # before the mask is set, since its start changes the mask
    # Ctrl-C reaches all processes of the terminal, but only this one must react, not one that is importing
    unmasked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _on_its_own():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unmasked)


@contextmanager
def _on_its_own() -> Iterator[None]:
    """A context in which processes start without the working folder and without the calling script.

    So a user's file `numpy.py` in the working folder is not taken for numpy.  The calling script needs no
    `if __name__ == "__main__":` and may come from standard input."""
    script, before = sys.modules["__main__"], {name: os.environ.get(name) for name in ENVIRONMENT}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ |= ENVIRONMENT
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start(spec: ProcessSpec) -> Child:
    """Starts a process of a run."""
    context: ForkServerContext = get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    control, child_control = context.Pipe()
    words, child_words = context.Pipe(duplex=False)
    process = context.Process(target=main, args=(spec, child_control, child_words), name=spec.name, daemon=True)
    with _on_its_own():
        process.start()
    child_control.close()
    child_words.close()
    os.set_blocking(words.fileno(), False)
    return Child(spec, process, control, words, time.monotonic())


def list_specs(
    plan: Plan,
    run: str,
    virtual: bool,
    folder: Path,
    can_urls: tuple[str, ...],
    scenario_toml: str,
    metadata: dict[str, str],
    part_files: dict[str, str],
    recorded: bool,
    keep_going: bool,
    gate: Gate | None = None,
) -> list[ProcessSpec]:
    """Returns the specifications of all processes of a run, with their connections.

    process        who connects to it
    node           its children
    recorder       all other processes except observers and referee
    observers      the same, if the run is open to observers
    bridge         robots
    drives         robots and the bridge

    Real drives have no process.  The referee connects to no process; it listens to the buses.
    """
    stations = [role.name for role in plan.bus_roles]
    if can_urls and not plan.can.closed:
        stations = ["bridge"]
    watchers = (["recorder"] if recorded else []) + (["observers"] if gate is not None else [])
    hubs = watchers + stations
    endpoints = loopback_endpoints(len(plan.nodes) + len(hubs))
    at = {node.index: endpoints.pop() for node in plan.nodes}
    hub_at = {hub: endpoints.pop() for hub in hubs}
    common: dict[str, Any] = {
        "run": run,
        "plan": plan,
        "virtual": virtual,
        "recorded": recorded,
        "folder": str(folder),
        "can_urls": can_urls,
        "scenario_toml": scenario_toml,
        "metadata": metadata,
        "part_files": part_files,
        "keep_going": keep_going,
        "credentials": NOBODY,
    }

    def with_hubs(names: Iterable[str]) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
        return tuple(hub_at[name] for name in names), tuple((name, name) for name in names)

    specs = []
    for member in plan.formation:
        near = [] if member.parent is None else [member.parent]
        near += [] if isinstance(member, RobotPlan) else member.children
        endpoints_of, peers_of = with_hubs(watchers + (stations if isinstance(member, RobotPlan) else []))
        specs.append(
            ProcessSpec(
                kind=member.role,
                name=member.name,
                index=member.index,
                listen=(at[member.index],) if member.index in at else (),
                connect=(*(() if member.parent is None else (at[member.parent],)), *endpoints_of),
                peers=(*((plan.formation[peer].role, plan.formation[peer].name) for peer in near), *peers_of),
                watched=bool(watchers) or (bool(stations) and isinstance(member, RobotPlan) and not plan.can.closed),
                **common,
            )
        )
    robots = tuple((robot.role, robot.name) for robot in plan.robots)
    for number, station in enumerate(stations):
        later = stations[number + 1 :]
        endpoints_of, _ = with_hubs(watchers + later)
        others = tuple((name, name) for name in watchers + stations if name != station)
        specs.append(
            ProcessSpec(
                kind=station,
                name=station,
                index=len(plan.formation) + number,
                listen=(hub_at[station],),
                connect=endpoints_of,
                peers=(*robots, *others),
                watched=bool(watchers),
                member=virtual and plan.can.closed,
                **common,
            )
        )
    for number, watcher in enumerate(watchers):
        everyone = tuple((member.role, member.name) for member in plan.formation)
        specs.append(
            ProcessSpec(
                kind=watcher,
                name=watcher,
                index=len(plan.formation) + len(stations) + number,
                listen=(hub_at[watcher],),
                connect=(),
                peers=(*everyone, *((name, name) for name in stations)),
                member=False,
                gate=gate if watcher == "observers" else None,
                **common,
            )
        )
    if not virtual and any(url.startswith("socketcan") for url in can_urls):
        # on other buses it would cost too much to receive each frame once more: there can.log is judged afterwards
        specs.append(
            ProcessSpec(
                kind="referee", name="referee", index=-1, listen=(), connect=(), peers=(), member=False, **common
            )
        )
    # the processes with the most imports start first
    return sorted(introduced(specs), key=lambda spec: spec.kind not in FINISHING)


def introduced(specs: Sequence[ProcessSpec]) -> list[ProcessSpec]:
    """Returns the specifications with new credentials: each process knows those that it is connected to, and nobody else."""
    own = [new_identity(f"{spec.kind}/{spec.name}", _own_keys(spec)) for spec in specs]
    at = {endpoint: one for spec, one in zip(specs, own, strict=True) for endpoint in spec.listen}
    guests: dict[str, list[Identity]] = {}
    for spec, one in zip(specs, own, strict=True):
        for endpoint in spec.connect:
            guests.setdefault(endpoint, []).append(one)
    return [
        replace(
            spec,
            credentials=Credentials(
                one,
                run_keys(spec.run),
                guests=tuple(guest for endpoint in spec.listen for guest in guests.get(endpoint, ())),
                hosts=tuple(at[endpoint] for endpoint in spec.connect),
            ),
        )
        for spec, one in zip(specs, own, strict=True)
    ]


def _own_keys(spec: ProcessSpec) -> list[str]:
    """Returns the key expressions under which a process publishes."""
    keys = [token_key(spec.run, spec.kind, spec.name, "*"), watch_key(spec.run, spec.kind, spec.name)]
    roles = spec.plan.all_roles
    if 0 <= spec.index < len(roles):
        channels = {link.channel for link in spec.plan.links if link.source == spec.index}
        keys += [data_key(spec.run, roles[spec.index].path, channel) for channel in sorted(channels)]
    elif spec.kind == "bridge":
        keys.append(watch_key(spec.run, "bridge", "frames"))
    return keys
