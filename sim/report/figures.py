"""Figures of a run as SVG text: trajectories, transformed state, errors, distances, wheel torques."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from echelon.messages import STATE_FIELDS, field_index
from echelon.plan.plan import Plan
from echelon.sim.report.drawing import (
    CENTROID,
    GROUPS,
    INK,
    QUIET,
    canvas,
    colour_of_block,
    colour_of_robot,
    drawable,
    short,
    thin,
    time_axis,
)
from echelon.sim.results.block_series import Blocks, BlockSeries
from echelon.sim.results.desired import Desired
from echelon.sim.results.distances import Distances, distances
from echelon.sim.results.settling import settle
from echelon.sim.results.trace import Trace

Array = NDArray[np.float64]
SMALL_MULTIPLES: Final = 16
X, Y, THETA = field_index(STATE_FIELDS, "x", "y", "theta")


def trajectories(trace: Trace, width: float) -> str:
    """Draws the paper's Figs. 2 and 3: paths of all robots, start and end as triangles in heading direction, the final
    formation's groups outlined, the desired and the real path of the centroid."""
    times_ns, states = trace.common()
    plan = trace.plan
    with canvas(width, _height(drawable(states[:, :, [X, Y]]), width)) as (figure, done):
        axes = figure.subplots()
        if len(times_ns):
            place = drawable(states[:, :, [X, Y]])
            wanted = Desired(plan).sample(np.linspace(0, times_ns[-1] / 1e9, 400))[:, 0]
            axes.plot(*wanted.T, color="#8d8d97", lw=1.6, dashes=(4, 2.5), zorder=2)
            _label(axes, wanted[-1], "desired centroid", "#70707a", (6, -2))
            centroid = place.mean(axis=1)
            axes.plot(*centroid.T, color=CENTROID, lw=0.9, zorder=3)
            size = _extent(place) / 62
            for robot in plan.robots:
                colour = colour_of_robot(plan, robot)
                path = place[:, robot.index]
                axes.plot(*path.T, color=colour, lw=0.85, alpha=0.8, zorder=4)
                for at, filled in ((0, False), (-1, True)):
                    _robot(axes, path[at], states[at, robot.index, THETA], size, colour, filled)
            for number, (name, robots) in enumerate(_groups(plan)):
                corners = place[-1, robots]
                if np.isfinite(corners).all():
                    colour = GROUPS[number % len(GROUPS)]
                    axes.add_patch(Polygon(_hull(corners), closed=True, fc=colour, ec=colour, alpha=0.13, lw=0.8))
                    _label(axes, corners.mean(axis=0), name, colour, (0, -3), ha="center", weight="bold")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    return done()


def transformed_state(blocks: Blocks, plan: Plan, width: float) -> str:
    """Draws the paper's Fig. 4: every shape variable and the centroid against time, on a linear and on a log axis."""
    layers = _layers(blocks)
    with canvas(width, 1.75 * len(layers) + 0.5) as (figure, done):
        grid = figure.subplots(len(layers), 2, squeeze=False, sharey="row")
        for (layer, members), row in zip(layers, grid, strict=True):
            title = {
                "intra": "Intra-group shape variables",
                "middle": "Shape variables of the layers between",
                "inter": "Inter-group shape variables",
            }.get(layer, "Centroid")
            for axes, log in zip(row, (False, True), strict=True):
                for series in members:
                    colour = colour_of_block(plan, series.block)
                    for number in range(series.block.size):
                        style = "-" if number % 2 == 0 else (0, (3, 1.2))
                        wanted = thin(blocks.times_ns, series.desired[:, number], log)
                        axes.plot(*wanted, color="#b9b9c2", lw=2.4, solid_capstyle="butt", zorder=1)
                        real = thin(blocks.times_ns, series.value[:, number], log)
                        axes.plot(*real, color=colour, lw=1.0, ls=style, zorder=3)
                time_axis(axes, blocks.times_ns, log, layer == layers[-1][0])
            row[0].set_title(title)
            row[0].set_ylabel("[m]")
    return done()


