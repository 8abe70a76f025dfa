"""How figures look and how they become files: colours, dashes and marks, one style, thinned lines, time as an axis.

Colours tell groups apart: the first three red, green and blue as in the paper, of tones and lightness that also differ
for colour-blind readers.  Each group has its own dashes and its own mark too.  The shape over groups is purple, the centroid
black.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any, Final, Self

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from echelon.files import replacing
from echelon.plan.plan import BlockPlan, Plan, RobotPlan
from echelon.sim.results.settling import response_ns

Array = NDArray[np.float64]

GROUPS: Final = ("#d0342c", "#0a8f6a", "#2a62c4", "#e08a00", "#b0529c", "#5b9bb5", "#7a5c3e", "#6d6f78")
Dashes = str | tuple[int, tuple[float, ...]]
DASHES: Final[tuple[Dashes, ...]] = (
    "-", (0, (6, 1.6)), (0, (5, 1.3, 1.2, 1.3)), (0, (1.6, 1.2)),
    (0, (9, 2)), (0, (5, 1.3, 1.2, 1.3, 1.2, 1.3)), (0, (3, 3)), (0, (1, 2.4)),
)  # fmt: skip
MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "p")
RUNS: Final = ("#1d1d22", "#e0701a", "#2a62c4", "#0a8f6a", "#b0529c", "#7a5c3e", "#5b9bb5", "#d0342c")
"""Colours of runs that are compared"""
FORMATS: Final = ("svg", "pdf", "png")
INTER: Final = "#7d4bb3"
CENTROID: Final = "#1d1d22"
INK: Final = "#26262b"
QUIET: Final = "#70707a"
FONT: Final = "'Inter', 'Source Sans 3', 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
COLUMNS: Final = 500
"""Lines are thinned to the least and the largest value in each of so many columns of the picture."""
APART: Final = 8.0
"""Response times are far apart from this ratio on"""
DRAWABLE: Final = 1e9
"""What is larger is left out: a picture of a diverged run would show nothing else."""

_STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "echelon",
    "font.size": 8.5,
    "axes.edgecolor": "#a9a9b2",
    "axes.labelcolor": QUIET,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.grid": True,
    "grid.color": "#ececf0",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "xtick.color": "#a9a9b2",
    "ytick.color": "#a9a9b2",
    "xtick.labelcolor": QUIET,
    "ytick.labelcolor": QUIET,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.solid_capstyle": "round",
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}


@dataclass(frozen=True, slots=True)
class Look:
    """What tells a group, a block or a run from others: colour, dashes, mark."""

    colour: str
    dashes: Dashes = "-"
    mark: str = "o"

    @classmethod
    def of_group(cls, number: int) -> Self:
        """Returns the look of a group, by its number."""
        return cls._of(GROUPS, number)

    @classmethod
    def of_robot(cls, plan: Plan, robot: RobotPlan) -> Self:
        """Returns the look of the group at the top of the tree that a robot belongs to."""
        return cls.of_group(_top_group(plan, robot.index))

    @classmethod
    def of_block(cls, plan: Plan, block: BlockPlan) -> Self:
        """Returns the look of a block's group, of the shape over groups, or of the centroid."""
        if block.node is None:
            return cls(CENTROID, mark="d")
        if block.layer in ("middle", "inter"):
            return cls(INTER, mark="h")
        return cls.of_group(_top_group(plan, block.node))

    @classmethod
    def of_run(cls, number: int) -> Self:
        """Returns the look of one of several runs, by its number."""
        return cls._of(RUNS, number)

    @classmethod
    def _of(cls, colours: Sequence[str], number: int) -> Self:
        return cls(colours[number % len(colours)], DASHES[number % len(DASHES)], MARKS[number % len(MARKS)])


