"""Values of Python as TOML text, as `--set` takes them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from echelon.errors import UserError
from echelon.plugins import Plugin


def toml_value(value: Any) -> str:
    """Returns a Python or numpy value as TOML text.  Raises UserError for a value that has no TOML type."""
    if hasattr(value, "tolist"):  # numpy
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (str, Path)):
        return tomlkit.item(str(value)).as_string()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, Mapping):
        return (
            "{"
            + ", ".join(f"{tomlkit.key(str(key)).as_string()} = {toml_value(item)}" for key, item in value.items())
            + "}"
        )
    if isinstance(value, (type, Plugin)):
        name = value.__name__ if isinstance(value, type) else type(value).__name__
        raise UserError(
            f"{name}: a scenario names a class by its file, which every process of a run reads: write it into a file beside "
            f"the scenario, my_laws.py for example, and give 'my_laws.py:{name}'"
        )
    raise UserError(f"{value!r}: must be a number, a string, a boolean, a list or a dictionary to be set in a scenario")
