"""A command, and its options: a frozen dataclass whose fields become arguments of argparse, by their types.

`str`, `float` and `Path` are read as such, `Literal` gives the choices, `bool` is a flag, of a tuple there may be several,
and `| None` means that it may be left out.  A field without a default must be given.
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
    """Returns the exit code.  Raises UserError for what the user can mend."""
    about: str
    """What it does, in lines that fit a terminal"""
    examples: Mapping[str, str]
    """Command lines that work as they stand, and what each is for"""
    codes: Mapping[int, str]
    """What its exit codes mean, except for 2 and 3, which mean the same for all commands"""

    def add_options(self, parser: ArgumentParser) -> None:
        """Gives a parser the arguments that fill the options."""
        for one in fields(self.options):  # type: ignore[arg-type]
            _add(parser, one)

    def read_options(self, parsed: Namespace) -> Options:
        """Returns the options that such a parser has read; what was not given has its default."""
        given = {name: value for name, value in vars(parsed).items() if value is not None}
        names = [one.name for one in fields(self.options) if one.name in given]  # type: ignore[arg-type]
        return self.options(
            **{name: tuple(value) if isinstance(value := given[name], list) else value for name in names}
        )


@dataclass(frozen=True, slots=True)
class _Choices:
    """What may be typed for an option.  It is asked for when something was typed, or is to be completed."""

    ask: Callable[[], Sequence[str]]

    def __iter__(self) -> Iterator[str]:
        return iter(self.ask())

    def __contains__(self, typed: object) -> bool:
        return typed in self.ask()


def argument(text: str, metavar: str) -> dict[str, Any]:
    """Returns the metadata of a field that is given by its place: its help, and what stands for it there."""
    return {"text": text, "metavar": metavar, "flag": None, "parse": None, "choices": None}


def option(
    text: str,
    metavar: str | None = None,
    *,
    flag: str = "",
    parse: Parse | None = None,
    choices: Callable[[], Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Returns the metadata of a field that is given by `--name`, or by `flag`.

    `parse` makes the value of what was typed, where the type alone would take too much.  It raises ValueError.  `choices`
    returns what may be typed, where it takes long to know that."""
    return {"text": text, "metavar": metavar, "flag": flag, "parse": parse, "choices": choices}


def _add(parser: ArgumentParser, one: "Field[Any]") -> None:
    """Gives a parser the argument that fills a field."""
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
    if get_origin(annotation) in (UnionType, Union):  # what `|` makes of a Literal is the latter
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
    """Returns a parser of values that tells argparse what is wrong in our words."""

    def typed(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise ArgumentTypeError(f"{text!r} is no number" if parse is float else str(error)) from None

    return typed
