"""What all figures share: colours, dashes and marks, the style, and how figures become files.

Each group has its own colour, dashes and mark.  The first three colours are red, green and blue as in the paper, in tones and
lightness that colour-blind readers can tell apart, too.  Shapes of groups of groups are purple, the centroid is black.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Final, Self

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from echelon.files import replacing
from echelon.plan.plan import BlockPlan, Plan, RobotPlan

Array = NDArray[np.float64]

GROUPS: Final = ("#d0342c", "#0a8f6a", "#2a62c4", "#e08a00", "#b0529c", "#5b9bb5", "#7a5c3e", "#6d6f78")
Dashes = str | tuple[int, tuple[float, ...]]
DASHES: Final[tuple[Dashes, ...]] = (
    "-", (0, (6, 1.6)), (0, (5, 1.3, 1.2, 1.3)), (0, (1.6, 1.2)),
    (0, (9, 2)), (0, (5, 1.3, 1.2, 1.3, 1.2, 1.3)), (0, (3, 3)), (0, (1, 2.4)),
)  # fmt: skip
MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "p")
RUNS: Final = ("#1d1d22", "#e0701a", "#2a62c4", "#0a8f6a", "#b0529c", "#7a5c3e", "#5b9bb5", "#d0342c")
"""Colours of runs in a comparison"""
FORMATS: Final = ("svg", "pdf", "png")
INTER: Final = "#7d4bb3"
CENTROID: Final = "#1d1d22"
INK: Final = "#26262b"
QUIET: Final = "#70707a"
FONT: Final = "'Inter', 'Source Sans 3', 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"

_HOVER: Final = "hover: "
"""Ids of SVG elements that begin so become what browsers show beside the pointer"""

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
    """Colour, dashes and mark of a group, a block or a run, which tell it apart from others."""

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
    """Returns the number of the group right below the root that a member (by index) is or belongs to; 0 for a robot that is
    itself right below the root."""
    root = plan.root
    nodes = [child for child in root.children if child >= len(plan.robots)]
    at: int | None = member
    while at is not None and at not in nodes:
        at = plan.formation[at].parent
    return 0 if at is None else nodes.index(at)


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure: its size [inches] and the function that draws it.  Jupyter shows it as SVG."""

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
        """Writes the figure as SVG, PDF or PNG, by the ending of the path.  Raises ValueError for another ending, and
        OSError."""
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
        """Draws the figure into a file.  The bytes are the same each time, since dates and versions are left out."""
        names = {"svg": ("Creator", "Date", "Format", "Type"), "pdf": ("CreationDate", "Creator", "Producer")}
        metadata = dict.fromkeys(names.get(kind, ("Software",)))
        with matplotlib.rc_context(_STYLE):  # type: ignore[arg-type]  # its stubs want literal keys
            figure = Figure(figsize=(self.width, self.height), layout="constrained")
            self.draw(figure)
            figure.savefig(file, format=kind, metadata=metadata, **options)


def _tidied(svg: str) -> str:
    """Returns an SVG reduced to what a page needs: without prolog, metadata and unused ids, coordinates rounded down to 0.01,
    with the page's font."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(rf'<g id="{_HOVER}([^"]*)">', r"<g><title>\1</title>", svg)
    used = set(re.findall(r"#([\w.-]+)", svg))
    svg = re.sub(r' id="([\w.-]+)"', lambda found: found[0] if found[1] in used else "", svg)
    # Only inside tags: numbers between them are text for people.
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(-?\d+\.\d{2})\d+", r"\1", tag[0]), svg)
    svg = re.sub(r"font: ([\d.]+px) [^;\"]*", rf"font: \1 {FONT}", svg)
    svg = re.sub(r"font: (\w+ [\d.]+px) [^;\"]*", rf"font: \1 {FONT}", svg)
    return re.sub(r"\n\s*", "\n", svg)


def explained(figure: Figure, words: Mapping[str, Mapping[str, Any]]) -> None:
    """Explains lines and marks below a figure: by word the properties of each."""
    lines = [Line2D([], [], **look) for look in words.values()]
    figure.legend(lines, list(words), loc="outside lower center", ncols=len(words), handlelength=3)


def hover(artist: Artist, text: str) -> None:
    """Gives a part of a figure a text that browsers show while the pointer is on it (SVG alone)."""
    artist.set_gid(_HOVER + text)


def short(value: float) -> str:
    """Returns a number as the label of a tick, with k or M for thousands and millions."""
    for unit, scale in (("M", 1e6), ("k", 1e3)):
        if abs(value) >= scale:
            return f"{value / scale:g} {unit}".replace("-", "−")
    return f"{value:g}".replace("-", "−")
