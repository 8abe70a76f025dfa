"""What a command's SCENARIO stands for: whatever `echelon.shipped.scenario_path` knows, or standard input."""

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
    """Returns the scenario that a name stands for, with overrides, and its plan.  Raises UserError."""
    if name != STANDARD_INPUT:
        return load(scenario_path(name), overrides)
    try:
        text = sys.stdin.buffer.read().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"standard input: is not UTF-8 text (byte {error.start})") from None
    return parse(text, "standard input", overrides)
