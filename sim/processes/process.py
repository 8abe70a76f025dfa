"""The entry point of each process of a distributed run (`contract` has the steps of its life).

Standard error goes to the supervisor.  Standard output, to which users' parts print, is the command's standard error.
"""

import ctypes
import gc
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import TextIOWrapper
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from echelon.agents.torque_loop import usual
from echelon.errors import PartRunError
from echelon.messages import Heard, Message
from echelon.role import Role
from echelon.runtime.arrivals import ArrivalFile
from echelon.runtime.link import LinkCounts
from echelon.runtime.lockstep import LockstepRunner
from echelon.runtime.paced import PacedRunner
from echelon.runtime.session import Session
from echelon.sim.engines.in_process import make_role
from echelon.sim.processes.contract import Body, ProcessSpec, StartError, failed, finish, meet
from echelon.sim.processes.pulse import Pulse
from echelon.sim.processes.to_supervisor import LinksProgress, Said, Waiting
from echelon.sim.processes.watch import STOP, Watch, leave

COMPILED: Final = "echelon.sim.batch.torque_loop"
"""The module of the compiled torque loop, which takes half a second to import"""
TOLD_S: Final = 1.0
"""Time between two reports of a member's links, for the live table [s]"""

_PR_SET_NAME: Final = 15
_libc: Final = ctypes.CDLL(None, use_errno=True)


def main(spec: ProcessSpec, control: Connection, words: Connection, pulses: Any, number: int) -> None:
    """Runs a process of a run until its work is done.  A failure ends the process with exit code 1.

    `control` is its pipe to the supervisor, `words` the pipe that gets its standard error.  `pulses` has the pulses of all
    processes of the run, that of this one with the number `number`."""
    gc.freeze()  # what the fork server imported stays; to look through it takes 10 ms and copies its shared pages
    watch = Watch(control, Pulse.received(pulses, number), spec.kind)
    _libc.prctl(_PR_SET_NAME, spec.name.encode(), 0, 0, 0)  # the name in ps, top and pgrep (15 characters)
    try:
        os.dup2(2, 1)
    except OSError:  # the command's standard error is closed
        os.dup2(words.fileno(), 1)
    os.dup2(words.fileno(), 2)
    words.close()
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # a process may end without writing what is left
    body: Body
    try:
        if not spec.virtual and spec.kind in ("recorder", "observers"):
            os.nice(10)  # this process can wait, others cannot
        if spec.kind == "recorder":
            from echelon.sim.processes.watchers import run_recorder as body
        elif spec.kind == "observers":
            from echelon.sim.processes.observers import run_observers as body
        elif spec.kind in ("bridge", "drives", "referee"):
            from echelon.sim.processes.bus_processes import body_of

            body = body_of(spec)
        else:
            body = _run_member
        with _open(spec) as session:
            body(spec, session, control, watch)
    except SystemExit:
        os._exit(0)
    except (StartError, PartRunError) as error:
        control.send(failed(error))
        os._exit(1)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)  # skips the parent's atexit functions and does not wait for threads that may hang


def _open(spec: ProcessSpec) -> Session:
    """Returns the session of a process.  Raises StartError if it cannot be opened."""
    try:
        return Session(
            listen=spec.listen,
            connect=spec.connect,
            lockstep=spec.virtual,
            own_receiver=spec.kind == "observers" or (spec.kind == "bridge" and not spec.member),
            credentials=spec.credentials,
        )
    except ValueError as error:
        raise StartError(str(error)) from None


class _LinkTeller:
    """A role whose last stage also tells the supervisor the counts of the role's links, every `TOLD_S`."""

    def __init__(self, role: Role, say: Callable[[LinksProgress], None]) -> None:
        *first, last = role.stages
        self.index = role.index
        self.stages = (*first, replace(last, run=self._run))
        self.counts: Callable[[], list[LinkCounts]] = list
        """Returns the counts of the links"""
        self._told, self._say, self._told_s = last.run, say, time.monotonic()

    def _run(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        if (now_s := time.monotonic()) > self._told_s + TOLD_S:
            self._told_s = now_s
            self._say(LinksProgress(tuple(self.counts())))
        return self._told(time_ns, heard)


def _run_member(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Runs a robot, a leader or the coordinator."""
    one_at_a_time = threading.Lock()  # stages run in the thread that brings their messages, or in the main thread

    def say(said: Said) -> None:
        with one_at_a_time:
            control.send(said)

    compiled = sys.modules.get(COMPILED)  # the fork server has it if it pays for this run (children.warm_up)
    role = _LinkTeller(make_role(spec.plan, spec.index, compiled.usual if compiled else usual), say)
    runner: LockstepRunner | PacedRunner
    if spec.virtual:
        runner = LockstepRunner(role, spec.plan, session, spec.run, watched=spec.watched)
    else:
        try:
            arrivals = ArrivalFile(Path(spec.folder)) if spec.recorded else None
        except OSError as error:
            raise StartError(f"{error.filename}: {error.strerror}") from None
        runner = PacedRunner(
            role,
            spec.plan,
            session,
            spec.run,
            watched=spec.watched,
            arrivals=arrivals,
            beat=watch.pulse.beat,
            every_ns=spec.every_ns,
        )
    role.counts = runner.mailbox.counts
    start_ns = watch.pulse.from_ns = meet(spec, session, control)
    signal.signal(STOP, lambda number, frame: runner.stop())
    gc.collect()
    gc.disable()  # the loop makes no reference cycles, and a pause of one role delays all others
    try:
        if isinstance(runner, LockstepRunner):
            runner.run(lambda time_ns, sources: say(Waiting(time_ns, tuple(sources))))
        else:
            runner.run(start_ns)
    except SystemExit:  # the run breaks off; what was counted so far is still told
        pass
    finally:
        runner.finish()  # also if the run breaks off: its messages so far must be recorded
    signal.signal(STOP, leave)
    watch.pulse.rest()
    finish(spec, control, runner.counts, runner.mailbox.counts(), refusals=runner.refusals)
