"""How a process of a run is asked to stop, and what it does then.

who asks                        how                        a bridge                   drives                 all others
the supervisor                  `STOP`, or `Finish`        wheels to zero, at once    end after the bridge   end in order
anyone else, also a whole       SIGTERM, SIGINT, SIGHUP    wheels to zero, at once;   tell the supervisor    tell the supervisor
group of processes                                         tells the supervisor
nobody: the supervisor is gone  its pipe hangs up          wheels to zero, then ends  end after watchdogs    end at once

The supervisor then ends the run in order.  So a signal to all processes at once ends no process before the wheels have
stopped.  A process that was asked, and gets no order for `ALONE_S`, ends by itself.  Signals that the supervisor ignores are
ignored here, too.
"""

import ctypes
import os
import select
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Final

from echelon.sim.processes.pulse import Pulse

STOP: Final = signal.SIGUSR1
"""The supervisor's order to end: shells, terminals, `timeout` and systemd send other signals"""
ASKED: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals with which others ask a process to end"""
ALONE_S: Final = 60.0
"""How long a process that was asked to end waits for the supervisor's order [s]"""
RESCUE_S: Final = 0.2
"""How long the main thread of a bridge may take to stop the wheels; then this module's thread does it [s]"""
LAST_S: Final = 2.0
"""How long bridge and drives may take to end after the supervisor [s]"""

_PR_SET_PDEATHSIG: Final = 1
_libc: Final = ctypes.CDLL(None, use_errno=True)


class Watch:
    """Watches for signals and for the end of the supervisor, in a thread of its own, since the main thread may be blocked.

    `station`: the process is the bridge or the drives of a run.  `asked` becomes True when it must stop; then the watch itself
    is readable for `select`."""

    def __init__(self, control: Connection, pulse: Pulse, kind: str) -> None:
        self.pulse, self._kind = pulse, kind
        self.asked = False
        self._station = kind in ("bridge", "drives")
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._stop: Callable[[], None] | None = None
        self._patience_s = RESCUE_S
        self._once = threading.Lock()
        self._did = False
        self._error: BaseException | None = None
        self._read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in ASKED:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda number, frame: None)  # the thread below hears of it
        signal.signal(STOP, leave)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {*ASKED, STOP})  # the fork server blocks them
        # The parent is the fork server, which may outlive the supervisor.  A station that stands still must go on once more
        # to stop the wheels; the others have nothing to do.
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGCONT if self._station else signal.SIGKILL)
        if os.getppid() == 1:
            os._exit(1)
        threading.Thread(target=self._run, args=(control,), name="supervisor-watch", daemon=True).start()

    def stops(self, stop: Callable[[], None], at_once: bool = False) -> Callable[[], None]:
        """Says what stops the wheels; returns a function that does it, once, whoever calls it first.

        This module's thread calls it if the main thread has not within `RESCUE_S` after the process was asked; with `at_once`
        without waiting.  What it raises is raised in the main thread."""

        def once() -> None:
            with self._once:
                if not self._did:
                    self._did = True
                    try:
                        stop()
                    except BaseException as error:
                        self._error = error
                    finally:
                        self.pulse.stopped()
                if self._error is not None and threading.current_thread() is threading.main_thread():
                    told, self._error = self._error, None
                    raise told

        self._stop, self._patience_s = once, 0.0 if at_once else RESCUE_S
        return once

    def fileno(self) -> int:
        """The file descriptor to wait for with `select`."""
        return self._wake

    def _run(self, control: Connection) -> None:
        poller = select.poll()
        poller.register(control.fileno(), 0)  # 0: only a hang-up is reported
        poller.register(self._read, select.POLLIN)
        rescue_s = end_s = float("inf")
        hung_up = False
        while True:
            left_s = min(rescue_s, end_s) - time.monotonic()
            for fd, _ in poller.poll(None if left_s == float("inf") else max(0.0, left_s) * 1e3):
                if fd == self._read:
                    numbers = set(os.read(self._read, 4096))
                    must = bool(numbers & {STOP}) or (self._kind == "bridge" and bool(numbers & {*ASKED}))
                    if others := numbers & {*ASKED}:
                        end_s = min(end_s, time.monotonic() + ALONE_S)
                        self.pulse.ask(min(others))
                    if STOP in numbers:
                        end_s = float("inf")  # the supervisor is there, and sees to the end
                else:
                    if not self._station:
                        os._exit(1)
                    hung_up = must = True
                    poller.unregister(control.fileno())
                    end_s = time.monotonic() + LAST_S
                if must and not self.asked:
                    self.asked = True
                    os.eventfd_write(self._wake, 1)
                    rescue_s = time.monotonic() + self._patience_s
            now_s = time.monotonic()
            if now_s >= rescue_s:
                rescue_s = float("inf")
                if self._stop is not None:
                    threading.Thread(target=self._stop, name="rescue", daemon=True).start()
                elif hung_up and self._kind == "bridge":
                    os._exit(1)  # no wheel has been commanded yet
            if now_s >= end_s:
                os._exit(1)


def leave(number: int, frame: object) -> None:
    """Ends this process after its messages are delivered: the handler of `STOP` while there is nothing else to do."""
    raise SystemExit(0)
