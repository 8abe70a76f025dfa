"""The supervisor: it starts the processes of a run, watches them, and ends them (docs/architecture.md, 3.7).

phase          entered when                        what the supervisor does, and what ends the phase
starting       `run` is called                     starts all processes; ends when all are ready
running        `Start` is sent to all              watches for lost processes and stalls; ends when all members are done
breaking off   a failure in one of the above, or   terminates the members, kills those that do not end within `GRACE_S`
               Ctrl-C
finishing      members are done or ended           sends `Finish` to bridge, drives, referee and recorder, one after the other
taking down    all of them are done                sends `End`; kills what is left

The modules beside this one: `specs` lists the processes and `children` starts them; `stalls` finds out who holds up a run;
`endings` has the last three phases; `outcome` is what is told of a run, `failures` why it breaks off.

All processes come from one fork server that has imported their modules, so fifteen start in the time of one.  No process
outlives the supervisor: each notices the hang-up of its pipe and ends, even if the supervisor was killed.  The processes talk
over the loopback, at an address and ports of this run alone.
"""

import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final

from echelon.bridge.reports import BridgeProgress
from echelon.plan.plan import Plan
from echelon.runtime.arrivals import FILE as ARRIVALS
from echelon.sim.observing import new_gate
from echelon.sim.processes.children import Child, last_words_of, start
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.endings import finish_watchers, stop_members, take_down
from echelon.sim.processes.failures import NAMED, DivergedError, RunError, StallError, few
from echelon.sim.processes.outcome import Outcome, Progress, outcome_of
from echelon.sim.processes.specs import list_specs
from echelon.sim.processes.stalls import StallWatch
from echelon.sim.processes.to_process import Start, Told
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

START_TIMEOUT_S: Final = 30.0
"""How long processes may take to become ready [s]"""
WALL_START_S: Final = 0.1
"""The time from `Start` to run time 0 on a wall clock, at least [s]"""
WALL_OVERTIME_S: Final = 10.0
"""How long after the end of a run on a wall clock its members may take to be done [s]"""
SHOW_S: Final = 0.2
"""Time between two looks at the progress [s]"""


class Supervisor:
    """Runs a plan as processes, once.

    `run` is a name that no other run has: it is part of the keys of all messages.  `virtual`: in virtual time, else on a wall
    clock.  `can_urls` has a URL for each bus; without it there are no frames.  `scenario_toml`, `metadata` and `part_files`
    (texts by file name) go into the recording, unless the run is not `recorded`.  `show` is called with the progress about
    five times a second.  A run in virtual time without progress for `stall_timeout_s` is given up.  With `keep_going` the run
    does not stop when a robot's state is not finite.  With `observe` it is open to observers, who get the `ticket`.  `order`
    may change the order in which processes start."""

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
        observe: bool = False,
        order: Callable[[list[ProcessSpec]], list[ProcessSpec]] = lambda specs: specs,
    ) -> None:
        self.plan, self.virtual = plan, virtual
        self._folder, self._notes_arrivals = folder, recorded and not virtual
        self.progress = Progress()
        self._show = show
        told = scenario_toml, metadata or {}, part_files or {}
        gate = new_gate(run) if observe else None
        self.ticket = None if gate is None else gate.ticket
        """What observers need to know; None if the run is not open to them"""
        self._specs = order(list_specs(plan, run, virtual, folder, can_urls, *told, recorded, keep_going, gate))
        self._children: list[Child] = []
        self._stalls = StallWatch(plan, self._children, self.progress, stall_timeout_s)

    def run(self) -> Outcome:
        """Runs the plan; returns when all processes are gone.  Failures are in the outcome, not raised.

        Raises OSError if the file of arrivals cannot be made."""
        if self._notes_arrivals:
            (self._folder / ARRIVALS).write_bytes(b"")  # members append to it
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
            lead_in_s = 0.0 if self.virtual else self._lead_in_s()
            start_s = time.monotonic() + lead_in_s
            self._tell_all(Start(round(start_s * 1e9)))
            self.progress.phase, self.progress.started_s = "running", start_s
            self._stalls.begin(time.monotonic())
            members = [child for child in self._children if child.is_member]
            limit_s = None if self.virtual else lead_in_s + self.plan.duration_ns / 1e9 + WALL_OVERTIME_S
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
                stop_members(self._children, self._serve)
            whole = self.virtual and not broken  # on a wall clock, messages may be lost on the way
            failure = finish_watchers(self._children, self._serve, self._say, failure, whole)
        except KeyboardInterrupt:
            failure = failure or "interrupted"
        finally:
            take_down(self._children)
            signal.signal(signal.SIGTERM, previous)
        processes = [child.done for child in self._children if child.done is not None]
        outcome = outcome_of(self.plan, processes, failure, startup_s, wall_s)
        common_ns = outcome.trace.common_ns()
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
            if now_s - shown_s >= SHOW_S:
                shown_s = now_s
                if self.progress.phase == "running" and self.virtual:
                    self._stalls.check(now_s)
                self._show(self.progress)
            if deadline_s is not None and now_s > deadline_s:
                late = [
                    child
                    for child in self._children
                    if not (child.ready if what == "not ready" else child.done or not child.is_member)
                ]
                who = few([child.name + child.runs() for child in late])
                raise RunError(f"{what} after {timeout_s:g} s: {who}{last_words_of(late[:NAMED])}")

    def _serve(self, timeout_s: float) -> None:
        """Waits up to `timeout_s` for messages, standard error or the end of any child, and reads what has come.

        Raises RunError or DivergedError if a message says that the run cannot or should not go on."""
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
        """Reads one message of a child.  Raises RunError or DivergedError, as `_serve` does."""
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
                    f"{child.kind_and_name} cannot start: {said.text}" if starting else f"{child.name}: {said.text}"
                )
            case PartFailed():
                raise RunError(said.text)
            case Done():
                child.done = said

    def _check_lost(self) -> None:
        """Raises RunError if a child has ended without its report."""
        for child in self._children:
            if child.done is None and not child.process.is_alive():
                while not child.control.closed and child.control.poll():
                    self._hear(child)
                if child.done is None:
                    if not child.words.closed:
                        child.hear_words()
                    raise RunError(f"lost {child.kind_and_name} ({child.ending()}){last_words_of([child])}")

    def _say(self, note: str) -> None:
        """Shows a note to the user."""
        self.progress.note = note
        self._show(self.progress)

    def _tell_all(self, message: Told) -> None:
        for child in self._children:
            try:
                child.control.send(message)
            except OSError:
                pass  # the process is lost; `_check_lost` reports it


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
