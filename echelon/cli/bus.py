"""Commands about CAN buses: `can`, `referee`, `drives`."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from echelon.cli.options import Command, option
from echelon.cli.shared import JSON, ScenarioOptions, seconds
from echelon.errors import UsageError

if TYPE_CHECKING:
    from echelon.plan.plan import Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class ListenOptions(ScenarioOptions):
    """Options of a command that listens to buses."""

    can: str | None = field(
        default=None,
        metadata=option(
            "where to listen; with several buses one URL for each, with commas between (default: what the scenario "
            "says; for a run's folder, its can.log)",
            "URL",
        ),
    )
    seconds: float | None = field(
        default=None, metadata=option("end after S seconds (default: at Ctrl-C)", "S", parse=seconds)
    )
    json: bool = field(default=False, metadata=JSON)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanOptions(ListenOptions):
    """Options of `echelon can`."""

    speed: float | None = field(
        default=None, metadata=option("replay a run's can.log, X times as fast as the run", "X")
    )


def can(options: CanOptions) -> int:
    """Shows the frames on a scenario's buses, or in a run's can.log, wheel by wheel."""
    from echelon.cli.showing import show_again, show_end, show_growing, show_live
    from echelon.sim.run_state import goes_on

    plan, folder = _plan_of(options)
    if folder is None or options.can is not None:
        if options.speed is not None:
            raise UsageError("--speed: is for a run's folder without --can; live frames come at their own speed")
        show_live(plan, options.can, options.seconds, options.json)
    elif options.speed is None and goes_on(folder):
        show_growing(plan, folder, options.seconds, options.json)
    elif options.speed is None:
        show_end(plan, folder, options.json)
    elif options.speed > 0:
        show_again(plan, folder, options.speed, options.seconds, options.json)
    else:
        raise UsageError(f"--speed {options.speed:g}: must be more than 0")
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class RefereeOptions(ListenOptions):
    """Options of `echelon referee`."""

    tolerance: float | None = field(
        default=None,
        metadata=option("how late a cyclic frame may be, live and with --log (default: half its period)", "S"),
    )
    log: Path | None = field(
        default=None,
        metadata=option(
            "judge this log: of candump (also as it shows frames), ASC, BLF, TRC, or python-can's CSV; also gzipped",
            "FILE",
        ),
    )
    map: tuple[str, ...] = field(
        default=(),
        metadata=option(
            "with --log: frames of this interface are those of this bus (vcan0=can0); may be repeated (default: equal "
            "names; a number in the log is that of a bus of the scenario, from 1)",
            "INTERFACE=BUS",
        ),
    )


def referee(options: RefereeOptions) -> int:
    """Prints what breaks the contract on a scenario's buses, or in a run's can.log.  Returns exit code 1 if something does."""
    from echelon.cli.judging import finding_lines, judge_foreign, judge_live, judge_run, verdict
    from echelon.sim.results.rendering import json_text
    from echelon.sim.run_state import goes_on

    plan, folder = _plan_of(options)
    if options.map and options.log is None:
        raise UsageError(f"--map {options.map[0]}: needs --log FILE")
    for name, value in (("--can", options.can), ("--seconds", options.seconds)):
        if options.log is not None and value is not None:
            raise UsageError(f"{name} {value}: is for live buses; --log {options.log} is judged as a whole")
    logged = options.log is not None or (folder is not None and options.can is None)
    if options.log is not None:
        report = judge_foreign(plan, options.log, options.map, options.tolerance)
    elif folder is not None and logged:
        if goes_on(folder):
            print(f"echelon: {folder}: the run goes on; this is about what its can.log holds so far", file=sys.stderr)
        report = judge_run(plan, folder)
    else:
        report = judge_live(plan, options.can, options.seconds, options.tolerance, quiet=options.json)
    if options.json:
        print(json_text(report))
    else:
        for line in finding_lines(report) if logged else ():  # live, they were printed as they were made
            print(line)
        print(verdict(report))
    return 1 if report.kinds else 0


def _plan_of(options: ListenOptions) -> "tuple[Plan, Path | None]":
    """Returns the plan of the scenario, and the run's folder if the argument SCENARIO names one.  Raises UserError."""
    from echelon.cli.scenario_file import read_scenario
    from echelon.shipped import run_folder

    folder = run_folder(options.scenario)
    if folder is not None and options.overrides:
        raise UsageError(f"--set {options.overrides[0]}: is for a scenario; {folder} is the folder of a run")
    return read_scenario(options.scenario, options.overrides)[1], folder


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivesOptions(ScenarioOptions):
    """Options of `echelon drives`."""

    can: str | None = field(
        default=None,
        metadata=option(
            "where the drives are: socketcan:vcan0, udp_multicast:<group>:<port>, or auto; with several buses one URL for "
            "each, with commas between (default: what the scenario says)",
            "URL",
        ),
    )
    seconds: float | None = field(
        default=None, metadata=option("end after S seconds (default: at Ctrl-C)", "S", parse=seconds)
    )
    json: bool = field(
        default=False, metadata=option("print JSON: an object about the drives, then one with their state every second")
    )


