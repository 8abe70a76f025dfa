"""What runs in each process of a distributed run: a member, the recorder, or the bridge.

A process is told everything in its `ProcessSpec`; it says `ready` when it is connected to all it will talk to, starts
when it is told to, and says `done` with what it counted.  Its words on standard error go to the supervisor.
"""

import ctypes
import gc
import os
import select
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Final

from echelon.errors import PartRunError
from echelon.runtime.runner import Runner
from echelon.runtime.session import Session
from echelon.sim.engines.in_process import make_role
from echelon.sim.processes.contract import Body, ProcessSpec, StartError, finish, meet
from echelon.sim.processes.to_supervisor import Failed, PartFailed, Waiting

_PR_SET_PDEATHSIG: Final = 1
_PR_SET_NAME: Final = 15
_libc: Final = ctypes.CDLL(None, use_errno=True)


def main(spec: ProcessSpec, control: Connection, words: Connection) -> None:
    """Entry point of every process of a run."""
    _die_with(control)
    _libc.prctl(_PR_SET_NAME, spec.name.encode(), 0, 0, 0)  # what ps, top and pgrep call it (15 characters)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole terminal; the supervisor decides
    signal.signal(signal.SIGTERM, _leave)
    os.dup2(words.fileno(), 1)
    os.dup2(words.fileno(), 2)
    words.close()
    body: Body
    try:
        if not spec.virtual and spec.kind == "recorder":
            os.nice(10)  # it has time, others have not
        if spec.kind == "recorder":
            from echelon.sim.processes.watchers import run_recorder as body
        elif spec.kind in ("bridge", "drives", "referee"):
            from echelon.sim.processes.bus_processes import body_of

            body = body_of(spec)
        else:
            body = _run_member
        with _open(spec) as session:
            body(spec, session, control)
    except SystemExit:
        os._exit(0)
    except StartError as error:
        control.send(Failed(str(error)))
        os._exit(1)
    except PartRunError as error:
        control.send(PartFailed(str(error)))
        os._exit(1)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)  # no atexit of the parent's, no wait for threads that may hang


def _open(spec: ProcessSpec) -> Session:
    try:
        return Session(
            listen=spec.listen,
            connect=spec.connect,
            lockstep=spec.virtual,
            own_receiver=spec.kind == "bridge" and not spec.member,
        )
    except ValueError as error:
        raise StartError(str(error)) from None


def _run_member(spec: ProcessSpec, session: Session, control: Connection) -> None:
    runner = Runner(
        make_role(spec.plan, spec.index),
        spec.plan,
        session,
        spec.run,
        watched=spec.watched,
        virtual=spec.virtual,
    )
    start_ns = meet(spec, session, control)
    signal.signal(signal.SIGTERM, lambda number, frame: runner.stop())
    gc.collect()
    gc.disable()  # nothing in the loop makes cycles, and a pause of one role is a pause of all
    try:
        if spec.virtual:
            runner.lockstep(lambda time_ns, sources: control.send(Waiting(time_ns, tuple(sources))))
        else:
            runner.wall_clock(start_ns)
    except SystemExit:  # the run breaks off; what was counted so far is still told
        pass
    finally:
        runner.finish()  # what a run that breaks off has said so far is to be recorded
    signal.signal(signal.SIGTERM, _leave)
    finish(spec, control, runner.counts, runner.mailbox.counts())


def _leave(number: int, frame: object) -> None:
    """Ends this process in good order: what it sent is delivered."""
    raise SystemExit(0)


def _die_with(supervisor: Connection) -> None:
    """Ends this process when the supervisor ends, however that ends, and whatever this process is doing then."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # the fork server is the parent; it may outlive the supervisor
    if os.getppid() == 1:
        os._exit(1)
    poller = select.poll()
    poller.register(supervisor.fileno(), 0)  # no events but the hang-up

    def wait() -> None:
        poller.poll()
        os._exit(1)

    threading.Thread(target=wait, name="supervisor-watch", daemon=True).start()
