"""Files of studies: a question, the sweeps that answer it, and the finding with its numbers (docs/studies.md)."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Any, Final, TypeVar

from echelon.errors import UsageError
from echelon.shipped import FOLDER as SCENARIOS

FOLDER: Final = SCENARIOS.parent / "studies"
Kind = TypeVar("Kind")


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepPart:
    """A sweep of a study, with the options of `echelon sweep`."""

    name: str
    scenario: str
    set: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    zip: bool = False
    find: str | None = None
    share: float = 0.9
    seeds: int | None = None
    engine: str | None = None
    allow_unstable: bool = False
    beside: str | None = None
    """The sweep in whose figures this one is a line, too; what it varies counts as the axis of that sweep"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A number that the finding says, and where it is measured.

    `column` is a column of the points of a sweep, read in the row with the values `at`; or `largest`, the largest value that
    holds; or `predicted`, the prediction of it.  With `over`, another such place, it is the ratio of the two."""

    says: str
    """The number as the finding writes it"""
    value: float
    within: float
    """By how much what is measured may differ"""
    sweep: str
    column: str
    at: Mapping[str, Any]
    over: Mapping[str, Any] | None = None
    """The sweep, column and values of the number that it is divided by; what is missing is as above"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A study."""

    name: str
    title: str
    question: str
    finding: str
    sweeps: tuple[SweepPart, ...]
    numbers: tuple[Number, ...] = ()


def shipped_studies() -> dict[str, Path]:
    """Returns the files of all shipped studies by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}


def read_study(name: str) -> Study:
    """Returns the study in a file, or the shipped one with this name.  Raises UsageError."""
    path, known = Path(name), shipped_studies()
    if name in known and not path.is_file():
        path = known[name]
    elif not path.is_file():
        raise UsageError(f"{name}: no such file, and no shipped study; those are {', '.join(known)}")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    return parse_study(table, path.stem, str(path))


def parse_study(table: Mapping[str, Any], name: str, where: str) -> Study:
    """Returns the study in a table; `where` begins the text of errors.  Raises UsageError."""
    common = {key: value for key, value in table.items() if key == "scenario"}
    sweeps = [
        _made(SweepPart, {**common, **each}, f"{where}: sweeps.{number}")
        for number, each in enumerate(_tables(table, "sweeps", where))
    ]
    if not sweeps:
        raise UsageError(f"{where}: sweeps: there is none")
    numbers = [
        _made(Number, {"at": {}, **each}, f"{where}: numbers.{number}")
        for number, each in enumerate(_tables(table, "numbers", where))
    ]
    names = [one.name for one in sweeps]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"{where}: sweeps: two of them have the name {twice[0]!r}")
    for part in sweeps:
        _check_beside(part, sweeps, where)
    for number in numbers:
        for place in (number, *([] if number.over is None else [_divisor(number, where)])):
            if place.sweep not in names:
                raise UsageError(f"{where}: numbers: there is no sweep {place.sweep!r}; there are {', '.join(names)}")
        if not isfinite(number.value) or not number.within >= 0:
            raise UsageError(f"{where}: numbers: {number.says!r}: value and within must be finite, within at least 0")
    rest = {key: value for key, value in table.items() if key not in ("scenario", "sweeps", "numbers")}
    return _made(Study, {**rest, "name": name, "sweeps": tuple(sweeps), "numbers": tuple(numbers)}, where)


def _check_beside(part: SweepPart, sweeps: Sequence[SweepPart], where: str) -> None:
    """Raises UsageError if a sweep cannot be a line in the figures of another one."""
    if part.beside is None:
        return
    host = next((one for one in sweeps if one.name == part.beside and one.beside is None), None)
    if host is None:
        raise UsageError(f"{where}: sweeps: {part.name}: beside: there is no other sweep {part.beside!r}")
    if len(part.vary) != 1 or len(host.vary) < 2 or host.zip or part.find or host.find or part.seeds != host.seeds:
        raise UsageError(
            f"{where}: sweeps: {part.name}: beside: one key must vary here, and in {host.name!r} several as a grid; "
            "both without find, with the same number of seeds"
        )


def _divisor(number: Number, where: str) -> Number:
    """Returns the place of the number that another one is divided by, as a number.  Raises UsageError."""
    own = {"says": number.says, "value": number.value, "within": number.within}
    place = {"sweep": number.sweep, "column": number.column, "at": number.at}
    return _made(Number, {**own, **place, **(number.over or {})}, f"{where}: numbers: {number.says!r}: over")


def _tables(table: Mapping[str, Any], key: str, where: str) -> Sequence[Mapping[str, Any]]:
    found = table.get(key, [])
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise UsageError(f"{where}: {key}: must be an array of tables, [[{key}]]")
    return found


def _made(kind: type[Kind], values: Mapping[str, Any], where: str) -> Kind:
    """Returns a dataclass made from a table.  Raises UsageError for keys that are missing, unknown or of another type."""
    known = {one.name: one for one in fields(kind)}  # type: ignore[arg-type]
    if unknown := [key for key in values if key not in known]:
        raise UsageError(f"{where}: {unknown[0]}: there is no such key; there are {', '.join(known)}")
    if missing := [key for key, one in known.items() if one.default is MISSING and key not in values]:
        raise UsageError(f"{where}: {missing[0]}: is missing")
    made = {}
    for key, value in values.items():
        text = str(known[key].type)
        fits = (
            isinstance(value, (list, tuple)) and all(isinstance(each, str) for each in value) if "tuple[str" in text
            else isinstance(value, tuple) if "tuple" in text
            else isinstance(value, Mapping) if "Mapping" in text
            else isinstance(value, (int, float)) if "float" in text
            else isinstance(value, bool if "bool" in text else int if "int" in text else str)
        )  # fmt: skip
        if not fits:
            raise UsageError(f"{where}: {key} = {value!r}: is of the wrong type")
        made[key] = tuple(value) if isinstance(value, list) else value
    return kind(**made)
