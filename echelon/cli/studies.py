"""Commands about studies: `figures` and `study`."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON
from echelon.errors import UsageError


@dataclass(frozen=True, slots=True, kw_only=True)
class FiguresOptions:
    """Options of `echelon figures`."""

    sweep: Path = field(metadata=argument("the folder of a sweep", "SWEEP"))
    out: Path | None = field(default=None, metadata=option("folder for the files (default: SWEEP/figures)", "DIR"))
    format: tuple[Literal["svg", "pdf", "png"], ...] = field(
        default=(), metadata=option("format of the files; may be repeated (default: svg)")
    )
    no_predictions: bool = field(default=False, metadata=option("draw what was measured alone"))
    json: bool = field(default=False, metadata=JSON)


def figures(options: FiguresOptions) -> int:
    """Draws the figures of a sweep, each into a file, and all on a page."""
    from echelon.shipped import EFFECTIVE
    from echelon.sim.report.studies.figures import save_study_figures, write_study_page
    from echelon.sim.studies.from_sweep import results_of
    from echelon.sim.sweep.study import open_sweep

    out = options.out or options.sweep / "figures"
    sweep = open_sweep(options.sweep)
    try:
        scenario = (options.sweep / EFFECTIVE).read_text(encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{error.filename}: {error.strerror}") from None
    results = results_of(sweep, predict=not options.no_predictions)
    try:
        written = save_study_figures(results, out, options.format or ("svg",))
        write_study_page(results, out / "index.html", scenario)
    except OSError as error:
        raise UsageError(f"{error.filename or out}: {error.strerror}") from None
    written.append(out / "index.html")
    print(json.dumps({"files": list(map(str, written))}) if options.json else "\n".join(map(str, written)))
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Options of `echelon study`."""

    studies: tuple[str, ...] = field(
        metadata=argument("the name of a shipped study (delay_per_layer, loss, …), or a file of yours", "STUDY")
    )
    out: Path | None = field(
        default=None, metadata=option("folder for the folders of the studies (default: runs/studies)", "DIR")
    )
    format: tuple[Literal["svg", "pdf", "png"], ...] = field(
        default=(), metadata=option("format of the figures; may be repeated (default: svg)")
    )
    quiet: bool = field(default=False, metadata=option("show no progress"))
    json: bool = field(default=False, metadata=JSON)


def study(options: StudyOptions) -> int:
    """Makes studies.  Returns 1 if a number of a finding is not what was measured."""
    from echelon.sim.studies.running import PAGE, make
    from echelon.sim.studies.study_file import read_study, shipped_studies

    names = [name for given in options.studies for name in (shipped_studies() if given == "all" else [given])]
    studies, out = [read_study(name) for name in names], options.out or Path("runs") / "studies"
    facts, wrong = [], 0
    for one in studies:
        folder = out / one.name

        def say(text: str) -> None:
            if not options.quiet:
                print(text, file=sys.stderr, flush=True)

        try:
            measured = make(one, folder, options.format or ("svg",), say)
        except OSError as error:
            raise UsageError(f"{error.filename or folder}: {error.strerror}") from None
        wrong += sum(not each.agrees for each in measured)
        numbers = [
            {
                "says": each.number.says,
                "measured": each.value if each.value == each.value else None,
                "agrees": each.agrees,
            }
            for each in measured
        ]
        facts.append({"study": one.name, "page": str(folder / PAGE), "finding": one.finding, "numbers": numbers})
        if not options.json:
            print(f"{one.name}: {one.finding}")
            for each in measured:
                differs = (
                    "" if each.agrees else f"; differs from {each.number.value:g} by more than {each.number.within:g}"
                )
                print(f"  {each.number.says:<24} measured {each.value:.6g}{differs}")
            print(f"  page     {folder / PAGE}")
    if options.json:
        print(json.dumps(facts, indent=2))
    return 1 if wrong else 0


COMMANDS: Final[tuple[Command[Any], ...]] = (
    Command(
        name="figures",
        options=FiguresOptions,
        work=figures,
        about="""\
Draws the figures of a sweep: each into a file, and all on one page, index.html, where the pointer
shows the numbers.  Which figures there are follows from what varied: one key with numbers gives
curves of what holds, of settling times, rates and integrals of the error; two give a map; a
search, or a key with names beside one with numbers, how far each holds.  Predictions that can be
made without runs are drawn beside what was measured.  captions.md has the captions, each with the
command that made the sweep.""",
        examples={
            "echelon figures runs/many": "writes runs/many/figures/index.html and the others",
            "echelon figures runs/many --out paper --format pdf": "for a paper",
        },
        codes={0: "written"},
    ),
    Command(
        name="study",
        options=StudyOptions,
        work=study,
        about="""\
Makes a study: its sweeps, their figures with predictions on one page, and the numbers of its
finding beside what was measured now.  `all` stands for all shipped studies.  A sweep that is
finished is not made again.  docs/studies.md says how to write one.""",
        examples={
            "echelon study delay_per_layer": "writes runs/studies/delay_per_layer/index.html",
            "echelon study all --out runs/studies": "all shipped studies",
        },
        codes={0: "the numbers are those of the finding", 1: "a number differs"},
    ),
)
