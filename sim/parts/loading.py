"""The built-in parts, and the loading of scenarios with them."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

import echelon.planning.loading
from echelon.agents.plant import PLANTS, Plant
from echelon.bridge.protocols.protocol import DriveProtocol
from echelon.bridge.protocols.registry import DEFAULT, PROTOCOLS
from echelon.bridge.protocols.trial import try_protocols
from echelon.controller.laws import LAWS, Law
from echelon.controller.trajectory import TRAJECTORIES, Trajectory
from echelon.errors import PartRunError
from echelon.part_groups import PartGroup, Registry
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError
from echelon.plugins import Part, PartError, Plugin, Source
from echelon.scenario.tables import Scenario
from echelon.sim.parts.probe import probe
from echelon.sim.parts.time_limit import no_longer

LOAD_PATIENCE_S: Final = 20.0
"""Time limit for reading a part's file or importing an installed part, and for the trial of a protocol [s]"""


class PatientRegistry(Registry):
    """A registry that limits the time for finding and making a part to `LOAD_PATIENCE_S`."""

    def find(self, group: str, use: str, folder: Path) -> tuple[type[Plugin], Source | None]:
        """Returns the class that `use` names, and its source if it is a file in `folder`.

        Raises PartError if it cannot be found or takes too long."""
        with _to_load(use):
            return super().find(group, use, folder)

    def make(self, group: str, use: str, parameters: Mapping[str, Any], folder: Path) -> Part[Any]:
        """Returns a part of a group with checked parameters.  Raises PartError if it cannot be made or takes too long."""
        with _to_load(use):
            return super().make(group, use, parameters, folder)


def _to_load(use: str) -> AbstractContextManager[None]:
    return no_longer(LOAD_PATIENCE_S, PartError(f"{use} takes longer than {LOAD_PATIENCE_S:g} s to load"))


def _to_be_tried(who: str) -> AbstractContextManager[None]:
    return no_longer(LOAD_PATIENCE_S, PartRunError(f"{who} takes longer than {LOAD_PATIENCE_S:g} s to be tried"))


REGISTRY: Final = PatientRegistry(
    {
        "laws": PartGroup("laws", Law, LAWS),
        "plants": PartGroup("plants", Plant, PLANTS),
        "trajectories": PartGroup("trajectories", Trajectory, TRAJECTORIES),
        "protocols": PartGroup("protocols", DriveProtocol, PROTOCOLS, DEFAULT),
    }
)
"""All groups of parts, with the built-in parts of each."""


def load(path: Path, overrides: Sequence[str] = (), *, trial: bool = True) -> tuple[Scenario, Plan]:
    """Reads a scenario file, applies overrides `key=value`, makes its plan, and tries the users' parts in it.

    Without `trial` the parts are not tried, so that the result of a run can be read even if its parts fail.
    Raises ScenarioError for any mistake."""
    loaded = echelon.planning.loading.load(path, overrides, REGISTRY)
    return _tried(str(path), *loaded) if trial else loaded


def parse(
    text: str, name: str, overrides: Sequence[str] = (), folder: Path = Path(), *, trial: bool = True
) -> tuple[Scenario, Plan]:
    """Does the same as `load` with TOML text; `name` names it in messages, and its file names are relative to `folder`."""
    loaded = echelon.planning.loading.parse(text, name, overrides, REGISTRY, folder)
    return _tried(name, *loaded) if trial else loaded


def _tried(name: str, scenario: Scenario, plan: Plan) -> tuple[Scenario, Plan]:
    """Returns scenario and plan after a trial of the users' parts."""
    try:
        probe(plan)
        try_protocols(plan, _to_be_tried)
    except PartRunError as error:
        raise ScenarioError(f"{name}: {error}") from error.__cause__  # what the part raised, for --debug
    return scenario, plan
