"""Reads the scenario that a command's argument SCENARIO names: see `echelon.shipped.scenario_path`; `-` is standard input."""

import sys
from collections.abc import Sequence
from typing import Final

from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError
from echelon.scenario.tables import Scenario
from echelon.shipped import scenario_path
from echelon.sim.parts.loading import load, parse

STANDARD_INPUT: Final = "-"


def read_scenario(name: str, overrides: Sequence[str] = ()) -> tuple[Scenario, Plan]:
    """Returns the scenario with this name, and its plan; `overrides` are those of `--set`.  Raises UserError."""
    if name != STANDARD_INPUT:
        return load(scenario_path(name), overrides)
    return parse(read_text(), "standard input", overrides)


def read_text() -> str:
    """Returns the text of a scenario on standard input.  Raises UserError if it is not UTF-8."""
    try:
        return sys.stdin.buffer.read().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"standard input: is not UTF-8 text (byte {error.start})") from None
