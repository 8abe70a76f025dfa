"""Finds out which processes hold up a run.

On a wall clock a process that stands still, or is slow, is known by its pulse (`pulse`): it is not at work when it said it
would be.  A bridge or drives that stand still for `BREAK_S` break the run off, for the watchdogs of the drives have stopped
the wheels for good; where the drives recover, for `RECOVER_S`.  Others are named, the run goes on without them, and the check
`standstill` fails the verdict.  A robot, leader or coordinator that stands still for the stall timeout ends the run.

In virtual time every member waits for the messages of others, so one process that stands still stops all.  A member that waits
says so every now and then; everyone waits for a member that says nothing, or for a watcher that is late by its pulse.
"""

import math
import time
from collections.abc import Sequence
from typing import Final

from echelon.plan.plan import Plan
from echelon.sim.processes.children import Child
from echelon.sim.processes.failures import RunError, StallError, few
from echelon.sim.processes.outcome import Progress

STALL_REPORT_S: Final = 3.0
"""After this time without progress a run in virtual time is reported as stalled [s]"""
SILENT_S: Final = 2.0
"""A process that has said nothing for this time counts as silent [s]"""
STANDSTILL_S: Final = 0.5
"""A process on a wall clock that is late by this time is named [s]"""
BREAK_S: Final = 1.0
"""A run on a wall clock whose bridge or drives stand still for this time breaks off [s]"""
RECOVER_S: Final = 10.0
"""The same where the drives recover from their watchdogs by themselves (`recover_after`) [s]"""
NAMED_STILL: Final = 3
"""How many processes a note names that stand still; if there are more, the machine is the likely cause"""
ASLEEP_S: Final = 0.4
"""If the supervisor itself was away for this time, the whole machine was, or the whole run was stopped [s]"""


