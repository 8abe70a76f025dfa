"""The supervisor: it starts the processes of a run, watches them, and ends them (docs/architecture.md, 3.7).

phase          entered when                        what the supervisor does, and what ends the phase
starting       `run` is called                     starts all processes; ends when all are ready
running        `Start` is sent to all              watches for lost processes and those that stand still; ends when all
                                                   members are done
breaking off   a failure in one of the above, or   has the bridge stop all wheels; then orders the members to end, and kills
               a signal to any process of the run  those that do not within `GRACE_S`
finishing      members are done or ended           sends `Finish` to bridge, drives, referee and recorder, one after the other
taking down    all of them are done                sends `End`; kills what is left

The modules beside this one: `specs` lists the processes and `children` starts them; `hearing` reads what they say, if it is
`understood`; `stalls` finds out who holds up a run; `endings` has the last three phases; `outcome` is what is told of a run,
`failures` why it breaks off.

All processes come from one fork server that has imported their modules, so fifteen start in the time of one.  No process
outlives the supervisor: each notices the hang-up of its pipe and ends, even if the supervisor was killed; the bridge stops the
wheels first (`watch`).  The processes talk over the loopback, at an address and ports of this run alone.
"""

import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from echelon.bridge.stations.closed import LOG
from echelon.plan.plan import Plan
from echelon.runtime.arrivals import FILE as ARRIVALS
from echelon.sim.interruption import Interruption, Raises, interruption
from echelon.sim.observing import new_gate
from echelon.sim.processes.children import Child, last_words_of, start, warm_up
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.endings import also_killed, finish_watchers, stop_members, stop_wheels, take_down
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.failures import NAMED, DivergedError, RunError, StallError, few
from echelon.sim.processes.hearing import Hearing
from echelon.sim.processes.outcome import Outcome, Progress, outcome_of
from echelon.sim.processes.pulse import Pulses
from echelon.sim.processes.specs import list_specs
from echelon.sim.processes.stalls import StallWatch, StandstillWatch
from echelon.sim.processes.to_process import Start, Told

START_TIMEOUT_S: Final = 90.0
"""How long processes may take to become ready [s]"""
WALL_START_S: Final = 0.1
"""The time from `Start` to run time 0 on a wall clock, at least [s]"""
WALL_OVERTIME_S: Final = 10.0
"""How long after the end of a run on a wall clock its members may take to be done [s]"""
LOOK_S: Final = 0.1
"""Time between two looks at the processes, if none of them says anything [s]"""
SHOW_S: Final = 0.2
"""Time between two looks at the progress [s]"""
GROUP_S: Final = 0.1
"""How long after a signal to a process the supervisor may get its own, if it was for all of them [s]"""


