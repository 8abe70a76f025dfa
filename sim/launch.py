"""Launches a run: checks the options, makes the folder, runs the plan, writes the report.

The command `echelon run` and the function `echelon.run` both use it.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from echelon.bridge.can.link_kind import is_hardware
from echelon.errors import UsageError, UserError
from echelon.plan.plan import Plan
from echelon.planning.members import MAX_ROBOTS
from echelon.scenario.tables import Scenario
from echelon.sim.bus_urls import NO_MULTICAST, bus_urls, check_wall_clock, claimed, sides_of
from echelon.sim.finished_run import Run
from echelon.sim.interruption import Interruption, interruption
from echelon.sim.out_folder import REPORT, OutFolder, out_folder, run_files
from echelon.sim.processes.children import warm_up
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.results.can_lines import some
from echelon.sim.run import execute
from echelon.sim.view.live import Display


@dataclass(frozen=True, slots=True, kw_only=True)
class Launch:
    """Options of a run, named as in `echelon run --help`.  Raises UsageError for an unknown engine or clock."""

    engine: Literal["processes", "inprocess"] = "processes"
    clock: Literal["virtual", "wall"] = "virtual"
    out: Path | None = None
    """Folder of the run; None: a new one in `runs/`"""
    can: str | None = None
    """URLs of the buses, with commas between; `none`: no frames; None: what the scenario says"""
    report: bool = True
    """Write report.html"""
    quiet: bool = False
    """Show no progress"""
    stall_timeout_s: float = 30.0
    """A run in virtual time that makes no progress for this time is given up [s]"""
    ends_at: EndsAt = EndsAt.DIVERGED
    """Where the run ends before its duration is over"""
    replace: bool = False
    """Delete the run of another scenario that is in `out`"""
    real_bus: bool = False
    """Let a run in virtual time, or one that mirrors torques, send its frames onto a bus of hardware"""
    observe: bool = False
    """Open the run for observers, who can read and never write"""

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("engine", self.engine, ("processes", "inprocess")),
            ("clock", self.clock, ("virtual", "wall")),
        ):
            if value not in allowed:
                raise UsageError(f"{name} = {value!r}: must be {' or '.join(map(repr, allowed))}")


def launch(scenario: Scenario, plan: Plan, options: Launch) -> Run:
    """Runs a scenario and writes its folder; shows progress on standard error.

    `plan` is the plan of `scenario`.  A run that breaks off is returned, too, with the reason as its `failure`.  Raises
    UserError for options that contradict each other, and OSError if a file of the run cannot be written."""
    if options.engine == "processes":
        warm_up(plan)
    urls = bus_urls(plan, options.can, options.engine == "inprocess")
    _check(plan, options, urls)
    with ExitStack() as stack:
        stack.enter_context(claimed(urls, *sides_of(plan)))
        files = run_files(plan, bool(urls) or plan.can.closed, options.observe)
        try:
            folder = stack.enter_context(out_folder(scenario.name, options.out, files, options.replace))
        except OSError as error:
            if options.out is not None:
                why = "is a file, and must be a folder" if isinstance(error, FileExistsError) else error.strerror
                raise UsageError(f"--out {options.out}: {why}") from None
            raise UsageError(f"{error.filename}: {error.strerror}; give a folder with --out") from None
        interrupted = stack.enter_context(interruption())
        return _run_in(folder, scenario, plan, options, urls, interrupted)


def _run_in(
    folder: OutFolder,
    scenario: Scenario,
    plan: Plan,
    options: Launch,
    urls: tuple[str, ...],
    interrupted: Interruption,
) -> Run:
    """Runs a scenario in a folder that is made and locked.  Raises OSError."""
    display = Display(plan, quiet=options.quiet)
    if not options.quiet:
        display.say(_heading(plan, options, folder.path, urls))
    if not urls and options.can is None and plan.can.enabled:
        display.say(f"no CAN frames: no vcan0 is up, and {NO_MULTICAST}")
    if folder.stays:
        display.say(f"{folder.path}: holds files of other runs, which stay: {some(folder.stays)}")
    try:
        summary, trace = execute(
            scenario,
            plan,
            folder,
            engine=options.engine,
            clock=options.clock,
            can_urls=urls,
            display=display,
            stall_timeout_s=options.stall_timeout_s,
            ends_at=options.ends_at,
            observe=options.observe,
            interrupted=interrupted,
        )
    except OSError as error:
        if error.filename is None:  # a write to an open file failed
            error.filename = str(folder.path)
        raise
    finally:
        display.close()
    run = Run(trace, summary, folder.path)
    if options.report:
        from echelon.sim.run_folder import report_on  # imported here because it imports matplotlib, which takes long

        try:
            report_on([folder.path], folder.path / REPORT)
        except (UserError, OSError) as error:  # a run that broke off early may have no states
            run.report_failure = f"no report: {error}"
    return run


def _check(plan: Plan, options: Launch, urls: Sequence[str]) -> None:
    """Raises UsageError for options that contradict each other or the plan."""
    if urls and not plan.can.enabled and len(plan.robots) > MAX_ROBOTS:
        raise UsageError(f"--can: {len(plan.robots)} robots, but a bus has identifiers for {MAX_ROBOTS}")
    if options.clock == "wall":
        if plan.can.closed and (not urls or options.engine == "inprocess"):
            raise UsageError("can.path = 'closed' with --clock wall: needs --engine processes, and a bus")
        check_wall_clock(plan, urls)
    if plan.can.closed and options.engine == "processes" and not urls:
        raise UsageError("--can none: the closed torque path needs a bus, unless --engine inprocess is given")
    if plan.can.closed and options.engine == "processes" and any(url.startswith("virtual") for url in urls):
        raise UsageError(
            "--can virtual: is a bus inside one process; the closed torque path needs one between processes"
        )
    hardware = [] if options.real_bus else [url for url in urls if is_hardware(url)]
    if hardware and (options.clock == "virtual" or not plan.can.closed):
        how = (
            "in virtual time, as fast as they are made" if options.clock == "virtual" else "without hearing the drives"
        )
        raise UsageError(
            f"--can {hardware[0]}: is hardware, and this run sends torques {how}; give --real-bus if that is what you want, "
            "or a virtual bus"
        )
    if options.observe and options.engine == "inprocess":
        raise UsageError("--observe: needs --engine processes; nobody can read a run in one process")
    if options.clock == "virtual" and not plan.can.virtual_drives:
        raise UsageError("can.virtual_drives = false: real drives need --clock wall")


def _heading(plan: Plan, options: Launch, folder: Path, urls: Sequence[str]) -> str:
    """Returns the line that is shown when a run begins."""
    robots, nodes = len(plan.robots), len(plan.nodes)
    how = "in one process" if options.engine == "inprocess" else f"as {robots + nodes} processes over Zenoh"
    bus = f", frames on {', '.join(urls)}" if urls else ""
    path = f", {plan.can.path} torque path" if plan.can.closed else ""
    return f"{plan.name}: {robots} robots, {nodes - 1} leaders, 1 coordinator, {how}{path}{bus}; into {folder}"
