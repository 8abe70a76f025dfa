"""Where a sweep's scenarios come from: the text of one scenario, changed by overrides for each point."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from echelon.errors import UserError
from echelon.plan.plan import Plan
from echelon.plugins import Source
from echelon.scenario.link_tables import Trace
from echelon.scenario.part_fields import parts_in
from echelon.scenario.tables import Scenario
from echelon.scenario.toml_text import toml_value
from echelon.sim.parts import loading


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a sweep: the values of the varied keys, its scenario and its plan."""

    values: tuple[Any, ...]
    scenario: Scenario
    plan: Plan
    hash: str
    """Hash of the scenario without its seed, with the files that it names"""


@dataclass(frozen=True, slots=True)
class Origin:
    """A scenario as TOML text, and the overrides that hold for all points."""

    text: str
    name: str
    """Its name in messages"""
    folder: Path
    """File names in it are relative to this folder"""
    overrides: tuple[str, ...] = ()

    @classmethod
    def of_file(cls, path: Path, overrides: tuple[str, ...] = ()) -> "Origin":
        """Returns the scenario in a file.  Raises UserError if it cannot be read."""
        try:
            return cls(path.read_text(encoding="utf-8-sig"), str(path), path.parent, overrides)
        except UnicodeDecodeError as error:
            raise UserError(f"{path}: is not UTF-8 text (byte {error.start})") from None
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: {getattr(error, 'strerror', None) or error}") from None

    def point(self, keys: Sequence[str] = (), values: Sequence[Any] = (), option: str = "--vary") -> Point:
        """Returns the point with these values.  Raises UserError for an unknown key or a wrong value.

        `option` gave the values; errors name it."""
        varied = [f"{key}={toml_value(value)}" for key, value in zip(keys, values, strict=True)]
        try:
            scenario, plan = loading.parse(self.text, self.name, [*self.overrides, *varied], self.folder)
        except UserError as error:
            lines = [_renamed(line, keys, option) for line in error.lines]
            raise type(error)(*lines) from error.__cause__
        return Point(tuple(values), scenario, plan, scenario_hash(scenario))


def _renamed(line: str, keys: Iterable[str], option: str) -> str:
    """Returns a line of an error in which the values of varied keys are called by the option that gave them."""
    for key in keys:
        line = line.replace(f"--set {key}=", f"{option} {key}=")
    return line


def scenario_hash(scenario: Scenario) -> str:
    """Returns a hash of a scenario without its seed, and of the files that it names."""
    digest = sha256(scenario.model_dump_json(exclude={"seed"}).encode())
    for source in sorted(_sources(scenario), key=lambda each: each.name):
        digest.update(f"{source.name} {source.sha256}\n".encode())
    return digest.hexdigest()[:16]


def _sources(scenario: Scenario) -> set[Source]:
    parts = {part.source for part in parts_in(scenario) if part.source is not None}
    return parts | {rule.delay.file for rule in scenario.links if isinstance(rule.delay, Trace)}
