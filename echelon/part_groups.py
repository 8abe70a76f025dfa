"""The groups of parts (echelon.plugins): how a scenario names a part, and how its parameters are checked.

A scenario names a part in one of three ways:

    use = "circle"                    built into this package
    use = "spiral"                    installed: an entry point of the group `echelon.trajectories`
    use = "my_paths.py:Spiral"        a class in a Python file beside the scenario

Parameters are checked by pydantic, from the types of the class's fields.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

from pydantic import TypeAdapter, ValidationError

from echelon.plugins import Part, PartError, Plugin, Source, class_in, error_text


@dataclass(frozen=True, slots=True)
class PartGroup:
    """A kind of parts: its name (one of `GROUPS`), the base class of its parts, and the built-in parts by name."""

    name: str
    base: type[Plugin]
    built_in: Mapping[str, type[Plugin]]
    default: str = ""
    """The built-in part of a scenario that names no part of this group; empty: the scenario must name one"""

    def find(self, use: str, folder: Path) -> tuple[type[Plugin], Source | None]:
        """Returns the class that `use` names, and its file if it is a class in a file.  Files are relative to `folder`.

        Raises PartError if there is no such class, or if it is not a complete part of this group."""
        if use in self.built_in:
            return self.built_in[use], None
        file, colon, name = use.rpartition(":")
        if colon and file.endswith(".py"):
            source = read_source(file, folder)
            return self._checked(class_in(source, name), use), source
        installed = {point.name: point for point in entry_points(group=f"echelon.{self.name}")}
        if use not in installed:
            raise PartError(self._unknown(use, [*self.built_in, *installed]))
        try:
            found = installed[use].load()
        except Exception as error:
            raise PartError(f"the installed {installed[use].value} cannot be loaded: {error_text(error)}") from None
        return self._checked(found, use), None

    def make(self, use: str, parameters: Mapping[str, Any], folder: Path) -> Part[Any]:
        """Returns the part that `use` names, with these parameters.  Raises PartError if the part or a parameter is wrong."""
        found, source = self.find(use, folder)
        adapter = _adapter(cast(Any, found))
        try:
            made = adapter.validate_python(dict(parameters))
        except ValidationError as error:
            errors = error.errors(include_url=False)
            raise PartError("wrong parameters", errors=errors, model=found) from None
        except Exception as error:  # a part's own validator may raise anything
            raise PartError(f"{use} refuses its parameters: {error_text(error)}") from None
        return Part(use, adapter.dump_python(made, mode="json", exclude_none=True), source, made)

    def _checked(self, found: Any, use: str) -> type[Plugin]:
        if not (isinstance(found, type) and issubclass(found, self.base)):
            raise PartError(f"{use} must be a class derived from echelon.{self.base.__name__}")
        if missing := sorted(getattr(found, "__abstractmethods__", ())):
            raise PartError(f"{use} lacks the method {', '.join(missing)}")
        try:
            _adapter(cast(Any, found))
        except Exception as error:  # a type that pydantic does not know
            raise PartError(f"{use}: {error_text(error)}") from None
        return found

    def _unknown(self, use: str, known: list[str]) -> str:
        close = get_close_matches(use, known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        return f"{allowed(known)}{hint}"


@dataclass(frozen=True, slots=True)
class Registry:
    """All groups of parts.  `echelon.sim.parts.loading` makes it with the built-in parts; planning uses it."""

    groups: Mapping[str, PartGroup]

    def find(self, group: str, use: str, folder: Path) -> tuple[type[Plugin], Source | None]:
        """Returns a class of a group and its file, as `PartGroup.find`.  Raises PartError."""
        return self.groups[group].find(use, folder)

    def make(self, group: str, use: str, parameters: Mapping[str, Any], folder: Path) -> Part[Any]:
        """Returns a part of a group with these parameters, as `PartGroup.make`.  Raises PartError."""
        return self.groups[group].make(use, parameters, folder)

    def default(self, group: str) -> Part[Any]:
        """Returns the default part of a group, for a scenario that names none.  Raises PartError if there is no default."""
        return self.make(group, self.groups[group].default, {}, Path())

    def allowed(self, group: str) -> str:
        """Returns the sentence of an error that says how a scenario may name a part of a group."""
        return allowed(list(self.groups[group].built_in))


def allowed(names: list[str]) -> str:
    """Returns the sentence of an error that lists these names, and says that a class in a file is allowed as well."""
    return f"must be one of {', '.join(map(repr, names))}, or 'file.py:Class'"


def read_source(name: str, folder: Path) -> Source:
    """Returns the text of a file in `folder`.  Raises PartError if it cannot be read, or is not UTF-8."""
    path = folder / name
    try:
        return Source(name, path.read_bytes().decode())
    except OSError as error:
        raise PartError(f"{path}: {error.strerror}") from None
    except ValueError as error:  # not UTF-8, or a path with a zero byte
        raise PartError(f"{path}: is not UTF-8 text: {error}") from None


@cache
def _adapter(part: type[Any]) -> TypeAdapter[Any]:
    return TypeAdapter(part)
