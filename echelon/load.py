"""Reading a scenario: TOML, overrides, and mistakes explained in one line (file, key, value, what is allowed)."""

import tomllib
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

import tomlkit
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from echelon.plan import Plan
from echelon.planning import PlanError, make_plan
from echelon.scenario import Scenario


class ScenarioError(Exception):
    """A mistake in a scenario or an override; the text is one line for its author."""


def load(path: Path, overrides: Sequence[str] = ()) -> tuple[Scenario, Plan]:
    """Reads a scenario file, applies overrides `key=value`, and makes its plan.  Raises ScenarioError."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise ScenarioError(f"{path}: {reason}") from None
    return parse(text, str(path), overrides)


def parse(text: str, name: str, overrides: Sequence[str] = ()) -> tuple[Scenario, Plan]:
    """Makes a scenario and its plan of TOML text; `name` stands for the file in messages.  Raises ScenarioError."""
    try:
        table: dict[str, Any] = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ScenarioError(_one_line(f"{name}: not TOML: {error}")) from None
    for override in overrides:
        _override(table, override)
    try:
        scenario = Scenario.model_validate(table)
    except ValidationError as error:
        raise ScenarioError(_one_line(f"{name}: {_explain(error.errors()[0], table)}")) from None
    except RecursionError:
        raise ScenarioError(f"{name}: groups are nested too deep") from None
    try:
        return scenario, make_plan(scenario)
    except PlanError as error:
        raise ScenarioError(_one_line(f"{name}: {error}")) from None


def effective_toml(scenario: Scenario) -> str:
    """Returns the scenario as TOML with all defaults written out; reading it again gives the same scenario."""
    return tomlkit.dumps(_without_none(scenario.model_dump(mode="json")))


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list):
        return [_without_none(item) for item in value]
    if isinstance(value, float) and value in (float("inf"), float("-inf")):
        return value
    return value


def _override(table: dict[str, Any], override: str) -> None:
    """Sets one value: `law.epsilon=[0.1, 0.2]`, `links.0.delay=0.006`; the value is TOML, or else a string."""
    key, equals, text = override.partition("=")
    chunks = key.strip().split(".")
    if not equals or not all(chunks):
        raise ScenarioError(_one_line(f"--set {override}: must read key=value, e.g. law.epsilon=[0.1, 0.2]"))
    try:
        value: Any = tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        value = text.strip()
    at: Any = table
    for chunk, following in zip(chunks, [*chunks[1:], None], strict=True):
        last = following is None
        if isinstance(at, list):
            if not chunk.isascii() or not chunk.isdecimal() or int(chunk) > len(at):
                raise ScenarioError(_one_line(f"--set {override}: {chunk!r} must be a number from 0 to {len(at)}"))
            index = int(chunk)
            if index == len(at):
                at.append({} if not last else None)
            if last:
                at[index] = value
            at = at[index]
        elif isinstance(at, dict):
            if last:
                at[chunk] = value
            else:
                at = at.setdefault(chunk, [] if following is not None and following.isdecimal() else {})
        else:
            raise ScenarioError(_one_line(f"--set {override}: {chunk!r} stands in a value, not in a table"))


def _explain(error: ErrorDetails, table: dict[str, Any]) -> str:
    location = [part for part in error["loc"] if not _is_tag(part, error["loc"], table)]
    key = ".".join(str(part) for part in location)
    if error["type"] == "extra_forbidden":
        allowed = _keys_at(location[:-1])
        close = get_close_matches(str(location[-1]), allowed, n=1, cutoff=0.5)
        hint = f"; did you mean {close[0]!r}?" if close else f"; known here: {', '.join(sorted(allowed))}"
        return f"{key}: unknown key{hint}"
    if error["type"] == "missing":
        return f"{key}: missing"
    value = error["input"]
    shown = "" if isinstance(value, dict) else f" = {_short(value)}"
    text = error["msg"].removeprefix("Value error, ")
    return f"{key}{shown}: {text[:1].lower() + text[1:]}"


def _is_tag(part: int | str, location: tuple[int | str, ...], table: dict[str, Any]) -> bool:
    """True for the parts that pydantic puts in a location to name a member of a union: they are no keys of the file."""
    at: Any = table
    for step in location:
        if isinstance(at, dict) and step in at:
            at = at[step]
        elif isinstance(at, list) and isinstance(step, int) and step < len(at):
            at = at[step]
        elif step == part and step is not location[-1]:
            return True
        elif step is part and not (isinstance(at, dict)):
            return True
    return False


def _keys_at(location: Sequence[int | str]) -> list[str]:
    """Returns the keys that are known in the table at a location of the scenario."""
    at: list[Any] = [Scenario]
    for step in location:
        found: list[Any] = []
        for model in at:
            if isinstance(model, type) and issubclass(model, BaseModel):
                if isinstance(step, str) and step in model.model_fields:
                    found.extend(_models(model.model_fields[step].annotation))
            elif isinstance(model, tuple):
                found.extend(model)
        at = found
    return sorted({name for m in at if isinstance(m, type) and issubclass(m, BaseModel) for name in m.model_fields})


def _models(annotation: Any) -> Iterable[Any]:
    """Yields the models an annotation may hold; those behind a list or a dict as a tuple, for the step into it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        return
    inner = [model for argument in get_args(annotation) for model in _models(argument)]
    if getattr(annotation, "__origin__", None) in (list, dict):
        yield tuple(inner)
    else:
        yield from inner


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _one_line(text: str) -> str:
    return " ".join(text.split())
