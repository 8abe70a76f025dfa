"""The processes of a run, from the supervisor's side: their start, their messages and their end."""

import os
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Final

from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.sim.parts.foreign_parts import runs_text
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.limits import ADVICE, check_limits
from echelon.sim.processes.process import COMPILED, main
from echelon.sim.processes.pulse import Pulse, Pulses
from echelon.sim.processes.socket_folder import FOLDER
from echelon.sim.processes.to_supervisor import Done
from echelon.sim.processes.watch import ASKED, STOP

PRELOAD: Final = [
    "echelon.sim.processes.socket_folder",
    "echelon.sim.processes.process",
    "echelon.bridge.protocols.protocol",
]
"""Modules that the fork server imports: one for itself, and those that each process needs, the last one because the plan holds
the protocols of drives"""
PAYS_FROM: Final = 200_000
"""From this many torque periods on, those of all robots together, compiled robots save more time than the compiler takes to
load"""
ENVIRONMENT: Final = {"PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment variables of the processes.  The matrices of a formation are small, so threads of numpy would only cost time."""
LAST_WORDS: Final = 4000
"""How many bytes of a process's standard error are kept."""
ROLES: Final = ("robot", "leader", "coordinator", "bridge", "drives", "referee")
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
    pulse: Pulse
    handle: int
    """A file descriptor of the kernel for the process: readable once it has ended.  It tells so even if the fork server has
    been killed, and never means another process with the same number."""
    ready: bool = False
    done: Done | None = None
    waiting_for: list[int] = field(default_factory=list)
    waiting_ns: int = -1
    waiting_s: float = 0.0
    """When it last said that it waits"""
    said: deque[bytes] = field(default_factory=lambda: deque(maxlen=64))
    ours: set[int] = field(default_factory=set)
    """The numbers of the signals that the supervisor has sent to it"""

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

    @property
    def alive(self) -> bool:
        """Whether the process has not ended."""
        return self.handle >= 0 and not self.ends_within(0.0)

    def ends_within(self, timeout_s: float) -> bool:
        """Waits until the process has ended, at most `timeout_s`; returns whether it has."""
        if self.handle < 0:
            return True
        poller = select.poll()  # unlike `select` it takes handles of any number
        poller.register(self.handle, select.POLLIN)
        return bool(poller.poll(timeout_s * 1e3))

    def signal(self, number: int) -> None:
        """Sends a signal to the process, if it is alive."""
        if self.alive:
            self.ours.add(number)
            try:
                signal.pidfd_send_signal(self.handle, number)
            except ProcessLookupError:
                pass

    def stop(self) -> None:
        """Orders the process to end: a bridge stops the wheels first."""
        self.signal(STOP)

    def close(self) -> None:
        """Closes the pipes and the handle of a process that has ended."""
        self.control.close()
        self.words.close()
        if self.handle >= 0:
            os.close(self.handle)
            self.handle = -1

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
        if self.alive:
            return "does not answer"
        self.process.join(1.0)  # the fork server tells the exit code
        code = self.process.exitcode
        if code is None:
            return "ended"
        if code >= 0:
            return f"exit code {code}"
        named = -code in {*signal.Signals}  # real-time signals have no names
        return f"killed by {signal.Signals(-code).name if named else f'signal {-code}'}"

    @property
    def was_killed(self) -> bool:
        """Whether a signal ended the process that the supervisor has not sent."""
        if self.alive:
            return False
        self.process.join(1.0)
        code = self.process.exitcode
        return code is not None and code < 0 and -code not in self.ours

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


def warm_up(plan: Plan) -> None:
    """Starts the fork server, which imports what the processes of a run need in the background.  Call it early.

    A fork server that runs already stays as it is.  Raises UsageError if this machine does not let a run of the plan start."""
    check_limits(len(plan.all_roles) + 3)  # with a recorder, a bridge and observers
    context = get_context("forkserver")
    context.set_forkserver_preload([*PRELOAD, COMPILED] if compiling_pays(plan) else PRELOAD)
    from multiprocessing import forkserver, resource_tracker, util

    # In Python 3.11.0 any user could give the fork server work through a socket without a file (CVE-2022-42919).
    setattr(util, "abstract_sockets_supported", False)  # noqa: B010  a constant, for type checkers
    # Signals to a whole group must not end the resource tracker, which heeds SIGHUP, nor the fork server, whose children would
    # end with it, nor a process that is importing.  The start of the tracker changes the mask.  While the folder is made a
    # signal would leave it behind.
    folder, unmasked = "", signal.pthread_sigmask(signal.SIG_BLOCK, {*ASKED})
    try:
        try:
            folder = util.get_temp_dir()
        except FileNotFoundError as error:  # the fork server has its socket there
            raise UsageError(f"{error.strerror}; give a folder with TMPDIR=…, {ADVICE}") from None
        with _on_its_own({FOLDER: f"{os.getpid()} {folder}"}):
            resource_tracker.ensure_running()
            signal.pthread_sigmask(signal.SIG_BLOCK, {*ASKED, STOP})
            forkserver.ensure_running()
    except OSError as error:
        if "path too long" not in str(error):
            raise
        raise UsageError(f"{folder}: {error}; give a folder with a shorter path with TMPDIR=…, {ADVICE}") from None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unmasked)


def compiling_pays(plan: Plan) -> bool:
    """Returns whether a run as processes is shorter with compiled robots, the time to load the compiler included."""
    torque_periods = sum(plan.duration_ns // robot.torque_period_ns for robot in plan.robots)
    return not plan.can.closed and torque_periods >= PAYS_FROM


@contextmanager
def _on_its_own(told: Mapping[str, str] = {}) -> Iterator[None]:
    """A context in which processes start without the working folder and without the calling script, with the environment
    variables of `ENVIRONMENT` and `told`.

    So a user's file `numpy.py` in the working folder is not taken for numpy.  The calling script needs no
    `if __name__ == "__main__":` and may come from standard input."""
    variables = {**ENVIRONMENT, **told}
    script, before = sys.modules["__main__"], {name: os.environ.get(name) for name in variables}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ |= variables
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start(spec: ProcessSpec, pulses: Pulses, number: int) -> Child:
    """Starts a process of a run, whose pulse has this number."""
    context: ForkServerContext = get_context("forkserver")
    control, child_control = context.Pipe()
    words, child_words = context.Pipe(duplex=False)
    arguments = spec, child_control, child_words, pulses.shared(), number
    process = context.Process(target=main, args=arguments, name=spec.name, daemon=True)
    with _on_its_own():
        process.start()
    child_control.close()
    child_words.close()
    os.set_blocking(words.fileno(), False)
    assert process.pid is not None
    return Child(spec, process, control, words, time.monotonic(), pulses.of(number), _handle(process.pid))


def _handle(pid: int) -> int:
    """Returns a handle of a process; -1 if it has ended already."""
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        return -1
