"""From a scenario and how it is to be run to a finished run: what the command `echelon run` and `echelon.run` share."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from echelon.errors import UsageError, UserError
from echelon.plan.plan import Plan
from echelon.scenario.tables import Scenario
from echelon.sim.bus_urls import bus_urls, check_wall_clock
from echelon.sim.finished_run import Run
from echelon.sim.out_folder import REPORT, OutFolder, out_folder, run_files
from echelon.sim.processes.children import warm_up
from echelon.sim.results.can_lines import some
from echelon.sim.run import execute
from echelon.sim.view.live import Display


@dataclass(frozen=True, slots=True, kw_only=True)
class Launch:
    """How a scenario is to be run; see `echelon run --help`.  Raises UsageError for an unknown engine or clock."""

    engine: Literal["processes", "inprocess"] = "processes"
    clock: Literal["virtual", "wall"] = "virtual"
    out: Path | None = None
    can: str | None = None
    report: bool = True
    quiet: bool = False
    stall_timeout_s: float = 30.0
    keep_going: bool = False
    replace: bool = False
    """Delete the run of another scenario that `out` holds"""

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("engine", self.engine, ("processes", "inprocess")),
            ("clock", self.clock, ("virtual", "wall")),
        ):
            if value not in allowed:
                raise UsageError(f"{name} = {value!r}: must be {' or '.join(map(repr, allowed))}")


def launch(scenario: Scenario, plan: Plan, options: Launch) -> Run:
    """Runs a scenario, writes its folder, and says on standard error how it stands.

    Raises UserError for options that do not go together, and OSError if a file of the run cannot be written."""
    if options.engine == "processes":
        warm_up()
    urls = bus_urls(plan, options.can, options.engine == "inprocess")
    _check(plan, options, urls)
    with ExitStack() as stack:
        files = run_files(plan, bool(urls) or plan.can.closed)
        try:
            folder = stack.enter_context(out_folder(scenario.name, options.out, files, options.replace))
        except OSError as error:
            if options.out is not None:
                raise UsageError(f"--out {options.out}: {error.strerror}") from None
            raise UsageError(f"{error.filename}: {error.strerror}; give a folder with --out") from None
        return _run_in(folder, scenario, plan, options, urls)


def _run_in(folder: OutFolder, scenario: Scenario, plan: Plan, options: Launch, urls: tuple[str, ...]) -> Run:
    display = Display(plan, quiet=options.quiet)
    if not options.quiet:
        display.say(_heading(plan, options, folder.path, urls))
    if folder.stays:
        display.say(f"{folder.path}: not of this run, and left as it is: {some(folder.stays)}")
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
            keep_going=options.keep_going,
        )
    except OSError as error:
        if error.filename is None:  # of a write to a file that was open
            error.filename = str(folder.path)
        raise
    finally:
        display.close()
    run = Run(trace, summary, folder.path)
    if options.report:
        from echelon.sim.run_folder import report_on  # matplotlib, when it is needed

        try:
            report_on([folder.path], folder.path / REPORT)
        except (UserError, OSError) as error:  # of a run that broke off there may be nothing to report
            run.report_failure = f"no report: {error}"
    return run


def _check(plan: Plan, options: Launch, urls: Sequence[str]) -> None:
    """Raises UsageError for options that do not go together."""
    if options.clock == "wall":
        if plan.can.closed and (not urls or options.engine == "inprocess"):
            raise UsageError("can.path = 'closed' with --clock wall: needs --engine processes and a bus")
        check_wall_clock(plan, urls)
    if plan.can.closed and options.engine == "processes" and not urls:
        raise UsageError("--can none: the closed torque path of several processes needs a bus; or --engine inprocess")
    if plan.can.closed and options.engine == "processes" and any(url.startswith("virtual") for url in urls):
        raise UsageError("--can virtual: is inside one process; the closed torque path of several needs another bus")
    if options.clock == "virtual" and not plan.can.virtual_drives:
        raise UsageError("can.virtual_drives = false: real drives need --clock wall")


def _heading(plan: Plan, options: Launch, folder: Path, urls: Sequence[str]) -> str:
    robots, nodes = len(plan.robots), len(plan.nodes)
    how = "in one process" if options.engine == "inprocess" else f"as {robots + nodes} processes over Zenoh"
    bus = f", frames on {', '.join(urls)}" if urls else ""
    path = f", {plan.can.path} torque path" if plan.can.closed else ""
    return f"{plan.name}: {robots} robots, {nodes - 1} leaders, 1 coordinator, {how}{path}{bus}; into {folder}"
