"""`echelon run`: from what the user typed to a run, its folder, and the exit code."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from echelon.cli.options import Command, option
from echelon.cli.shared import ScenarioOptions, seconds
from echelon.errors import UsageError, UserError

if TYPE_CHECKING:
    from echelon.plan import Plan
    from echelon.scenario import Scenario


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions(ScenarioOptions):
    """Options of `echelon run`."""

    engine: Literal["processes", "inprocess"] = field(
        default="processes", metadata=option("every role its own process over Zenoh, or all roles in one process")
    )
    clock: Literal["virtual", "wall"] = field(
        default="virtual",
        metadata=option("as fast as messages come, bit for bit repeatable; or paced by real time"),
    )
    out: Path | None = field(
        default=None, metadata=option("folder of the run (default: runs/<scenario>-<utc time>)", "DIR")
    )
    can: str | None = field(
        default=None,
        metadata=option(
            "where frames go: socketcan:vcan0, udp_multicast:<group>:<port>, virtual, auto or none; one for each bus, "
            "with commas between (default: what the scenario says)",
            "URL",
        ),
    )
    json: bool = field(default=False, metadata=option("print the summary as JSON"))
    quiet: bool = field(default=False, metadata=option("show no progress"))
    no_report: bool = field(default=False, metadata=option("write no report.html"))
    stall_timeout: float = field(
        default=30.0,
        metadata=option("give a run up that stands still for so long, in virtual time", "S", parse=seconds),
    )


def run(options: RunOptions) -> int:
    """Runs a scenario; leaves a folder."""
    if options.engine == "processes":
        from echelon.sim.children import warm_up

        warm_up()
    from echelon.cli.bus_urls import bus_urls
    from echelon.cli.scenario_file import read_scenario
    from echelon.sim.live import Display
    from echelon.sim.results.rendering import json_text
    from echelon.sim.results.summary import summary_text
    from echelon.sim.run import execute

    scenario, plan = read_scenario(options.scenario, options.overrides)
    can_urls = bus_urls(plan, options.can, options.engine == "inprocess")
    _check(plan, options, can_urls)
    folder = _folder(scenario, options.out)
    display = Display(plan, quiet=options.quiet)
    if not options.quiet:
        display.say(_heading(plan, options, folder, can_urls))
    try:
        finished = execute(
            scenario,
            plan,
            folder,
            engine=options.engine,
            clock=options.clock,
            can_urls=can_urls,
            display=display,
            stall_timeout_s=options.stall_timeout,
        )
    except OSError as error:
        print(f"echelon: {error.filename or folder}: {error.strerror or error}", file=sys.stderr)
        return 3
    finally:
        display.close()
    failure = finished.failure
    if not options.no_report:
        try:
            from echelon.sim.run_folder import report_on  # matplotlib, when it is needed

            report_on([folder], folder / "report.html")
        except (UserError, OSError) as error:  # of a run that broke off there may be nothing to report
            failure = failure or f"no report: {error}"
    if options.json:
        print(json_text(finished.summary))
    else:
        print(summary_text(finished.summary))
        print(f"  folder   {folder}")
    if failure:
        print(f"echelon: {failure}", file=sys.stderr)
        return 3
    return 0 if finished.summary.verdict.holds else 1


def _check(plan: "Plan", options: RunOptions, can_urls: Sequence[str]) -> None:
    """Raises UsageError for options that do not go together."""
    from echelon.cli.bus_urls import check_wall_clock

    if options.clock == "wall":
        if plan.can.closed and (not can_urls or options.engine == "inprocess"):
            raise UsageError("can.path = 'closed' with --clock wall: needs --engine processes and a bus")
        check_wall_clock(plan, can_urls)
    if plan.can.closed and options.engine == "processes" and not can_urls:
        raise UsageError("--can none: the closed torque path of several processes needs a bus; or --engine inprocess")
    if plan.can.closed and options.engine == "processes" and any(url.startswith("virtual") for url in can_urls):
        raise UsageError("--can virtual: is inside one process; the closed torque path of several needs another bus")
    if options.clock == "virtual" and not plan.can.virtual_drives:
        raise UsageError("can.virtual_drives = false: real drives need --clock wall")


def _folder(scenario: "Scenario", out: Path | None) -> Path:
    """Returns the folder of the run, made.  Raises UsageError."""
    from echelon.sim.run import new_folder

    try:
        return new_folder(scenario, out)
    except OSError as error:
        if out is not None:
            raise UsageError(f"--out {out}: {error.strerror}") from None
        raise UsageError(f"{error.filename}: {error.strerror}; give a folder with --out") from None


def _heading(plan: "Plan", options: RunOptions, folder: Path, can_urls: Sequence[str]) -> str:
    robots, nodes = len(plan.robots), len(plan.nodes)
    how = "in one process" if options.engine == "inprocess" else f"as {robots + nodes} processes over Zenoh"
    bus = f", frames on {', '.join(can_urls)}" if can_urls else ""
    path = f", {plan.can.path} torque path" if plan.can.closed else ""
    return f"{plan.name}: {robots} robots, {nodes - 1} leaders, 1 coordinator, {how}{path}{bus}; into {folder}"


COMMANDS: Final = (
    Command(
        name="run",
        options=RunOptions,
        work=run,
        about="""\
Runs a scenario and leaves one folder: report.html, run.mcap (for Foxglove, PlotJuggler and the
like), can.log, torque.dbc, summary.json, and scenario.toml with every default written out.
Given the folder of a run, it runs that scenario again, into a new folder.""",
        examples={
            "echelon run paper": "the paper's nine robots, thirteen processes over Zenoh",
            "echelon run lab --clock wall": "in real time, torques on the CAN bus",
            "echelon run paper --set avoidance.enabled=true --out runs/avoiding": "one value changed, into a folder of yours",
            "echelon run runs/demo --set duration=1.0": "the scenario of an earlier run again",
            "echelon run - --quiet --json < my.toml": "from a script",
        },
        codes={0: "the verdict holds", 1: "the verdict fails"},
    ),
)