class Supervisor:
    """Runs a plan as processes, once.

    `run` is a name that no other run has: it is part of the keys of all messages.  `virtual`: in virtual time, else on a wall
    clock.  `can_urls` has a URL for each bus; without it there are no frames.  `scenario_toml`, `metadata` and `part_files`
    (texts by file name) go into the recording, unless the run is not `recorded`.  `show` is called with the progress about
    five times a second.  A run in virtual time without progress for `stall_timeout_s` is given up; one that is not recorded
    shows no progress, and must be over by then.  One on a wall clock is given up if a member stands still for as long.
    `ends_at` says where the run ends before its duration is over.  With `observe` it is open to observers, who get the
    `ticket`.  `interrupted` notes the signals that ask the run to end; without it the supervisor notes them itself.  On a wall
    clock only the messages of one instant in every `every_ns` are
    recorded, if it is given (`sim.wall_load`).  `order` may change the order in which processes start."""

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
        ends_at: EndsAt = EndsAt.DIVERGED,
        observe: bool = False,
        interrupted: Interruption | None = None,
        every_ns: int = 0,
        order: Callable[[list[ProcessSpec]], list[ProcessSpec]] = lambda specs: specs,
    ) -> None:
        self.plan, self.virtual = plan, virtual
        self._folder, self._notes_arrivals = folder, recorded and not virtual
        self._log = folder / LOG if can_urls else None
        self.progress = Progress()
        self._show = show
        told = scenario_toml, metadata or {}, part_files or {}
        gate = new_gate(run) if observe else None
        self.ticket = None if gate is None else gate.ticket
        """What observers need to know; None if the run is not open to them"""
        self._specs = order(list_specs(plan, run, virtual, folder, can_urls, *told, recorded, ends_at, gate, every_ns))
        self._children: list[Child] = []
        self._hearing = Hearing(plan, self._children, self.progress)
        self._stalls = StallWatch(plan, self._children, self.progress, stall_timeout_s)
        self._still = StandstillWatch(plan, self._children, self.progress, stall_timeout_s)
        self._asked, self._startup_s = interrupted, 0.0

    def run(self) -> Outcome:
        """Runs the plan; returns when all processes are gone.  Failures are in the outcome, not raised.

        Raises OSError if the file of arrivals cannot be made.  Other errors, which would be faults of this program or of
        `show`, are raised after all processes have ended."""
        if self._notes_arrivals:
            (self._folder / ARRIVALS).open("xb").close()  # members append to it
        with ExitStack() as stack:
            if self._asked is None:
                self._asked = stack.enter_context(interruption())
            wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            stack.callback(os.close, wake)
            stack.enter_context(self._asked.during(Raises.NONE, lambda: os.eventfd_write(wake, 1)))
            self._hearing.wake = wake
            self._pulses = Pulses(len(self._specs))
            stack.callback(self._pulses.close)
            return self._run()

    def _run(self) -> Outcome:
        failure: str | None = None
        stall: StallError | None = None
        error: BaseException | None = None
        broke: RunError | None = None
        diverged = False
        try:
            self._until_members_are_done()
        except StallError as stalled:
            stall, failure = stalled, stalled.text(f"t = {self.progress.time_ns / 1e9:g} s")
        except RunError as why:
            broke = why
        except DivergedError as why:
            diverged, self.progress.note = True, f"{why}: the run stops"
        except BaseException as other:
            error, failure = other, f"{type(other).__name__}: {other}"
        broken = diverged or failure is not None or broke is not None
        begun_s = self.progress.started_s
        wall_s = max(0.0, time.monotonic() - begun_s) if begun_s else 0.0
        try:
            standstills = self._standstills()  # a process that goes on to end stands still no more
            if broken:
                stop_wheels(self._children, self._hearing.serve)
                failure = failure if broke is None else str(broke)
                if failure is not None:
                    failure = self._signalled() or failure
                    self.progress.note = failure.splitlines()[0]
                stop_members(self._children, self._hearing.serve)
            else:
                self.progress.phase = "finishing"
            whole = self.virtual and not broken  # on a wall clock, messages may be lost on the way
            failure = finish_watchers(
                self._children,
                self._hearing.serve,
                self._say,
                failure,
                whole,
                lambda: self._interruption.asked,
                self._stalls.stands_still,
            )
        except BaseException as other:
            error = error or other
            raise error from None
        finally:
            take_down(self._children)
        if error is not None:
            raise error
        processes = [child.done for child in self._children if child.done is not None]
        outcome = outcome_of(
            self.plan, processes, failure, self._startup_s, wall_s, self._log, "virtual" if self.virtual else "wall"
        )
        outcome.standstills = standstills
        outcome.refused_here = self._hearing.refusals.by_source()
        common_ns = outcome.trace.common_ns()
        if stall is not None and len(common_ns):
            outcome.failure = stall.text(f"t = {common_ns[-1] / 1e9:g} s")
        if outcome.failure is not None:
            outcome.failure = also_killed(self._children, outcome.failure)
        return outcome

    def _until_members_are_done(self) -> None:
        """Starts all processes and waits until the members are done.

        Raises RunError or DivergedError if the run breaks off."""
        begun_s = time.monotonic()
        warm_up(self.plan)
        for number, spec in enumerate(self._specs):
            self._children.append(start(spec, self._pulses, number))
        self._until(lambda: all(child.ready for child in self._children), START_TIMEOUT_S, "not ready")
        self._startup_s = time.monotonic() - begun_s
        lead_in_s = 0.0 if self.virtual else self._lead_in_s()
        start_s = time.monotonic() + lead_in_s
        self._tell_all(Start(round(start_s * 1e9)))
        self.progress.phase, self.progress.started_s = "running", start_s
        self._stalls.begin(time.monotonic())
        members = [child for child in self._children if child.is_member]
        limit_s = None if self.virtual else lead_in_s + self.plan.duration_ns / 1e9 + WALL_OVERTIME_S
        self._until(lambda: all(child.done for child in members), limit_s, "not done")

    def _standstills(self) -> dict[str, tuple[int, int]]:
        """Returns for each process the longest time for which it stood still, and from when on in run time [ns]."""
        now_ns, start_ns = time.monotonic_ns(), round(self.progress.started_s * 1e9)
        if self.virtual or not 0 < start_ns < now_ns:
            return {}
        found = {child.name: child.pulse.standstill(now_ns) for child in self._children}
        return {name: (one.lasted_ns, one.from_ns - start_ns) for name, one in found.items() if one.lasted_ns}

    def _signalled(self) -> str | None:
        """Returns which signal ended the run, in words; None if none did.

        A signal to one process, not to the supervisor, is that process's."""
        if self._interruption.asked:
            return "interrupted"
        for child in self._children:
            if number := child.pulse.asked_by:
                deadline_s = time.monotonic() + GROUP_S
                while not self._interruption.asked and time.monotonic() < deadline_s:
                    time.sleep(0.005)
                if self._interruption.asked:
                    return "interrupted"
                return f"{child.kind_and_name} was asked to end ({signal.Signals(number).name})"
        return None

    @property
    def _interruption(self) -> Interruption:
        assert self._asked is not None
        return self._asked

    def _lead_in_s(self) -> float:
        """Returns the time from `Start` to run time 0 on a wall clock, in which drives are brought up [s]."""
        return max(WALL_START_S, self.plan.can.bring_up_ns / 1e9 if self.plan.can.closed else 0.0)

    def _until(self, done: Callable[[], bool], timeout_s: float | None, what: str) -> None:
        """Serves the children until `done`.  Raises RunError if a process is lost, the run stalls, or the time is over."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        shown_s = 0.0
        while not done():
            self._hearing.serve(LOOK_S)
            if self._interruption.asked or any(child.pulse.asked_by for child in self._children):
                raise RunError("interrupted")
            self._hearing.check_lost()
            now_s = time.monotonic()
            if self.progress.phase == "running" and not self.virtual:
                self._still.check(time.monotonic_ns())
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

    def _say(self, note: str) -> None:
        """Shows a note to the user."""
        self.progress.note = note
        self._show(self.progress)

    def _tell_all(self, message: Told) -> None:
        for child in self._children:
            try:
                child.control.send(message)
            except OSError:
                pass  # the process is lost; `Hearing.check_lost` reports it
