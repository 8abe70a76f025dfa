"""Commands about the folders of runs: `report`, `export`, `recover`."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON
from echelon.errors import UsageError

if TYPE_CHECKING:
    from echelon.sim.recording.mcap_reader import RecoverResult


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """Options of `echelon report`."""

    runs: tuple[Path, ...] = field(metadata=argument("the folder of a run; several folders give a comparison", "RUN"))
    out: Path | None = field(
        default=None,
        metadata=option(
            "file to write (default: report.html in the run's folder; of several runs, in this folder)", "FILE"
        ),
    )
    figures: Path | None = field(
        default=None,
        metadata=option("write each figure as a file into this folder, and no page unless --out is given", "DIR"),
    )
    format: tuple[Literal["svg", "pdf", "png"], ...] = field(
        default=(), metadata=option("format of the files of --figures; may be repeated (default: svg)")
    )
    json: bool = field(default=False, metadata=JSON)


def report(options: ReportOptions) -> int:
    """Writes the report of a run, or a comparison of several; or its figures, each as a file."""
    from echelon.sim.report.report import save_figures, write_report
    from echelon.sim.run_folder import runs_for_report

    if options.format and options.figures is None:
        raise UsageError(f"--format {options.format[0]}: needs --figures DIR, which writes the figures as files")
    path = options.out
    if path is None and options.figures is None:
        path = options.runs[0] / "report.html" if len(options.runs) == 1 else Path("report.html")
        if not _may_replace(path):
            raise UsageError(f"{path}: exists, and echelon did not write it; give another file with --out")
    runs, written = runs_for_report(options.runs), list[Path]()
    try:
        if options.figures is not None:
            written = save_figures(runs, options.figures, options.format or ("svg",))
        if path is not None:
            write_report(runs, path)
    except OSError as error:
        raise UsageError(f"{error.filename or path}: {error.strerror}") from None
    if options.json:
        page = None if path is None else str(path)
        print(json.dumps({"report": page, "figures": list(map(str, written)), "runs": list(map(str, options.runs))}))
    else:
        print(*written, *(() if path is None else (path,)), sep="\n")
    return 0


def _may_replace(path: Path) -> bool:
    """Returns whether there is no file at `path`, or one that this command wrote earlier."""
    from echelon.sim.report.page import GENERATOR

    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return GENERATOR in file.read(1000)
    except OSError:  # there is no file; or it cannot be read, and writing it will fail with a reason
        return True


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Options of `echelon export`."""

    run: Path = field(metadata=argument("the folder of a run", "RUN"))
    csv: Path | None = field(default=None, metadata=option("folder for CSV files (default: RUN/csv)", "DIR"))
    parquet: Path | None = field(
        default=None,
        metadata=option("folder for Parquet files; needs pyarrow; CSV is then written only if --csv is given", "DIR"),
    )
    replace: bool = field(default=False, metadata=option("overwrite tables that these folders hold already"))
    json: bool = field(default=False, metadata=JSON)


def export(options: ExportOptions) -> int:
    """Writes a run's tables as CSV or Parquet."""
    from echelon.sim.export import export_csv, export_parquet, in_the_way
    from echelon.sim.run_folder import open_run

    run = open_run(options.run)
    asked = [("--parquet ", export_parquet, options.parquet), ("--csv ", export_csv, options.csv)]
    jobs = [(flag, write, folder) for flag, write, folder in asked if folder is not None]
    jobs = jobs or [("", export_csv, options.run / "csv")]
    if not options.replace:
        for flag, write, folder in jobs:  # before the first file is written
            if there := in_the_way(run, folder, "csv" if write is export_csv else "parquet"):
                raise UsageError(
                    f"{flag}{folder}: holds {', '.join(there)} already; give another folder, or --replace to overwrite"
                )
    written: dict[str, list[str]] = {}
    for flag, write, folder in jobs:
        try:
            written[str(folder)] = [path.name for path in write(run, folder)]
        except OSError as error:
            raise UsageError(f"{flag}{folder}: {error.strerror}") from None
    if options.json:
        print(json.dumps({"run": str(options.run), "files": written}))
    else:
        for where, names in written.items():
            print(f"{where}: {', '.join(names)}")
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoverOptions:
    """Options of `echelon recover`."""

    what: Path = field(metadata=argument("the folder of a run, or an MCAP file that is cut short or damaged", "RUN"))
    out: Path | None = field(
        default=None,
        metadata=option("of an MCAP file: where to write the mended one (default: <file>-recovered.mcap)", "FILE"),
    )
    json: bool = field(default=False, metadata=JSON)


