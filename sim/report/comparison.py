"""Figures that compare several runs: paths, errors, distances and torques.  Each run has its own colour and dashes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from echelon.sim.report.axes import (
    CALM_DISTANCE,
    CALM_TORQUE,
    SMALL_MULTIPLES,
    TAUS,
    TorqueScale,
    as_map,
    distance_limits,
    distance_time,
    error_limits,
    extent,
    largest_torques,
    map_height,
    positive,
    radii,
    shown_distance,
    small_multiples,
    torque_time,
)
from echelon.sim.report.drawing import RUNS, Array, Look, Picture
from echelon.sim.report.thinning import drawable
from echelon.sim.report.time_axis import TimeAxis
from echelon.sim.report.trajectory_map import Paths
from echelon.sim.results.block_series import Blocks
from echelon.sim.results.distances import Distances
from echelon.sim.results.trace import Trace

Kind = TypeVar("Kind")
WIDTH: Final = 11.5
"""Width of a figure [inches]"""


@dataclass(frozen=True, slots=True)
class Compared:
    """A run in a comparison: its name, its trace, and what is computed from the trace."""

    name: str
    trace: Trace
    blocks: Blocks
    near: Distances


def comparison(runs: Sequence[Compared]) -> dict[str, tuple[Picture, str]]:
    """Returns the figures of several runs by name, each with its caption."""
    distance = longest([distance_time(run.near, run.trace.plan) for run in runs])
    torque = longest([torque_time(run.trace) for run in runs])
    error = longest([TimeAxis.of(run.trace.plan, run.blocks.times_ns) for run in runs])
    scale = TorqueScale.of([run.trace for run in runs])
    return {
        "trajectories": (_paths(runs), "Paths of all robots. Open mark: start; filled: end."),
        "errors": (_errors(runs, error), f"Error norm of every block. {error.words}"),
        "distance": (
            _distance(runs, distance),
            f"Smallest distance of all pairs; the radii of avoidance are the first run's. {distance.words_then(CALM_DISTANCE)}",
        ),
        "torques": (
            _torques(runs, torque, scale),
            f"Mean torque of each period, of the right wheel. {torque.words_then(CALM_TORQUE)} {scale.words}".rstrip(),
        ),
    }


def longest(times: Sequence[TimeAxis]) -> TimeAxis:
    """Returns the time axis that shows all runs; it is logarithmic if that of one run is."""
    log = any(time.log for time in times)
    end = max(time.end for time in times)
    last = end if log else max(time.last for time in times)
    return TimeAxis(log, min(time.first for time in times), last, end)


def _paths(runs: Sequence[Compared]) -> Picture:
    several = [Paths.of(run.trace, WIDTH) for run in runs]
    shown = np.concatenate([paths.corners for paths in several])

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for look, paths in _looks(several):
            for path, *ends in zip(paths.robots, paths.start, paths.end, strict=True):
                axes.plot(*path.T, color=look.colour, ls=look.dashes, lw=0.9, alpha=0.85)
                for end, face in zip(ends, ("white", look.colour), strict=True):
                    axes.plot(*drawable(end[:2]), look.mark, ms=4, mfc=face, mec=look.colour, mew=0.9, zorder=5)
        if extent(shown) > 0:
            as_map(axes)
        _legend(figure, runs)

    return Picture(WIDTH, map_height(shown, WIDTH), draw)


def _errors(runs: Sequence[Compared], time: TimeAxis) -> Picture:
    series = [{one.block.name: one for one in run.blocks.series if one.block.size} for run in runs]
    names = list(dict.fromkeys(name for by_name in series for name in by_name))
    columns = min(3, len(names))

    def draw(figure: Figure) -> None:
        grid = small_multiples(figure, len(names), columns)
        for number, (axes, name) in enumerate(zip(grid.flat, names, strict=False)):
            axes.set_yscale("log")
            for look, (run, by_name) in _looks(zip(runs, series, strict=True)):
                if name in by_name:
                    line = time.thin(run.blocks.times_ns, by_name[name].norm, positive)
                    axes.plot(*line, color=look.colour, ls=look.dashes, lw=1.2, **_marks(line, look, len(runs)))
            axes.set_title(name)
            error_limits(axes, [run.blocks for run in runs])
            time.apply(axes, number >= len(names) - columns)
        for row in grid:
            row[0].set_ylabel("|e| [m]")
        _legend(figure, runs)

    return Picture(WIDTH, 1.8 * -(-len(names) // columns) + 0.7, draw)


def _distance(runs: Sequence[Compared], time: TimeAxis) -> Picture:
    avoidance = runs[0].trace.plan.avoidance
    radius, sensing = avoidance.avoidance_radius, avoidance.sensing_radius

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        radii(axes, radius, sensing)
        for look, run in _looks(runs):
            line = time.thin(run.near.times_ns, run.near.smallest, shown_distance(radius))
            axes.plot(*line, color=look.colour, ls=look.dashes, lw=1.2, **_marks(line, look, len(runs)))
        distance_limits(axes, [run.near.smallest for run in runs], radius, sensing)
        time.apply(axes)
        _legend(figure, runs)

    return Picture(WIDTH, 3.0, draw)


def _torques(runs: Sequence[Compared], time: TimeAxis, scale: TorqueScale) -> Picture:
    robots = [{robot.name: robot.index for robot in run.trace.plan.robots} for run in runs]
    largest: dict[str, float] = {}
    for run, by_name in zip(runs, robots, strict=True):
        peaks = largest_torques(run.trace)
        for name, index in by_name.items():
            largest[name] = max(largest.get(name, 0.0), peaks[index])
    most = sorted(largest, key=lambda name: -largest[name])[:SMALL_MULTIPLES]
    names = [name for name in largest if name in most]
    columns = 3 if len(names) <= 9 else 4

    def draw(figure: Figure) -> None:
        grid = small_multiples(figure, len(names), columns)
        for number, (axes, name) in enumerate(zip(grid.flat, names, strict=False)):
            scale.apply(axes)
            for look, (run, by_name) in _looks(zip(runs, robots, strict=True)):
                if name in by_name:
                    times_ns, states = run.trace.times_ns[by_name[name]], run.trace.states[by_name[name]]
                    line = time.thin(times_ns, states[:, TAUS[0]])
                    axes.plot(*line, color=look.colour, ls=look.dashes, lw=1.0, **_marks(line, look, len(runs)))
            axes.set_title(name)
            time.apply(axes, number >= len(names) - columns)
        for row in grid:
            row[0].set_ylabel("torque [N m]")
        _legend(figure, runs)

    return Picture(WIDTH, 1.35 * -(-len(names) // columns) + 0.8, draw)


def _marks(line: tuple[Array, Array], look: Look, runs: int) -> dict[str, Any]:
    """Returns what gives the line of a run its marks, apart from those of the other runs; nothing for an empty line."""
    if not np.isfinite(line[1]).any():  # matplotlib marks no empty line
        return {}
    number = RUNS.index(look.colour)
    return {"marker": look.mark, "markevery": (0.05 + 0.25 * number / min(runs, len(RUNS)), 0.25), "ms": 4}


def _looks(runs: Iterable[Kind]) -> Iterator[tuple[Look, Kind]]:
    for number, run in enumerate(runs):
        yield Look.of_run(number), run


def _legend(figure: Figure, runs: Sequence[Compared]) -> None:
    lines = [Line2D([], [], color=look.colour, ls=look.dashes, marker=look.mark, ms=4) for look, _ in _looks(runs)]
    figure.legend(
        lines, [run.name for run in runs], loc="outside lower center", ncols=min(len(runs), 6), handlelength=3
    )
