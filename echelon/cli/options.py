"""Commands and their options.  The options of a command are a frozen dataclass; each field becomes an argument of argparse.

type of the field   argument
str, float, Path    one value of this type
Literal             one of these values
bool                a flag without a value
tuple[T, ...]       any number of values of type T
T | None            one value of type T, which may be left out

A field without a default must be given.  The metadata of a field come from `argument` or `option`.
"""

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from types import UnionType
from typing import Any, Generic, Literal, TypeVar, Union, get_args, get_origin

Options = TypeVar("Options")
Parse = Callable[[str], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command(Generic[Options]):
    """A command: its options, what it does with them, and what its help says."""

    name: str
    options: type[Options]
    work: Callable[[Options], int]
    """Does the work and returns the exit code.  Raises UserError for a mistake of the user"""
    about: str
    """Text of the help: what the command does, in lines that fit a terminal"""
    examples: Mapping[str, str]
    """Command lines that can be typed as they are, each with its purpose"""
    codes: Mapping[int, str]
    """Meanings of the exit codes 0 and 1, and of others if there is more to say than for all commands"""
    live: bool = False
    """It prints until it is stopped, and ends when nobody reads that any more"""

    def add_options(self, parser: ArgumentParser) -> None:
        """Adds the arguments for all options to a parser."""
        for one in fields(self.options):  # type: ignore[arg-type]
            _add(parser, one)

    def read_options(self, parsed: Namespace) -> Options:
        """Returns the options from what that parser has read; an option that was not given has its default."""
        given = {name: value for name, value in vars(parsed).items() if value is not None}
        names = [one.name for one in fields(self.options) if one.name in given]  # type: ignore[arg-type]
        return self.options(
            **{name: tuple(value) if isinstance(value := given[name], list) else value for name in names}
        )


@dataclass(frozen=True, slots=True)
class _Choices:
    """The values that an option may have, for argparse.  They are looked up only when one was typed or is to be completed."""

    ask: Callable[[], Sequence[str]]

    def __iter__(self) -> Iterator[str]:
        return iter(self.ask())

    def __contains__(self, typed: object) -> bool:
        return typed in self.ask()


def argument(text: str, metavar: str) -> dict[str, Any]:
    """Returns the metadata of a field that is given by its position: its help text, and its name in the help."""
    return {"text": text, "metavar": metavar, "flag": None, "parse": None, "choices": None}


def option(
    text: str,
    metavar: str | None = None,
    *,
    flag: str = "",
    parse: Parse | None = None,
    choices: Callable[[], Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Returns the metadata of a field that is given by an option: `flag`, by default `--` and the field's name.

    `text` is its help; `metavar` stands for its value there.  `parse` turns what was typed into the value, or raises
    ValueError, if that takes more than the field's type.  `choices` returns the values that are allowed; use it instead of
    Literal if it takes long to find them."""
    return {"text": text, "metavar": metavar, "flag": flag, "parse": parse, "choices": choices}


def _add(parser: ArgumentParser, one: "Field[Any]") -> None:
    """Adds the argument for a field to a parser."""
    kind, several = _kind(one.type)
    flag, required = one.metadata["flag"], one.default is MISSING
    settings: dict[str, Any] = {"help": _help(one)}
    if kind is bool:
        settings["action"] = "store_true"
    elif one.metadata["choices"] is not None:
        settings |= {"choices": _Choices(one.metadata["choices"]), "metavar": one.metadata["metavar"]}
    elif get_origin(kind) is Literal:
        settings |= {"choices": get_args(kind), "metavar": one.metadata["metavar"]}
    else:
        settings |= {"type": _typed(one.metadata["parse"] or kind), "metavar": one.metadata["metavar"]}
    if flag is None:
        parser.add_argument(one.name, nargs="+" if several else None if required else "?", **settings)
    else:
        settings |= {"action": "append"} if several else {}
        parser.add_argument(flag or f"--{one.name.replace('_', '-')}", dest=one.name, required=required, **settings)


def _kind(annotation: Any) -> tuple[Any, bool]:
    """Returns the type of one value of a field, and whether there may be several."""
    if get_origin(annotation) in (
        UnionType,
        Union,
    ):  # `Literal[…] | None` is a Union, other types with `|` are a UnionType
        (annotation,) = (one for one in get_args(annotation) if one is not type(None))
    return (get_args(annotation)[0], True) if get_origin(annotation) is tuple else (annotation, False)


def _help(one: "Field[Any]") -> str:
    text: str = one.metadata["text"]
    if one.default is MISSING or one.default is None or one.default in (False, ()):
        return text
    return (
        f"{text} (default: {one.default:g})" if isinstance(one.default, float) else f"{text} (default: {one.default})"
    )


def _typed(parse: Any) -> Parse:
    """Returns a function that parses a value for argparse; its errors say in plain words what is wrong."""

    def typed(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise ArgumentTypeError(f"{text!r} is no number" if parse is float else str(error)) from None

    return typed
