"""The result of a check of `echelon doctor`."""

from dataclasses import dataclass
from typing import Final

LIMIT_S: Final = 2.0
"""A check that takes longer than this counts as hanging [s]."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The result of one check.

    `state` is `ok`, `note` (it works with a restriction) or `problem`; `advice` says what to do about it."""

    what: str
    state: str
    text: str
    advice: tuple[str, ...] = ()
