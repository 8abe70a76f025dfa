"""JSON schemas that allow nothing they do not name."""

from typing import Any


def strict(schema: Any) -> Any:
    """Returns a schema that allows no key it does not name."""
    if isinstance(schema, dict):
        more = {"additionalProperties": False} if "properties" in schema else {}
        return {key: strict(value) for key, value in schema.items()} | more
    return [strict(item) for item in schema] if isinstance(schema, list) else schema
