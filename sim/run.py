"""Executes a run, in one process or in many, and writes its folder (docs/architecture.md, 6.1), except for the report."""

import os
import platform
import resource
import shlex
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from hashlib import blake2b
from importlib.metadata import version
from pathlib import Path
from typing import Final

from echelon import __version__
from echelon.bridge.stations.closed import LOG
from echelon.bridge.stations.opening import open_bridge
from echelon.errors import PartRunError
from echelon.files import write_text
from echelon.messages import Message
from echelon.plan.plan import Plan
from echelon.planning.loading import effective_toml
from echelon.scenario.tables import Scenario
from echelon.shipped import EFFECTIVE
from echelon.sim.engines.in_process import Engine
from echelon.sim.interruption import Interruption, Raises, interruption
from echelon.sim.judged_log import Terms, judged, until_ns
from echelon.sim.kept_parts import keep_parts
from echelon.sim.observing import TICKET
from echelon.sim.out_folder import NOTE, SUMMARY, OutFolder, run_files
from echelon.sim.parts.foreign_parts import patience_with_bridge, stalled_in, unstalled
from echelon.sim.parts.time_limit import TookTooLong
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.outcome import Outcome, Progress
from echelon.sim.processes.supervisor import Supervisor
from echelon.sim.processes.watchers import RunRecorder
from echelon.sim.recording.time_order import TimeOrder, speakers
from echelon.sim.results.records import ProcessResult, RunFacts, StandstillResult, Summary
from echelon.sim.results.rendering import write_summary
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Trace
from echelon.sim.run_state import write_state
from echelon.sim.view.live import Display
from echelon.sim.wall_load import wall_load

PACKAGES: Final = ("eclipse-zenoh", "numpy", "python-can", "mcap")
"""Packages whose versions are noted in the recording"""
STOP_S: Final = 5.0
"""How long a bridge in one process may take to stop the wheels, if drives speak a user's own protocol [s]"""