def drives(options: DrivesOptions) -> int:
    """Runs the virtual drives of a scenario alone, in real time."""
    from echelon.bridge.can.claim import DRIVES
    from echelon.cli.drive_bench import serve
    from echelon.cli.scenario_file import read_scenario
    from echelon.sim.bus_urls import bus_urls, check_wall_clock, claimed

    _, plan = read_scenario(options.scenario, [*options.overrides, "can.path=closed", "can.virtual_drives=true"])
    urls = bus_urls(plan, options.can, False)
    if not urls or any(url.startswith("virtual") for url in urls):
        raise UsageError(
            "drives need a bus that other processes can use: give --can socketcan:vcan0, udp_multicast: or auto"
        )
    check_wall_clock(plan, urls)
    with claimed(urls, DRIVES):
        serve(plan, urls, options.seconds, options.json)
    return 0


COMMANDS: Final[tuple[Command[Any], ...]] = (
    Command(
        name="drives",
        live=True,
        options=DrivesOptions,
        work=drives,
        about="""\
Runs the virtual drives of a scenario on its buses, in real time and without robots, to try your
own host on them.  Wheels turn freely.  Faults of drives that the scenario schedules happen, at
times counted from the start of this command.""",
        examples={
            "echelon drives lab --can auto": "on vcan0 if it exists, else on a multicast bus; prints which",
            "echelon drives lab --set robot.drive.protocol=odrive --can socketcan:vcan0": "nine robots with ODrives",
            "echelon drives lab --seconds 1.0 --json": "for scripts",
        },
        codes={0: "ended, by Ctrl-C or by --seconds", 141: "nobody reads it any more"},
    ),
    Command(
        name="can",
        live=True,
        options=CanOptions,
        work=can,
        about="""\
Shows the torque, state and faults of every wheel, as the frames on the buses say them, with
frame rates and bus loads: in a terminal a live table, otherwise a line every second.  For the
folder of a run it reads can.log: it shows how the run ended, or follows a run that goes on.""",
        examples={
            "echelon can lab --can socketcan:vcan0": "live",
            "echelon can runs/demo": "how a run ended, or a run that goes on",
            "echelon can runs/demo --speed 10.0 --json": "a run ten times as fast, an object every second",
        },
        codes={0: "shown", 141: "nobody reads it any more"},
    ),
    Command(
        name="referee",
        options=RefereeOptions,
        work=referee,
        about="""\
Judges the frames on the buses, and nothing else: periods, counters, checksums, limits, state
machines, silence.  Prints what breaks the contract between the scenario's drives and their
host.  Lines of a log that cannot be read, and frames of other interfaces, are counted and are
no findings; if nothing else is left, the exit code is 2.""",
        examples={
            "echelon referee runs/demo": "the can.log of a run",
            "echelon referee lab --can socketcan:vcan0 --seconds 10.0": "live",
            "echelon referee lab --log candump.log --map vcan0=can0": "what another program logged",
        },
        codes={0: "no findings", 1: "something breaks the contract"},
    ),
)
