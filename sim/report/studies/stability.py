"""Figures of what holds: the share of runs along an axis, the map over two axes, and the largest values that hold."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from echelon.sim.report.axes import plain_numbers, small_multiples
from echelon.sim.report.drawing import INK, QUIET, Array, Look, Picture, hover
from echelon.sim.report.studies.results import Boundary, Key, Series, StudyResults

SHARES: Final = LinearSegmentedColormap.from_list("shares", ["#5b2a86", "#b77fb0", "#f3e9ee", "#8fc1a9", "#0a6a4e"])
"""From purple, no run holds, to green, all do; lightness alone tells both from the middle"""
PREDICTED: Final[dict[str, Any]] = {"color": "#e0701a", "lw": 1.6, "dashes": (4, 2)}
"""How predictions are drawn beside what was measured"""
SMALL_CELLS: Final = 400
"""Up to this number of cells each says its number of runs that hold"""
TOUCH: Final = 9.0
"""Size of the place around a mark that shows its text under the pointer [points]"""
LEAST_GROWTH: Final = 1e-4
MOST_GROWTH: Final = 1e4
"""Limits of an axis of growth"""


def touched(axes: Axes, x: float, y: float, text: str) -> None:
    """Puts an invisible mark that shows a text under the pointer."""
    (mark,) = axes.plot([x], [y], "o", ms=TOUCH, mec="none", mfc=INK, alpha=0.0, zorder=9)
    hover(mark, text)


def shares(results: StudyResults, width: float) -> Picture:
    """Draws the share of runs that hold with its interval along the axis, and below it how much E|e|² grows over a sixth of the
    run: the largest growth of all blocks.  Predicted boundaries are dashed lines."""
    axis = results.axis
    assert axis is not None
    assert axis.numbers is not None
    x, lines = axis.numbers, results.series(axis)
    growth = _largest(results, "moment_growth")
    bounds = [_largest(results, f"moment_growth_{end}") for end in ("low", "high")]

    def draw(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        for line in lines:
            look, rows = line.look, line.rows
            share, low, high = (results.numbers(name)[rows] for name in ("share", "share_low", "share_high"))
            if results.seeds > 1:
                above.fill_between(x[rows], low, high, color=look.colour, alpha=0.14, lw=0)
            style: dict[str, Any] = {"color": look.colour, "ls": look.dashes, "lw": 1.1, "marker": look.mark, "ms": 4}
            above.plot(x[rows], share, **style)
            below.plot(x[rows], _within(growth[rows]), **style)
            if results.seeds > 1:
                below.fill_between(
                    x[rows], *(_within(bound[rows]) for bound in bounds), color=look.colour, alpha=0.14, lw=0
                )
            for row in rows.tolist():
                what = f"{line.name + ', ' if line.name else ''}{axis.label} = {axis.texts[row]}"
                held = f"{results.points['holds'][row]:g} of {results.points['runs'][row]:g} runs hold"
                touched(above, x[row], results.numbers("share")[row], f"{what}: {held}")
                if np.isfinite(growth[row]):
                    touched(below, x[row], _within(growth[row : row + 1])[0], f"{what}: E|e|² × {growth[row]:.3g}")
            for axes in (above, below):
                _predicted_line(axes, results, line, axis)
        above.set_ylim(-0.04, 1.06)
        above.set_ylabel("share of runs that hold")
        below.set_yscale("log")
        below.axhline(1.0, color=QUIET, lw=0.8)
        below.set_ylabel("growth of E|e|² in a sixth")
        below.set_xlabel(axis.label)
        _legend(figure, results, lines)

    return Picture(width, 4.4, draw)


def _predicted_line(axes: Axes, results: StudyResults, line: Series, axis: Key) -> None:
    for one in results.predicted.boundaries:
        if one.value is not None and one.at == _beside(results, line, axis):
            axes.axvline(one.value, zorder=2, **{**PREDICTED, "color": line.look.colour})


def _beside(results: StudyResults, line: Series, axis: Key) -> Mapping[str, str]:
    return {key.name: key.texts[line.rows[0]] for key in results.others(axis)}


def _largest(results: StudyResults, name: str) -> Array:
    """Returns the largest of a column over all blocks at each point; NaN where no block has one."""
    columns = np.array([results.numbers(f"{name}.{block}") for block in results.blocks])
    return np.asarray(np.fmax.reduce(columns, axis=0))


def _within(growth: Array) -> Array:
    return np.clip(growth, LEAST_GROWTH, MOST_GROWTH)


def stability_map(results: StudyResults, width: float) -> Picture:
    """Draws the share of runs that hold over two keys as cells, the boundary between cells of which more and less than half of
    the runs hold as a line, and the predicted boundary over it, dashed."""
    axis, second = results.axis, results.second
    assert axis is not None
    assert second is not None
    names = results.names(results.others(axis, second))
    panels = list(dict.fromkeys(names))
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)

    def draw(figure: Figure) -> None:
        grid = small_multiples(figure, len(panels), columns)
        for axes, name in zip(grid.flat, panels, strict=False):
            _cells(axes, results, axis, second, np.flatnonzero([each == name for each in names]))
            axes.set_title(name)
        for axes in grid[-1]:
            axes.set_xlabel(axis.label)
        for row in grid:
            row[0].set_ylabel(second.label)
        marks: list[Artist] = [Patch(fc=SHARES(share), ec="#c9c9d0", lw=0.5) for share in (0.0, 0.5, 1.0)]
        marks.append(Line2D([], [], color=INK, lw=1.6))
        words = ["no run holds", "half of the runs hold", "all runs hold", "measured boundary"]
        if results.predicted.boundaries:
            marks.append(Line2D([], [], **PREDICTED))
            words.append("predicted")
        figure.legend(marks, words, loc="outside lower center", ncols=len(words), handlelength=3)

    return Picture(width, min(width / columns * 0.62, 5.6) * rows + 0.5, draw)


def _cells(axes: Axes, results: StudyResults, axis: Key, second: Key, rows: NDArray[np.int64]) -> None:
    assert axis.numbers is not None
    assert second.numbers is not None
    x, y = axis.numbers[rows], second.numbers[rows]
    x_edges, y_edges = _edges(np.unique(x)), _edges(np.unique(y))
    shares: dict[tuple[int, int], float] = {}
    for row, at_x, at_y in zip(rows.tolist(), x.tolist(), y.tolist(), strict=True):
        column, line = int(np.searchsorted(np.unique(x), at_x)), int(np.searchsorted(np.unique(y), at_y))
        share = float(results.numbers("share")[row])
        shares[column, line] = share
        corner, far = (x_edges[column], y_edges[line]), (x_edges[column + 1], y_edges[line + 1])
        cell = Rectangle(corner, far[0] - corner[0], far[1] - corner[1], fc=SHARES(share), ec="white", lw=0.4)
        holds, runs = results.points["holds"][row], results.points["runs"][row]
        hover(cell, f"{axis.label} = {at_x:g}, {second.label} = {at_y:g}: {holds:g} of {runs:g} runs hold")
        axes.add_patch(cell)
        if 0 < share < 1 and len(rows) <= SMALL_CELLS:
            middle = (corner[0] + far[0]) / 2, (corner[1] + far[1]) / 2
            dark = "white" if share < 0.25 or share > 0.85 else INK
            axes.text(*middle, f"{100 * share:.0f}", ha="center", va="center", fontsize=5.5, color=dark)
    for (column, line), share in shares.items():  # the measured boundary, along the edges of cells
        right, up = shares.get((column + 1, line)), shares.get((column, line + 1))
        if right is not None and (share >= 0.5) != (right >= 0.5):
            axes.plot([x_edges[column + 1]] * 2, y_edges[line : line + 2], color=INK, lw=1.6, zorder=4)
        if up is not None and (share >= 0.5) != (up >= 0.5):
            axes.plot(x_edges[column : column + 2], [y_edges[line + 1]] * 2, color=INK, lw=1.6, zorder=4)
    curve = [
        (one.value, float(one.at[second.name]))
        for one in results.predicted.boundaries
        if one.value is not None
        and all(one.at.get(key.name) == key.texts[rows[0]] for key in results.others(axis, second))
    ]
    if curve:
        axes.plot(*zip(*sorted(curve, key=lambda at: at[1]), strict=True), zorder=6, marker="o", ms=2.5, **PREDICTED)
    axes.set_xlim(x_edges[0], x_edges[-1])
    axes.set_ylim(y_edges[0], y_edges[-1])
    axes.grid(False)


def _edges(values: Array) -> Array:
    """Returns the edges of cells around values in ascending order."""
    if len(values) == 1:
        return np.array([values[0] - 0.5, values[0] + 0.5])
    between = (values[1:] + values[:-1]) / 2
    return np.concatenate([[2 * values[0] - between[0]], between, [2 * values[-1] - between[-1]]])


def tolerated(results: StudyResults, width: float) -> Picture:
    """Draws the largest value that holds, with its interval, against a second key with numbers, or side by side for each value
    of a key without; predictions are open marks on dashed lines."""
    axis, bounds = results.axis, results.boundaries()
    assert axis is not None
    second = results.second
    if second is None:
        return _side_by_side(axis, bounds, results, width)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        names = list(dict.fromkeys(_named(one, second) for one in bounds))
        for number, name in enumerate(names):
            look = Look.of_run(number)
            for several, measured in ((bounds, True), (results.predicted.boundaries, False)):
                points = sorted(
                    (float(_number(one.at[second.name])), one)
                    for one in several
                    if one.value is not None and _named(one, second) == name
                )
                x, y = [at for at, _ in points], [float(one.value or 0.0) for _, one in points]
                if measured:
                    axes.plot(
                        x,
                        y,
                        color=look.colour,
                        ls=look.dashes,
                        lw=1.2,
                        marker=look.mark,
                        ms=5,
                        label=name or "measured",
                    )
                    _bars(axes, x, [one for _, one in points], look)
                else:
                    axes.plot(
                        x, y, color=look.colour, lw=0.9, dashes=(4, 2), marker=look.mark, ms=9, mfc="none", zorder=2
                    )
                for at, value in zip(x, y, strict=True):
                    word = "holds up to" if measured else "predicted:"
                    touched(
                        axes, at, value, f"{name + ', ' if name else ''}{second.label} = {at:g}: {word} {value:.4g}"
                    )
        axes.set_xlabel(second.label)
        axes.set_ylabel(f"largest {axis.label}")
        _log_if_wide(axes, [one.value for one in bounds])
        if results.predicted.boundaries:
            axes.plot([], [], color=QUIET, lw=0.9, dashes=(4, 2), marker="o", ms=9, mfc="none", label="predicted")
        figure.legend(loc="outside lower center", ncols=4, handlelength=3)

    return Picture(width, 3.6, draw)


def _side_by_side(axis: Key, bounds: Sequence[Boundary], results: StudyResults, width: float) -> Picture:
    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for number, one in enumerate(bounds):
            look, name = Look.of_run(number), _named(one, None) or results.scenario
            if one.value is not None:
                axes.barh(number, one.value, height=0.5, color=look.colour, alpha=0.75)
                axes.text(
                    one.value,
                    number,
                    f" {one.value:.4g}{'' if one.fails is not None else ' or more'}",
                    va="center",
                    fontsize=8,
                )
                touched(axes, one.value, number, f"{name}: holds up to {one.value:.4g}")
            for guess in results.predicted.boundaries:
                if guess.at == one.at and guess.value is not None:
                    axes.plot([guess.value] * 2, [number - 0.38, number + 0.38], zorder=5, **PREDICTED)
                    touched(axes, guess.value, number - 0.3, f"{name}: predicted {guess.value:.4g}")
        axes.set_yticks(range(len(bounds)), labels=[_named(one, None) or results.scenario for one in bounds])
        axes.invert_yaxis()
        axes.grid(False, axis="y")
        axes.margins(x=0.14)
        axes.set_xlabel(f"largest {axis.label}")

    return Picture(width, 0.42 * len(bounds) + 0.9, draw)


def _number(text: str) -> float:
    """Returns the number that tells a value."""
    numbers = Key.of("", [text, text]).numbers
    return float(numbers[0]) if numbers is not None else float("nan")


def _bars(axes: Axes, x: Sequence[float], bounds: Sequence[Boundary], look: Look) -> None:
    for at, one in zip(x, bounds, strict=True):
        low, high = one.low, one.high
        if low is not None and high is not None:
            axes.plot([at, at], [low, high], color=look.colour, lw=0.8, marker="_", ms=5, zorder=2)


def _named(one: Boundary, second: Key | None) -> str:
    """Returns the values beside which a boundary was found, without those of the second axis."""
    at = {name: value for name, value in one.at.items() if second is None or name != second.name}
    return ", ".join(f"{name.rpartition('.')[2]} {value}" for name, value in at.items())


def _log_if_wide(axes: Axes, values: Sequence[float | None]) -> None:
    known = [value for value in values if value]
    if known and max(known) > 8 * min(known):
        axes.set_yscale("log")
        plain_numbers(axes.yaxis)


def _legend(figure: Figure, results: StudyResults, lines: Sequence[Series]) -> None:
    handles = [
        Line2D([], [], color=one.look.colour, ls=one.look.dashes, marker=one.look.mark, ms=4)
        for one in lines
        if one.name
    ]
    words = [one.name for one in lines if one.name]
    if results.predicted.boundaries:
        handles.append(Line2D([], [], **PREDICTED))
        words.append("predicted")
    if handles:
        figure.legend(handles, words, loc="outside lower center", ncols=4, handlelength=3)
