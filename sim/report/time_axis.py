"""Time as the x axis of figures, and marks at instants."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from echelon.plan.plan import Plan
from echelon.sim.report.drawing import QUIET, Array
from echelon.sim.report.thinning import Change, drawable, thin
from echelon.sim.results.settling import response_ns

APART: Final = 8.0
"""Ratio of the slowest response time to the fastest one from which on time is logarithmic"""


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """Time as the x axis of a figure: linear from 0 on, or logarithmic from the first instant after 0 on."""

    log: bool
    first: float
    """First instant after 0 [s]"""
    last: float
    """End of the axis [s]"""
    end: float
    """End of the run [s]"""

    @classmethod
    def of(cls, plan: Plan, times_ns: NDArray[np.int64]) -> Self:
        """Returns the axis for a run: logarithmic if the slowest block takes `APART` times as long to respond as the fastest,
        or longer, and the run is long enough to show it."""
        after = times_ns[int(np.searchsorted(times_ns, 0, side="right")) :]
        first, last = (float(after[0]) / 1e9, float(after[-1]) / 1e9) if len(after) > 1 else (1e-3, 1.0)
        responses = [response_ns(block) / 1e9 for block in plan.blocks if block.size]
        fastest = min(responses, default=last)
        return cls(max(responses, default=last) >= APART * fastest and last >= APART * fastest, first, last, last)

    def with_log(self, log: bool) -> Self:
        """Returns the axis as a linear or a logarithmic one."""
        return replace(self, log=log)

    def until(self, t: float) -> Self:
        """Returns the axis, cut off soon after `t` [s] if it is linear and `t` is early in the run."""
        if self.log or not 0 < 1.25 * t < 0.6 * self.end:
            return self
        step = 10.0 ** np.floor(np.log10(1.25 * t)) / 2
        return replace(self, last=float(np.ceil(1.25 * t / step) * step))

    def shows(self, t: float) -> bool:
        """Returns whether an instant [s] is on the axis."""
        return (self.first if self.log else 0.0) <= t <= self.last

    def thin(self, times_ns: NDArray[np.int64], values: Array, change: Change = drawable) -> tuple[Array, Array]:
        """Returns the part of a line that the axis shows, thinned; `change` makes of values what is drawn."""
        if self.last < self.end:
            times_ns = times_ns[: int(np.searchsorted(times_ns, round(self.last * 1e9), side="right"))]
        return thin(times_ns, values[: len(times_ns)], self.log, change)

    def apply(self, axes: Axes, labelled: bool = True) -> None:
        """Sets the x axis of axes; a label is written if `labelled`: on the lowest of several axes above each other."""
        if self.log:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlim(self.first if self.log else 0.0, self.last)
        if labelled:
            axes.set_xlabel(self.label)

    @property
    def label(self) -> str:
        """The label of the axis."""
        return "t [s], log" if self.log else "t [s]"

    @property
    def words(self) -> str:
        """The sentence about the axis in a caption."""
        return f"Time is {'logarithmic' if self.log else 'linear'}."

    def words_then(self, calm: str) -> str:
        """Returns the sentence about an axis in a caption.  If the axis is cut off, `calm` says how the rest of the run
        looks."""
        if self.last == self.end:
            return self.words
        return f"The first {self.last:g} s of {self.end:g} s; then {calm}."

    def share(self, t: float) -> float:
        """Returns the position of an instant [s] on the axis: 0 at its beginning, 1 at its end."""
        if self.log:
            return float(np.log(max(t, self.first) / self.first) / np.log(self.last / self.first))
        return t / self.last


def above(axes: Axes, time: TimeAxis, width: float, marks: Sequence[tuple[float, str]]) -> None:
    """Marks instants [s] by dashed lines with words above the axes, each in the lowest row with room for it.  `width` is that
    of the axes [inches]."""
    ends: list[float] = []
    for t, text in sorted(marks):
        if not 0 < t <= time.last * 1.001:
            continue
        axes.axvline(t, color="#8d8d97", lw=0.8, dashes=(3, 2), zorder=1)
        at, room = time.share(t), 0.058 * len(text) / width  # width of a character of 7.5 pt [inches]
        left = min(max(at - room / 2, 0.0), 1.0 - room)
        row = next((row for row, end in enumerate(ends) if left > end + 0.01), len(ends))
        ends[row:] = [left + room] if row == len(ends) else [left + room, *ends[row + 1 :]]
        axes.annotate(
            text, (left + room / 2, 1.0), xycoords="axes fraction", xytext=(0, 3 + 10 * row), textcoords="offset points",
            ha="center", va="bottom", fontsize=7.5, color=QUIET, annotation_clip=False,
        )  # fmt: skip
