"""Reads a scenario: parses TOML, applies overrides, makes the plan, and reports each mistake in one line (file, key, value,
what is allowed)."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from echelon.errors import UserError
from echelon.part_groups import Registry
from echelon.plan.plan import Plan
from echelon.planning.explain import explain, is_array, key_text, short
from echelon.planning.missing_keys import fill_missing
from echelon.planning.plan_maker import PlanError, make_plan
from echelon.plugins import Source
from echelon.scenario.part_fields import PartContext
from echelon.scenario.tables import Scenario


class ScenarioError(UserError):
    """Mistakes in a scenario or in its overrides, one line each.  The first line begins with the name of the file."""


def load(path: Path, overrides: Sequence[str], registry: Registry) -> tuple[Scenario, Plan]:
    """Reads a scenario file, applies overrides `key=value`, and returns the scenario and its plan.  Raises ScenarioError.

    `registry` has the parts that a scenario may name; `echelon.sim.parts.loading.load` calls this with the usual one."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: is not UTF-8 text (byte {error.start})") from None
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from None
    except ValueError as error:  # a path with a zero byte
        raise ScenarioError(f"{path}: {error}") from None
    return parse(text, str(path), overrides, registry, path.parent)


def parse(text: str, name: str, overrides: Sequence[str], registry: Registry, folder: Path) -> tuple[Scenario, Plan]:
    """Returns the scenario and the plan of a TOML text.  Raises ScenarioError.

    Errors call the file `name`.  Files of parts are relative to `folder`."""
    table = read_table(text, name)
    if not table and not overrides:
        needed = [key for key, field in Scenario.model_fields.items() if field.is_required()]
        raise ScenarioError(f"{name}: empty; a scenario needs {', '.join(needed)}")
    changed: dict[str, str] = {}
    refused: list[tuple[str, str]] = []
    for override in overrides:
        try:
            changed[_override(table, override)] = override
        except OverrideError as error:
            refused.append((f"with --set {short(override)}", str(error)))
    if refused:
        raise _scenario_error(name, refused)
    missing: list[tuple[str, str]] = []
    found: list[tuple[str, str]] = []
    try:
        missing = fill_missing(table)
        scenario = Scenario.model_validate(table, context=PartContext(registry, folder))
        plan = make_plan(scenario, registry)
        if not missing:
            return scenario, plan
    except ValidationError as error:
        mistakes = explain(error.errors(include_url=False), Scenario)
        found = [(key_text(mistake.keys), mistake.text) for mistake in mistakes]
    except PlanError as error:
        found = [(line.split(" = ")[0].split(":")[0], line) for line in error.lines]
    except RecursionError:
        found = [("formation", "formation: groups are nested too deep")]
    raise _scenario_error(
        name, [(_overridden(key, changed), _with_name(text, table)) for key, text in [*found, *missing]]
    )


def _scenario_error(name: str, mistakes: Sequence[tuple[str, str]]) -> ScenarioError:
    """Returns the error for a list of mistakes: pairs of the override that causes the mistake (or an empty string) and its
    text."""
    (where, text), *others = dict.fromkeys(mistakes)
    first = f"{name} {where}: {text}" if where else f"{name}: {text}"
    return ScenarioError(first, *(f"{where}: {text}" if where else text for where, text in others))


def _with_name(text: str, table: Mapping[str, Any]) -> str:
    """Returns a text about a mistake; a rule of links that has a name is called by it: `links.uplink`."""
    links: Any = table.get("links")
    if not (about := _LINK.match(text)) or not _holds_tables(links):
        return text
    name = links[int(about[1])].get("name") if int(about[1]) < len(links) else None
    return f"links.{name}{text[about.end() :]}" if isinstance(name, str) and _NAME.fullmatch(name) else text


def effective_toml(scenario: Scenario, names: Mapping[Source, str] | None = None) -> str:
    """Returns the scenario as TOML with all defaults written out.  Reading it again gives the same scenario.

    `names` gives new names to files of parts."""
    import tomlkit  # imported here because it takes long and only few commands write a scenario

    return tomlkit.dumps(scenario.model_dump(mode="json", exclude_none=True, context=names))


_PARTS: Final = 1000
"""The largest number of parts that a key may have.  For a longer one tomllib takes time by the square of its length."""
_TEXT: Final = re.compile(r'''"""(?:[^\\]|\\.)*?"""|'{3}.*?'{3}|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|\#[^\n]*''', re.DOTALL)
"""Strings, quoted parts of keys, and comments: dots and separators in them mean nothing"""
_BETWEEN_KEYS: Final = re.compile(r"[=,\n\[\]{}]")


def read_table(text: str, name: str) -> dict[str, Any]:
    """Returns TOML text as a table.  Raises ScenarioError."""
    if any(one.count(".") >= _PARTS for one in _BETWEEN_KEYS.split(_TEXT.sub("q", text))):
        raise ScenarioError(f"{name}: not TOML that can be read: a key of {_PARTS} parts or more")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        hint = _THERE_ALREADY if str(error).startswith(_TWICE) else ""
        raise ScenarioError(f"{name}: not TOML: {error}{hint}") from None
    except RecursionError:
        raise ScenarioError(f"{name}: not TOML that can be read: nested too deep") from None
    except ValueError:  # Python limits the number of digits of an integer
        raise ScenarioError(f"{name}: an integer has too many digits") from None