def _top_group(plan: Plan, member: int) -> int:
    """Returns the number of the child of the root that a member is or is below of; robots right below it share 0."""
    root = plan.root
    nodes = [child for child in root.children if child >= len(plan.robots)]
    at: int | None = member
    while at is not None and at not in nodes:
        at = plan.formation[at].parent
    return 0 if at is None else nodes.index(at)


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure: its size [inches] and what draws it.  Jupyter shows it."""

    width: float
    height: float
    draw: Callable[[Figure], None]

    @property
    def svg(self) -> str:
        """The figure as SVG text for a page."""
        text = StringIO()
        self._save(text, "svg", transparent=True)
        return _tidied(text.getvalue())

    def _repr_svg_(self) -> str:
        return self.svg

    def save(self, path: str | Path) -> None:
        """Writes it as SVG, PDF or PNG, by the ending of its name.  Raises OSError, and ValueError for another ending."""
        path = Path(path)
        kind = path.suffix.removeprefix(".").lower()
        if kind not in FORMATS:
            raise ValueError(
                f"{path}: must end in {', '.join(f'.{known}' for known in FORMATS[:-1])} or .{FORMATS[-1]}"
            )
        with replacing(path) as partial:
            if kind == "svg":
                partial.write_text(self.svg, encoding="utf-8")
            else:
                with partial.open("wb") as file:
                    self._save(file, kind, dpi=200)

    def _save(self, file: Any, kind: str, **options: Any) -> None:
        """Draws it anew, the same bytes each time: without dates and versions."""
        names = {"svg": ("Creator", "Date", "Format", "Type"), "pdf": ("CreationDate", "Creator", "Producer")}
        metadata = dict.fromkeys(names.get(kind, ("Software",)))
        with matplotlib.rc_context(_STYLE):  # type: ignore[arg-type]  # its stubs want literal keys
            figure = Figure(figsize=(self.width, self.height), layout="constrained")
            self.draw(figure)
            figure.savefig(file, format=kind, metadata=metadata, **options)


def _tidied(svg: str) -> str:
    """Cuts an SVG down to what a page needs: no prolog, no unused ids, coordinates to 0.01, its font."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    used = set(re.findall(r"#([\w.-]+)", svg))
    svg = re.sub(r' id="([\w.-]+)"', lambda found: found[0] if found[1] in used else "", svg)
    # Inside tags only: what stands between them is text for people.
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(-?\d+\.\d{2})\d+", r"\1", tag[0]), svg)
    svg = re.sub(r"font: ([\d.]+px) [^;\"]*", rf"font: \1 {FONT}", svg)
    svg = re.sub(r"font: (\w+ [\d.]+px) [^;\"]*", rf"font: \1 {FONT}", svg)
    return re.sub(r"\n\s*", "\n", svg)


def thin(times_ns: NDArray[np.int64], values: Array, log: bool) -> tuple[Array, Array]:
    """Thins a line for drawing: of each column of the picture the first, least and largest value, in order of time."""
    keep = times_ns > 0 if log else np.ones(len(times_ns), dtype=bool)
    times, values = times_ns[keep] / 1e9, drawable(values[keep])
    if len(times) <= 4 * COLUMNS:
        return times, values
    axis = np.log(times) if log else times
    column = np.minimum(((axis - axis[0]) / (axis[-1] - axis[0]) * COLUMNS).astype(int), COLUMNS - 1)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    order = np.lexsort((values, column))  # NaN sorts last: a column's largest may be NaN, which breaks the line there
    ends = np.append(starts[1:], len(times)) - 1
    picked = np.unique(np.concatenate([starts, order[starts], order[ends], [len(times) - 1]]))
    return times[picked], values[picked]


