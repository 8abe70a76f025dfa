"""Types of values in a scenario, which pydantic checks, and the base class of all tables."""

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from echelon.parameters import Finite, Positive

# Numbers are strict: pydantic refuses `true` and "1.5".
Seconds = Annotated[float, Field(strict=True, gt=0, le=1e6, allow_inf_nan=False)]
"""A duration or an instant [s], at most 10⁶ s"""
SecondsOrZero = Annotated[float, Field(strict=True, ge=0, le=1e6, allow_inf_nan=False)]
Constant = Annotated[float, Field(strict=True, ge=1e-6, le=1e6, allow_inf_nan=False)]
"""A physical property of a motor"""
ConstantOrZero = Annotated[float, Field(strict=True, ge=0, le=1e6, allow_inf_nan=False)]
Limit = Annotated[float, Field(strict=True, gt=0)]
Fraction = Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False)]
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,31}$")]
"""Name of a scenario, robot, group or bus.  In ROS topics and DBC identifiers, which allow no hyphens, they become
underscores"""
NodeId = Annotated[int, Field(strict=True, ge=0, le=127)]
Bitrate = Annotated[int, Field(strict=True, ge=10_000, le=1_000_000)]
Matrix = list[list[Finite]]


def number_or_table(value: Any) -> str:
    """Returns the tag of the union's member that a value is meant for, so that pydantic explains mistakes of that member
    only."""
    return "a table" if isinstance(value, (dict, BaseModel)) else "a number"


def number_or_array(value: Any) -> str:
    """Returns the tag of the union's member that a value is meant for, as `number_or_table`."""
    return "an array" if isinstance(value, (list, tuple)) else "a number"


Gain = Annotated[
    Annotated[Positive, Tag("a number")] | Annotated[Matrix, Tag("an array")], Discriminator(number_or_array)
]
CouplingGain = Annotated[
    Annotated[Finite, Tag("a number")] | Annotated[Matrix, Tag("an array")], Discriminator(number_or_array)
]


def alike(names: Iterable[str]) -> str | None:
    """Returns the first name that differs from an earlier one only by hyphens and underscores, or None.

    Such names would be the same in topics and DBC identifiers."""
    known: dict[str, str] = {}
    return next((name for name in names if known.setdefault(name.replace("-", "_"), name) != name), None)


def path_matches(pattern: str, path: str) -> bool:
    """True if a path fits a pattern chunk by chunk: `*` stands for one chunk, `**` for any number of them."""
    chunks = path.split("/")
    fitted = {0}  # the numbers of leading chunks of the path that the pattern up to here can match
    for want in pattern.split("/"):
        if want == "**":
            fitted = set(range(min(fitted), len(chunks) + 1)) if fitted else fitted
        else:
            fitted = {at + 1 for at in fitted if at < len(chunks) and want in ("*", chunks[at])}
    return len(chunks) in fitted


class Table(BaseModel):
    """Base class of all tables of a scenario.  Unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True)
