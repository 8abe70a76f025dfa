"""The supervisor: it starts the processes of a run, watches them, and ends them (docs/architecture.md, 3.7).

phase          entered when                        what the supervisor does, and what ends the phase
starting       `run` is called                     starts all processes; ends when all are ready
running        `Start` is sent to all              watches for lost processes and stalls; ends when all members are done
breaking off   a failure in one of the above, or   terminates the members, kills those that do not end within `GRACE_S`
               Ctrl-C
finishing      members are done or ended           sends `Finish` to bridge, drives, referee and recorder, one after the other
taking down    all of them are done                sends `End`; kills what is left

All processes come from one fork server that has imported their modules, so fifteen start in the time of one.  No process
outlives the supervisor: each notices the hang-up of its pipe and ends, even if the supervisor was killed.  The processes talk
over the loopback, at an address and ports of this run alone.
"""

import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final

from echelon.bridge.reports import BridgeProgress, CanReport, DrivesReport, RefereeReport
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.processes.children import FINISHING, Child, list_specs, start
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.to_process import End, Finish, Start, Told
from echelon.sim.processes.to_supervisor import (
    Done,
    Failed,
    LinksProgress,
    PartFailed,
    Ready,
    RecorderProgress,
    RecorderReport,
    Said,
    Waiting,
)
from echelon.sim.results.trace import Array, Trace, TraceBuilder

NAMED: Final = 12
"""The largest number of processes that a note names; the others are counted."""
START_TIMEOUT_S: Final = 30.0
STALL_REPORT_S: Final = 3.0
"""A run in virtual time without progress for this time is reported, with the process that everyone waits for."""
GRACE_S: Final = 3.0
"""How long processes may take to end, and watchers to close their files, when a run breaks off."""
FINISH_TIMEOUT_S: Final = 60.0
"""How long watchers may take to finish after a complete run."""
WALL_START_S: Final = 0.1
"""The time from `Start` to run time 0 on a wall clock, at least."""


@dataclass(slots=True)
class Progress:
    """The present state of a run, for a live table; `states` are the last states of the robots, at `states_ns`."""

    phase: str = "starting"
    time_ns: int = 0
    states_ns: int = 0
    states: Array | None = None
    messages: int = 0
    started_s: float = 0.0
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
    """The result of a run: the recorded trace, counts, and `failure` if the run did not finish."""

    trace: Trace
    links: list[LinkCounts]
    processes: list[Done]
    can: CanReport | None
    startup_s: float
    wall_s: float
    messages: int
    failure: str | None = None
    stopped: str | None = None
    """Why the run was stopped before its end though nothing failed"""


class RunError(Exception):
    """The run cannot go on; the text says why."""


class StallError(RunError):
    """A run in virtual time made no progress for a while, for `who`."""

    def __init__(self, still_s: float, who: str) -> None:
        self._still_s, self._who = still_s, who
        super().__init__(self.text("an unknown instant"))

    def text(self, when: str) -> str:
        """Returns what happened, in words; `when` it did is known for certain only once all is recorded."""
        return f"stalled for {self._still_s:.0f} s at {when}: {self._who}"


class DivergedError(Exception):
    """There is no point in going on; the text says why."""


