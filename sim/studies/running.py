"""Makes a study: its sweeps, their figures on one page, and the numbers of the finding beside what was measured."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from echelon.files import write_text
from echelon.shipped import scenario_path
from echelon.sim.report.page import header, page, paragraph, section, subheading, table
from echelon.sim.report.studies.figures import save_study_figures, study_sections
from echelon.sim.report.studies.results import Key, StudyResults
from echelon.sim.studies.beside import with_line
from echelon.sim.studies.from_sweep import results_of
from echelon.sim.studies.study_file import Number, Study, SweepPart
from echelon.sim.sweep.origin import Origin
from echelon.sim.sweep.preparing import Request, prepare
from echelon.sim.sweep.search import Search
from echelon.sim.sweep.sweep import run
from echelon.sim.sweep.values import parse_vary

PAGE: Final = "index.html"
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Measured:
    """A number of a finding beside what was measured."""

    number: Number
    value: float
    """NaN if there is no such number"""

    @property
    def agrees(self) -> bool:
        """True if it differs by at most `within`."""
        return bool(abs(self.value - self.number.value) <= self.number.within)


def command_of(part: SweepPart) -> str:
    """Returns the command that makes a sweep of a study."""
    words = ["echelon", "sweep", part.scenario]
    for option, values in (("--set", part.set), ("--vary", part.vary)):
        words += [word for value in values for word in (option, value)]
    words += ["--zip"] if part.zip else []
    share = None if part.find is None else part.share
    for option, value in (
        ("--find", part.find), ("--share", share), ("--seeds", part.seeds), ("--engine", part.engine)
    ):  # fmt: skip
        words += [] if value is None else [option, str(value)]
    words += ["--allow-unstable"] if part.allow_unstable else []
    return shlex.join(words)


def request_of(part: SweepPart) -> Request:
    """Returns what a sweep of a study asks for.  Raises UserError."""
    return Request(
        origin=Origin.of_file(scenario_path(part.scenario), part.set),
        varied=tuple(parse_vary(text) for text in part.vary),
        kind="zip" if part.zip else "grid",
        search=None if part.find is None else Search.parse(part.find),
        share=part.share,
        seeds=part.seeds,
        engine=part.engine,  # type: ignore[arg-type]  # prepare refuses what is no engine
        allow_unstable=part.allow_unstable,
    )


def make(study: Study, out: Path, formats: Sequence[str], say: Say = lambda text: None) -> list[Measured]:
    """Makes a study in a folder, where sweeps that are finished are not made again; returns its numbers as measured.

    The folder gets a folder for each sweep, `figures` and `index.html`.  Raises UserError, and OSError."""
    prepared = [(part, prepare(request_of(part))) for part in study.sweeps]  # all mistakes before the first run
    results: dict[str, StudyResults] = {}
    for part, one in prepared:
        say(f"{study.name}: {part.name}: {command_of(part)}")
        folder = out / part.name
        folder.parent.mkdir(parents=True, exist_ok=True)
        results[part.name] = replace(results_of(run(one, folder)), command=command_of(part))
    for part in study.sweeps:
        if part.beside is not None:
            results[part.beside] = with_line(results[part.beside], results[part.name], part.name)
    measured = [Measured(number, measure(number, results)) for number in study.numbers]
    for name, found in results.items():
        save_study_figures(found, out / "figures" / name, formats)
    write_text(out / PAGE, study_page(study, results, measured))
    return measured


def measure(number: Number, results: Mapping[str, StudyResults]) -> float:
    """Returns a number of a finding as it was measured; NaN if there is none."""
    own = {"sweep": number.sweep, "column": number.column, "at": number.at}
    value = _place(own, results)
    return value if number.over is None else value / _place({**own, **number.over}, results)


def _place(place: Mapping[str, Any], results: Mapping[str, StudyResults]) -> float:
    found = results[place["sweep"]]
    wanted = {key: Key.of(key, [value]).texts[0] for key, value in place["at"].items()}
    if place["column"] in ("largest", "predicted"):
        bounds = found.boundaries() if place["column"] == "largest" else found.predicted.boundaries
        values = [one.value for one in bounds if all(_same(one.at.get(key), text) for key, text in wanted.items())]
        return float(values[0]) if len(values) == 1 and values[0] is not None else float("nan")
    rows = [
        row
        for row in range(len(found.points["point"]))
        if all(_same(key.texts[row], wanted[key.name]) for key in found.keys if key.name in wanted)
    ]
    return float(found.numbers(place["column"])[rows[0]]) if len(rows) == 1 else float("nan")


def _same(one: str | None, other: str) -> bool:
    try:
        return one is not None and (one == other or bool(np.isclose(float(one), float(other), rtol=1e-9)))
    except ValueError:
        return False


def study_page(study: Study, results: Mapping[str, StudyResults], measured: Sequence[Measured]) -> str:
    """Returns the page of a study as HTML."""
    parts = [
        header(study.title, study.question, [f"study {study.name}"]),
        section("Finding", "", [paragraph(study.finding)]),
    ]
    if measured:
        rows = [[each.number.says, each.number.value, each.value, each.number.within, each.agrees] for each in measured]
        parts.append(
            section("Its numbers", "", [table(["says", "value", "measured", "within", ""], rows, what="numbers")])
        )
    for name, found in results.items():
        parts += [subheading(name), *study_sections(found)]
    return page(study.title, parts)
