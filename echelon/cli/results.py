"""Commands about what runs left: `report`, `export`, `recover`."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON
from echelon.errors import UsageError


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """Options of `echelon report`."""

    runs: tuple[Path, ...] = field(metadata=argument("the folder of a run; of several, a comparison", "RUN"))
    out: Path | None = field(
        default=None,
        metadata=option("where to write it (default: report.html in the run's folder, or here for several)", "FILE"),
    )
    json: bool = field(default=False, metadata=JSON)


def report(options: ReportOptions) -> int:
    """Writes the report of a run, or a comparison of several."""
    from echelon.sim.run_folder import report_on

    alone = options.runs[0] / "report.html" if len(options.runs) == 1 else Path("report.html")
    path = options.out or alone
    try:
        report_on(list(options.runs), path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    print(json.dumps({"report": str(path), "runs": list(map(str, options.runs))}) if options.json else path)
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Options of `echelon export`."""

    run: Path = field(metadata=argument("the folder of a run", "RUN"))
    csv: Path | None = field(default=None, metadata=option("folder for the files (default: RUN/csv)", "DIR"))
    json: bool = field(default=False, metadata=JSON)


def export(options: ExportOptions) -> int:
    """Writes a run as CSV."""
    from echelon.sim.export import export_csv
    from echelon.sim.run_folder import open_run

    run = open_run(options.run)
    folder = options.csv or options.run / "csv"
    try:
        files = export_csv(run, folder)
    except OSError as error:
        what = folder if options.csv is None else f"--csv {folder}"
        raise UsageError(f"{what}: {error.strerror}") from None
    if options.json:
        print(json.dumps({"run": str(options.run), "folder": str(folder), "files": [path.name for path in files]}))
    else:
        print(f"{folder}: {', '.join(path.name for path in files)}")
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoverOptions:
    """Options of `echelon recover`."""

    file: Path = field(metadata=argument("an MCAP file that was cut off or is damaged", "FILE"))
    out: Path | None = field(
        default=None, metadata=option("where to write what is whole (default: <file>-recovered.mcap)", "FILE")
    )
    json: bool = field(default=False, metadata=JSON)


def recover(options: RecoverOptions) -> int:
    """Mends a recording that was cut off."""
    from echelon.sim.recording import recover as mend

    target = options.out or options.file.with_name(options.file.stem + "-recovered.mcap")
    try:
        result = mend(options.file, target)
    except OSError as error:
        raise UsageError(f"{error.filename or options.file}: {error.strerror}") from None
    except ValueError as error:  # which begins with the file
        raise UsageError(str(error)) from None
    until_s = (result.until_ns or 0) / 1e9
    if options.json:
        facts = {"messages": result.messages, "until": until_s, "damaged": result.damaged, "complete": result.complete}
        print(json.dumps({"file": str(target), **facts}))
    else:
        print(f"{target}: {result.messages} messages, up to t = {until_s:g} s")
    return 0


COMMANDS: Final[tuple[Command[Any], ...]] = (
    Command(
        name="report",
        options=ReportOptions,
        work=report,
        about="""\
Writes a page with figures, tables and the verdict of a run, or of several runs side by side.
It needs no other file and no network.""",
        examples={
            "echelon report runs/demo": "runs/demo/report.html, written again",
            "echelon report runs/demo runs/avoiding --out both.html": "two runs side by side",
        },
        codes={0: "written"},
    ),
    Command(
        name="export",
        options=ExportOptions,
        work=export,
        about="""\
Writes what a run recorded as CSV: every state of every robot, the shape variables and the
centroid with their errors, and what became of the messages of each link.""",
        examples={
            "echelon export runs/demo": "into runs/demo/csv",
            "echelon export runs/demo --csv tables": "into a folder of yours",
        },
        codes={0: "written"},
    ),
    Command(
        name="recover",
        options=RecoverOptions,
        work=recover,
        about="""\
Writes what is whole in a recording that was cut off, or is damaged, as a complete MCAP file.""",
        examples={
            "echelon recover runs/demo/run.mcap": "runs/demo/run-recovered.mcap",
            "echelon recover runs/demo/run.mcap --out mended.mcap": "into a file of yours",
        },
        codes={0: "written"},
    ),
)
