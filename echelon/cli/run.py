"""The command `echelon run`."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from echelon.cli.options import Command, option
from echelon.cli.shared import ScenarioOptions, seconds
from echelon.sim.interruption import interruption
from echelon.sim.processes.ends_at import EndsAt


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions(ScenarioOptions):
    """Options of `echelon run`."""

    engine: Literal["processes", "inprocess"] = field(
        default="processes",
        metadata=option("processes: every role its own process, over Zenoh; inprocess: all roles in one process"),
    )
    clock: Literal["virtual", "wall"] = field(
        default="virtual",
        metadata=option("virtual: as fast as messages come, repeatable bit for bit; wall: paced by real time"),
    )
    out: Path | None = field(
        default=None, metadata=option("folder of the run (default: runs/<scenario>-<utc time>)", "DIR")
    )
    replace: bool = field(
        default=False, metadata=option("if the folder of --out holds a run of another scenario, delete that run")
    )
    can: str | None = field(
        default=None,
        metadata=option(
            "where CAN frames go: socketcan:vcan0, udp_multicast:<group>:<port>, virtual, auto or none; with several "
            "buses one URL for each, with commas between (default: what the scenario says)",
            "URL",
        ),
    )
    real_bus: bool = field(
        default=False,
        metadata=option("let a run in virtual time, or one that mirrors torques, send frames onto a bus of hardware"),
    )
    json: bool = field(default=False, metadata=option("print the summary as JSON"))
    quiet: bool = field(default=False, metadata=option("show no progress while the run goes on"))
    no_report: bool = field(default=False, metadata=option("do not write report.html"))
    keep_going: bool = field(
        default=False,
        metadata=option(
            "go on when a robot has diverged (far beyond its reach, or not finite); without it the run stops there"
        ),
    )
    observe: bool = field(
        default=False,
        metadata=option("let others read the run while it goes on (echelon observe); they can never write"),
    )
    stall_timeout: float = field(
        default=30.0,
        metadata=option(
            "give up a run that makes no progress for S seconds; on a wall clock, one in which a robot, leader or coordinator "
            "stands still for so long",
            "S",
            parse=seconds,
        ),
    )


def run(options: RunOptions) -> int:
    """Runs a scenario, writes its folder, and prints the summary."""
    # Signals are noted from the start on, so that one before the run leaves no process and no folder behind.
    with interruption() as noted:
        try:
            return _run(options)
        except Exception:
            if noted.asked:  # libraries make other exceptions of an interrupt
                raise KeyboardInterrupt from None
            raise


def _run(options: RunOptions) -> int:
    from echelon.cli.scenario_file import read_scenario

    scenario, plan = read_scenario(options.scenario, options.overrides)
    if options.engine == "processes":
        from echelon.sim.processes.children import warm_up

        warm_up(plan)  # before the imports below, which take as long
    from echelon.sim.launch import Launch, launch
    from echelon.sim.results.rendering import json_text
    from echelon.sim.results.summary import summary_text

    try:
        finished = launch(
            scenario,
            plan,
            Launch(
                engine=options.engine,
                clock=options.clock,
                out=options.out,
                can=options.can,
                report=not options.no_report,
                quiet=options.quiet,
                stall_timeout_s=options.stall_timeout,
                ends_at=EndsAt.NOWHERE if options.keep_going else EndsAt.DIVERGED,
                replace=options.replace,
                real_bus=options.real_bus,
                observe=options.observe,
            ),
        )
    except OSError as error:
        for line in (*getattr(error, "__notes__", ()), f"{error.filename}: {error.strerror or error}"):
            print(f"echelon: {line}", file=sys.stderr)
        return 3
    if options.json:
        print(json_text(finished.summary))
    else:
        print(summary_text(finished.summary))
        print(f"  folder   {finished.folder}")
    if failure := finished.failure or finished.report_failure:
        print(f"echelon: {failure}", file=sys.stderr)
        return 3
    return 1 if finished.verdict.fails else 0


COMMANDS: Final = (
    Command(
        name="run",
        options=RunOptions,
        work=run,
        about="""\
Runs a scenario and leaves one folder: report.html, run.mcap (for Foxglove, PlotJuggler and the
like), can.log, torque.dbc, summary.json, run.json (where its buses are, from the start), and
scenario.toml with every default written out.
Given the folder of a run, it runs that scenario again, into a new folder.""",
        examples={
            "echelon run paper": "the paper's nine robots, thirteen processes over Zenoh",
            "echelon run lab --clock wall": "in real time, torques on the CAN bus",
            "echelon run paper --set avoidance.enabled=true --out runs/avoiding": "one value changed, into a folder of yours",
            "echelon run runs/demo --set duration=1.0": "the scenario of an earlier run again",
            "echelon run - --quiet --json < my.toml": "from a script",
        },
        codes={0: "HOLDS, or HEALTHY where nothing is claimed", 1: "FAILS"},
    ),
)
