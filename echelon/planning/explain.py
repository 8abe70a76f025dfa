"""Turns pydantic's errors about a scenario into lines for the user: the key, the value and what is allowed."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from difflib import get_close_matches
from types import UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, Tag
from pydantic_core import ErrorDetails

from echelon.plugins import PartError

TEXTS: Final = {
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "finite_number": "must be a finite number",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be a string",
    "string_unicode": "must be a string of Unicode characters",
    "list_type": "must be an array",
    "too_short": "must have {min_length} or more entries, not {actual_length}",
    "too_long": "must have {max_length} or fewer entries, not {actual_length}",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "dataclass_type": "must be a table",
    "missing": "missing",
}
"""Texts for pydantic's types of errors.  `_text` makes the texts that need more than the error's context."""

UNKNOWN: Final = ("extra_forbidden", "unexpected_keyword_argument")
"""pydantic's types of the error of an unknown key: in a table, and in the parameters of a part"""
NAME_RULE: Final = "a name is a lower-case letter, then up to 31 lower-case letters, digits, hyphens or underscores"
PAIR_RULE: Final = "must be two numbers, [x, y]"


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake in a scenario: the keys that lead to it, and the line for the user."""

    keys: tuple[str | int, ...]
    text: str


def explain(errors: Sequence[ErrorDetails], root: type, above: tuple[str | int, ...] = ()) -> list[Mistake]:
    """Returns the mistakes, each once.

    If a key is missing and an unknown key resembles it, only the unknown key is reported, since it is probably misspelled.
    `root` is the model that was validated; `above` are the keys that lead to it in the file."""
    misspelled = {
        (error["loc"][:-1], close)
        for error in errors
        if error["type"] in UNKNOWN and (close := close_key(str(error["loc"][-1]), _walk(error["loc"], root)[1]))
    }
    reported = [e for e in errors if e["type"] != "missing" or (e["loc"][:-1], e["loc"][-1]) not in misspelled]
    return list(dict.fromkeys(mistake for error in reported for mistake in _mistakes(error, root, above)))


def _mistakes(error: ErrorDetails, root: type, above: tuple[str | int, ...]) -> list[Mistake]:
    """Returns the mistakes of one error: several if it is a part with several wrong parameters."""
    if error["type"] != "value_error" or not isinstance(part := error["ctx"]["error"], PartError):
        return [_mistake(error, root, above)]
    keys = above + _walk(error["loc"], root)[0] + part.keys
    if part.model is not None:
        return explain(part.errors, part.model, keys)
    shown = "" if part.shown is None else f" = {value_text(part.shown)}"
    return [Mistake(keys, f"{key_text(keys)}{shown}: {part.text}")]


def _mistake(error: ErrorDetails, root: type, above: tuple[str | int, ...]) -> Mistake:
    """Returns the mistake of one error that does not come from a part."""
    kind, value, location = error["type"], error["input"], error["loc"]
    if kind.startswith("recursion"):
        return Mistake(("formation",), "formation: groups are nested too deep")
    if kind.startswith("string") and location[-1] == "[key]":  # the key is wrong, not its value
        keys = above + _walk(location[:-1], root)[0]
        return Mistake(keys, f"{key_text(keys)}: {NAME_RULE}")
    keys, annotation = _walk(location, root)
    keys = above + keys
    if kind in UNKNOWN:
        return Mistake(keys, f"{key_text(keys)}: {_unknown(str(keys[-1]), annotation)}")
    if kind in ("union_tag_invalid", "union_tag_not_found"):  # a table whose `kind` is wrong or missing
        keys, kinds = (*keys, "kind"), list(_members(annotation))
        if kind == "union_tag_not_found":
            return Mistake(keys, f"{key_text(keys)}: missing; {_one_of(kinds)}")
        return Mistake(keys, f"{key_text(keys)} = {value_text(value['kind'])}: {_one_of(kinds, value['kind'])}")
    if kind == "missing" and isinstance(keys[-1], int):  # a pair with one number: report the pair
        keys, kind = keys[:-1], "tuple_type"
    text = PAIR_RULE if kind == "tuple_type" else _text(error, annotation)
    shown = "" if kind in ("missing", "value_error") else f" = {value_text(value)}"
    return Mistake(keys, f"{key_text(keys)}{shown}: {text}")


def _text(error: ErrorDetails, annotation: Any) -> str:
    """Returns the text that says what is allowed in the place of an error."""
    kind, value = error["type"], error["input"]
    if kind == "value_error":
        return str(error["ctx"]["error"])
    if kind == "literal_error":
        return _one_of(get_args(_bare(annotation)), value)
    if kind == "string_pattern_mismatch":
        return NAME_RULE
    if get_origin(_bare(annotation)) is tuple:
        return PAIR_RULE
    if kind == "float_type" and isinstance(value, int) and not isinstance(value, bool):
        return "is too large for a number"
    if kind == "float_type" and _members(annotation):
        return f"must be {' or '.join(_members(annotation))}"
    if kind in TEXTS:
        return TEXTS[kind].format_map({key: _limit(limit) for key, limit in error.get("ctx", {}).items()})
    return error["msg"].replace("Input should", "must")


def _limit(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _one_of(allowed: Sequence[str], value: Any = None) -> str:
    names = ", ".join(repr(name) for name in allowed)
    text = f"must be one of {names}" if len(allowed) > 1 else f"must be {names}"
    close = get_close_matches(value, allowed, n=1) if isinstance(value, str) else []
    return f"{text}; did you mean {close[0]!r}?" if close else text


def _unknown(key: str, model: Any) -> str:
    known = ", ".join(sorted(_fields(model)))
    if not known:
        return "unknown key; there are none here"
    close = close_key(key, model)
    return f"unknown key; did you mean {close!r}?" if close else f"unknown key; known here: {known}"


def close_key(key: str, model: Any) -> str | None:
    """Returns the key of a table that most resembles an unknown key, or None."""
    close = get_close_matches(key, sorted(_fields(model)), n=1, cutoff=0.5)
    return close[0] if close else None


def _walk(location: Sequence[str | int], root: Any) -> tuple[tuple[str | int, ...], Any]:
    """Follows a location of a pydantic error through the types of a model.

    Returns the parts of the location that are keys of the file (other parts name members of unions), and the type to which
    the location leads.  A location that ends with an unknown key leads to the type of the table with that key.
    """
    keys: list[str | int] = []
    annotation: Any = root
    for at, part in enumerate(location, start=1):
        if members := _members(annotation):
            member = members[str(part)]
            if at < len(location) or _is_model(member) or _members(member):
                annotation = member
            continue  # a plain value: the type stays the union, so that all its members are offered
        keys.append(part)
        bare = _bare(annotation)
        # of a list, a pair, or a table of tables the last type argument is the type of its entries
        annotation = _fields(bare).get(str(part), annotation) if _is_model(bare) else get_args(bare)[-1]
    return tuple(keys), annotation


def is_array(keys: Sequence[str], root: type[BaseModel]) -> bool:
    """True if a path of keys, which may hold numbers of entries, leads to an array of tables in a model."""
    annotation: Any = root
    for key in keys:
        bare = _bare(annotation)
        if _is_model(bare) and key in _fields(bare):
            annotation = _fields(bare)[key]
        elif get_origin(bare) in (list, dict):
            annotation = get_args(bare)[-1]
        else:
            return False
    bare = _bare(annotation)
    entry = get_args(bare)[0] if get_origin(bare) is list else None
    return _is_model(entry) or any(map(_is_model, _members(entry).values()))


def _is_model(annotation: Any) -> bool:
    bare = _bare(annotation)
    return isinstance(bare, type) and (issubclass(bare, BaseModel) or is_dataclass(bare))


def _fields(model: Any) -> dict[str, Any]:
    """Returns the types of the keys of a table: a pydantic model, or a dataclass, which a part is."""
    bare = _bare(model)
    if issubclass(bare, BaseModel):
        return {name: field.annotation for name, field in bare.model_fields.items()}
    types = get_type_hints(bare)
    return {field.name: types[field.name] for field in fields(bare)}


def _bare(annotation: Any) -> Any:
    """Returns a type without its metadata (Annotated) and without None."""
    while get_origin(annotation) is Annotated or (_is_union(annotation) and len(_choices(annotation)) == 1):
        annotation = get_args(annotation)[0] if get_origin(annotation) is Annotated else _choices(annotation)[0]
    return annotation


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, UnionType)


def _choices(annotation: Any) -> list[Any]:
    return [choice for choice in get_args(annotation) if choice is not type(None)]


def _members(annotation: Any) -> dict[str, Any]:
    """Returns the members of a union by their tags in pydantic's locations; empty if the type is not a union."""
    bare = _bare(annotation)
    return {_tag(member): member for member in _choices(bare)} if _is_union(bare) else {}


def _tag(member: Any) -> str:
    if get_origin(member) is Annotated:
        return next(data.tag for data in get_args(member) if isinstance(data, Tag))
    literal = member.model_fields["kind"].annotation
    assert get_origin(literal) is Literal
    return str(get_args(literal)[0])


def key_text(keys: Sequence[str | int]) -> str:
    """Returns a path of keys as `--set` takes it: `links.0.delay`.  Keys that TOML would quote are quoted."""
    return ".".join(str(key) if re.fullmatch(r"[A-Za-z0-9_-]+", str(key)) else short(json.dumps(key)) for key in keys)


def value_text(value: Any) -> str:
    """Returns a value nearly as TOML writes it, in at most 60 characters."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return short(f"[{', '.join(value_text(item) for item in value[:30])}]")
    if isinstance(value, int) and value.bit_length() > 1000:  # Python refuses to write such a number out
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, (str, int, float)):
        return short(repr(value))
    return "{...}" if isinstance(value, dict) else short(str(value))


def short(text: str) -> str:
    """Returns a text cut to at most 60 characters."""
    return text if len(text) <= 60 else text[:57] + "..."
