"""The parts that are built into this package, and scenarios loaded with them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import echelon.load
from echelon.agents.plant import PLANTS, Plant
from echelon.controller.laws import LAWS, Law
from echelon.controller.trajectory import TRAJECTORIES, Trajectory
from echelon.plan import Plan
from echelon.plugins import Group, Registry
from echelon.scenario import Scenario

REGISTRY: Final = Registry(
    {
        "laws": Group("laws", Law, LAWS),
        "plants": Group("plants", Plant, PLANTS),
        "trajectories": Group("trajectories", Trajectory, TRAJECTORIES),
    }
)
"""All groups of parts, with what is built in."""


def load(path: Path, overrides: Sequence[str] = ()) -> tuple[Scenario, Plan]:
    """Reads a scenario file, applies overrides `key=value`, and makes its plan.  Raises ScenarioError."""
    return echelon.load.load(path, overrides, REGISTRY)


def parse(text: str, name: str, overrides: Sequence[str] = (), folder: Path = Path()) -> tuple[Scenario, Plan]:
    """Makes a scenario and its plan of TOML text; `name` stands for the file in messages, `folder` holds files that the text
    names.  Raises ScenarioError."""
    return echelon.load.parse(text, name, overrides, REGISTRY, folder)
