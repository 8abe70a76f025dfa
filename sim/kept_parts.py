"""Copies the files that a scenario names (users' parts, traces of delays) into a run's folder, so that its scenario.toml can be
run again from there."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from echelon.plugins import Source
from echelon.scenario.link_tables import Trace
from echelon.scenario.part_fields import parts_in
from echelon.scenario.tables import Scenario
from echelon.sim.results.records import PartResult

HASH_OF: Final = "sha256 of "
"""How a key of a recording's metadata begins that holds the SHA-256 of a file"""


@dataclass(frozen=True, slots=True)
class KeptParts:
    """The files that a scenario names, as a run's folder keeps them."""

    names: dict[Source, str]
    """The name of each file in the folder"""
    results: tuple[PartResult, ...]
    """The parts that are not built in, for the summary"""

    @property
    def files(self) -> dict[str, str]:
        """The texts of the files, by their names in the folder."""
        return {name: source.text for source, name in self.names.items()}

    @property
    def metadata(self) -> dict[str, str]:
        """The SHA-256 of each file, for the metadata of the recording."""
        return {f"{HASH_OF}{name}": source.sha256 for source, name in self.names.items()}


def keep_parts(scenario: Scenario, folder: Path, reserved: Iterable[str] = ()) -> KeptParts:
    """Copies the files that a scenario names into a folder; returns their names there.  Raises OSError.

    Nothing is overwritten: if another file has the name already, or it is `reserved`, a number is added (`law-2.py`)."""
    names: dict[Source, str] = {}
    results: dict[str, PartResult] = {}
    for part in parts_in(scenario):
        if part.source is not None:
            if part.source not in names:
                names[part.source] = _copied(part.source, folder, {*names.values(), *reserved})
            name, use = names[part.source], part.use.rpartition(":")[2]
            results[f"{name}:{use}"] = PartResult(f"{name}:{use}", name, part.source.sha256)
        elif not part.is_own:
            results[part.use] = PartResult(part.use, None, None)
    for rule in scenario.links:
        if isinstance(rule.delay, Trace) and rule.delay.file not in names:
            names[rule.delay.file] = _copied(rule.delay.file, folder, {*names.values(), *reserved})
    return KeptParts(names, tuple(results.values()))


def _copied(source: Source, folder: Path, taken: set[str]) -> str:
    """Copies a file into a folder, unless the same text is there already; returns its name there.

    `taken` are names that it cannot have."""
    data, path = source.text.encode(), Path(source.name)
    count = 1
    while True:
        target = folder / (path.name if count == 1 else f"{path.stem}-{count}{path.suffix}")
        if target.name not in taken:
            with suppress(FileExistsError), target.open("xb") as file:
                file.write(data)
                return target.name
            if target.is_file() and target.read_bytes() == data:
                return target.name
        count += 1
