"""The search for the largest value that still holds: `--find KEY=lo:hi:step`.

Values are lo + k·step for k = 0 … K.  First come `COARSE` + 1 of them, spread over the range.  The search takes the first of
these that does not hold, in ascending order, and halves the distance to the one before until they are neighbours.  So the
result is the value up to which everything that was tried holds.  It does not assume that all values above it fail: if one of
those holds, the result says so.

A point has two judgements, and holds if it holds by both.  Each has a boundary of its own, too:

by             a point holds if
both           it holds by share and by second moment
share          the share of its runs that hold is at least `wanted`
second moment  E|e|² of no block grows from the sixth of the run before the last to the last one (`statistics.moment_growth`)

Neither is enough by itself: with random loss most runs may hold while E|e|² grows, and an error that has grown into a limit
cycle grows no more, but ends larger than it began.

Runs are random, so each judgement has an interval.  A point *surely* holds if all of its interval holds, and surely fails if
none of it does.  The boundary lies between the last value up to which all points surely hold, and the first that surely fails.
"""

from collections.abc import Generator, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from echelon.errors import UsageError
from echelon.sim.sweep.values import TAKEN, Span, parse_span

COARSE: Final = 8
STEPS: Final = 256
"""Number of steps of a range that was given without one"""
By = Literal["both", "share", "second moment"]
ALL: Final[tuple[By, ...]] = ("both", "share", "second moment")


@dataclass(frozen=True, slots=True)
class Judged:
    """A judgement of a point."""

    holds: bool
    surely: bool
    """True if all of the interval says the same"""


Judgements = Mapping[By, Judged]


def judgements(share: Judged, moment: Judged) -> Judgements:
    """Returns all judgements of a point from those by share and by second moment."""
    holds = share.holds and moment.holds
    deciding = (share, moment) if holds else [one for one in (share, moment) if not one.holds]
    surely = (all if holds else any)(one.surely for one in deciding)
    return {"both": Judged(holds, surely), "share": share, "second moment": moment}


@dataclass(frozen=True, slots=True)
class Found:
    """A boundary."""

    key: str
    by: By
    at: Mapping[str, object]
    """The values of the keys that vary beside it"""
    value: float | None
    """The largest value up to which every point that was tried holds; None if even the lowest one does not"""
    fails: float | None
    """The next value: it does not hold; None if all values hold"""
    low: float | None
    """Up to this value all points that were tried surely hold; None if there is none"""
    high: float | None
    """The smallest value that surely fails; None if there is none"""
    limited_by: tuple[By, ...] = ()
    """Which of share and second moment do not hold at `fails`"""
    again: tuple[float, ...] = ()
    """Values above `fails` that hold all the same: what is asked for is not monotone.  With random runs, those that surely
    hold, above one that surely fails"""

    @property
    def text(self) -> str:
        """The boundary in a sentence."""
        beside = ", ".join(f"{key} = {value}" for key, value in self.at.items())
        by, limit = ("", f" by {' and '.join(self.limited_by)}") if self.by == "both" else (f" by {self.by}", "")
        begin = f"{self.key}{by}{f' ({beside})' if beside else ''}: "
        if self.value is None:
            return f"{begin}fails even at {self.fails:g}{limit}{self._more}"
        if self.fails is None:
            return f"{begin}all values hold, up to {self.value:g}; give a larger range{self._more}"
        return f"{begin}holds up to {self.value:g}, fails at {self.fails:g}{limit}{self._more}"

    @property
    def _more(self) -> str:
        if self.again:
            values = ", ".join(f"{value:g}" for value in self.again)
            return f"{self._interval}; not monotone: holds again at {values}"
        return self._interval

    @property
    def _interval(self) -> str:
        if (self.low, self.high) == (self.value, self.fails):
            return ""
        low = "nowhere for sure" if self.low is None else f"surely up to {self.low:g}"
        high = "fails nowhere for sure" if self.high is None else f"surely fails at {self.high:g}"
        return f" ({low}, {high})"


@dataclass(frozen=True, slots=True)
class Search:
    """What is searched for: the key and its range, with a step."""

    key: str
    span: Span

    @classmethod
    def of(cls, key: str, span: Span) -> "Search":
        """Returns a search; a range without a step gets `STEPS` steps.  Raises UsageError for a range of one step."""
        if span.step is None:
            span = Span(span.low, span.high, (span.high - span.low) / STEPS)
        if span.steps < 1:
            raise UsageError(f"--find {key}: the range has no step")
        return cls(key, span)

    @classmethod
    def parse(cls, text: str) -> "Search":
        """Returns the search for a text `KEY=lo:hi:step` or `KEY=lo:hi`.  Raises UsageError."""
        key, equals, rest = text.partition("=")
        if not equals or not key.strip() or key.strip() in TAKEN:
            raise UsageError(f"--find {text}: must be KEY=lo:hi:step, such as links.uplink.delay=0:0.5:0.01")
        return cls.of(key.strip(), parse_span(rest, f"--find {text}"))

    @classmethod
    def of_mapping(cls, find: Mapping[str, str]) -> "Search | None":
        """Returns the search for `{key: "lo:hi:step"}`; None if it is empty.  Raises UsageError for several keys."""
        if len(find) > 1:
            raise UsageError(f"--find {', '.join(find)}: one key can be searched for; vary the others")
        return next((cls.parse(f"{key}={span}") for key, span in find.items()), None)

    def value(self, number: int) -> float | int:
        """Returns the value after a number of steps."""
        return self.span.at(number)

    def run(self) -> Generator[list[int], dict[int, Judgements], dict[By, tuple[int | None, int | None]]]:
        """Yields the numbers of values to be tried, is sent their judgements, and returns for each judgement the numbers of the
        last value that holds and of the next one, as in `Found`."""
        last = self.span.steps
        known = dict((yield sorted({round(part * last / COARSE) for part in range(COARSE + 1)})))
        bounds: dict[By, tuple[int | None, int | None]] = {}
        for by in ALL:
            while True:
                numbers = sorted(known)
                failing = [number for number in numbers if not known[number][by].holds]
                fails = failing[0] if failing else None
                below = [number for number in numbers if fails is None or number < fails]
                holds = below[-1] if below else None
                if fails is None or holds is None or fails - holds == 1:
                    break
                known |= yield [(holds + fails) // 2]
            bounds[by] = holds, fails
        return bounds

    def found(
        self, by: By, known: Mapping[int, Judgements], bounds: tuple[int | None, int | None], at: Mapping[str, object]
    ) -> Found:
        """Returns a boundary from all judgements and its numbers."""
        holds, fails = bounds
        numbers = sorted(known)
        sure_until: int | None = None
        for number in numbers:
            judged = known[number][by]
            if not (judged.holds and judged.surely):
                break
            sure_until = number
        sure_fails = [number for number in numbers if not known[number][by].holds and known[number][by].surely]
        first = sure_fails[0] if sure_fails else None
        again = [
            number for number in numbers
            if first is not None and number > first and known[number][by].holds and known[number][by].surely
        ]  # fmt: skip

        def value(number: int | None) -> float | None:
            return None if number is None else float(self.value(number))

        return Found(
            key=self.key,
            by=by,
            at=at,
            value=value(holds),
            fails=value(fails),
            low=value(sure_until),
            high=value(first),
            limited_by=() if fails is None else tuple(one for one in ALL[1:] if not known[fails][one].holds),
            again=tuple(float(self.value(number)) for number in again),
        )
