"""The parts that are built into this package, and scenarios loaded with them."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError
from echelon.plugins import Part, PartError, PartGroup, Plugin, Registry, Source
from echelon.scenario.tables import Scenario
from echelon.sim.parts.probe import probe
from echelon.sim.parts.time_limit import TookTooLong, time_limit

LOAD_PATIENCE_S: Final = 20.0
"""For a file that is read, or an installed part that is imported"""


class PatientRegistry(Registry):
    """A registry in which finding and making a part may take `LOAD_PATIENCE_S` and no longer."""

    def find(self, group: str, use: str, folder: Path) -> tuple[type[Plugin], Source | None]:
        """Returns the class that `use` names, and its file if it comes from one in `folder`.  Raises PartError."""
        with _patience(use):
            return super().find(group, use, folder)

    def make(self, group: str, use: str, parameters: Mapping[str, Any], folder: Path) -> Part[Any]:
        """Returns a part of a group with its parameters checked.  Raises PartError."""
        with _patience(use):
            return super().make(group, use, parameters, folder)


@contextmanager
def _patience(use: str) -> Iterator[None]:
    try:
        with time_limit(LOAD_PATIENCE_S):
            yield
    except TookTooLong:
        raise PartError(f"{use} takes longer than {LOAD_PATIENCE_S:g} s to load") from None


REGISTRY: Final = PatientRegistry(
    {
        "laws": PartGroup("laws", Law, LAWS),
        "plants": PartGroup("plants", Plant, PLANTS),
        "trajectories": PartGroup("trajectories", Trajectory, TRAJECTORIES),
        "protocols": PartGroup("protocols", DriveProtocol, PROTOCOLS, DEFAULT),
    }
)
"""All groups of parts, with what is built in."""


def load(path: Path, overrides: Sequence[str] = (), *, trial: bool = True) -> tuple[Scenario, Plan]:
    """Reads a scenario file, applies overrides `key=value`, makes its plan, and tries the parts in it that others wrote.

    Without a `trial`, what a run left can be read whatever its parts do.  Raises ScenarioError."""
    loaded = echelon.planning.loading.load(path, overrides, REGISTRY)
    return _tried(str(path), *loaded) if trial else loaded


def parse(
    text: str, name: str, overrides: Sequence[str] = (), folder: Path = Path(), *, trial: bool = True
) -> tuple[Scenario, Plan]:
    """Does the same with TOML text; `name` stands for the file in messages, `folder` holds files that the text names."""
    loaded = echelon.planning.loading.parse(text, name, overrides, REGISTRY, folder)
    return _tried(name, *loaded) if trial else loaded


def _tried(name: str, scenario: Scenario, plan: Plan) -> tuple[Scenario, Plan]:
    """Returns what was loaded, after a trial of what others wrote."""
    try:
        probe(plan)
        try_protocols(plan)
    except PartRunError as error:
        raise ScenarioError(f"{name}: {error}") from None
    return scenario, plan
