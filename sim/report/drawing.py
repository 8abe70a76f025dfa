"""How figures look and how they become SVG text: colours, one style, thinned lines, a tidied canvas.

Colours tell groups apart: the first three red, green and blue as in the paper, of tones and lightness that also differ
for colour-blind readers; groups are labelled besides.  The shape over groups is purple, the centroid black.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import StringIO
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from echelon.plan.plan import BlockPlan, Plan, RobotPlan

Array = NDArray[np.float64]

GROUPS: Final = ("#d0342c", "#0a8f6a", "#2a62c4", "#e08a00", "#b0529c", "#5b9bb5", "#7a5c3e", "#6d6f78")
INTER: Final = "#7d4bb3"
CENTROID: Final = "#1d1d22"
INK: Final = "#26262b"
QUIET: Final = "#70707a"
FONT: Final = "'Inter', 'Source Sans 3', 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
COLUMNS: Final = 500
"""Lines are thinned to the least and the largest value in each of so many columns of the picture."""
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


def colour_of_robot(plan: Plan, robot: RobotPlan) -> str:
    """Returns the colour of the group at the top of the tree that a robot belongs to."""
    return GROUPS[_top_group(plan, robot.index) % len(GROUPS)]


def colour_of_block(plan: Plan, block: BlockPlan) -> str:
    """Returns a block's colour: its group's, or that of the shape over groups, or that of the centroid."""
    if block.node is None:
        return CENTROID
    if block.layer in ("middle", "inter"):
        return INTER
    return GROUPS[_top_group(plan, block.node) % len(GROUPS)]


def _top_group(plan: Plan, member: int) -> int:
    """Returns the number of the child of the root that a member is or is below of; robots right below it share 0."""
    root = plan.root
    nodes = [child for child in root.children if child >= len(plan.robots)]
    at: int | None = member
    while at is not None and at not in nodes:
        at = plan.formation[at].parent
    return 0 if at is None else nodes.index(at)


@contextmanager
def canvas(width: float, height: float) -> Iterator[tuple[Figure, Callable[[], str]]]:
    """Gives a figure [inches] in the house style, and what turns it into SVG once it is drawn."""
    text = StringIO()
    with matplotlib.rc_context(_STYLE):  # type: ignore[arg-type]  # its stubs want literal keys
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, lambda: _tidied(text.getvalue())
        metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(text, format="svg", transparent=True, metadata=metadata)
    figure.clear()


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


def time_axis(axes: Axes, times_ns: NDArray[np.int64], log: bool, last: bool) -> None:
    """Makes time the x axis, from 0 or (log) the first instant after it; only the `last` of several is labelled."""
    after = times_ns[times_ns > 0]
    if log:
        axes.set_xscale("log")
    first, last_instant = (after[0] / 1e9, after[-1] / 1e9) if len(after) > 1 else (1e-3, 1.0)
    axes.set_xlim(first if log else 0.0, last_instant)
    if log:
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if last:
        axes.set_xlabel("t [s], log" if log else "t [s]")


def short(value: float) -> str:
    """Returns a number as a tick label."""
    for unit, scale in (("M", 1e6), ("k", 1e3)):
        if abs(value) >= scale:
            return f"{value / scale:g} {unit}".replace("-", "−")
    return f"{value:g}".replace("-", "−")
