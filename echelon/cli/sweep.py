"""The command `echelon sweep`: many runs of a scenario with values that vary."""

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON, OVERRIDES, SCENARIO
from echelon.errors import UsageError

if TYPE_CHECKING:
    from echelon.sim.sweep.origin import Origin
    from echelon.sim.sweep.preparing import Prepared, Request
    from echelon.sim.sweep.study import Sweep

SHOWN_POINTS: Final = 24
"""How many points are printed; of further points only the number is"""


def _count(text: str) -> int:
    if not text.isascii() or not text.isdecimal() or len(text) > 9:
        raise ValueError(f"{text!r}: must be a whole number")
    return int(text)


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions:
    """Options of `echelon sweep`."""

    scenario: str | None = field(default=None, metadata=argument(SCENARIO, "SCENARIO"))
    overrides: tuple[str, ...] = field(default=(), metadata=OVERRIDES)
    vary: tuple[str, ...] = field(
        default=(),
        metadata=option(
            "values of a key: a range links.uplink.delay=0:0.4:0.02, or a list law.lead=0,0.5,1; may be repeated",
            "KEY=VALUES",
        ),
    )
    zip: bool = field(
        default=False, metadata=option("take the first values of all keys, the second ones, …, instead of their grid")
    )
    random: int | None = field(
        default=None, metadata=option("N random points, evenly distributed over the ranges", "N", parse=_count)
    )
    sobol: int | None = field(
        default=None, metadata=option("N points of a Sobol' sequence; a power of two", "N", parse=_count)
    )
    find: str | None = field(
        default=None,
        metadata=option(
            "search for the largest value at which enough runs hold and E|e|² does not grow, at each point of what varies",
            "KEY=LO:HI:STEP",
        ),
    )
    share: float | None = field(
        default=None,
        metadata=option("with --find: share of its runs that must hold for a point to hold (default: 0.9)", "P"),
    )
    seeds: int | None = field(
        default=None,
        metadata=option(
            "runs at each point, with the scenario's seed and those after it (default: 1; 64 for a search over random links)",
            "N",
            parse=_count,
        ),
    )
    engine: Literal["batch", "gpu", "inprocess", "processes"] | None = field(
        default=None,
        metadata=option("who makes the runs (default: batch where it can, otherwise inprocess)"),
    )
    workers: str | None = field(
        default=None,
        metadata=option(
            "number of workers, or the address of a dask scheduler, tcp://host:port (default: one for each processor)",
            "N",
        ),
    )
    out: Path | None = field(
        default=None, metadata=option("folder for the tables (default: runs/<scenario>-sweep-<utc time>)", "DIR")
    )
    resume: Path | None = field(default=None, metadata=option("go on with the sweep in this folder", "DIR"))
    allow_unstable: bool = field(
        default=False, metadata=option("sweep though the scenario is unstable before a value is varied")
    )
    quiet: bool = field(default=False, metadata=option("show no progress"))
    json: bool = field(default=False, metadata=JSON)


def sweep(options: SweepOptions) -> int:
    """Makes the runs of a sweep and prints what they say."""
    from echelon.sim.sweep.preparing import prepare
    from echelon.sim.sweep.sweep import run
    from echelon.sim.sweep.workers import parse_workers
    from echelon.sim.view.sweep_progress import SweepDisplay

    try:
        workers = None if options.workers is None else parse_workers(options.workers)
    except ValueError as error:
        raise UsageError(f"--workers {error}") from None
    prepared = prepare(_request(options))
    out = options.resume or options.out or _new_folder(prepared)
    done = total = 0

    def show(now: int, of: int, before: int) -> None:
        nonlocal done, total
        if not total and not options.quiet:
            print(_heading(prepared, out), file=sys.stderr, flush=True)
        done, total = now, of
        display.show(now, of, before)

    try:
        with SweepDisplay(_notes(prepared), quiet=options.quiet) as display:
            made = run(prepared, out, workers, show)
    except KeyboardInterrupt:
        print(
            f"echelon: interrupted; {done} of {total} runs are kept; go on with: echelon sweep --resume {out}",
            file=sys.stderr,
        )
        return 3
    except OSError as error:
        print(f"echelon: {error.filename or out}: {error.strerror or error}", file=sys.stderr)
        return 3
    print(json.dumps(_facts(made), indent=2) if options.json else _text(made))
    return 0


def _request(options: SweepOptions) -> "Request":
    from echelon.sim.sweep.folder import resumed
    from echelon.sim.sweep.preparing import SHARE, Request
    from echelon.sim.sweep.search import Search
    from echelon.sim.sweep.values import parse_vary

    if options.resume is not None:
        kept = replace(
            SweepOptions(), resume=options.resume, workers=options.workers, quiet=options.quiet, json=options.json
        )
        if options != kept:
            raise UsageError(
                f"--resume {options.resume}: takes scenario, values and seeds from that folder; "
                "beside it only --workers, --quiet and --json can be given"
            )
        return resumed(options.resume)
    if options.scenario is None:
        raise UsageError("give a scenario, or the folder of a sweep with --resume")
    kinds = {
        "zip": options.zip,
        "random": options.random is not None,
        "sobol": options.sobol is not None,
    }
    chosen = [name for name, is_given in kinds.items() if is_given]
    if len(chosen) > 1:
        raise UsageError(f"--{' and --'.join(chosen)}: only one design can be given")
    if options.share is not None and options.find is None:
        raise UsageError("--share: is for a search; give --find too")
    samples = options.random if options.random is not None else options.sobol
    return Request(
        origin=_origin(options.scenario, options.overrides),
        varied=tuple(parse_vary(text) for text in options.vary),
        kind=chosen[0] if chosen else "grid",  # type: ignore[arg-type]
        samples=samples or 0,
        search=None if options.find is None else Search.parse(options.find),
        share=SHARE if options.share is None else options.share,
        seeds=options.seeds,
        engine=options.engine,
        allow_unstable=options.allow_unstable,
    )


