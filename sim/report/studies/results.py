"""What figures of a study are drawn from: the tables of a sweep, what varied in it, and what was predicted about it."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from echelon.sim.report.drawing import CENTROID, GROUPS, INTER, MARKS, Array, Look
from echelon.sim.report.studies.words import label_of

HOLDS: Final = 0.5
"""A point holds if at least this share of its runs does"""
MOST_LINES: Final = 4
"""With so many values a second key is an axis of its own"""
Columns = Mapping[str, NDArray[Any]]
Kind = Literal["delay", "loss", "blackout", "other"]


@dataclass(frozen=True, slots=True)
class Key:
    """A key of the scenario that varied, with a number for each point if its values can be told by one number."""

    name: str
    texts: tuple[str, ...]
    """Its value at each point, as text"""
    numbers: Array | None
    """Its value at each point; None if its values are no numbers"""
    label: str = field(default="", compare=False)
    """The key in words, with its unit, as the label of an axis"""

    @classmethod
    def of(cls, name: str, values: Sequence[Any], scenario: Mapping[str, Any] | None = None) -> "Key":
        """Returns a key from its values at each point: floats, or TOML text.  `scenario` is the table of the scenario, which
        says of which links a rule is.

        Lists of numbers in which one entry varies, or in which all entries are equal, count as that number: `[0.1, 0.1]`."""
        texts = tuple(f"{value:g}" if isinstance(value, float) else str(value).strip('"') for value in values)
        try:
            numbers = _single([tomllib.loads(f"value = {value}")["value"] for value in values])
        except ValueError:
            numbers = None
        return cls(name, texts, numbers, label_of(name, {} if scenario is None else scenario))

    @property
    def kind(self) -> Kind:
        """What the key changes."""
        if self.name.startswith("events.") and self.name.endswith(".duration"):
            return "blackout"
        if self.name.startswith("links.") and ".loss" in self.name and not self.name.endswith(".burst"):
            return "loss"
        return "delay" if self.name.startswith("links.") and ".delay" in self.name else "other"

    @property
    def count(self) -> int:
        """Number of different values."""
        return len(set(self.texts))


def _single(values: Sequence[Any]) -> Array | None:
    """Returns one number for each value; None if they cannot be told by one number."""
    if all(isinstance(value, list) and value for value in values) and len({len(value) for value in values}) == 1:
        if not all(isinstance(entry, (int, float)) for value in values for entry in value):
            return None
        rows = np.array(values, dtype=float)
        varying = np.flatnonzero(np.ptp(rows, axis=0) > 0)
        alike = bool((rows[:, varying] == rows[:, varying[:1]]).all()) if varying.size else True
        return rows[:, varying[0] if varying.size else 0] if alike else None
    if any(isinstance(value, (bool, str)) or not isinstance(value, (int, float)) for value in values):
        return None
    return np.array(values, dtype=float)


@dataclass(frozen=True, slots=True)
class Boundary:
    """The largest value of a key that still holds, beside values of the other keys."""

    at: Mapping[str, str]
    """The values of the other keys, as text"""
    value: float | None
    """The largest value that holds; None: even the lowest does not"""
    fails: float | None = None
    """The next value; None: all hold"""
    low: float | None = None
    """Up to this value all surely hold"""
    high: float | None = None
    """The smallest value that surely fails"""
    by: str = "share"


@dataclass(frozen=True, slots=True)
class Predicted:
    """What was predicted about a study, without runs.  NaN stands for what cannot be predicted."""

    boundaries: tuple[Boundary, ...] = ()
    """Largest values of the study's first key that are stable"""
    rates: Columns = field(default_factory=dict)
    """Decay rate of each block at each point [1/s]"""
    costs: Columns = field(default_factory=dict)
    """Expected integral of the squared error of each block at each point [m² s]"""


@dataclass(frozen=True, slots=True)
class Series:
    """The points of a study that differ in the axis alone: one line of a figure."""

    name: str
    rows: NDArray[np.int64]
    """The rows of its points, in ascending order of the axis"""
    look: Look


