"""Kinds of values in a scenario, as pydantic checks them, and the table that holds them."""

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

# Numbers are strict: neither true nor "1.5" is one.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(strict=True, gt=0, le=1e6, allow_inf_nan=False)]
"""A duration, or an instant, that is not absurd"""
SecondsOrZero = Annotated[float, Field(strict=True, ge=0, le=1e6, allow_inf_nan=False)]
Constant = Annotated[float, Field(strict=True, ge=1e-6, le=1e6, allow_inf_nan=False)]
"""A property of a motor"""
ConstantOrZero = Annotated[float, Field(strict=True, ge=0, le=1e6, allow_inf_nan=False)]
Limit = Annotated[float, Field(strict=True, gt=0)]
Fraction = Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False)]
Flag = Annotated[bool, Field(strict=True)]
Point = tuple[Finite, Finite]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,31}$")]
"""Of a scenario, robot, group or bus.  Where hyphens are not allowed (ROS topics, DBC identifiers) they become underscores"""
NodeId = Annotated[int, Field(strict=True, ge=0, le=127)]
Bitrate = Annotated[int, Field(strict=True, ge=10_000, le=1_000_000)]
Matrix = list[list[Finite]]


def number_or_table(value: Any) -> str:
    """Tells which member of a union a value is meant to be, so that a mistake in it is explained as that member's."""
    return "a table" if isinstance(value, (dict, BaseModel)) else "a number"


def number_or_array(value: Any) -> str:
    return "an array" if isinstance(value, (list, tuple)) else "a number"


Gain = Annotated[
    Annotated[Positive, Tag("a number")] | Annotated[Matrix, Tag("an array")], Discriminator(number_or_array)
]
CouplingGain = Annotated[
    Annotated[Finite, Tag("a number")] | Annotated[Matrix, Tag("an array")], Discriminator(number_or_array)
]


def alike(names: Iterable[str]) -> str | None:
    """Returns the name that differs from an earlier one by hyphens and underscores alone, or None: topics and DBC
    identifiers could not tell the two apart."""
    known: dict[str, str] = {}
    return next((name for name in names if known.setdefault(name.replace("-", "_"), name) != name), None)


def path_matches(pattern: str, path: str) -> bool:
    """True if a path fits a pattern chunk by chunk: `*` stands for one chunk, `**` for any number of them."""
    chunks = path.split("/")
    fitted = {0}  # how many of the path's chunks the pattern may have used up so far
    for want in pattern.split("/"):
        if want == "**":
            fitted = set(range(min(fitted), len(chunks) + 1)) if fitted else fitted
        else:
            fitted = {at + 1 for at in fitted if at < len(chunks) and want in ("*", chunks[at])}
    return len(chunks) in fitted


class Table(BaseModel):
    """A TOML table: unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True)