class OverrideError(ValueError):
    """An override that cannot be applied."""


_TWICE: Final = ("Cannot overwrite a value", "Cannot mutate immutable namespace", "Cannot declare")
"""How tomllib begins its message about a key or table that is given a second time"""
_THERE_ALREADY: Final = (
    "; this key or table is there already: change it at its first place (a table in braces cannot be added to: "
    "write it as [table])"
)
_INDEX = re.compile(r"\s*\[\s*([0-9]{1,9})\s*\](?=\s*(?:[.\[]|$))")
"""The number of an array's entry in brackets, at the end of a chunk of a key"""
_LINK = re.compile(r"links\.([0-9]{1,9})(?![0-9A-Za-z_-])")
"""The key of a rule of links, at the beginning of a text"""
_NAME = re.compile(r"[a-z][a-z0-9_-]*")


def _override(table: dict[str, Any], override: str) -> str:
    """Sets one value in a table and returns its key.  Raises OverrideError.

    An override reads `law.epsilon=[0.1, 0.2]`, `links.0.delay=0.006` or `links[0].delay=0.006`.  An entry with a name may be
    called by it: `links.uplink.delay=0.006`.  The number may be left out if the array holds only one table:
    `links.delay=0.006`."""
    key, equals, text = override.partition("=")
    chunks = [chunk.strip() for chunk in _INDEX.sub(r".\1", key).split(".")]
    if not equals or not all(chunks):
        raise OverrideError("must read key=value, e.g. law.epsilon=[0.1, 0.2]")
    chunks = _numbered(table, chunks)
    at: Any = table
    for chunk, following in pairwise(chunks):
        empty: Any = [] if _is_number(following) else {}
        if isinstance(at, list):
            index = _index(at, chunk)
            at.extend([empty] if index == len(at) else [])
            at = at[index]
        elif isinstance(at, dict):
            at = at.setdefault(chunk, empty)
        else:
            break
    last, value = chunks[-1], value_of(text)
    if value == text.strip() and value[:1] in tuple("\"'[{"):
        raise OverrideError(f"{short(value)} begins as TOML, but is none; is a quote or a bracket missing?")
    if isinstance(at, list):
        index = _index(at, last)
        at[index : index + 1] = [value]
    elif isinstance(at, dict):
        at[last] = value
    else:
        raise OverrideError(f"{short(last)} would stand in a value, not in a table")
    return key_text(chunks)


def _numbered(table: dict[str, Any], chunks: Sequence[str]) -> list[str]:
    """Returns a path of keys in which entries of arrays of tables have their numbers: in place of their names, and where the
    number of an only entry was left out.

    Raises OverrideError if neither a name nor a number is given, and the array has not just one entry."""
    path: list[str] = []
    at: Any = table
    for chunk in chunks:
        if not _is_number(chunk) and is_array(path, Scenario) and (at is None or _holds_tables(at)):
            entries = at or []
            if named := [number for number, entry in enumerate(entries) if entry.get("name") == chunk]:
                path.append(str(named[0]))
                at = entries[named[0]]
                continue
            if len(entries) != 1:
                array, rest = ".".join(path), ".".join(chunks[len(path) :])
                have = f"{len(entries)} entries" if entries else "no entry yet"
                last = f", …, {array}.{len(entries) - 1}.{short(rest)}" if len(entries) > 2 else ""
                also = f" or {array}.1.{short(rest)}" if len(entries) == 2 else ""
                names = ", ".join(repr(entry["name"]) for entry in entries if isinstance(entry.get("name"), str))
                call = f" or its name ({names})" if names else ""
                raise OverrideError(f"{array} has {have}; give its number{call}: {array}.0.{short(rest)}{also}{last}")
            path.append("0")
            at = entries[0]
        path.append(chunk)
        if isinstance(at, list):
            at = at[int(chunk)] if _is_number(chunk) and int(chunk) < len(at) else None
        else:
            at = at.get(chunk) if isinstance(at, dict) else None
    return path


def _holds_tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)


def _is_number(chunk: str) -> bool:
    return chunk.isascii() and chunk.isdecimal() and len(chunk) <= 9


def _index(array: list[Any], chunk: str) -> int:
    """Returns the index that a chunk of a key stands for: of an entry, or of the next entry to be added.  Raises
    OverrideError."""
    if not _is_number(chunk) or int(chunk) > len(array):
        allowed = (
            f"a number from 0 to {len(array)}, for an entry or the next one" if array else "0, for the first entry"
        )
        raise OverrideError(f"{short(chunk)} must be {allowed}")
    return int(chunk)


def value_of(text: str) -> Any:
    """Returns the value of a text in TOML.  A text that is not TOML is returned as a string, so that strings need no quotes."""
    try:
        table = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text.strip()
    return table["value"] if len(table) == 1 else text.strip()


def _overridden(key: str, changed: dict[str, str]) -> str:
    """Returns `with --set …` if the value of a key, or a value within it, comes from an override; otherwise an empty string."""
    for path, override in reversed(changed.items()):
        if f"{key}.".startswith(f"{path}.") or f"{path}.".startswith(f"{key}."):
            return f"with --set {short(override)}"
    return ""
