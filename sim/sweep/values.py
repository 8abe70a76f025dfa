"""What a sweep varies: a key of the scenario, with a list of values or a range of them."""

import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Final

from echelon.errors import UsageError
from echelon.planning.loading import value_of
from echelon.scenario.toml_text import toml_value

MOST_VALUES: Final = 1_000_000
"""A range with more steps is a mistake"""
_NUMBER: Final = r"[+-]?(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)(?:[eE][+-]?[0-9]+)?"
_RANGE: Final = re.compile(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*(?::\s*({_NUMBER})\s*)?")
_LOOKS_LIKE_A_RANGE: Final = re.compile(r"[^\"'\[{]*:[^\"'\[{]*")
TAKEN: Final = ("seed", "name", "description")
"""Keys of a scenario that cannot be varied: seeds have an option of their own, the others change nothing"""


@dataclass(frozen=True, slots=True)
class Span:
    """A range of numbers.  Its ends and its step are decimal, so that 0:0.4:0.02 has the value 0.06, and not
    0.06000000000000001."""

    low: Decimal
    high: Decimal
    step: Decimal | None = None

    @property
    def whole(self) -> bool:
        """True if both ends are written as integers, and the step, too."""
        return all(end.as_tuple().exponent == 0 for end in (self.low, self.high, self.step or Decimal(1)))

    @property
    def steps(self) -> int:
        """The number of steps; 0 without a step."""
        return 0 if self.step is None else int((self.high - self.low) // self.step)

    def at(self, number: int) -> float | int:
        """Returns the value after a number of steps."""
        assert self.step is not None
        value = self.low + number * self.step
        return int(value) if self.whole else float(value)

    def between(self, share: float) -> float | int:
        """Returns the value that divides the range by `share`, in [0, 1).  In a range of integers all are equally likely."""
        if self.whole:
            return int(self.low) + int(share * (int(self.high) - int(self.low) + 1))
        return float(self.low) + share * (float(self.high) - float(self.low))


_PARTS: Final = re.compile(r"""((?:"(?:[^"\\]|\\.)*"|'[^']*'|[^,])*),""")
"""What is between commas; a comma in quotes does not count"""


@dataclass(frozen=True, slots=True)
class Vary:
    """A key of the scenario with the values that it takes: a list, or a range without a step."""

    key: str
    values: tuple[Any, ...]
    """Empty for a range without a step"""
    span: Span | None = None
    """The range; None for a list"""


def parse_vary(text: str, option: str = "--vary") -> Vary:
    """Returns what a text `KEY=a:b:step`, `KEY=a:b` or `KEY=v1,v2,…` varies; values are TOML, strings need no quotes.

    `option` names the text in errors.  Raises UsageError."""
    key, equals, rest = text.partition("=")
    key, where = key.strip(), f"{option} {text}"
    if not equals or not key or not rest.strip():
        raise UsageError(f"{where}: must be KEY=a:b:step or KEY=value,value,…")
    if key in TAKEN:
        more = "; seeds have an option of their own, --seeds" if key == "seed" else ""
        raise UsageError(f"{where}: {key} cannot be varied{more}")
    if _RANGE.fullmatch(rest) or _LOOKS_LIKE_A_RANGE.fullmatch(rest):
        span = parse_span(rest, where)
        values = () if span.step is None else tuple(span.at(number) for number in range(span.steps + 1))
        return Vary(key, values, span)
    return Vary(key, _unique(_listed(rest), where))


def vary_of(key: str, values: Any) -> Vary:
    """Returns what a notebook varies: `values` is a text as on the command line, or any list or array of values.

    Raises UsageError."""
    if isinstance(values, str):
        return parse_vary(f"{key}={values}", "vary")
    if hasattr(values, "tolist"):  # numpy
        values = values.tolist()
    if not isinstance(values, Iterable):
        raise UsageError(f"vary {key}={values!r}: must be a list of values, or a text such as '0:0.4:0.02'")
    listed = tuple(values)
    if key in TAKEN or not listed:
        why = f"{key} cannot be varied" if key in TAKEN else "there is no value"
        raise UsageError(f"vary {key}: {why}")
    return Vary(key, _unique(listed, f"vary {key}"))


def parse_span(text: str, where: str) -> Span:
    """Returns the range in a text `a:b` or `a:b:step`.  `where` begins the text of errors.  Raises UsageError."""
    found = _RANGE.fullmatch(text)
    if not found:
        raise UsageError(f"{where}: must be a range a:b:step of numbers, such as 0:0.4:0.02")
    low, high, step = (None if part is None else Decimal(part.replace("_", "")) for part in found.groups())
    assert low is not None
    assert high is not None
    if not low < high:
        raise UsageError(f"{where}: the range must go up, from the smaller number to the larger one")
    if step is not None and not 0 < step <= high - low:
        raise UsageError(f"{where}: the step must be more than 0 and at most the range, {high - low}")
    if step is not None and (high - low) / step > MOST_VALUES:
        raise UsageError(f"{where}: more than {MOST_VALUES} values; give a larger step")
    return Span(low, high, step)


def _listed(text: str) -> tuple[Any, ...]:
    """Returns the values between commas.  Where they are not TOML, each is taken as a string."""
    try:
        table = tomllib.loads(f"values = [{text}]")
    except (ValueError, RecursionError):
        return tuple(value_of(part) for part in _PARTS.findall(f"{text},"))
    return tuple(table["values"]) if len(table) == 1 else tuple(_PARTS.findall(f"{text},"))


def _unique(values: tuple[Any, ...], where: str) -> tuple[Any, ...]:
    """Returns values if each is there once and has a TOML type.  Raises UserError."""
    if not values:
        raise UsageError(f"{where}: there is no value")
    texts = [toml_value(value) for value in values]
    if twice := [text for text in texts if texts.count(text) > 1]:
        raise UsageError(f"{where}: {twice[0]} is there twice")
    return values
