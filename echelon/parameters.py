"""Types of parameters of parts.  pydantic checks them when a scenario is read; this module does not need it, so neither do
the processes of a run.

`Annotated[float, Limits(strict=True, ge=1)]` is a number of at least 1; `strict` refuses `true` and "1.5"."""

from typing import Annotated, Any


class Limits:
    """What pydantic asks of a value besides its type: keys of pydantic's core schema of this type."""

    def __init__(self, **limits: Any) -> None:
        self._limits = limits

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return handler(source) | self._limits


Finite = Annotated[float, Limits(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Limits(strict=True, gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Limits(strict=True, ge=0, allow_inf_nan=False)]
Point = tuple[Finite, Finite]
