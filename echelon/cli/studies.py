"""Commands about studies: `figures`."""

import json
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
    results = results_of(open_sweep(options.sweep), predict=not options.no_predictions)
    scenario = (options.sweep / EFFECTIVE).read_text(encoding="utf-8")
    try:
        written = save_study_figures(results, out, options.format or ("svg",))
        write_study_page(results, out / "index.html", scenario)
    except OSError as error:
        raise UsageError(f"{error.filename or out}: {error.strerror}") from None
    written.append(out / "index.html")
    print(json.dumps({"files": list(map(str, written))}) if options.json else "\n".join(map(str, written)))
    return 0


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
)
