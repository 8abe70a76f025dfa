"""Which figures the tables of a study can fill, their captions, and the page and the files that show them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from echelon.files import write_text
from echelon.sim.report.drawing import Picture
from echelon.sim.report.page import figure, header, page, paragraph, preformatted, section, table
from echelon.sim.report.studies.curves import aged, ages, blackouts, costs, integrals, rates, settling
from echelon.sim.report.studies.results import HOLDS, StudyResults
from echelon.sim.report.studies.stability import shares, stability_map, tolerated

WIDTH: Final = 11.5
"""Width of a figure on the page [inches]"""
CAPTIONS: Final = "captions.md"
"""The file with the captions beside figures that are files of their own"""
MOST_BLOCKS: Final = 6
"""Blocks for which integrals have axes of their own"""


@dataclass(frozen=True, slots=True)
class StudyFigure:
    """A figure of studies."""

    title: str
    make: Callable[[StudyResults, float], Picture]
    supported: Callable[[StudyResults], bool]
    """Whether a study's tables can fill it"""
    caption: Callable[[StudyResults], str]


def _along(results: StudyResults) -> bool:
    """One key with at least three numbers is varied, not by a search."""
    axis = results.axis
    return axis is not None and axis.count >= 3 and not results.searched and results.second is None


def _has(results: StudyResults, name: str) -> bool:
    return any(np.isfinite(results.numbers(f"{name}.{block}")).any() for block in results.blocks)


def _bounded(results: StudyResults) -> bool:
    """There are several boundaries, and one of them is in the range that was tried."""
    bounds = results.boundaries()
    return len(bounds) > 1 and any(one.value is not None and one.fails is not None for one in bounds)


def _runs(results: StudyResults) -> str:
    return "one run" if results.seeds == 1 else f"{results.seeds} runs"


def _dashed(results: StudyResults, words: str) -> str:
    return f" Dashed: {words}." if results.predicted.boundaries else ""


STUDY_FIGURES: Final[Mapping[str, StudyFigure]] = {
    "map": StudyFigure(
        "What holds",
        stability_map,
        lambda of: of.second is not None and of.second.count >= 3 and _cells_of(of) and not of.searched,
        lambda of: (
            f"Share of runs that hold, {_runs(of)} for each cell; numbers are in per cent. Solid line: half of the runs hold."
            + _dashed(of, "predicted boundary")
        ),
    ),
    "shares": StudyFigure(
        "What holds",
        shares,
        _along,
        lambda of: (
            f"Above: share of runs that hold, {_runs(of)} for each value"
            + (", with Wilson intervals of 95 %" if of.seeds > 1 else "")
            + ". Below: growth of E|e|² from the sixth of the run before the last to the last one, of the block in which it is "
            "largest; above 1 errors grow." + _dashed(of, "predicted boundary")
        ),
    ),
    "tolerated": StudyFigure(
        "How far it holds",
        tolerated,
        _bounded,
        lambda of: (
            "Largest value with which "
            + (
                "the wanted share of runs holds and E|e|² does not grow"
                if of.found
                else f"{100 * HOLDS:g} % of the runs hold"
            )
            + f", {_runs(of)} for each value. Bars: from the last value that surely holds to the first that surely fails."
            + _dashed(of, "predicted")
        ),
    ),
    "settling": StudyFigure(
        "Settling",
        settling,
        lambda of: _along(of) and _has(of, "settling_5"),
        lambda of: (
            "Settling time of each block to 5 % of the error that it starts with (filled) and to 2 % (open); "
            f"median of {_runs(of)}. A mark is missing where half of the runs do not settle."
        ),
    ),
    "rates": StudyFigure(
        "Decay rates",
        rates,
        lambda of: _along(of) and _has(of, "decay_rate"),
        lambda of: (
            f"Decay rate fitted to the amplitude of each block; median of {_runs(of)}; below zero errors grow."
            + (
                " Dashed: predicted for the block alone, in continuous time, with the delays of its loop."
                if of.predicted.rates
                else ""
            )
        ),
    ),
    "integrals": StudyFigure(
        "Integrals of the error",
        integrals,
        lambda of: _along(of) and len(of.blocks) <= MOST_BLOCKS and (_has(of, "ise_mean") or _has(of, "itae_mean")),
        lambda of: f"Mean of ∫|e|² dt (ISE) and ∫ t |e| dt (ITAE) over {_runs(of)}, of each block.",
    ),
    "ages": StudyFigure(
        "Age and error",
        ages,
        lambda of: bool(aged(of)),
        lambda of: (
            "∫|e| dt of each block against the age of the messages in use, on the link on which it is largest: two marks for "
            "each run, the median (filled) and the 95th percentile of ages (open)."
        ),
    ),
    "blackouts": StudyFigure(
        "Blackouts",
        blackouts,
        lambda of: of.axis is not None and of.axis.kind == "blackout" and of.axis.count >= 3 and not of.searched,
        lambda of: f"Largest error of each block, and when it has settled to 5 %; median of {_runs(of)}.",
    ),
    "costs": StudyFigure(
        "Cost",
        costs,
        lambda of: any(np.isfinite(column).any() for column in of.predicted.costs.values()),
        lambda of: f"Mean of ∫|e|² dt over {_runs(of)} against what is predicted for it, near the formation.",
    ),
}
"""All figures of studies by name"""