def _origin(name: str, overrides: tuple[str, ...]) -> "Origin":
    from echelon.cli.scenario_file import STANDARD_INPUT, read_text
    from echelon.shipped import scenario_path
    from echelon.sim.sweep.origin import Origin

    if name == STANDARD_INPUT:
        return Origin(read_text(), "standard input", Path(), overrides)
    return Origin.of_file(scenario_path(name), overrides)


def _new_folder(prepared: "Prepared") -> Path:
    from echelon.sim.out_folder import new_folder

    try:
        return new_folder(f"{prepared.nominal.scenario.name}-sweep")
    except OSError as error:
        raise UsageError(f"{error.filename}: {error.strerror}; give a folder with --out") from None


def _notes(prepared: "Prepared") -> list[str]:
    from importlib.util import find_spec

    notes = [f"note: {note}" for note in prepared.notes]
    if find_spec("pyarrow") is None:
        notes.append("note: no Parquet files without pyarrow: pip install 'echelon[parquet]'")
    return notes


def _heading(prepared: "Prepared", out: Path) -> str:
    points, seeds = len(prepared.points), len(prepared.seeds)
    each = f"{seeds} run{'s' if seeds > 1 else ''} each"
    name, search = prepared.nominal.scenario.name, prepared.request.search
    if search is not None:
        what = f"search for the largest {search.key} that holds, {each}" + (f", {points} times" if points > 1 else "")
    else:
        what = f"{points} point{'s' if points > 1 else ''}, {each}"
    return f"{name}: {what}, engine {prepared.engine}; into {out}"


def _text(done: "Sweep") -> str:
    """Returns what a sweep says, for people."""
    points = done.points
    count = f"{len(points)} point{'s' if len(points) > 1 else ''}"
    lines = [f"{done.scenario}: {len(done.runs)} runs at {count}, engine {done.engine}"]
    for row in range(min(len(points), SHOWN_POINTS)):
        at = ", ".join(f"{key} = {_number(points[key][row])}" for key in done.keys)
        share = f"{points['holds'][row]} of {points['runs'][row]} hold"
        low, high = (100 * float(points[name][row]) for name in ("share_low", "share_high"))
        share += f" ({low:.4g} to {high:.4g} %)" if points["runs"][row] > 1 else ""
        lines.append(f"  {at:<40} {share}" if at else f"  {share}")
    if len(points) > SHOWN_POINTS:
        lines.append(f"  and {len(points) - SHOWN_POINTS} points more")
    lines += [f"  {found.text}" for found in done.find]
    lines.append(f"  folder   {done.folder}")
    return "\n".join(lines)


def _number(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _facts(done: "Sweep") -> dict[str, object]:
    """Returns what a sweep says, as data for JSON."""
    from dataclasses import asdict
    from math import isfinite

    def plain(value: object) -> object:
        return None if isinstance(value, float) and not isfinite(value) else value

    columns = {name: column.tolist() for name, column in done.points.columns.items()}
    rows = [dict(zip(columns, map(plain, row), strict=True)) for row in zip(*columns.values(), strict=True)]
    found = [asdict(each) | {"at": dict(each.at), "text": each.text} for each in done.find]
    return {"scenario": done.scenario, "folder": str(done.folder), "engine": done.engine, "points": rows, "find": found}


COMMANDS: Final = (
    Command(
        name="sweep",
        options=SweepOptions,
        work=sweep,
        about="""\
Runs a scenario many times, with values that vary and with paired seeds, on all processors.
Leaves one folder: runs.csv with a row for each run, points.csv with the share of runs that hold
at each point, both as Parquet too where pyarrow is installed, and find.json with the boundary
that --find found.  A sweep that was interrupted or killed goes on with --resume, or with the
same command: finished runs are not made again.""",
        examples={
            "echelon sweep lab --set duration=30 --seeds 8000 --out runs/many": "8000 runs of one scenario",
            "echelon sweep lab --vary law.lead=0:1:0.5 --set duration=20": "three values, into a new folder",
            'echelon sweep lab --set \'links=[{name="up",channel="state"}]\' --vary links.up.loss=0:0.4:0.2 '
            "--vary links.up.delay=0,0.05 --seeds 3 --set duration=20": "a grid of loss and delay on one link",
            'echelon sweep lab --set \'links=[{name="up",channel="state"}]\' --set duration=60 --set claims=[] '
            "--find links.up.delay=0:0.5:0.01": "the largest delay at which errors do not grow",
        },
        codes={0: "done, whatever the verdicts of the runs"},
    ),
)