def execute(
    scenario: Scenario,
    plan: Plan,
    out: OutFolder,
    *,
    engine: str,
    clock: str,
    can_urls: tuple[str, ...],
    display: Display,
    stall_timeout_s: float = 30.0,
    ends_at: EndsAt = EndsAt.DIVERGED,
    observe: bool = False,
    interrupted: Interruption | None = None,
) -> tuple[Summary, Trace]:
    """Runs a plan and writes the files of the run, except for the report; returns its summary and its trace.

    `plan` is the plan of `scenario`, `out` the locked folder.  `engine` is `processes` or `inprocess`, `clock` is `virtual` or
    `wall`.  `can_urls` has a URL for each bus, or none if the run makes no frames.  A run in virtual time without progress for
    `stall_timeout_s` is given up, and one on a wall clock with a member that stands still for as long.  `ends_at` says
    where a run ends before its duration is over.  With `observe`, others can read the messages
    of a run as processes while it goes on.  `interrupted` notes the signals that ask the run to end; without it this function
    notes them itself.  A run that breaks off has its reason in the summary; its exception is not raised.

    Raises OSError if a file cannot be written, with a note if the run broke off, too; in one process also OSError or ValueError
    if a bus cannot be opened."""
    begun, folder = datetime.now(UTC), out.path
    parts = keep_parts(scenario, folder, (NOTE, *run_files(plan, bus=True)))
    toml = effective_toml(scenario, parts.names)
    out.note((), {EFFECTIVE: toml, **parts.files})
    write_text(folder / EFFECTIVE, toml)
    names = [bus.name for bus in plan.can.buses] if can_urls else []
    write_state(folder, engine, clock, dict(zip(names, can_urls, strict=True)))
    metadata = {
        "scenario": scenario.name,
        "engine": engine,
        "clock": clock,
        "echelon": version("echelon"),
        "python": platform.python_version(),
    }
    load = wall_load(plan, bool(can_urls)) if clock == "wall" and engine == "processes" else None
    every_ns = 0 if load is None else load.every_ns
    if load is not None and load.warning:
        display.say(f"warning: {load.warning}")
    if every_ns:
        metadata["recorded every"] = f"{every_ns / 1e9:g}"
    metadata |= {package: version(package) for package in PACKAGES} | parts.metadata
    if engine == "inprocess":
        recorder = partial(RunRecorder, folder, plan, toml, metadata, parts.files, ends_at)
        with interruption() if interrupted is None else nullcontext(interrupted) as noted, noted.during(Raises.NONE):
            outcome = _in_process(plan, folder, clock, can_urls, recorder, display, stall_timeout_s, noted)
    else:
        supervisor = Supervisor(
            plan,
            folder,
            run=blake2b(f"{folder.resolve()} {time.time_ns()}".encode(), digest_size=8).hexdigest(),
            virtual=clock == "virtual",
            can_urls=can_urls,
            scenario_toml=toml,
            metadata=metadata,
            part_files=parts.files,
            show=display.show,
            stall_timeout_s=stall_timeout_s,
            ends_at=ends_at,
            observe=observe,
            interrupted=interrupted,
            every_ns=every_ns,
        )
        if supervisor.ticket is not None:
            supervisor.ticket.write(folder)
            where = f"address {supervisor.ticket.endpoint}, read-only secret in {folder / TICKET}"
            display.say(f"open to observers: echelon observe {folder} ({where})")
        outcome = supervisor.run()
    can = outcome.can
    whole = not (outcome.failure or outcome.stopped)
    # of a run that diverged some robots' frames end before the others'
    if can is not None and (can.referee is None or outcome.stopped):
        try:
            terms = Terms.of(plan, clock, whole, until_ns(plan, outcome))
            can = replace(can, referee=judged(folder / LOG, plan, terms))
        except PartRunError as error:
            outcome.failure = outcome.failure or str(error)
    display.close()
    summary = summarise(
        outcome.trace, outcome.links, can, _run_facts(plan, outcome, engine, clock, begun, every_ns), parts.results
    )
    try:
        write_summary(summary, folder / SUMMARY)
    except OSError as error:
        if outcome.failure:
            error.add_note(outcome.failure)
        raise
    return summary, outcome.trace


