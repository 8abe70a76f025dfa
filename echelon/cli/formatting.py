"""Numbers, names and tables as text."""

from collections.abc import Iterable, Sequence
from typing import Final

NAMES: Final = 3
"""Largest number of names in a list; of more there is a number"""


def rate(value: float | None) -> str:
    """Returns a rate [1/s] as text; None: any."""
    return "any" if value is None else f"{value:.3g}/s"


def bound(value: float | None) -> str:
    """Returns a bound as text; None: any value is allowed."""
    return "none" if value == 0 else number(value, "any")


def number(value: float | None, none: str) -> str:
    """Returns a number as text; `none` if there is none."""
    return none if value is None else f"{value:.4g}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterable[str]:
    """Returns lines with columns of equal width."""
    wide = [max(len(row[at]) for row in (head, *rows)) for at in range(len(head))]
    return [
        "    " + "  ".join(cell.ljust(width) for cell, width in zip(row, wide, strict=True)).rstrip()
        for row in (head, *rows)
    ]


def ms(seconds: Sequence[float]) -> str:
    """Returns times [s] as text in milliseconds: one number if all are equal, else the smallest and the largest."""
    least, most = (f"{1e3 * each:g}" for each in (min(seconds), max(seconds)))
    return f"{least} ms" if least == most else f"{least} to {most} ms"


def enumeration(names: Sequence[str]) -> str:
    """Returns names as a list in words: `a, b and c`."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def percent(shares: Sequence[float]) -> str:
    """Returns shares in percent: one number if all are equal, else the smallest and the largest."""
    least, most = (f"{100 * each:.3g} %" for each in (min(shares), max(shares)))
    return least if least == most else f"{least} to {most}"


def counted(names: Sequence[str]) -> str:
    """Returns names as a list; of many the first and their number."""
    return f"{names[0]} and {len(names) - 1} more" if len(names) > NAMES else enumeration(names)
