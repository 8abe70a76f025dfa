"""Parts of a run that users can write themselves: laws, plants, trajectories and drive protocols.

A part is a class derived from the base class of its group (Law, Plant, Trajectory, DriveProtocol).  It is a frozen dataclass:
its fields are the parameters that a scenario gives.  `echelon.part_groups` finds the class that a scenario names, and has its
parameters checked by pydantic.  No module of a part needs pydantic, so the processes of a run do not import it.

A part from a file is read once, when the scenario is loaded.  The file's text travels with the plan to every process of a run.
So all processes run the same code even if the file changes meanwhile, and no folder is added to Python's module path.
"""

import ast
import hashlib
import pickle
import sys
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import FrozenInstanceError, dataclass, field, fields
from functools import partial
from io import StringIO
from multiprocessing import parent_process
from traceback import walk_tb
from types import ModuleType
from typing import Any, ClassVar, Final, Generic, TypeVar, dataclass_transform

from echelon.errors import PartRunError

T_co = TypeVar("T_co", covariant=True)

GROUPS: Final = ("laws", "plants", "trajectories", "protocols")
"""The kinds of parts; `echelon.<group>` is the group of their entry points."""


class PartError(ValueError):
    """A scenario names a part that does not exist or cannot be loaded, or gives it wrong parameters.

    `keys` lead from the part's key in the scenario to the key that is wrong.  If parameters of the class `model` are wrong,
    `errors` are pydantic's errors; otherwise `text` says what is wrong with the value `shown`."""

    def __init__(
        self,
        text: str,
        keys: tuple[str, ...] = (),
        shown: Any = None,
        errors: Sequence[Any] = (),
        model: "type[Plugin] | None" = None,
    ) -> None:
        super().__init__(text)
        self.text, self.keys, self.shown, self.errors, self.model = text, keys, shown, errors, model

    def at(self, *keys: str, shown: Any = None) -> "PartError":
        """Returns the same error with other keys and another shown value."""
        return PartError(self.text, keys, shown, self.errors, self.model)


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True)
class Plugin:
    """Base class of every part.  A derived class is a frozen dataclass, whose fields are the parameters.

    Raises PartError for an attribute that has a value but no type: a scenario could not set it."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}
    """For pydantic: unknown parameters are mistakes"""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        inherited = {name for base in cls.__mro__[1:] for name in vars(base)} - {one.name for one in fields(cls)}
        for name, value in list(vars(cls).items()):
            if name in cls.__annotations__:
                if type(value).__hash__ is None:  # a list or the like, of which every part gets its own
                    setattr(cls, name, field(default_factory=partial(deepcopy, value)))
            elif not (
                name.startswith("_") or name in inherited or hasattr(value, "__get__") or isinstance(value, type)
            ):
                raise PartError(f"{name} needs a type: {name}: {_type_of(value)} = {value!r}")
        dataclass(frozen=True, kw_only=True)(cls)


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
        return [
            (frame.f_code.co_name, line)
            for frame, line in walk_tb(error.__traceback__)
            if frame.f_globals.get("__name__") == module
            and frame.f_code.co_filename != "<string>"  # a method that `dataclass` made
        ]

    def raised(self, whom: str, what: str, error: Exception) -> PartRunError:
        """Returns the error for a call of the part that raised: the line of its file where it raised, and what.

        `what` names the call, and `whom` says for what it was made (" of block g1")."""
        who, calls = self.use, self.calls_in(error)
        if self.source is not None and calls:
            who = f"{self.source.name}, line {calls[-1][1]}: {type(self.made).__name__}"
        if isinstance(error, FrozenInstanceError):  # "cannot assign to field 'rate'"
            name = str(error).partition("'")[2].rstrip("'")
            text = f"sets self.{name}: a part's attributes do not change; a law keeps numbers in `state`"
        else:
            text = f"raised {error_text(error)}"
        return PartRunError(f"{who}{whom}: {what} {text}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the class's file with the class: the process that unpickles a plan runs the file's text itself."""
        if self.source is None:
            return Part, (self.use, self.parameters, None, self.made)
        made: Any = self.made
        values = {one.name: getattr(made, one.name) for one in fields(made) if one.init}
        return _from_source, (self.use, self.parameters, self.source, pickle.dumps(values))


def _from_source(use: str, parameters: Mapping[str, Any], source: Source, values: bytes) -> Part[Any]:
    """Returns a part from its file.  `values` are those of its fields; they were checked when the scenario was read, and are
    unpickled after the file has run, for they may be of its types."""
    found = class_in(source, use.rpartition(":")[2])
    return Part(use, parameters, source, found(**pickle.loads(values)))


def class_in(source: Source, name: str) -> Any:
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
        raise PartError(f"{source.name}: {error_text(error)}") from None
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


def error_text(error: BaseException) -> str:
    """Returns an error as text: its type and what it says."""
    if isinstance(error, PartError):
        return error.text
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _type_of(value: Any) -> str:
    """Returns the name of a value's type; "…" if it is not a number, text, list or the like."""
    try:
        return type(ast.literal_eval(repr(value))).__name__
    except (ValueError, SyntaxError):
        return "…"
