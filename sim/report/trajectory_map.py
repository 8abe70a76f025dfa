"""The map of a run: the robots' paths, the final formation, and the path of the centroid."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from echelon.messages import STATE_FIELDS, field_index
from echelon.plan.plan import Plan
from echelon.sim.report.axes import Array, as_map, extent, map_height
from echelon.sim.report.drawing import CENTROID, QUIET, Look, Picture, explained
from echelon.sim.report.thinning import ThinPath, drawable
from echelon.sim.results.desired import Desired
from echelon.sim.results.trace import Trace

X, Y, THETA = field_index(STATE_FIELDS, "x", "y", "theta")
DPI: Final = 200
"""Pixels of an inch; what is smaller is not drawn"""


@dataclass(frozen=True, slots=True)
class Paths:
    """The paths of N robots and of their centroid [m], thinned; arrays of points are (.., 2)."""

    robots: tuple[Array, ...]
    centroid: Array
    corners: Array
    """The corners of the smallest rectangle around the robots' paths, (2, 1, 2); (0, 1, 2) if there is no path"""
    start: Array
    """x, y and heading of each robot at the start, (N, 3); (0, 3) if there is no path"""
    end: Array

    @classmethod
    def of(cls, trace: Trace, width: float) -> Self:
        """Returns the paths in a run for a map of some width [inches]."""
        low, high = np.full((2, 2), np.nan)
        start = end = np.empty((0, 3))
        for part, states in trace.windows((X, Y, THETA)):
            place = drawable(states[:, :, :2])
            with np.errstate(invalid="ignore"):
                low = np.fmin(low, np.fmin.reduce(place, axis=(0, 1)))
                high = np.fmax(high, np.fmax.reduce(place, axis=(0, 1)))
            start, end = states[0].copy() if part.start == 0 else start, states[-1].copy()
        if not len(start):
            return cls((), np.empty((0, 2)), np.empty((0, 1, 2)), start, end)
        corners = np.stack([low, high])[:, None]
        pixel, lowest = extent(corners) / (DPI * width), np.where(np.isfinite(low), low, 0.0)
        thinned = [ThinPath(lowest, pixel) for _ in range(len(start) + 1)]
        for _, states in trace.windows((X, Y)):
            place = drawable(states)
            for path, points in zip(thinned, (*place.transpose(1, 0, 2), place.mean(axis=1)), strict=True):
                path.add(points)
        *robots, centroid = (path.points for path in thinned)
        return cls(tuple(robots), centroid, corners, start, end)


def trajectories(trace: Trace, width: float) -> Picture:
    """Draws a map like the paper's Figs. 2 and 3: the paths of all robots, triangles that point in heading direction at their
    start and end, the outline of each group at the end, and the desired and the real path of the centroid."""
    plan, times_ns, paths = trace.plan, trace.common_ns(), Paths.of(trace, width)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        if len(times_ns):
            wanted = Desired(plan).sample(np.linspace(0, times_ns[-1] / 1e9, 400))[:, 0]
            axes.plot(*wanted.T, color="#8d8d97", lw=1.6, dashes=(4, 2.5), zorder=2)
            _label(axes, wanted[-1], "desired centroid", "#70707a", (6, -2))
            axes.plot(*paths.centroid.T, color=CENTROID, lw=0.9, zorder=3)
            size = extent(paths.corners) / 62
            for robot in plan.robots:
                look = Look.of_robot(plan, robot)
                axes.plot(*paths.robots[robot.index].T, color=look.colour, ls=look.dashes, lw=0.9, alpha=0.85, zorder=4)
                for states, filled in ((paths.start, False), (paths.end, True)):
                    *place, heading = states[robot.index]
                    _robot(axes, drawable(np.array(place)), heading, size, look.colour, filled)
            for number, (name, robots) in enumerate(_groups(plan)):
                corners = drawable(paths.end[robots, :2])
                if np.isfinite(corners).all():
                    look = Look.of_group(number)
                    fill = {"fc": look.colour, "ec": look.colour, "ls": look.dashes}
                    axes.add_patch(Polygon(_hull(corners), closed=True, alpha=0.13, lw=0.8, **fill))
                    _label(axes, corners.mean(axis=0), name, look.colour, (0, -3), ha="center", weight="bold")
            explained(
                figure,
                {
                    "desired centroid": {"color": "#8d8d97", "lw": 1.6, "dashes": (4, 2.5)},
                    "centroid": {"color": CENTROID, "lw": 0.9},
                    "start": {"color": QUIET, "ls": "", "marker": "^", "mfc": "white", "mec": QUIET},
                    "end": {"color": QUIET, "ls": "", "marker": "^"},
                },
            )
        as_map(axes)

    return Picture(width, map_height(paths.corners, width), draw)


def _robot(axes: Axes, place: Array, heading: float, size: float, colour: str, filled: bool) -> None:
    """Draws a robot at a place (2,) [m] as a triangle that points in the direction of its heading [rad]."""
    if not np.isfinite([*place, heading]).all():
        return
    c, s = np.cos(heading), np.sin(heading)
    corners = size * np.array([[1.0, 0.0], [-0.7, 0.62], [-0.7, -0.62]]) @ np.array([[c, s], [-s, c]]) + place
    axes.add_patch(
        Polygon(corners, closed=True, fc=colour if filled else "white", ec=colour, lw=1.0, zorder=6 + filled)
    )


def _groups(plan: Plan) -> list[tuple[str, list[int]]]:
    """Returns name and robots (indices) of every group right below the root; of the whole formation if it has no groups."""
    nodes = [node for node in plan.nodes if node.parent == plan.root.index] or [plan.root]
    return [(node.name, list(range(node.first_robot, node.first_robot + node.robots))) for node in nodes]


def _hull(points: Array) -> Array:
    """Returns the corners of the convex hull of points (N, 2), counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(map(tuple, points.tolist()))
    if len(ordered) < 3:
        return points
    hull: list[tuple[float, ...]] = []
    for way in (ordered, ordered[::-1]):
        chain: list[tuple[float, ...]] = []
        for x, y in way:
            while len(chain) > 1 and (chain[-1][0] - chain[-2][0]) * (y - chain[-2][1]) <= (
                chain[-1][1] - chain[-2][1]
            ) * (x - chain[-2][0]):
                chain.pop()
            chain.append((x, y))
        hull += chain[:-1]
    return np.array(hull)


def _label(axes: Axes, at: Array, text: str, colour: str, shift: Sequence[float], **style: Any) -> None:
    axes.annotate(
        text, (float(at[0]), float(at[1])), xytext=(shift[0], shift[1]), textcoords="offset points", color=colour,
        fontsize=8, zorder=8, bbox={"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.75}, **style,
    )  # fmt: skip
