"""Figures of what errors do along an axis: settling, decay rates, integrals of the error, ages, blackouts, costs."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from echelon.sim.report.axes import plain_numbers, small_multiples
from echelon.sim.report.drawing import QUIET, Array, Look, Picture
from echelon.sim.report.studies.results import Series, StudyResults, pairs
from echelon.sim.report.studies.stability import touched
from echelon.sim.report.thinning import drawable

MOST_PANELS: Final = 6
"""Values of other keys for which a figure has axes of their own"""


def settling(results: StudyResults, width: float) -> Picture:
    """Draws the settling time of each block to 5 % (filled) and to 2 % (open) along the axis, with axes for each series."""

    def panel(axes: Axes, line: Series) -> None:
        for block in results.blocks:
            look = results.look_of(block)
            for fraction, face, style in ((5, look.colour, look.dashes), (2, "white", "none")):
                _line(
                    axes, results, line, f"settling_{fraction}.{block}", look, f"{block} to {fraction} %", face, style
                )
        axes.set_yscale("log")
        plain_numbers(axes.yaxis)

    return _panels(results, width, "settling time [s]", panel)


def rates(results: StudyResults, width: float) -> Picture:
    """Draws the fitted decay rate of each block along the axis, and the predicted one as a dashed line of the same colour."""
    predicted = results.predicted.rates

    def panel(axes: Axes, line: Series) -> None:
        x = _axis(results)
        for block in results.blocks:
            look = results.look_of(block)
            _line(axes, results, line, f"decay_rate.{block}", look, block, style="none")
            if block in predicted:
                axes.plot(x[line.rows], predicted[block][line.rows], color=look.colour, lw=1.0, dashes=(4, 2), zorder=2)
        axes.axhline(0.0, color=QUIET, lw=0.8)
        values = np.concatenate([results.numbers(f"decay_rate.{block}")[line.rows] for block in results.blocks])
        known = np.abs(values[np.isfinite(values) & (values != 0)])
        if known.size and known.max() > 8 * known.min():
            axes.set_yscale("symlog", linthresh=float(known.min()), linscale=0.5)

    extra = [("predicted", Line2D([], [], color=QUIET, lw=1.0, dashes=(4, 2)))] if predicted else []
    return _panels(results, width, "decay rate [1/s]", panel, extra)


def integrals(results: StudyResults, width: float) -> Picture:
    """Draws the mean integrals of the squared error (above) and of the error times time (below) along the axis: axes for each
    block, a line for each series."""
    axis, blocks = results.axis, results.blocks
    assert axis is not None
    lines = results.series(axis)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(2, len(blocks), squeeze=False, sharex=True)
        for row, (name, unit) in zip(grid, (("ise_mean", "ISE [m² s]"), ("itae_mean", "ITAE [m s²]")), strict=True):
            for axes, block in zip(row, blocks, strict=True):
                for line in lines:
                    _line(axes, results, line, f"{name}.{block}", line.look, f"{line.name} {block}".strip())
                axes.set_yscale("log")
                plain_numbers(axes.yaxis)
                axes.margins(x=0.06)
            row[0].set_ylabel(unit)
        for axes, block in zip(grid[0], blocks, strict=True):
            axes.set_title(block)
        for axes in grid[1]:
            axes.set_xlabel(axis.label)
        _legend(figure, [(one.name, one.look) for one in lines if one.name])

    return Picture(width, 4.2, draw)


def ages(results: StudyResults, width: float) -> Picture:
    """Draws the integral of the error's norm of each block against the median age (filled) and the 95th percentile of ages
    (open) of the messages in use: a pair of marks for each run, axes for each channel."""
    channels = aged(results)

    def draw(figure: Figure) -> None:
        grid = small_multiples(figure, len(channels), min(len(channels), 3))
        for axes, channel in zip(grid.flat, channels, strict=False):
            for block in results.blocks:
                look = results.look_of(block)
                error = drawable(np.asarray(results.runs[f"iae.{block}"], dtype=float))
                for percentile, face in ((50, look.colour), (95, "white")):
                    age = np.asarray(results.runs[f"age_p{percentile}.{channel}"], dtype=float)
                    axes.plot(age, error, look.mark, ms=4, mfc=face, mec=look.colour, mew=0.8, ls="none", alpha=0.8)
            axes.set_yscale("log")
            plain_numbers(axes.yaxis)
            axes.set_xlabel(f"age of {channel} messages in use [s]")
        for row in grid:
            row[0].set_ylabel("∫|e| dt [m s]")
        looks = [(block, results.look_of(block)) for block in results.blocks]
        ends = [("p50", Line2D([], [], ls="none", marker="o", mfc=QUIET, mec=QUIET))]
        ends += [("p95", Line2D([], [], ls="none", marker="o", mfc="white", mec=QUIET))]
        _legend(figure, looks, ends)

    return Picture(width, 3.6 * -(-len(channels) // 3) + 0.3, draw)


def aged(results: StudyResults) -> list[str]:
    """Returns the channels whose ages differ between runs, where percentiles were counted."""
    found = []
    for channel in results.channels:
        late = np.asarray(results.runs.get(f"age_p95.{channel}", np.array([np.nan])), dtype=float)
        known = late[np.isfinite(late)]
        if known.size and np.ptp(known) > 0:
            found.append(channel)
    return found


def blackouts(results: StudyResults, width: float) -> Picture:
    """Draws the largest error of each block (above), and its settling time to 5 % (below), against the duration of a
    blackout."""
    axis = results.axis
    assert axis is not None
    (line, *_) = results.series(axis)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(2, 1, sharex=True)
        for axes, name, label in zip(
            grid, ("peak_error", "settling_5"), ("largest |e| [m]", "settled to 5 % [s]"), strict=True
        ):
            for block in results.blocks:
                _line(axes, results, line, f"{name}.{block}", results.look_of(block), block)
            axes.set_ylabel(label)
        grid[0].set_yscale("log")
        plain_numbers(grid[0].yaxis)
        grid[1].set_xlabel(axis.label)
        _legend(figure, [(block, results.look_of(block)) for block in results.blocks])

    return Picture(width, 4.4, draw)


def costs(results: StudyResults, width: float) -> Picture:
    """Draws the measured mean integral of the squared error of each block against the predicted one, a mark for each point."""
    predicted = results.predicted.costs

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        most, least = 0.0, np.inf
        for block, expected in predicted.items():
            look, measured = results.look_of(block), drawable(results.numbers(f"ise_mean.{block}"))
            for x, y in pairs(drawable(expected), measured):
                axes.plot(x, y, look.mark, ms=5, color=look.colour, alpha=0.85)
                touched(axes, x, y, f"{block}: predicted {x:.4g}, measured {y:.4g} ({100 * (y / x - 1):+.2g} %)")
                most, least = max(most, x, y), min(least, x, y)
        if most > 0:
            axes.plot([least, most], [least, most], color=QUIET, lw=0.9, dashes=(4, 2), zorder=1)
        axes.set_xscale("log")
        axes.set_yscale("log")
        plain_numbers(axes.xaxis)
        plain_numbers(axes.yaxis)
        axes.set_xlabel("predicted E ∫|e|² dt [m² s]")
        axes.set_ylabel("measured mean [m² s]")
        equal = [("equal", Line2D([], [], color=QUIET, lw=0.9, dashes=(4, 2)))]
        _legend(figure, [(block, results.look_of(block)) for block in predicted], equal)

    return Picture(width, 4.2, draw)


def _axis(results: StudyResults) -> Array:
    assert results.axis is not None
    assert results.axis.numbers is not None
    return results.axis.numbers


def _line(
    axes: Axes,
    results: StudyResults,
    line: Series,
    column: str,
    look: Look,
    words: str,
    face: str | None = None,
    style: Any = None,
) -> None:
    """Draws a column along the axis, with gaps where it has no number."""
    assert results.axis is not None
    x, y = _axis(results)[line.rows], drawable(results.numbers(column)[line.rows])
    axes.plot(
        x, y, color=look.colour, ls=look.dashes if style is None else style, lw=1.1, marker=look.mark, ms=4.2,
        mfc=face or look.colour, mec=look.colour, mew=0.9,
    )  # fmt: skip
    for at, value in pairs(x, y):
        touched(axes, at, value, f"{words}, {results.axis.label} = {at:g}: {value:.4g}")


def _panels(
    results: StudyResults, width: float, label: str, panel: Any, extra: Sequence[tuple[str, Line2D]] = ()
) -> Picture:
    """Returns a figure with axes for each series, in which lines are blocks."""
    axis = results.axis
    assert axis is not None
    lines = results.series(axis)[:MOST_PANELS]
    columns = min(len(lines), 3)

    def draw(figure: Figure) -> None:
        grid = small_multiples(figure, len(lines), columns)
        for axes, line in zip(grid.flat, lines, strict=False):
            panel(axes, line)
            axes.set_title(line.name)
            axes.set_xlabel(axis.label)
        for row in grid:
            row[0].set_ylabel(label)
        _legend(figure, [(block, results.look_of(block)) for block in results.blocks], extra)

    return Picture(width, 3.3 * -(-len(lines) // columns) + 0.4, draw)


def _legend(figure: Figure, looks: Sequence[tuple[str, Look]], extra: Sequence[tuple[str, Line2D]] = ()) -> None:
    handles = [Line2D([], [], color=look.colour, ls=look.dashes, marker=look.mark, ms=4) for _, look in looks]
    handles += [handle for _, handle in extra]
    words = [word for word, _ in looks] + [word for word, _ in extra]
    if handles:
        figure.legend(handles, words, loc="outside lower center", ncols=min(len(words), 8), handlelength=3)
