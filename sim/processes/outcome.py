"""What the supervisor of a run tells others: its progress while it goes on, and its outcome at the end."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.reports import BridgeProgress, CanReport, DrivesReport
from echelon.errors import UserError
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.log_report import report_of_log
from echelon.sim.processes.to_supervisor import Done, RecorderProgress, RecorderReport
from echelon.sim.results.records import RefusalResult
from echelon.sim.results.trace import Array, Trace, TraceBuilder

_Report = TypeVar("_Report")


@dataclass(slots=True)
class Progress:
    """The present state of a run, for a display."""

    phase: str = "starting"
    """`starting`, `running`, `stopping` (it diverged) or `finishing`"""
    time_ns: int = 0
    """Run time of the last recorded message [ns]"""
    states_ns: int = 0
    states: Array | None = None
    """The last states of the robots, at run time `states_ns`; None before the first"""
    messages: int = 0
    """Number of recorded messages"""
    started_s: float = 0.0
    """When the run began, on the monotonic clock [s]; 0 before that"""
    bridge: BridgeProgress = field(default_factory=BridgeProgress)
    drives: BridgeProgress = field(default_factory=BridgeProgress)
    links: dict[tuple[int, int, int], LinkCounts] = field(default_factory=dict)
    """The last counts of links, by receiver, source and channel"""
    note: str = ""
    """News for the user, for example which process everyone waits for"""

    def hear_links(self, links: Iterable[LinkCounts]) -> None:
        """Takes over counts of links."""
        self.links |= {(each.receiver, each.source, each.channel): each for each in links}

    def hear(self, recorder: RecorderProgress) -> None:
        """Takes over the progress of the recorder."""
        self.time_ns, self.messages = recorder.time_ns, recorder.messages
        self.states, self.states_ns = recorder.states, recorder.states_ns


@dataclass(slots=True)
class Outcome:
    """The result of a run: the recorded trace, and counts."""

    trace: Trace
    links: list[LinkCounts]
    processes: list[Done]
    """The reports of the processes; empty for a run in one process"""
    can: CanReport | None
    startup_s: float
    """From the start of the first process until all were ready [s]"""
    wall_s: float
    """From the start of the run to its end, by the monotonic clock [s]"""
    messages: int
    failure: str | None = None
    """Why the run broke off; None if it did not"""
    stopped: str | None = None
    """Why the run was stopped before its end though nothing failed; None if it was not"""
    thinned: int = 0
    """Messages that were not recorded by rule"""
    standstills: dict[str, tuple[int, int]] = field(default_factory=dict)
    """On a wall clock, by name of the process: the longest time for which it stood still, and since when [ns of run time]"""
    refused_here: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """What the supervisor refused, by source and reason"""

    def refusals(self) -> tuple[RefusalResult, ...]:
        """Returns what the processes refused, the most frequent first."""
        found = [
            RefusalResult(name, source, reason, count)
            for name, refused in [
                *((each.name, each.refused) for each in self.processes),
                ("supervisor", self.refused_here),
            ]
            for source, reasons in refused.items()
            for reason, count in reasons.items()
        ]
        return tuple(sorted(found, key=lambda each: -each.messages))


def outcome_of(
    plan: Plan,
    processes: list[Done],
    failure: str | None,
    startup_s: float,
    wall_s: float,
    log: Path | None,
    clock: str,
) -> Outcome:
    """Returns the outcome of a run from the reports of its processes; `log` is its can.log, if it has buses, and
    `clock` is `virtual` or `wall`.

    A run whose recorder gave no report has an empty trace.  If its bridge gave none, the report on the buses is what can.log
    shows."""
    recorder = _report(RecorderReport, processes)
    can, drives = _report(CanReport, processes), _report(DrivesReport, processes)
    if can is None and log is not None:
        with suppress(OSError, UserError):  # a run that failed early has no log
            found = report_of_log(plan, log, clock)
            can = found if found.frames else None
    if can is not None:
        can = replace(can if drives is None else can.with_drives(drives), referee=_report(RefereeReport, processes))
    return Outcome(
        trace=TraceBuilder(plan).build() if recorder is None else replace(recorder.trace, plan=plan),
        links=[counts for process in processes for counts in process.links],
        processes=processes,
        can=can,
        startup_s=startup_s,
        wall_s=wall_s,
        messages=0 if recorder is None else recorder.messages,
        thinned=sum(process.runner.thinned for process in processes if process.runner is not None)
        + (0 if recorder is None else recorder.thinned),
        failure=failure,
        stopped=None if recorder is None else recorder.stopped(plan),
    )


def _report(kind: type[_Report], processes: Iterable[Done]) -> _Report | None:
    """Returns the report of a kind among those of the processes; None if no process gave one."""
    return next((process.report for process in processes if isinstance(process.report, kind)), None)