def errors(blocks: Blocks, plan: Plan, width: float) -> str:
    """Draws |e| of every block, both axes logarithmic, with its settling to 5 % and 2 % marked and the claims."""
    with canvas(width, 3.3) as (figure, done):
        axes = figure.subplots()
        axes.set_yscale("log")
        for series in blocks.series:
            if not series.block.size:
                continue
            colour = colour_of_block(plan, series.block)
            times, norm = thin(blocks.times_ns, np.where(series.norm > 0, series.norm, np.nan), log=True)
            axes.plot(times, norm, color=colour, lw=1.3, zorder=3, label=series.block.name)
            for fraction, face in ((0.05, colour), (0.02, "white")):
                settled = settle(plan, series, blocks.times_ns, fraction).settled_ns
                if settled:
                    at = int(np.searchsorted(blocks.times_ns, settled))
                    axes.plot(
                        settled / 1e9,
                        series.norm[at],
                        "o",
                        ms=5.5,
                        mfc=face,
                        mec=colour,
                        mew=1.2,
                        zorder=5,
                        clip_on=False,
                    )
        for claim in plan.claims:
            axes.axvline(claim.settled_by, color="#8d8d97", lw=0.8, dashes=(3, 2), zorder=1)
            axes.annotate(
                f"{claim.block} by {claim.settled_by:g} s", (claim.settled_by, 0.02),
                xycoords=("data", "axes fraction"), xytext=(-3, 0), textcoords="offset points", rotation=90, zorder=6,
                ha="right", va="bottom", fontsize=7.5, color=QUIET,
                bbox={"fc": "white", "ec": "none", "pad": 0.8, "alpha": 0.85},
            )  # fmt: skip
        _error_limits(axes, blocks)
        time_axis(axes, blocks.times_ns, log=True, last=True)
        axes.set_ylabel("|e| [m]")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=min(len(blocks.series), 8), handlelength=1.4)
    return done()


