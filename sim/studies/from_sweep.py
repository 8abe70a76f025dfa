"""From a finished sweep to what its figures are drawn from, with predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from echelon.errors import UserError
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError, read_table
from echelon.shipped import EFFECTIVE
from echelon.sim.parts import loading
from echelon.sim.report.studies.results import Boundary, Columns, Key, Predicted, StudyResults
from echelon.sim.studies.predictions import boundary, costs, decay_rates
from echelon.sim.sweep.search import Found
from echelon.sim.sweep.study import Sweep

MOST_RATES: Final = 400
"""Points up to which decay rates are predicted"""
MOST_COSTS: Final = 100
"""Points up to which costs are predicted"""
MOST_ROBOTS: Final = 12
"""Robots up to which costs are predicted"""


def results_of(sweep: Sweep, *, predict: bool = True) -> StudyResults:
    """Returns what the figures of a sweep are drawn from.

    With `predict` boundaries and rates are predicted; for a sweep that is in no folder nothing is predicted."""
    points = dict(sweep.points.columns)
    scenario = _scenario(sweep)
    for key in sweep.keys:  # of which channel a rule is says nothing where the channel varies
        rule, links = key.removeprefix("links.").removesuffix(".channel"), scenario.get("links")
        if key == f"links.{rule}.channel" and isinstance(links, list):
            for number, table in enumerate(links):
                if isinstance(table, dict) and rule in (str(number), table.get("name")):
                    table["channel"] = ""
    keys = tuple(Key.of(key, points[key].tolist(), scenario) for key in sweep.keys)
    searched = sweep.keys[-1] if sweep.design == "find" else ""
    results = StudyResults(
        sweep.scenario,
        sweep.command or "echelon.sweep(…) in Python",
        keys,
        points,
        dict(sweep.runs.columns),
        len(sweep.seeds),
        tuple(_boundary(found) for found in sweep.find),
        searched,
    )
    if not predict or sweep.folder is None or results.axis is None:
        return results
    return replace(results, predicted=_Predictor(results, sweep.folder).predicted())


def _scenario(sweep: Sweep) -> dict[str, Any]:
    """Returns the table of the nominal scenario; empty if the sweep has no folder, or if it cannot be read."""
    if sweep.folder is None:
        return {}
    try:
        return read_table((sweep.folder / EFFECTIVE).read_text(encoding="utf-8"), EFFECTIVE)
    except (OSError, ValueError, ScenarioError):
        return {}


def _boundary(found: Found) -> Boundary:
    at = {key: Key.of(key, [value]).texts[0] for key, value in found.at.items()}
    return Boundary(at, found.value, found.fails, found.low, found.high, found.by)


class _Predictor:
    """Predicts what belongs to the points of a sweep."""

    def __init__(self, results: StudyResults, folder: Path) -> None:
        assert results.axis is not None
        self.results, self.folder, self.axis = results, folder, results.axis
        self.text = (folder / EFFECTIVE).read_text(encoding="utf-8")

    def predicted(self) -> Predicted:
        results = self.results
        bounds: list[Boundary] = []
        if self._is_number():
            bounds = [
                one for line in results.series(self.axis) if (one := self._of_series(line.rows.tolist())) is not None
            ]
        return Predicted(tuple(bounds), self._rates(), self._costs())

    def _is_number(self) -> bool:
        """The values of the axis are numbers, not lists that one number tells."""
        return self.results.points[self.axis.name].dtype != object

    def _of_series(self, rows: Sequence[int]) -> Boundary | None:
        assert self.axis.numbers is not None
        values = sorted({float(self.axis.numbers[row]) for row in rows})
        if len(values) < 2:
            return None
        try:
            found, known = boundary(lambda value: self._plan(rows[0], value), values)
        except UserError:  # a value between two that were tried is not allowed: a period that divides no other one
            return None
        if not known or found == np.inf:
            return None
        at = {key.name: key.texts[rows[0]] for key in self.results.others(self.axis)}
        return Boundary(at, found, by="predicted")

    def _plan(self, row: int, value: float | None = None) -> Plan:
        """Returns the plan of a point, with another value of the axis if one is given."""
        changes = []
        for key in self.results.keys:
            own: Any = self.results.points[key.name][row : row + 1].tolist()[0]
            if value is not None and key.name == self.axis.name:
                own = value
            changes.append(f"{key.name}={own:.17g}" if isinstance(own, float) else f"{key.name}={own}")  # 64, not 64.0
        return loading.parse(self.text, str(self.folder), changes, self.folder, trial=False)[1]

    def _rates(self) -> Columns:
        """Returns the predicted decay rate of each block at each point, where rates were measured."""
        results, count = self.results, len(self.results.points["point"])
        measured = any(np.isfinite(results.numbers(f"decay_rate.{block}")).any() for block in results.blocks)
        if not measured or count > MOST_RATES:
            return {}
        return self._columns([decay_rates(self._plan(row)) for row in range(count)])

    def _costs(self) -> Columns:
        """Returns the expected cost of each block at each point, where losses vary."""
        count = len(self.results.points["point"])
        if self.axis.kind != "loss" or count > MOST_COSTS:
            return {}
        plans = [self._plan(row) for row in range(count)]
        return self._columns([costs(plan) if len(plan.robots) <= MOST_ROBOTS else {} for plan in plans])

    def _columns(self, rows: Sequence[Mapping[str, float]]) -> Columns:
        """Returns the numbers of each block at all points as a column, for blocks that have one."""
        found = {block: np.array([row.get(block, np.nan) for row in rows]) for block in self.results.blocks}
        return {block: column for block, column in found.items() if np.isfinite(column).any()}
