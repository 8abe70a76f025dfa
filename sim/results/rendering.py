"""Records written as JSON and read back, and the JSON schemas of summary.json and of what `echelon analyse` prints."""

import inspect
import json
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any, get_args, get_type_hints

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
    write_text(path, json_text(summary) + "\n", durable=True)


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
    return _schema(_adapter(), Summary, "summary.json of an echelon run")


def analysis_schema() -> dict[str, Any]:
    """Returns the JSON schema of what `echelon analyse --json` prints."""
    from pydantic import TypeAdapter

    from echelon.sim.results.analysis import AnalysisResult

    return _schema(TypeAdapter(AnalysisResult), AnalysisResult, "what echelon analyse --json prints")


def _schema(adapter: Any, record: type, title: str) -> dict[str, Any]:
    """Returns the JSON schema of a record and of all records in it."""
    schema: dict[str, Any] = adapter.json_schema(mode="serialization")
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title} | schema
    known = {each.__name__: each for each in _records_in(record)}
    for name, table in [*schema.get("$defs", {}).items(), (record.__name__, schema)]:
        if name in known:
            _describe(table, known[name])
    return schema


def _records_in(kind: Any) -> Iterator[type]:
    """Yields the records that a type is made of, itself included."""
    if is_dataclass(kind) and isinstance(kind, type):
        yield kind
    parts = get_type_hints(kind).values() if is_dataclass(kind) else get_args(kind)
    for part in parts:
        yield from _records_in(part)


@cache
def _adapter() -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(Summary)


def _describe(table: dict[str, Any], record: type) -> None:
    """Puts the docstrings of a record and of its fields into the record's part of the schema."""
    table["description"] = inspect.getdoc(record)
    for name, text in field_docstrings(record).items():
        table["properties"][name]["description"] = text
