"""What commands share: the scenario that a user names, and what is raised for a mistake."""

import argparse
from pathlib import Path

from echelon.load import ScenarioError
from echelon.plan import Plan
from echelon.scenario import Scenario
from echelon.sim.parts import load

SCENARIOS = Path(__file__).parent.parent / "deploy" / "scenarios"


class UsageError(Exception):
    """A mistake of the user's; the text is one line."""


def scenario_of(arguments: argparse.Namespace) -> tuple[Scenario, Plan]:
    """Loads the scenario that a command names: a file, or one of those shipped.  Raises UsageError."""
    name = arguments.scenario
    path = Path(name)
    if not path.is_file() and path.suffix == "" and "/" not in name:
        shipped = sorted(file.stem for file in SCENARIOS.glob("*.toml"))
        if name not in shipped:
            raise UsageError(f"{name}: no such file, and no shipped scenario; those are {', '.join(shipped)}")
        path = SCENARIOS / f"{name}.toml"
    try:
        return load(path, getattr(arguments, "set", None) or ())
    except ScenarioError as error:
        raise UsageError(str(error)) from None
