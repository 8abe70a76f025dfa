"""The keys of a scenario as a JSON schema for editors and as a page of Markdown for people, made from the tables.

The description of a key is the docstring below its field.  It is read from the source only when a schema is made: with
pydantic's `use_attribute_docstrings` it would be read for every table of every run, and each start would take 30 ms longer.
"""

import json
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, Final

from pydantic import BaseModel, TypeAdapter

from echelon.docstrings import field_docstrings
from echelon.part_groups import Registry
from echelon.plugins import Plugin
from echelon.scenario.part_fields import BESIDE, KIND, PART
from echelon.scenario.tables import Scenario
from echelon.scenario.values import Table

Schema = dict[str, Any]
USE: Final = "Part"
_USE: Final[Schema] = {
    "title": USE,
    "type": "object",
    "description": "A part that is built in, installed, or a class in a Python file",
    "properties": {
        "use": {
            "type": "string",
            "description": "Name of a built-in or installed part, or `file.py:Class`, a file relative to the scenario",
        },
        "parameters": {"type": "object", "description": "Parameters of the part: the fields of its class"},
    },
    "required": ["use"],
    "additionalProperties": False,
}
WITH_KIND: Final = "trajectories"
"""The group whose parts are written as a table with the name as `kind` and the parameters beside it"""
USE_KEYS: Final = {"laws": "law.use", "plants": "robot.model.use", "protocols": "robot.drive.protocol.use"}
"""The keys that hold the names of parts of the other groups"""
DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
HEAD: Final = """\
# Scenario files

All keys of a scenario, made from their source by `make docs`.  `echelon schema scenario` prints the same as a JSON schema
for editors, `echelon validate FILE` checks a file, and `echelon new NAME` writes one to begin with.

Rules of links, with examples: [links.md](links.md).

A part of your own (a law, a plant, a trajectory, a drive protocol) is a class in a Python file beside the scenario:
`trajectory = { use = "my_paths.py:Eight", parameters = { … } }` ([how to](add-a-law.md)).

"""


def scenario_schema(registry: Registry) -> Schema:
    """Returns the JSON schema of scenario files.  The description of a key is the docstring of its field; built-in parts are
    those of `registry`."""
    schema = Scenario.model_json_schema(mode="serialization")
    schema["$defs"] |= {USE: _USE}
    docs = {model.__name__: field_docstrings(model) for model in _tables(Table)}
    docs[USE] = {key: value["description"] for key, value in _USE["properties"].items()}
    for group, name, part in _built_in(registry):
        schema["$defs"][part.__name__] = _part(group, name, part)
        docs[part.__name__] = {KIND: f"`{name}`"} | field_docstrings(part)
    schema = _plain(_with_parts(schema, registry))
    schema["$defs"]["Law"]["allOf"] = [
        {
            "if": {"properties": {"use": {"const": name}}, "required": ["use"]},
            "then": {"properties": {"parameters": {"$ref": f"#/$defs/{part.__name__}"}}},
        }
        for group, name, part in _built_in(registry)
        if group == "laws"
    ]
    for name, table in {Scenario.__name__: schema, **schema["$defs"]}.items():
        for key, value in table["properties"].items():
            value["description"] = docs[name][key]
    return {"$schema": DIALECT, **schema}


def _built_in(registry: Registry) -> Iterator[tuple[str, str, type[Plugin]]]:
    """Yields group, name and class of the built-in parts that need a table of their own in the schema.

    These are all laws, all parts that are written with their `kind`, and all other parts that have parameters."""
    for group in registry.groups.values():
        for name, part in group.built_in.items():
            if fields(part) or group.name in (WITH_KIND, "laws"):
                yield group.name, name, part


def _part(group: str, name: str, part: type[Plugin]) -> Schema:
    """Returns the schema of a built-in part's parameters, with the key `kind` if its group is written with it."""
    table = TypeAdapter(part).json_schema()
    assert "$defs" not in table, "parameters of parts are plain values"
    if group != WITH_KIND:
        return {"properties": {}, **table}
    properties = {KIND: {"const": name, "type": "string"}, **table.get("properties", {})}
    return {**table, "properties": properties, "required": [KIND, *table.get("required", ())]}