@dataclass(frozen=True, slots=True)
class StudyResults:
    """The tables of a study."""

    scenario: str
    command: str
    """The command that made it"""
    keys: tuple[Key, ...]
    """The keys that varied; the first one that is a number is the axis of curves"""
    points: Columns
    runs: Columns
    seeds: int
    """Runs for each point"""
    found: tuple[Boundary, ...] = ()
    """The boundaries that were searched for, if any were"""
    searched: str = ""
    """The key that was searched for"""
    predicted: Predicted = field(default_factory=Predicted)

    @property
    def axis(self) -> Key | None:
        """The key along which curves are drawn: delay, loss or duration of blackouts before others; None if no key has
        numbers."""
        numeric = [key for key in self.keys if key.numbers is not None and key.count > 1]
        named = [key for key in numeric if key.name == self.searched] or [key for key in numeric if key.kind != "other"]
        return next(iter(named or numeric), None)

    @property
    def second(self) -> Key | None:
        """The other key with numbers, if there is one with `MOST_LINES` values or more."""
        axis = self.axis
        others = [key for key in self.keys if key.numbers is not None and key.count >= MOST_LINES]
        others = [key for key in others if axis is None or key.texts != axis.texts]
        return others[0] if others else None

    def others(self, *but: Key | None) -> list[Key]:
        """Returns the keys that vary, but for these, and for those that have the same value as one of these at each point."""
        texts = [key.texts for key in but if key is not None]
        return [key for key in self.keys if key.count > 1 and key.texts not in texts]

    def series(self, axis: Key, second: Key | None = None) -> list[Series]:
        """Returns the lines of a figure along an axis: one for each value of all other keys but `second`."""
        assert axis.numbers is not None
        names = self.names(self.others(axis, second))
        found = []
        for number, name in enumerate(dict.fromkeys(names)):
            rows = np.flatnonzero([each == name for each in names])
            rows = rows[np.argsort(axis.numbers[rows], kind="stable")]
            found.append(Series(name, rows, Look.of_run(number)))
        return found

    def names(self, keys: Sequence[Key]) -> list[str]:
        """Returns for each point the values of some keys in words."""
        count = len(self.points["point"])
        return [", ".join(f"{_last(key.name)} {key.texts[row]}" for key in keys) for row in range(count)]

    def numbers(self, name: str) -> Array:
        """Returns a column of the points as numbers; NaN if there is none."""
        return np.asarray(self.points.get(name, np.full(len(self.points["point"]), np.nan)), dtype=float)

    @property
    def blocks(self) -> tuple[str, ...]:
        """The names of the blocks."""
        return tuple(name.removeprefix("ise.") for name in self.points if name.startswith("ise."))

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the channels."""
        return tuple(name.removeprefix("age_mean.") for name in self.points if name.startswith("age_mean."))

    def look_of(self, block: str) -> Look:
        """Returns the look of a block, as figures of single runs have it."""
        if block == "centroid":
            return Look(CENTROID, mark="d")
        if block == "inter":
            return Look(INTER, mark="h")
        groups = [name for name in self.blocks if name not in ("centroid", "inter")]
        number = groups.index(block)
        return Look(GROUPS[number % len(GROUPS)], Look.of_group(number).dashes, MARKS[number % len(MARKS)])

    def boundaries(self) -> list[Boundary]:
        """Returns how far points hold along the axis: as the search found it, by share and by second moment; without a search
        from the table, by share alone.

        The value is the last one up to which every point holds; those of the table hold if `HOLDS` of their runs do."""
        if self.found:
            return [one for one in self.found if one.by == "both"]
        axis = self.axis
        return [] if axis is None else [self._boundary(axis, one.rows) for one in self.series(axis)]

    def _boundary(self, axis: Key, rows: NDArray[np.int64]) -> Boundary:
        assert axis.numbers is not None
        values = axis.numbers[rows]
        low, share, high = (self.numbers(name)[rows] for name in ("share_low", "share", "share_high"))
        failing = np.flatnonzero(~(share >= HOLDS))
        first = int(failing[0]) if failing.size else len(values)
        surely = int(np.flatnonzero(~(low >= HOLDS))[0]) if (~(low >= HOLDS)).any() else len(values)
        sure_fails = np.flatnonzero(high < HOLDS)
        return Boundary(
            {key.name: key.texts[rows[0]] for key in self.others(axis)},
            float(values[first - 1]) if first else None,
            float(values[first]) if first < len(values) else None,
            float(values[surely - 1]) if surely else None,
            float(values[sure_fails[0]]) if sure_fails.size else None,
        )


def _last(key: str) -> str:
    """Returns a key without what stands before its last part; a number is no part by itself."""
    head, _, last = key.rpartition(".")
    return f"{_last(head)}.{last}" if last.isdigit() and head else last


def pairs(values: Array, column: Array) -> Iterator[tuple[float, float]]:
    """Yields the pairs that are finite."""
    for x, y in zip(values.tolist(), column.tolist(), strict=True):
        if np.isfinite(x) and np.isfinite(y):
            yield x, y
