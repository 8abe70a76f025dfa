"""The parts that are built into this package, and scenarios loaded with them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import echelon.loading
from echelon.agents.plant import PLANTS, Plant
from echelon.bridge.protocol import DriveProtocol
from echelon.bridge.protocols import DEFAULT, PROTOCOLS
from echelon.bridge.trial import try_protocols
from echelon.controller.trajectory import TRAJECTORIES, Trajectory
from echelon.errors import PartRunError
from echelon.loading import ScenarioError
from echelon.plan import Plan
from echelon.plugins import Group, Registry
from echelon.scenario import Scenario

REGISTRY: Final = Registry(
    {
        "plants": Group("plants", Plant, PLANTS),
        "trajectories": Group("trajectories", Trajectory, TRAJECTORIES),
        "protocols": Group("protocols", DriveProtocol, PROTOCOLS, DEFAULT),
    }
)
"""All groups of parts, with what is built in."""


def load(path: Path, overrides: Sequence[str] = ()) -> tuple[Scenario, Plan]:
    """Reads a scenario file, applies overrides `key=value`, and makes its plan.  Raises ScenarioError."""
    return _tried(str(path), *echelon.loading.load(path, overrides, REGISTRY))


def parse(text: str, name: str, overrides: Sequence[str] = (), folder: Path = Path()) -> tuple[Scenario, Plan]:
    """Makes a scenario and its plan of TOML text; `name` stands for the file in messages, `folder` holds files that the text
    names.  Raises ScenarioError."""

    return _tried(name, *echelon.loading.parse(text, name, overrides, REGISTRY, folder))


def write_files(plan: Plan, folder: Path) -> None:
    """Writes the Python files that a plan's parts come from, so that a run's folder has all that its scenario names.

    Those that stand outside the scenario's folder are left out.  Raises OSError."""
    parts = [plan.trajectory, *(part for robot in plan.robots for part in (robot.model, robot.drive.protocol))]
    for source in {part.source.name: part.source for part in parts if part.source is not None}.values():
        name = Path(source.name)
        if not name.is_absolute() and ".." not in name.parts:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(source.text, encoding="utf-8")


def _tried(name: str, scenario: Scenario, plan: Plan) -> tuple[Scenario, Plan]:
    """Returns what was loaded, after a trial of what others wrote."""
    try:
        try_protocols(plan)
    except PartRunError as error:
        raise ScenarioError(f"{name}: {error}") from None
    return scenario, plan