def drawable(values: Array) -> Array:
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < DRAWABLE, values, np.nan)


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """Time [s] as the x axis of a figure: from 0 on, or logarithmic from the first instant after it."""

    log: bool
    first: float
    last: float
    end: float
    """Of the run"""

    @classmethod
    def of(cls, plan: Plan, times_ns: NDArray[np.int64]) -> Self:
        """Returns the axis on which most can be seen: logarithmic where blocks answer on time scales that are far apart."""
        after = times_ns[times_ns > 0]
        first, last = (float(after[0]) / 1e9, float(after[-1]) / 1e9) if len(after) > 1 else (1e-3, 1.0)
        responses = [response_ns(block) / 1e9 for block in plan.blocks if block.size]
        fastest = min(responses, default=last)
        return cls(max(responses, default=last) >= APART * fastest and last >= APART * fastest, first, last, last)

    def with_log(self, log: bool) -> Self:
        """Returns the axis as it is in a figure that shows both."""
        return replace(self, log=log)

    def until(self, t: float) -> Self:
        """Returns a linear axis that ends soon after `t` [s], by when all is calm, if that is early in the run."""
        if self.log or not 0 < 1.25 * t < 0.6 * self.end:
            return self
        step = 10.0 ** np.floor(np.log10(1.25 * t)) / 2
        return replace(self, last=float(np.ceil(1.25 * t / step) * step))

    def shows(self, t: float) -> bool:
        """Returns whether an instant [s] is between the ends of the axis."""
        return (self.first if self.log else 0.0) <= t <= self.last

    def thin(self, times_ns: NDArray[np.int64], values: Array) -> tuple[Array, Array]:
        """Returns the part of a line that the axis shows, thinned."""
        if self.last < self.end:
            times_ns = times_ns[: int(np.searchsorted(times_ns, round(self.last * 1e9), side="right"))]
        return thin(times_ns, values[: len(times_ns)], self.log)

    def apply(self, axes: Axes, labelled: bool = True) -> None:
        """Makes time the x axis; of several figures above each other only the last is labelled."""
        if self.log:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlim(self.first if self.log else 0.0, self.last)
        if labelled:
            axes.set_xlabel(self.label)

    @property
    def label(self) -> str:
        """What stands below it."""
        return "t [s], log" if self.log else "t [s]"

    @property
    def words(self) -> str:
        """How a caption says it."""
        return f"Time is {'logarithmic' if self.log else 'linear'}."

    def words_then(self, calm: str) -> str:
        """Returns how a caption says it of an axis that ends when all is calm, which is said too."""
        if self.last == self.end:
            return self.words
        return f"The first {self.last:g} s of {self.end:g} s; then {calm}."

    def share(self, t: float) -> float:
        """Returns where a time is between the ends of the axis, 0 to 1."""
        if self.log:
            return float(np.log(max(t, self.first) / self.first) / np.log(self.last / self.first))
        return t / self.last


def above(axes: Axes, time: TimeAxis, width: float, marks: Sequence[tuple[float, str]]) -> None:
    """Marks instants [s] by dashed lines, with words above the figure: each in the lowest row where it has room."""
    ends: list[float] = []
    for t, text in sorted(marks):
        if not 0 < t <= time.last * 1.001:
            continue
        axes.axvline(t, color="#8d8d97", lw=0.8, dashes=(3, 2), zorder=1)
        at, room = time.share(t), 0.058 * len(text) / width  # of 7.5 pt a character is so many inches wide
        left = min(max(at - room / 2, 0.0), 1.0 - room)
        row = next((row for row, end in enumerate(ends) if left > end + 0.01), len(ends))
        ends[row:] = [left + room] if row == len(ends) else [left + room, *ends[row + 1 :]]
        axes.annotate(
            text, (left + room / 2, 1.0), xycoords="axes fraction", xytext=(0, 3 + 10 * row), textcoords="offset points",
            ha="center", va="bottom", fontsize=7.5, color=QUIET, annotation_clip=False,
        )  # fmt: skip


def short(value: float) -> str:
    """Returns a number as a tick label."""
    for unit, scale in (("M", 1e6), ("k", 1e3)):
        if abs(value) >= scale:
            return f"{value / scale:g} {unit}".replace("-", "−")
    return f"{value:g}".replace("-", "−")