def _with_parts(schema: Any, registry: Registry) -> Any:
    """Returns a schema in which each field that holds a part lists what may be written there."""
    if isinstance(schema, list):
        return [_with_parts(part, registry) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if PART not in schema:
        return {key: _with_parts(value, registry) for key, value in schema.items()}
    built_in, use = registry.groups[schema[PART]].built_in, {"$ref": f"#/$defs/{USE}"}
    other = {"type": "string", "not": {"enum": list(built_in)}}  # an installed part, which may take any parameters
    if schema[BESIDE] is None:
        return {"oneOf": [{"enum": list(built_in)}, other]}
    if schema[BESIDE]:
        installed = {"type": "object", "properties": {KIND: other}, "required": [KIND]}
        return {"oneOf": [*({"$ref": f"#/$defs/{part.__name__}"} for part in built_in.values()), installed, use]}
    return {"oneOf": [{"enum": list(built_in)}, other, use]}


def reference_page(registry: Registry) -> str:
    """Returns a Markdown page with a section for each table of a scenario: its place, its keys, their values and defaults."""
    schema = scenario_schema(registry)
    sections = []
    for name, places in _places(schema).items():
        table = schema if name == Scenario.__name__ else schema["$defs"][name]
        where = ", ".join(f"`{place}`" for place in places)
        if kind := table["properties"].get("kind", {}).get("const"):
            where += f", kind `{kind}`"
        sections.append(f"## {where or 'The file'}\n\n{_text(table['description'])}\n\n{_rows(table)}")
    for group, name, part in _built_in(registry):
        if group != WITH_KIND and fields(part):
            table = schema["$defs"][part.__name__]
            where = f"`parameters` of `{USE_KEYS[group]} = {json.dumps(name)}`"
            sections.append(f"## {where}\n\n{_text(table['description'])}\n\n{_rows(table)}")
    return HEAD + "\n".join(sections)


def _tables(table: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in table.__subclasses__():
        yield model
        yield from _tables(model)


def _plain(schema: Any) -> Any:
    """Returns a schema without entries that mean nothing in TOML: null, which TOML does not have; titles, which repeat the
    keys; and defaults of tables, because their keys have defaults."""
    if isinstance(schema, list):
        return [_plain(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if "anyOf" in schema:
        one, *others = [part for part in schema["anyOf"] if part.get("type") != "null"]
        assert not others, "a key with several types needs tags"
        schema = {key: value for key, value in schema.items() if key not in ("anyOf", "default")} | one
    if "patternProperties" in schema:
        schema = schema | {"additionalProperties": False}
    is_table = schema.get("type") == "object" and "properties" in schema
    return {
        key: {name: _plain(part) for name, part in value.items()} if key in ("properties", "$defs") else _plain(value)
        for key, value in schema.items()
        if (key != "title" or is_table) and not (key == "default" and isinstance(value, dict))
    }


def _places(schema: Schema) -> dict[str, list[str]]:
    """Returns for each table all places in a scenario where it may stand; a table comes before the tables in it."""
    places: dict[str, list[str]] = {Scenario.__name__: []}

    def walk(place: str, table: Schema) -> None:
        for key, value in table["properties"].items():
            for end, name in _references(value):
                there = f"{place}.{key}{end}".removeprefix(".")
                known = name in places
                places.setdefault(name, []).append(there)
                if not known:
                    walk(there, schema["$defs"][name])

    walk("", schema)
    return places


def _references(value: Schema) -> Iterator[tuple[str, str]]:
    """Yields the tables that a value may be: the suffix of the key in each case, and the name of the table."""
    if "$ref" in value:
        yield "", value["$ref"].rpartition("/")[2]
    for part in value.get("oneOf", ()):
        yield from _references(part)
    for part in value.get("patternProperties", {}).values():
        yield from ((f".NAME{end}", name) for end, name in _references(part))
    if isinstance(value.get("items"), dict):
        yield from ((f"[]{end}", name) for end, name in _references(value["items"]))


def _rows(table: Schema) -> str:
    lines = ["| key | value | default | what it is |", "|---|---|---|---|"]
    for key, value in table["properties"].items():
        default = "needed" if key in table.get("required", ()) else _default(value.get("default"))
        lines.append(f"| `{key}` | {_values(value)} | {default} | {_text(value['description'])} |")
    return "\n".join(lines) + "\n"


def _default(value: Any) -> str:
    return "" if value is None or isinstance(value, dict) else _literal(value)


def _literal(value: Any) -> str:
    return f"`{json.dumps(value, ensure_ascii=False)}`"


def _values(value: Schema) -> str:
    """Returns a description in words of the values that a schema allows."""
    if "const" in value:
        return _literal(value["const"])
    if "enum" in value:
        return ", ".join(map(_literal, value["enum"]))
    if "oneOf" in value:
        return "; or ".join(dict.fromkeys(_values(part) for part in value["oneOf"]))
    if "$ref" in value:
        return "table"
    match value["type"]:
        case "array" if "prefixItems" in value:
            first, *others = (_values(part) for part in value["prefixItems"])
            return f"[{', '.join([first, *others])}]" if "," not in first else f"[…, …], each a {first}"
        case "array":
            return f"array of {_values(value['items'])}"
        case "object":
            return "tables by name" if "patternProperties" in value else "table"
        case "string":
            return "name" if "pattern" in value else "string"
        case "boolean":
            return "`true`, `false`"
        case kind:
            return _range("whole number" if kind == "integer" else "number", value)


def _range(what: str, value: Schema) -> str:
    bounds = {
        "exclusiveMinimum": "more than",
        "minimum": "at least",
        "exclusiveMaximum": "less than",
        "maximum": "at most",
    }
    said = [f"{words} {_limit(value[key])}" for key, words in bounds.items() if key in value]
    return f"{what}, {', '.join(said)}" if said else what


def _limit(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.10g}"


def _text(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
