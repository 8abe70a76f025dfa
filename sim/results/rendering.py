"""Records written as JSON and read back, and the JSON schema of summary.json."""

import inspect
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

from echelon.docstrings import field_docstrings
from echelon.files import write_text
from echelon.sim.results.records import Summary


def to_json(value: Any) -> Any:
    """Returns a record, or a list or mapping of records, as values of JSON; a number that is not finite becomes None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    if isinstance(value, float):
        return value if isfinite(value) else None
    return value


def json_text(value: Any) -> str:
    """Returns a record as indented JSON."""
    return json.dumps(to_json(value), indent=2, allow_nan=False, ensure_ascii=False)


def write_summary(summary: Summary, path: Path) -> None:
    """Writes summary.json.  Raises OSError."""
    write_text(path, json_text(summary) + "\n")


def read_summary(path: Path) -> Summary:
    """Reads summary.json.  Raises OSError, and ValueError if the file is not a summary in the present format."""
    from pydantic import ValidationError

    try:
        summary: Summary = _adapter().validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"is no summary that can be read: {where + ': ' if where else ''}{first['msg']}") from None
    return summary


def summary_schema() -> dict[str, Any]:
    """Returns the JSON schema of summary.json; descriptions are the docstrings of the records and their fields."""
    schema: dict[str, Any] = _adapter().json_schema(mode="serialization")
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "summary.json of an echelon run",
    } | schema
    records = {record.__name__: record for record in _records()}
    for name, table in [*schema.get("$defs", {}).items(), ("Summary", schema)]:
        if name in records:
            _describe(table, records[name])
    return schema


@cache
def _adapter() -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(Summary)


def _records() -> list[type]:
    from echelon.bridge import reports
    from echelon.sim.results import records, verdict

    return [value for module in (records, verdict, reports) for value in vars(module).values() if is_dataclass(value)]  # type: ignore[misc]


def _describe(table: dict[str, Any], record: type) -> None:
    """Puts the docstrings of a record and of its fields into the record's part of the schema."""
    table["description"] = inspect.getdoc(record)
    for name, text in field_docstrings(record).items():
        table["properties"][name]["description"] = text
