"""What a check of `echelon doctor` finds."""

from dataclasses import dataclass
from typing import Final

LIMIT_S: Final = 2.0
"""What takes longer than this hangs."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The outcome of one check: `state` is `ok`, `note` (works, but) or `problem`; `advice` is what to do about it."""

    what: str
    state: str
    text: str
    advice: tuple[str, ...] = ()
