"""Parts of a run that users can write themselves: laws, plants, trajectories and drive protocols.

A part is a class derived from the base class of its group (Law, Plant, Trajectory, DriveProtocol).  It is a pydantic model:
its fields are the parameters that a scenario gives, and pydantic checks them.  A scenario names a part in one of three ways:

    use = "circle"                    built into this package
    use = "spiral"                    installed: an entry point of the group `echelon.trajectories`
    use = "my_paths.py:Spiral"        a class in a Python file beside the scenario

A file is read once, when the scenario is loaded.  Its text travels with the plan to every process of a run.  So all processes
run the same code even if the file changes meanwhile, and no folder is added to Python's module path.
"""

import ast
import hashlib
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.metadata import entry_points
from io import StringIO
from multiprocessing import parent_process
from pathlib import Path
from traceback import walk_tb
from types import ModuleType
from typing import Any, Final, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, PydanticUserError, ValidationError
from pydantic_core import ErrorDetails

from echelon.errors import PartRunError

T_co = TypeVar("T_co", covariant=True)

GROUPS: Final = ("laws", "plants", "trajectories", "protocols")
"""The kinds of parts; `echelon.<group>` is the group of their entry points."""


_NO_TYPE: Final = re.compile(r"non-annotated attribute was detected: `(\w+) = (.*?)`")
"""What pydantic says of a field without a type"""


class PartError(ValueError):
    """A scenario names a part that does not exist or cannot be loaded, or gives it wrong parameters.

    `keys` lead from the part's key in the scenario to the key that is wrong.  If parameters of the class `model` are wrong,
    `errors` are pydantic's errors; otherwise `text` says what is wrong with the value `shown`."""

    def __init__(
        self,
        text: str,
        keys: tuple[str, ...] = (),
        shown: Any = None,
        errors: Sequence[ErrorDetails] = (),
        model: type[BaseModel] | None = None,
    ) -> None:
        super().__init__(text)
        self.text, self.keys, self.shown, self.errors, self.model = text, keys, shown, errors, model

    def at(self, *keys: str, shown: Any = None) -> "PartError":
        """Returns the same error with other keys and another shown value."""
        return PartError(self.text, keys, shown, self.errors, self.model)


