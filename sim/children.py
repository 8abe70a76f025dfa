"""The processes of a run as their supervisor sees them: who they are and whom they talk to, how they start, what they
say, how they ended."""

import os
import signal
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Final

from echelon.plan import Plan, RobotPlan
from echelon.session import loopback_endpoints
from sim.joining import ProcessSpec, Result
from sim.process import main

PRELOAD: Final = ["sim.process"]
LAST_WORDS: Final = 4000
"""Bytes kept of what a process says on standard error."""
WATCHERS: Final = ("bridge", "recorder")
"""The kinds of processes that are no members, in the order in which they finish."""


@dataclass(slots=True)
class Child:
    """A started process, with the ends of its pipes and what it has said so far."""

    spec: ProcessSpec
    process: ForkServerProcess
    control: Connection
    words: Connection
    """Its standard output and standard error"""
    heard_s: float
    ready: bool = False
    result: Result | None = None
    waiting_for: list[int] = field(default_factory=list)
    waiting_ns: int = -1
    said: deque[bytes] = field(default_factory=lambda: deque(maxlen=64))

    @property
    def name(self) -> str:
        """Its name in the run."""
        return self.spec.name

    @property
    def is_member(self) -> bool:
        """True for robots, leaders and the coordinator; False for those who watch."""
        return self.spec.kind not in WATCHERS

    def hear_words(self) -> None:
        """Takes all that it has said on standard error and not been heard yet."""
        try:
            while data := os.read(self.words.fileno(), 65536):
                self.said.append(data)
        except BlockingIOError:
            return
        self.words.close()

    def last_words(self) -> str:
        """Returns the end of what it said on standard error."""
        return b"".join(self.said)[-LAST_WORDS:].decode(errors="replace").strip()

    def ending(self) -> str:
        """Says how it ended."""
        code = self.process.exitcode
        if code is None:
            return "does not answer"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def state(self) -> str:
        """Returns what the kernel says of it: running, sleeping, stopped…"""
        try:
            text = Path(f"/proc/{self.process.pid}/status").read_text()
        except OSError:
            return "gone"
        state = next((line for line in text.splitlines() if line.startswith("State:")), "State: ? (unknown)")
        return state.partition("(")[2].rstrip(")")


def warm_up() -> None:
    """Starts the fork server, which imports in the background what processes need.  Call it early."""
    context = get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    from multiprocessing import forkserver, resource_tracker

    resource_tracker.ensure_running()  # which changes the mask when it starts
    # Ctrl-C reaches the whole terminal: it is for this process alone, and not for one that is just importing.
    unmasked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unmasked)


def start(spec: ProcessSpec) -> Child:
    """Starts a process of a run."""
    context: ForkServerContext = get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    control, child_control = context.Pipe()
    words, child_words = context.Pipe(duplex=False)
    process = context.Process(target=main, args=(spec, child_control, child_words), name=spec.name, daemon=True)
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
    can_url: str,
    scenario_toml: str,
    metadata: dict[str, str],
    recorded: bool,
) -> list[ProcessSpec]:
    """Lists the processes of a run: every node listens, its children connect; all members connect to the watchers."""
    watchers = ([("recorder", "recorder")] if recorded else []) + ([("bridge", "bridge")] if can_url else [])
    endpoints = loopback_endpoints(len(plan.nodes) + len(watchers))
    endpoint = {node.index: endpoints.pop() for node in plan.nodes}
    watcher_endpoint = {name: endpoints.pop() for _, name in watchers}
    specs = []
    for member in plan.members:
        peers = [] if member.parent is None else [member.parent]
        peers += [] if isinstance(member, RobotPlan) else member.children
        specs.append(
            ProcessSpec(
                run=run,
                kind=member.role,
                name=member.name,
                index=member.index,
                plan=plan,
                virtual=virtual,
                listen=(endpoint[member.index],) if member.index in endpoint else (),
                connect=(
                    *(() if member.parent is None else (endpoint[member.parent],)),
                    *watcher_endpoint.values(),
                ),
                peers=(*((plan.members[peer].role, plan.members[peer].name) for peer in peers), *watchers),
                watched=bool(watchers),
            )
        )
    everyone = tuple((member.role, member.name) for member in plan.members)
    for watcher, name in watchers:
        others = tuple(endpoint for other, endpoint in watcher_endpoint.items() if other != name)
        specs.append(
            ProcessSpec(
                run=run,
                kind=watcher,
                name=name,
                index=len(plan.members),
                plan=plan,
                virtual=virtual,
                listen=(watcher_endpoint[name],),
                connect=others if watcher == "bridge" else (),
                peers=(*everyone, *(one for one in watchers if one[1] != name)),
                folder=str(folder),
                can_url=can_url,
                scenario_toml=scenario_toml,
                metadata=metadata,
            )
        )
    # Those that import most start first.
    return sorted(specs, key=lambda spec: spec.kind not in WATCHERS)