def _cells_of(results: StudyResults) -> bool:
    """At least half of the cells of the map have a point: it is a grid, not a scatter of draws."""
    axis, second = results.axis, results.second
    assert axis is not None
    assert second is not None
    others = len(set(results.names(results.others(axis, second))))
    return 2 * len(results.points["point"]) >= axis.count * second.count * others


def study_figures(results: StudyResults, width: float = WIDTH) -> dict[str, tuple[Picture, str]]:
    """Returns the figures that a study's tables can fill, by name, each with its caption.

    The caption ends with the command that made the study."""
    return {
        name: (one.make(results, width), f"{one.caption(results)} Made by: {results.command}")
        for name, one in STUDY_FIGURES.items()
        if one.supported(results)
    }


def study_sections(results: StudyResults) -> list[str]:
    """Returns the sections of a page about a study: its figures, and the table of its boundaries."""
    parts = [
        section(STUDY_FIGURES[name].title, "", [figure(picture, caption, caption)])
        for name, (picture, caption) in study_figures(results).items()
    ]
    if rows := boundary_rows(results):
        assert results.axis is not None
        head = [*(key.label for key in results.others(results.axis)), "by", "holds up to", "fails at", "predicted"]
        parts.append(
            section(
                f"Largest {results.axis.label}", "", [table(head, rows, numeric_from=len(head) - 3, what="boundaries")]
            )
        )
    return parts or [
        section("Figures", "", [paragraph("No key with three or more numbers varies: nothing can be drawn.")])
    ]


def boundary_rows(results: StudyResults) -> list[list[object]]:
    """Returns a row for each boundary: the values of the other keys, what is judged, the largest value that holds, the next
    one, and the prediction."""
    guesses = {tuple(one.at.items()): one.value for one in results.predicted.boundaries}
    bounds = results.found or tuple(results.boundaries())
    return [[*one.at.values(), one.by, one.value, one.fails, guesses.get(tuple(one.at.items()))] for one in bounds]


def write_study_page(results: StudyResults, path: Path, scenario: str = "") -> None:
    """Writes the page about a study; `scenario` is its nominal scenario as TOML.  Raises OSError."""
    facts = [f"{len(results.points['point'])} points", f"{len(results.runs['point'])} runs", results.command]
    varied = ", ".join(key.name for key in results.keys)
    parts = [header(f"{results.scenario}: {varied or 'seeds'}", "", facts), *study_sections(results)]
    if scenario:
        parts.append(section("Nominal scenario", "Every default written out.", [preformatted(scenario)]))
    write_text(path, page(f"{results.scenario}: {varied}", parts))


def save_study_figures(results: StudyResults, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Writes each figure of a study into a file of its own, and the captions into `captions.md`; returns the files.

    The folder is made if it does not exist.  Raises ValueError for a format that is not in drawing.FORMATS, and OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    figures, written = study_figures(results), []
    for name, (picture, _) in figures.items():
        for kind in formats:
            written.append(folder / f"{name}.{kind}")
            picture.save(written[-1])
    if figures:
        written.append(folder / CAPTIONS)
        write_text(written[-1], "".join(f"**{name}.** {caption}\n\n" for name, (_, caption) in figures.items()))
    return written