def recover(options: RecoverOptions) -> int:
    """Rebuilds the folder of a run that was killed, or mends a recording that is cut short."""
    try:
        return _recover_folder(options) if options.what.is_dir() else _recover_file(options)
    except OSError as error:
        raise UsageError(f"{error.filename or options.what}: {error.strerror}") from None
    except ValueError as error:  # its text begins with the name of the file
        raise UsageError(str(error)) from None


def _recover_folder(options: RecoverOptions) -> int:
    from echelon.sim.recovery import recover_run

    if options.out is not None:
        raise UsageError(f"--out {options.out}: the folder of a run is mended in place; --out is for a file")
    done = recover_run(options.what)
    if options.json:
        print(json.dumps({"run": str(options.what), **_facts(done.recording), "files": done.files}))
    elif done.files:
        print(f"{options.what}: {_text(done.recording)}; written: {', '.join(done.files)}")
    else:
        print(f"{options.what}: nothing is missing, nothing was changed")
    if done.report_failure:
        print(f"echelon: {done.report_failure}", file=sys.stderr)
    return 0


def _recover_file(options: RecoverOptions) -> int:
    from echelon.sim.recording.mcap_reader import recover as mend

    target = options.out or options.what.with_name(options.what.stem + "-recovered.mcap")
    result = mend(options.what, target)
    if options.json:
        print(json.dumps({"file": str(target), **_facts(result)}))
    else:
        print(f"{target}: {_text(result)}")
    return 0


def _facts(result: "RecoverResult") -> dict[str, Any]:
    """Returns what was saved of a recording, for JSON: times in seconds."""
    until_s = (result.until_ns or 0) / 1e9
    return {"messages": result.messages, "until": until_s, "damaged": result.damaged, "complete": result.complete}


def _text(result: "RecoverResult") -> str:
    """Returns what was saved of a recording, in words."""
    return f"{result.messages} messages, up to t = {(result.until_ns or 0) / 1e9:g} s"


COMMANDS: Final[tuple[Command[Any], ...]] = (
    Command(
        name="report",
        options=ReportOptions,
        work=report,
        about="""\
Writes a page with figures, tables and the verdict of a run.  The page of several runs says what
differs between them, and shows their curves in the same figures.  A page is one file and needs
no network.  A report.html that echelon did not write is not overwritten.""",
        examples={
            "echelon report runs/demo": "writes runs/demo/report.html again",
            "echelon report runs/demo runs/avoiding --out both.html": "two runs compared",
            "echelon report runs/demo --figures figures --format pdf": "trajectories.pdf and the others",
        },
        codes={0: "written"},
    ),
    Command(
        name="export",
        options=ExportOptions,
        work=export,
        about="""\
Writes the tables of a run as CSV or Parquet:
  robots   every state of every robot, and its place in the desired formation
  blocks   the shape variables and the centroid, with their errors
  links    what became of the messages of each link
  frames   the CAN frames, decoded
  torques  wanted, commanded and reported torque of each wheel (closed torque path)
A notebook has the same tables: `run.tables`, `run.to_pandas()`.""",
        examples={
            "echelon export runs/demo": "writes runs/demo/csv/robots.csv and the others",
            "echelon export runs/demo --csv tables": "into a folder of yours",
            "echelon export runs/demo --csv tables --replace": "the same folder again",
        },
        codes={0: "written"},
    ),
    Command(
        name="recover",
        options=RecoverOptions,
        work=recover,
        about="""\
Rebuilds the folder of a run that was killed: mends run.mcap, keeps the file that was cut short
as run.mcap.cut, and writes summary.json and report.html, so that report and export work.
Given an MCAP file, it copies all that can be read into a complete file.""",
        examples={
            "echelon recover runs/demo": "mends run.mcap, summary.json and report.html in place",
            "echelon recover runs/demo/run.mcap": "writes runs/demo/run-recovered.mcap",
            "echelon recover runs/demo/run.mcap --out mended.mcap": "into a file of yours",
        },
        codes={0: "written"},
    ),
)