class Supervisor:
    """One distributed run.

    `show` is called with the progress about five times a second.  A run in virtual time without progress for
    `stall_timeout_s` is given up.  `order` may change the order in which processes start."""

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        *,
        run: str,
        virtual: bool,
        can_urls: tuple[str, ...] = (),
        scenario_toml: str = "",
        metadata: dict[str, str] | None = None,
        part_files: dict[str, str] | None = None,
        recorded: bool = True,
        show: Callable[[Progress], None] = lambda progress: None,
        stall_timeout_s: float = 30.0,
        keep_going: bool = False,
        order: Callable[[list[ProcessSpec]], list[ProcessSpec]] = lambda specs: specs,
    ) -> None:
        self.plan, self.virtual = plan, virtual
        self.progress = Progress()
        self._show = show
        self._stall_timeout_s = stall_timeout_s
        told = scenario_toml, metadata or {}, part_files or {}
        self._specs = order(list_specs(plan, run, virtual, folder, can_urls, *told, recorded, keep_going))
        self._children: list[Child] = []
        self._moved_s = 0.0
        self._moved_at = (-1, -1)
        self._warned = False

    def run(self) -> Outcome:
        """Runs the plan; returns when all processes are gone.  Failures are in the outcome, not raised."""
        begun_s = time.monotonic()
        failure: str | None = None
        stall: StallError | None = None
        diverged = False
        startup_s = wall_s = 0.0
        previous = signal.signal(signal.SIGTERM, _interrupt)
        try:
            for spec in self._specs:
                self._children.append(start(spec))
            self._until(lambda: all(child.ready for child in self._children), START_TIMEOUT_S, "not ready")
            startup_s = time.monotonic() - begun_s
            start_s = time.monotonic() + (0.0 if self.virtual else self._lead_in_s())
            self._tell_all(Start(round(start_s * 1e9)))
            self.progress.phase, self.progress.started_s = "running", start_s
            self._moved_s = time.monotonic()
            members = [child for child in self._children if child.is_member]
            limit_s = None if self.virtual else self.plan.duration_ns / 1e9 + 10.0
            self._until(lambda: all(child.done for child in members), limit_s, "not done")
            wall_s = time.monotonic() - start_s
            self.progress.phase = "finishing"
        except StallError as error:
            stall, failure = error, error.text(f"t = {self.progress.time_ns / 1e9:g} s")
        except RunError as error:
            failure = str(error)
        except DivergedError as error:
            diverged, self.progress.note = True, f"{error}: the run stops"
        except KeyboardInterrupt:
            failure = "interrupted"
        broken = diverged or failure is not None
        if broken:
            wall_s = max(0.0, time.monotonic() - self.progress.started_s) if self.progress.started_s else 0.0
            self.progress.note = failure.splitlines()[0] if failure else self.progress.note
        try:
            if broken:
                self._stop_members()
            failure = self._finish_watchers(failure, broken)
        except KeyboardInterrupt:
            failure = failure or "interrupted"
        finally:
            self._take_down()
            signal.signal(signal.SIGTERM, previous)
        outcome = self._outcome(failure, startup_s, wall_s)
        common_ns, _ = outcome.trace.common()
        if stall is not None and len(common_ns):
            outcome.failure = stall.text(f"t = {common_ns[-1] / 1e9:g} s")
        return outcome

    def _lead_in_s(self) -> float:
        """Returns the time from `Start` to run time 0 on a wall clock, in which drives are brought up [s]."""
        return max(WALL_START_S, self.plan.can.bring_up_ns / 1e9 if self.plan.can.closed else 0.0)

    def _until(self, done: Callable[[], bool], timeout_s: float | None, what: str) -> None:
        """Serves the children until `done`.  Raises RunError if a process is lost, the run stalls, or the time is over."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        shown_s = 0.0
        while not done():
            self._serve(0.1)
            self._check_lost()
            now_s = time.monotonic()
            if now_s - shown_s >= 0.2:
                shown_s = now_s
                self._check_stall(now_s)
                self._show(self.progress)
            if deadline_s is not None and now_s > deadline_s:
                late = [
                    child
                    for child in self._children
                    if not (child.ready if what == "not ready" else child.done or not child.is_member)
                ]
                who = few([child.name + child.runs() for child in late])
                words = self._words_of([child.name for child in late[:NAMED]])
                raise RunError(f"{what} after {timeout_s:g} s: {who}{words}")

    def _serve(self, timeout_s: float) -> None:
        """Reads the control pipes and the standard error of all children."""
        by_handle: dict[Any, Child] = {}
        for child in self._children:
            if not child.control.closed:
                by_handle[child.control] = child
            if not child.words.closed:
                by_handle[child.words] = child
        sentinels = [child.process.sentinel for child in self._children if child.done is None]
        for handle in wait([*by_handle, *sentinels], timeout_s):
            if isinstance(handle, Connection):
                child = by_handle[handle]
                if handle is child.words:
                    child.hear_words()
                else:
                    self._hear(child)

    def _hear(self, child: Child) -> None:
        try:
            said: Said = child.control.recv()
        except (EOFError, OSError):
            child.control.close()
            return
        child.heard_s = time.monotonic()
        progress = self.progress
        match said:
            case Ready():
                child.ready = True
            case Waiting():
                child.waiting_ns, child.waiting_for = said.time_ns, list(said.sources)
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
                    raise DivergedError(said.lost.text(self.plan))
            case Failed():
                starting = progress.phase == "starting"
                raise RunError(
                    f"{child.spec.kind} {child.name} cannot start: {said.text}"
                    if starting
                    else f"{child.name}: {said.text}"
                )
            case PartFailed():
                raise RunError(said.text)
            case Done():
                child.done = said

    def _check_lost(self) -> None:
        for child in self._children:
            if child.done is None and not child.process.is_alive():
                while not child.control.closed and child.control.poll():
                    self._hear(child)
                if child.done is None:
                    if not child.words.closed:
                        child.hear_words()
                    raise RunError(
                        f"lost {child.spec.kind} {child.name} ({child.ending()}){self._words_of([child.name])}"
                    )

    def _words_of(self, names: list[str]) -> str:
        said = [
            f"\n--- last words of {child.name}:\n{words}"
            for child in self._children
            if child.name in names and (words := child.last_words())
        ]
        return "".join(said)

    def _check_stall(self, now_s: float) -> None:
        """Reports a run in virtual time that makes no progress; raises RunError after `stall_timeout_s`."""
        if self.progress.phase != "running" or not self.virtual:
            return
        at = (self.progress.time_ns, max((child.waiting_ns for child in self._children), default=-1))
        if at != self._moved_at:
            self._moved_at, self._moved_s = at, now_s
            if self._warned:
                self._warned, self.progress.note = False, "goes on"
            return
        still_s = now_s - self._moved_s
        if still_s > STALL_REPORT_S and not self._warned:
            self._warned = True
            self.progress.note = f"stalled at t = {self.progress.time_ns / 1e9:g} s: {self._who_is_waited_for(now_s)}"
        if still_s > self._stall_timeout_s:
            raise StallError(still_s, self._who_is_waited_for(now_s))

    def _who_is_waited_for(self, now_s: float) -> str:
        """Returns in words which processes everyone waits for: those that report nothing, not even that they wait."""
        silent = [child for child in self._children if not child.is_member and now_s - child.heard_s > 2]
        if not silent:
            silent = [
                child
                for child in self._children
                if child.is_member and child.done is None and now_s - child.heard_s > 2
            ]
        if silent:
            return "everyone waits for " + few(
                [f"{child.name} (process {child.process.pid}, {child.state()}{child.runs()})" for child in silent]
            )
        members = self.plan.all_roles
        waits = [
            f"{child.name} for {few([members[source].name for source in child.waiting_for])}"
            for child in self._children
            if child.waiting_for
        ]
        return "all wait: " + few(waits, "; ")

    def _stop_members(self) -> None:
        """Ends the members of a run that broke off: terminates them, so that they can send their last batches, then kills."""
        members = [child for child in self._children if child.is_member]
        for child in members:
            if child.process.is_alive():
                child.process.terminate()
        deadline_s = time.monotonic() + GRACE_S
        # bridge and drives report their counts before they end, and their pipe must be read meanwhile
        while time.monotonic() < deadline_s and any(
            child.process.is_alive() and child.done is None for child in members
        ):
            try:
                self._serve(0.05)
            except (RunError, DivergedError):
                pass  # why the run broke off is known already
        for child in members:
            if child.process.is_alive() and child.done is None:
                child.process.kill()

    def _finish_watchers(self, failure: str | None, broken: bool) -> str | None:
        """Lets bridge, drives, referee and recorder finish, in this order; returns the failure, old or new.

        A run that has `broken` off owes them messages that never come."""
        links = [counts for child in self._children if child.done for counts in child.done.links]
        sent = {"robot": 0, "leader": 0, "coordinator": 0, "bridge": 0, "drives": 0}
        for child in self._children:
            if child.done and child.done.runner:
                sent[child.spec.kind] += child.done.runner.messages
        for kind in FINISHING:
            for child in self._children:
                if (
                    child.spec.kind != kind
                    or child.is_member
                    or not child.ready
                    or child.control.closed
                    or not child.process.is_alive()
                ):
                    continue
                # On a wall clock, messages may be lost on the way.
                whole = not broken and failure is None and self.virtual
                order = Finish(
                    links=tuple(links),
                    robot_messages=sent["robot"] if whole else None,
                    messages=sum(sent.values()) if whole else None,
                )
                try:
                    child.control.send(order)
                    begun_s = time.monotonic()
                    patience_s = GRACE_S if failure else FINISH_TIMEOUT_S
                    while child.done is None and child.process.is_alive() and time.monotonic() - begun_s < patience_s:
                        self._serve(0.05)
                        if not failure and time.monotonic() - begun_s > STALL_REPORT_S:
                            self.progress.note = f"waits for {child.name} to finish ({child.state()})"
                            self._show(self.progress)
                except (RunError, DivergedError, OSError) as error:
                    failure = failure or str(error)
                if child.done is not None and isinstance(child.done.report, CanReport):
                    sent["bridge"] = child.done.report.messages
                if child.done is None:
                    failure = failure or f"lost {kind} ({child.ending()}){self._words_of([child.name])}"
        for child in self._children:
            report = child.done and child.done.report
            if isinstance(report, RecorderReport) and report.failure:
                failure = failure or f"the recording failed: {report.failure}"
        return failure

    def _take_down(self) -> None:
        """Ends all processes: sends `End` to those that are done, kills the others."""
        for child in self._children:
            if child.done is not None and not child.control.closed:
                try:
                    child.control.send(End())
                except OSError:
                    pass
            elif child.process.is_alive():
                child.process.terminate()
        deadline_s = time.monotonic() + GRACE_S
        for child in self._children:
            child.process.join(max(0.0, deadline_s - time.monotonic()))
            if child.process.is_alive():
                child.process.kill()
                child.process.join()
            child.control.close()
            child.words.close()

    def _outcome(self, failure: str | None, startup_s: float, wall_s: float) -> Outcome:
        processes = [child.done for child in self._children if child.done is not None]
        can: CanReport | None = None
        drives: DrivesReport | None = None
        referee: RefereeReport | None = None
        recorder: RecorderReport | None = None
        for process in processes:
            match process.report:
                case CanReport():
                    can = process.report
                case DrivesReport():
                    drives = process.report
                case RefereeReport():
                    referee = process.report
                case RecorderReport():
                    recorder = process.report
        if can is not None:
            can = replace(can if drives is None else can.with_drives(drives), referee=referee)
        return Outcome(
            trace=TraceBuilder(self.plan).build() if recorder is None else recorder.trace,
            links=[counts for process in processes for counts in process.links],
            processes=processes,
            can=can,
            startup_s=startup_s,
            wall_s=wall_s,
            messages=0 if recorder is None else recorder.messages,
            failure=failure,
            stopped=None if recorder is None else recorder.stopped(self.plan),
        )

    def _tell_all(self, message: Told) -> None:
        for child in self._children:
            try:
                child.control.send(message)
            except OSError:
                pass  # the process is lost; `_check_lost` reports it


def few(names: Sequence[str], between: str = ", ") -> str:
    """Returns names as text, `NAMED` of them at most; the others are counted."""
    more = [f"and {len(names) - NAMED} more"] if len(names) > NAMED else []
    return between.join([*names[:NAMED], *more])


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
