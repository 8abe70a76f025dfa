"""What the supervisor hears: messages over the pipes of its children, their standard error, and their ends."""

import os
import pickle
import time
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Final

from echelon.bridge.reports import BridgeProgress
from echelon.plan.plan import Plan
from echelon.runtime.admission import Refusals
from echelon.sim.processes.children import Child
from echelon.sim.processes.failures import DivergedError, LostError, RunError
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.to_supervisor import (
    Done,
    Failed,
    LinksProgress,
    PartFailed,
    Ready,
    RecorderProgress,
    Said,
    Waiting,
)
from echelon.sim.processes.understood import understood

NOT_UNDERSTOOD: Final = "not understood"
"""Why the supervisor refuses what a process says over its pipe"""


class Hearing:
    """Reads what children say, and notes it in them and in the progress of the run.

    `children` may become more.  `wake` is a handle that ends a wait when it is readable, as a signal makes it."""

    def __init__(self, plan: Plan, children: list[Child], progress: Progress) -> None:
        self._plan, self._children, self._progress = plan, children, progress
        self.wake = -1
        self.refusals = Refusals()
        """What processes said over their pipes that is no message of theirs"""

    def serve(self, timeout_s: float) -> None:
        """Waits up to `timeout_s` for messages, standard error or the end of any child, and reads what has come.

        Raises RunError or DivergedError if a message says that the run cannot or should not go on."""
        by_handle: dict[Any, Child] = {}
        for child in self._children:
            if not child.control.closed:
                by_handle[child.control] = child
            if not child.words.closed:
                by_handle[child.words] = child
        # Handles of processes that have ended stay readable: with them a wait would be none.
        ends = [child.handle for child in self._children if child.done is None and child.alive]
        ready = wait([*by_handle, *ends, self.wake], timeout_s)
        if self.wake in ready:
            os.eventfd_read(self.wake)
        for handle in ready:
            if isinstance(handle, Connection):
                child = by_handle[handle]
                if handle is child.words:
                    child.hear_words()
                else:
                    self._hear(child)

    def _hear(self, child: Child) -> None:
        """Reads one message of a child.  Raises RunError or DivergedError, as `serve` does."""
        try:
            content = child.control.recv_bytes()
        except (EOFError, OSError):
            child.control.close()
            return
        said: Said | None = None
        if content.startswith(pickle.PROTO) and content.endswith(pickle.STOP):  # noise may take gigabytes to read
            with suppress(Exception):  # no message of a process
                said = pickle.loads(content)
        if said is None or not understood(said, child.spec, self._plan):
            self.refusals.count(child.name, NOT_UNDERSTOOD)
            return
        child.heard_s = time.monotonic()
        progress = self._progress
        match said:
            case Ready():
                child.ready = True
            case Waiting():
                child.waiting_ns, child.waiting_for, child.waiting_s = said.time_ns, list(said.sources), child.heard_s
            case LinksProgress():
                progress.hear_links(said.links)
            case BridgeProgress() if child.spec.kind == "bridge":
                progress.bridge = said
            case BridgeProgress():
                progress.drives = said
            case RecorderProgress():
                progress.hear(said)
                if said.failure and progress.phase == "running":
                    raise RunError(f"the recording failed: {said.failure}")
                if said.lost is not None and progress.phase == "running":
                    progress.phase = "stopping"
                    raise DivergedError(said.lost.text(self._plan))
            case Failed():
                starting = progress.phase == "starting"
                raise RunError(
                    f"{child.kind_and_name} cannot start: {said.text}" if starting else f"{child.name}: {said.text}"
                )
            case PartFailed():
                raise RunError(said.text)
            case Done():
                child.done = said

    def check_lost(self) -> None:
        """Raises RunError if a child has ended without its report."""
        for child in self._children:
            if child.done is None and not child.alive:
                while not child.control.closed and child.control.poll():
                    self._hear(child)
                if child.done is None:
                    if not child.words.closed:
                        child.hear_words()
                    raise LostError(child)