class Plugin(BaseModel):
    """Base class of every part: a frozen pydantic model.  Its fields are the parameters; unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True, slots=True)
class Source:
    """A file that a scenario names: the Python file of a part, or a trace of delays."""

    name: str
    """The path as the scenario gives it, relative to the scenario's folder"""
    text: str

    @property
    def sha256(self) -> str:
        """The file's hash, hexadecimal."""
        return hashlib.sha256(self.text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Part(Generic[T_co]):
    """A part as a plan holds it: `made` is the object; `use` and `parameters` are its name and parameters in the scenario."""

    use: str
    parameters: Mapping[str, Any]
    """All parameters, defaults included, as values that TOML can hold"""
    source: Source | None
    """None for parts that are built in or installed"""
    made: T_co = field(compare=False)

    @property
    def is_own(self) -> bool:
        """True if the part belongs to this package, so that its answers need no check."""
        return type(self.made).__module__.startswith("echelon.")

    def calls_in(self, error: BaseException) -> list[tuple[str, int]]:
        """Returns the calls in an error's traceback that are in the part's own module: function and line, innermost last."""
        module = type(self.made).__module__
        found = walk_tb(error.__traceback__)
        return [(frame.f_code.co_name, line) for frame, line in found if frame.f_globals.get("__name__") == module]

    def raised(self, whom: str, what: str, error: Exception) -> PartRunError:
        """Returns the error for a call of the part that raised: the line of its file where it raised, and what.

        `what` names the call, and `whom` says for what it was made (" of block g1")."""
        who, calls = self.use, self.calls_in(error)
        if self.source is not None and calls:
            who = f"{self.source.name}, line {calls[-1][1]}: {type(self.made).__name__}"
        if isinstance(error, ValidationError) and (found := error.errors()[0])["type"].startswith("frozen"):
            text = f"sets self.{found['loc'][0]}: a part's attributes do not change; a law keeps numbers in `state`"
        else:
            text = f"raised {_error_text(error)}"
        return PartRunError(f"{who}{whom}: {what} {text}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the source in place of the object: the process that unpickles a plan runs the file's text itself."""
        if self.source is None:
            return Part, (self.use, self.parameters, None, self.made)
        return _from_source, (self.use, self.parameters, self.source)


def _from_source(use: str, parameters: Mapping[str, Any], source: Source) -> Part[Any]:
    made = _class_in(source, use.rpartition(":")[2]).model_validate(dict(parameters))
    return Part(use, parameters, source, made)


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
            return self._checked(_class_in(source, name), use), source
        installed = {point.name: point for point in entry_points(group=f"echelon.{self.name}")}
        if use not in installed:
            raise PartError(self._unknown(use, [*self.built_in, *installed]))
        try:
            found = installed[use].load()
        except Exception as error:
            raise PartError(f"the installed {installed[use].value} cannot be loaded: {_error_text(error)}") from None
        return self._checked(found, use), None

    def make(self, use: str, parameters: Mapping[str, Any], folder: Path) -> Part[Any]:
        """Returns the part that `use` names, with these parameters.  Raises PartError if the part or a parameter is wrong."""
        found, source = self.find(use, folder)
        try:
            made = found.model_validate(dict(parameters))
        except ValidationError as error:
            errors = error.errors(include_url=False)
            raise PartError("wrong parameters", errors=errors, model=found) from None
        except Exception as error:  # a part's own validator may raise anything
            raise PartError(f"{use} refuses its parameters: {_error_text(error)}") from None
        return Part(use, made.model_dump(mode="json", exclude_none=True), source, made)

    def _checked(self, found: Any, use: str) -> type[Plugin]:
        if not (isinstance(found, type) and issubclass(found, self.base)):
            raise PartError(f"{use} must be a class derived from echelon.{self.base.__name__}")
        if missing := sorted(getattr(found, "__abstractmethods__", ())):
            raise PartError(f"{use} lacks the method {', '.join(missing)}")
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


def _class_in(source: Source, name: str) -> Any:
    """Returns the attribute `name` of a file's module.  Raises PartError if the file fails, or has no such attribute."""
    module = _module(source)
    if not hasattr(module, name):
        classes = [
            key
            for key, value in vars(module).items()
            if isinstance(value, type) and value.__module__ == module.__name__
        ]
        there = f"; it has {', '.join(classes)}" if classes else ""
        raise PartError(f"{source.name} has no class {name}{there}")
    return getattr(module, name)


def _module(source: Source) -> ModuleType:
    """Returns the module of a file; runs the file's text once per process.  Raises PartError if the text fails.

    The module's name holds the text's hash, so files of the same name with different texts are different modules."""
    name = f"echelon_part_{source.sha256[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    module = ModuleType(name)
    module.__file__ = source.name
    module.__dict__["print"] = _print
    sys.modules[name] = module  # dataclasses and pydantic look their module up there
    try:
        exec(compile(source.text, source.name, "exec"), module.__dict__)
    except SyntaxError as error:
        del sys.modules[name]
        raise PartError(f"{source.name}, line {error.lineno}: {error.msg}") from None
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, KeyboardInterrupt):
            raise
        raise PartError(f"{source.name}: {_error_text(error)}") from None
    return module


def _print(*values: object, file: Any = None, **options: Any) -> None:
    """Is `print` in the files of parts.  Without `file` it writes to the command's standard error, since standard output is
    for the command's result (`--json`).  In the processes of a run, standard output is the command's standard error."""
    if file is None:
        file = sys.stderr if parent_process() is None else sys.stdout
    flush, whole = options.pop("flush", False), StringIO()
    print(*values, file=whole, **options)
    file.write(whole.getvalue())  # at once, for several processes may print at the same time
    if flush:
        file.flush()


def _error_text(error: BaseException) -> str:
    if isinstance(error, PydanticUserError) and (found := _NO_TYPE.search(str(error))):
        name, value = found.groups()
        return f"{name} needs a type: {name}: {_type_of(value)} = {value}"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _type_of(value: str) -> str:
    """Returns the name of the type of a value that is written in Python; "…" if it is not a number, text, list or the like."""
    try:
        return type(ast.literal_eval(value)).__name__
    except (ValueError, SyntaxError):
        return "…"