class StandstillWatch:
    """Watches the processes of one run on a wall clock."""

    def __init__(
        self, plan: Plan, children: Sequence[Child], progress: Progress, stall_timeout_s: float = math.inf
    ) -> None:
        self._plan, self._children, self._progress = plan, children, progress
        self._stall_timeout_s = stall_timeout_s
        recover = all(robot.drive.recover_ns is not None for robot in plan.robots)
        self._break_s = RECOVER_S if recover else BREAK_S
        self._named: set[str] = set()
        self._looked_ns = 0

    def check(self, now_ns: int) -> None:
        """Notes in the progress which processes stand still; call it some times a second while the run goes on.

        `now_ns` is on the monotonic clock.  Raises RunError if the bridge or the drives do for `BREAK_S`, or
        `RECOVER_S`, or a member of the run for the stall timeout."""
        asleep, self._looked_ns = now_ns - self._looked_ns > ASLEEP_S * 1e9, now_ns
        if asleep or now_ns < self._progress.started_s * 1e9:
            return  # all processes get the time to go on; before run time 0 no wheel has torque yet
        overdue_s = {child.name: child.pulse.overdue_ns(now_ns) / 1e9 for child in self._children if child.done is None}
        still = [child for child in self._children if overdue_s.get(child.name, 0.0) > STANDSTILL_S]
        if new := [self._text(child, overdue_s[child.name]) for child in still if child.name not in self._named]:
            more = f"; and {len(new) - NAMED_STILL} more: is the machine too busy?" if len(new) > NAMED_STILL else ""
            self._progress.note = "; ".join(new[:NAMED_STILL]) + more
        elif back := sorted(self._named - {child.name for child in still}):
            self._progress.note = f"{few(back)} {'goes' if len(back) == 1 else 'go'} on"
        self._named = {child.name for child in still}
        for child in still:
            if (
                self._plan.can.closed
                and child.spec.kind in ("bridge", "drives")
                and overdue_s[child.name] > self._break_s
            ):
                raise RunError(
                    f"{self._text(child, overdue_s[child.name])}: longer than the watchdogs of the drives allow"
                )
        given_up = [child for child in still if child.is_member and overdue_s[child.name] > self._stall_timeout_s]
        if given_up:
            who = few([self._text(child, overdue_s[child.name]) for child in given_up], "; ")
            raise RunError(f"{who}: longer than the stall timeout of {self._stall_timeout_s:g} s")

    def _text(self, child: Child, still_s: float) -> str:
        """Returns in words how long a process has stood still, since when, and what the kernel says of it."""
        from_s = time.monotonic() - still_s - self._progress.started_s
        about = f"process {child.process.pid}, {child.state()}{child.runs()}"
        return f"{child.kind_and_name} stands still, for {still_s:.1f} s from t = {from_s:.2f} s on ({about})"


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

        A run stalls, too, if a watcher stands still, though members go on until there is no room for more messages.

        `now_s` is on the monotonic clock [s].  Raises StallError after `stall_timeout_s` without progress."""
        at = (self._progress.time_ns, max((child.waiting_ns for child in self._children), default=-1))
        waited_for = self._watchers_late_by(STANDSTILL_S, now_s)  # members may run ahead of a watcher
        if at != self._moved_at and not waited_for:
            self._moved_at, self._moved_s = at, now_s
            if self._warned:
                self._warned, self._progress.note = False, "goes on"
            return
        still_s = now_s - self._moved_s
        if still_s > STALL_REPORT_S and not self._warned:
            self._warned = True
            self._progress.note = (
                f"stalled at t = {self._stands_at_ns(now_s) / 1e9:g} s: {self._who_is_waited_for(now_s)}"
            )
        if still_s > self._stall_timeout_s:
            raise StallError(still_s, self._who_is_waited_for(now_s))

    def stands_still(self, child: Child) -> str | None:
        """Returns in words that a process has stood still for the stall timeout, by its pulse; None if it has not."""
        still_s = child.pulse.overdue_ns(time.monotonic_ns()) / 1e9
        if still_s <= self._stall_timeout_s:
            return None
        return StallError(still_s, _waited_for([child])).text(f"t = {self._progress.time_ns / 1e9:g} s")

    def _watchers_late_by(self, late_s: float, now_s: float) -> list[Child]:
        """Returns the watchers that are late by some time, by their pulses."""
        then_ns = round((now_s - late_s) * 1e9)
        return [child for child in self._children if not child.is_member and child.pulse.overdue_ns(then_ns)]

    def _stands_at_ns(self, now_s: float) -> int:
        """Returns the instant [ns] at which the run stands: the first one at which a member waits.  What is recorded may be
        older, for copies of messages come in batches."""
        waits = [child.waiting_ns for child in self._children if _waits(child, now_s)]
        return max(self._progress.time_ns, min(waits, default=0))

    def _who_is_waited_for(self, now_s: float) -> str:
        """Returns in words which processes everyone waits for: the silent ones, or else who waits for whom.

        A watcher that stands still, by its pulse, comes first: members may be silent only because it does not take their
        messages.  One that is waited for, and waits for nobody, works or hangs, even if a thread of it still speaks.  If there
        is no such process, everyone waits for those that the kernel has stopped."""
        quiet = [child for child in self._children if now_s - child.heard_s > SILENT_S]
        silent = self._watchers_late_by(SILENT_S, now_s)
        silent = silent or [child for child in quiet if child.is_member and child.done is None]
        awaited = {source for child in self._children if _waits(child, now_s) for source in child.waiting_for}
        silent = silent or [
            child
            for child in self._children
            if child.spec.index in awaited and child.is_member and child.done is None and not _waits(child, now_s)
        ]
        silent = silent or [child for child in self._children if child.state() == "stopped"]
        if silent:
            return _waited_for(silent)
        members = self._plan.all_roles
        waits = [
            f"{child.name} for {few([members[source].name for source in child.waiting_for])}"
            for child in self._children
            if child.waiting_for
        ]
        return "all wait: " + few(waits, "; ")


def _waited_for(children: Sequence[Child]) -> str:
    """Returns in words that everyone waits for some processes."""
    return "everyone waits for " + few(
        [f"{child.name} (process {child.process.pid}, {child.state()}{child.runs()})" for child in children]
    )


def _waits(child: Child, now_s: float) -> bool:
    """Returns whether a process has said lately that it waits."""
    return bool(child.waiting_for) and now_s - child.waiting_s <= SILENT_S