def smallest_distance(near: Distances, plan: Plan, width: float) -> str:
    """Draws the smallest distance of all pairs over time, with the radii of avoidance and the closest encounter."""
    with canvas(width, 2.7) as (figure, done):
        axes = figure.subplots()
        axes.set_yscale("log")
        radius, sensing = plan.avoidance.avoidance_radius, plan.avoidance.sensing_radius
        axes.axhspan(1e-12, radius, color="#d0342c", alpha=0.10, lw=0, zorder=0)
        for value, text, colour in (
            (radius, f"rₐ = {radius:g} m", "#d0342c"),
            (sensing, f"Rₛ = {sensing:g} m", QUIET),
        ):
            axes.axhline(value, color=colour, lw=0.9, dashes=(3, 2), zorder=2)
            axes.annotate(
                text, (1, value), xycoords=("axes fraction", "data"), xytext=(0, 3), textcoords="offset points",
                ha="right", fontsize=7.5, color=colour,
            )  # fmt: skip
        shown = np.maximum(drawable(near.smallest), radius * 1e-3)
        axes.plot(*thin(near.times_ns, shown, log=True), color=INK, lw=1.0, zorder=3)
        if near.closest is not None and near.closest.time_ns > 0:
            axes.plot(
                near.closest.time_ns / 1e9,
                max(near.closest.distance, radius * 1e-3),
                "o",
                ms=5,
                mfc="white",
                mec=INK,
                zorder=5,
            )
        finite = shown[np.isfinite(shown)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (radius, sensing)
        axes.set_ylim(min(low, radius) / 1.6, max(high, sensing) * 1.6)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        time_axis(axes, near.times_ns, log=True, last=True)
        axes.set_ylabel("smallest distance [m]")
    return done()


def wheel_torques(trace: Trace, width: float) -> str:
    """Draws both wheels' mean torque of every period, one small picture per robot (of many: those with the largest)."""
    plan = trace.plan
    right, left, *peaks = field_index(STATE_FIELDS, "tau_right", "tau_left", "tau_right_peak", "tau_left_peak")
    with np.errstate(all="ignore"):
        largest = [float(np.fmax.reduce(states[:, peaks], axis=None, initial=0.0)) for states in trace.states]
    chosen = sorted(sorted(range(len(largest)), key=lambda robot: -largest[robot])[:SMALL_MULTIPLES])
    columns = 3 if len(chosen) <= 9 else 4
    rows = -(-len(chosen) // columns)
    limit = min(max([*(value for value in largest if np.isfinite(value)), 1e-3]), 1e12)
    linear = 10.0 ** (np.floor(np.log10(limit)) - 3)
    with canvas(width, 1.35 * rows + 0.5) as (figure, done):
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes in grid.flat[len(chosen) :]:
            axes.set_visible(False)
        for axes, robot in zip(grid.flat, chosen, strict=False):
            colour = colour_of_robot(plan, plan.robots[robot])
            axes.set_yscale("symlog", linthresh=linear, linscale=0.5)
            for field, shade, weight in ((left, "#a5a5ae", 0.9), (right, colour, 0.9)):
                times, torque = thin(trace.times_ns[robot], trace.states[robot][:, field], log=True)
                axes.plot(times, torque, color=shade, lw=weight)
            torque_limit = plan.robots[robot].torque_limit
            if np.isfinite(torque_limit):
                for bound in (-torque_limit, torque_limit):
                    axes.axhline(bound, color=INK, lw=0.6, dashes=(3, 2))
            axes.set_title(plan.robots[robot].name, color=colour)
            time_axis(axes, trace.times_ns[robot], log=True, last=robot >= chosen[-min(columns, len(chosen))])
            axes.set_ylim(-1.6 * limit, 1.6 * limit)
            ticks = [sign * linear * 10.0**power for power in (1, 3) for sign in (-1, 1)]
            axes.set_yticks([*ticks, 0.0], labels=[short(tick) for tick in [*ticks, 0.0]])
        for row in grid:
            row[0].set_ylabel("torque [N m]")
    return done()


def _extent(place: Array) -> float:
    with np.errstate(all="ignore"):
        span = np.fmax.reduce(place, axis=(0, 1)) - np.fmin.reduce(place, axis=(0, 1))
    largest = float(np.fmax.reduce(span))
    return largest if np.isfinite(largest) and largest > 0 else 1.0


def _height(place: Array, width: float) -> float:
    """Returns how tall a map must be to show its places in full width, within reason."""
    with np.errstate(all="ignore"):
        x, y = np.fmax.reduce(place, axis=(0, 1)) - np.fmin.reduce(place, axis=(0, 1)) if len(place) else (1.0, 1.0)
        ratio = float(y / x)
    return float(min(max(width * ratio if np.isfinite(ratio) else width, 0.6 * width), 1.3 * width, 7.4))


def _error_limits(axes: Axes, blocks: Blocks) -> None:
    """Shows six decades: what zero crossings of the error dip to says nothing."""
    largest = max((float(np.fmax.reduce(drawable(series.norm), initial=0.0)) for series in blocks.series), default=0.0)
    if largest > 0:
        axes.set_ylim(largest * 1e-6, largest * 2)


def _robot(axes: Axes, place: Array, heading: float, size: float, colour: str, filled: bool) -> None:
    """Draws a triangle that points in heading direction."""
    if not np.isfinite([*place, heading]).all():
        return
    c, s = np.cos(heading), np.sin(heading)
    corners = size * np.array([[1.0, 0.0], [-0.7, 0.62], [-0.7, -0.62]]) @ np.array([[c, s], [-s, c]]) + place
    axes.add_patch(
        Polygon(corners, closed=True, fc=colour if filled else "white", ec=colour, lw=1.0, zorder=6 + filled)
    )


def _groups(plan: Plan) -> list[tuple[str, list[int]]]:
    """Returns name and robots of every group at the top of the tree, of the formation itself if it has none."""
    nodes = [node for node in plan.nodes if node.parent == plan.root.index] or [plan.root]
    return [(node.name, list(range(node.first_robot, node.first_robot + node.robots))) for node in nodes]


def _hull(points: Array) -> Array:
    """Returns the corners of the convex hull, counter-clockwise (Andrew's monotone chain)."""
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


def _layers(blocks: Blocks) -> list[tuple[str, list[BlockSeries]]]:
    layers: dict[str, list[BlockSeries]] = {}
    for series in blocks.series:
        if series.block.size:
            layers.setdefault(series.block.layer, []).append(series)
    return list(layers.items())


def _label(axes: Axes, at: Array, text: str, colour: str, shift: Sequence[float], **style: Any) -> None:
    axes.annotate(
        text, (float(at[0]), float(at[1])), xytext=(shift[0], shift[1]), textcoords="offset points", color=colour,
        fontsize=8, zorder=8, **style,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure as SVG.  Jupyter shows it."""

    svg: str

    def _repr_svg_(self) -> str:
        return self.svg

    def save(self, path: str | Path) -> None:
        """Writes it.  Raises OSError, and ValueError for a file that is not to be an SVG."""
        path = Path(path)
        if path.suffix != ".svg":
            raise ValueError(f"{path}: must end in .svg")
        path.write_text(self.svg, encoding="utf-8")


FIGURES: Final = ("trajectories", "blocks", "errors", "distance", "torques")


def picture(name: str, trace: Trace, blocks: Blocks, width: float = 11.5) -> Picture:
    """Returns one of `FIGURES`, so many inches wide.  Raises KeyError for another name."""
    match name:
        case "trajectories":
            return Picture(trajectories(trace, width))
        case "blocks":
            return Picture(transformed_state(blocks, trace.plan, width))
        case "errors":
            return Picture(errors(blocks, trace.plan, width))
        case "distance":
            return Picture(smallest_distance(distances(trace), trace.plan, width))
        case "torques":
            return Picture(wheel_torques(trace, width))
    raise KeyError(f"no figure {name!r}; there are {', '.join(FIGURES)}")
