"""The processes of a run, from the supervisor's side: their start, their messages and their end."""

import os
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Final

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