def _in_process(
    plan: Plan,
    folder: Path,
    clock: str,
    can_urls: tuple[str, ...],
    recorder: Callable[[], RunRecorder],
    display: Display,
    stall_timeout_s: float,
    interrupted: Interruption,
) -> Outcome:
    """Runs a plan in one process, with recorder and bridge; returns its outcome.

    Recorder and bridge get the messages in the same order as in a run as processes."""
    gathered: list[Message] = []
    engine = Engine(plan, gathered.append)
    recording = recorder()
    bridge = open_bridge(plan, can_urls, folder, engine.commander)
    order = TimeOrder(speakers(plan, True, bool(can_urls)))
    progress = Progress(phase="running", started_s=time.monotonic(), bridge=bridge.progress())
    begun_s = shown_s = time.monotonic()
    failure: str | None = None

    def pass_on() -> None:
        """Passes the gathered messages on to the bridge, and everything to the recorder."""
        batch = gathered.copy()
        gathered.clear()  # before anything can raise, so that nothing is passed on twice
        recording.add(order.push(batch))
        copies: list[Message] = []
        try:
            with patience_with_bridge(plan, stall_timeout_s):
                bridge.take(batch, copies)
        finally:
            recording.add(order.push(copies))

    time_ns = 0
    error: BaseException | None = None
    try:
        with interrupted.during(Raises.SECOND, bridge.interrupt):
            for time_ns in unstalled(plan, engine.instants(), stall_timeout_s):
                if clock == "wall":
                    pass_on()
                    if (left_s := begun_s + time_ns / 1e9 - time.monotonic()) > 0:
                        time.sleep(left_s)
                elif len(gathered) >= 512:
                    pass_on()
                now_s = time.monotonic()
                if now_s - shown_s >= 0.2:
                    shown_s = now_s
                    progress.hear(recording.progress())
                    progress.bridge = bridge.progress()
                    progress.hear_links(engine.link_counts())
                    recording.recorder.flush_if_due(time.monotonic_ns())
                    display.show(progress)
                if recording.recorder.failure:
                    failure = f"the recording failed: {recording.recorder.failure}"
                    break
                if interrupted.asked:
                    failure = "interrupted"
                    break
                if recording.lost is not None:
                    break
    except (KeyboardInterrupt, SystemExit):
        failure = "interrupted"
    except PartRunError as why:
        failure = str(why)
    except TookTooLong as why:
        who = stalled_in(plan, why)
        failure = f"stalled for {stall_timeout_s:.0f} s at t = {time_ns / 1e9:g} s: everyone waits for {who}"
    except BaseException as other:
        error = other
    wall_s = time.monotonic() - begun_s
    # From here on signals raise nothing, as before the loop.
    try:
        pass_on()
    except (SystemExit, PartRunError, TookTooLong):
        pass
    except BaseException as other:
        error = error or other
    try:
        with patience_with_bridge(plan, STOP_S):
            bridge.stop()
    except PartRunError as why:
        failure = failure or str(why)
    except TookTooLong as why:
        failure = failure or f"{stalled_in(plan, why)} takes longer than {STOP_S:g} s to stop the wheels"
    if error is not None:
        bridge.close()
        raise error
    recording.add(order.rest())
    links = engine.link_counts()
    recording.close(links)
    bridge.close()
    recorded = recording.report()
    failure = failure or (f"the recording failed: {recorded.failure}" if recorded.failure else None)
    can = bridge.report()
    if can is not None and engine.drives is not None:
        can = can.with_drives(engine.drives.report())
    return Outcome(
        trace=recorded.trace,
        links=links,
        processes=[],
        can=can,
        startup_s=0.0,
        wall_s=wall_s,
        messages=recorded.messages,
        failure=failure,
        stopped=recorded.stopped(plan),
    )


def _run_facts(plan: Plan, outcome: Outcome, engine: str, clock: str, begun: datetime, every_ns: int) -> RunFacts:
    """Returns the facts about a run for its summary: how it was made, how fast it was, what it used."""
    common_ns = outcome.trace.common_ns()
    # The period that begins at the last instant is simulated, too.
    simulated_s = (int(common_ns[-1]) + plan.robots[0].period_ns) / 1e9 if len(common_ns) else 0.0
    factor = simulated_s / outcome.wall_s if outcome.wall_s > 0 else None
    runners = [process.runner for process in outcome.processes if process.runner is not None]
    refusals = outcome.refusals()
    robots = {robot.name for robot in plan.robots}
    of_robots = [process.memory_bytes for process in outcome.processes if process.name in robots]
    return RunFacts(
        engine=engine,
        clock=clock,
        wall_time=outcome.wall_s,
        startup_time=outcome.startup_s,
        real_time_factor=factor,
        ticks_per_second=None if factor is None else factor * 1e9 / plan.robots[0].period_ns,
        messages=outcome.messages,
        failure=outcome.failure,
        stopped=outcome.stopped,
        date=begun.isoformat(timespec="seconds"),
        version=__version__,
        machine=f"{platform.platform()}, {platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        python=platform.python_version(),
        command=shlex.join(sys.argv),
        late_stages=sum(runner.late for runner in runners),
        stages=sum(runner.stages for runner in runners),
        latest=max((runner.latest_ns for runner in runners), default=0) / 1e9,
        refused=sum(each.messages for each in refusals),
        refusals=refusals,
        resident_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 if engine == "inprocess" else None,
        memory_bytes_robot_max=max(of_robots, default=None),
        processes={process.name: ProcessResult(process.cpu_s, process.memory_bytes) for process in outcome.processes},
        recorded_every=every_ns / 1e9 if every_ns else None,
        thinned=outcome.thinned,
        standstills={
            name: StandstillResult(lasted_ns / 1e9, from_ns / 1e9)
            for name, (lasted_ns, from_ns) in outcome.standstills.items()
        },
    )
