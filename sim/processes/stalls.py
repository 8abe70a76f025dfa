"""Finds out that a run in virtual time makes no progress, and which processes are to blame.

In virtual time every member waits for the messages of others, so one process that stands still stops all.  A member that waits
says so every now and then; a process that says nothing is the one that everyone waits for.
"""

from collections.abc import Sequence
from typing import Final

from echelon.plan.plan import Plan
from echelon.sim.processes.children import Child
from echelon.sim.processes.failures import StallError, few
from echelon.sim.processes.outcome import Progress

STALL_REPORT_S: Final = 3.0
"""After this time without progress a run in virtual time is reported as stalled [s]"""
SILENT_S: Final = 2.0
"""A process that has said nothing for this time counts as silent [s]"""


class StallWatch:
    """Watches the progress of one run in virtual time.  A run without progress for `stall_timeout_s` is given up."""

    def __init__(self, plan: Plan, children: Sequence[Child], progress: Progress, stall_timeout_s: float) -> None:
        self._plan, self._children, self._progress = plan, children, progress
        self._stall_timeout_s = stall_timeout_s
        self._moved_s = 0.0
        self._moved_at = (-1, -1)
        self._warned = False

    def begin(self, now_s: float) -> None:
        """Notes when the run begins, by the monotonic clock [s]."""
        self._moved_s = now_s

    def check(self, now_s: float) -> None:
        """Notes in the progress that the run stalls, or that it goes on; call it a few times a second while it runs.

        `now_s` is on the monotonic clock [s].  Raises StallError after `stall_timeout_s` without progress."""
        at = (self._progress.time_ns, max((child.waiting_ns for child in self._children), default=-1))
        if at != self._moved_at:
            self._moved_at, self._moved_s = at, now_s
            if self._warned:
                self._warned, self._progress.note = False, "goes on"
            return
        still_s = now_s - self._moved_s
        if still_s > STALL_REPORT_S and not self._warned:
            self._warned = True
            self._progress.note = f"stalled at t = {self._progress.time_ns / 1e9:g} s: {self._who_is_waited_for(now_s)}"
        if still_s > self._stall_timeout_s:
            raise StallError(still_s, self._who_is_waited_for(now_s))

    def _who_is_waited_for(self, now_s: float) -> str:
        """Returns in words which processes everyone waits for: the silent ones, or else who waits for whom.

        A silent watcher comes first: members may be silent only because it does not take their messages."""
        quiet = [child for child in self._children if now_s - child.heard_s > SILENT_S]
        silent = [child for child in quiet if not child.is_member]
        silent = silent or [child for child in quiet if child.is_member and child.done is None]
        if silent:
            return "everyone waits for " + few(
                [f"{child.name} (process {child.process.pid}, {child.state()}{child.runs()})" for child in silent]
            )
        members = self._plan.all_roles
        waits = [
            f"{child.name} for {few([members[source].name for source in child.waiting_for])}"
            for child in self._children
            if child.waiting_for
        ]
        return "all wait: " + few(waits, "; ")
