"""Figures of a run: trajectories, transformed state, errors, distances, wheel torques."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from echelon.messages import STATE_FIELDS, field_index
from echelon.plan.plan import Plan
from echelon.sim.report.drawing import CENTROID, INK, QUIET, Look, Picture, TimeAxis, above, drawable, short, thin
from echelon.sim.results.block_series import Blocks, BlockSeries
from echelon.sim.results.desired import Desired
from echelon.sim.results.distances import Distances, distances
from echelon.sim.results.settling import settle
from echelon.sim.results.trace import Trace

Array = NDArray[np.float64]
SMALL_MULTIPLES: Final = 16
CALM: Final = 0.02
"""Share of the largest torque, and of the distance in the end, that is no longer worth a look"""
CALM_TORQUE: Final = "no torque is more than 2 % of the largest"
CALM_DISTANCE: Final = "it stays within 2 % of what it is in the end"
PEAKED: Final = 20.0
"""Torque is drawn on a logarithmic axis where the largest is so many times what 95 % of the torques stay within"""
X, Y, THETA = field_index(STATE_FIELDS, "x", "y", "theta")
TAUS: Final = field_index(STATE_FIELDS, "tau_right", "tau_left")
PEAKS: Final = field_index(STATE_FIELDS, "tau_right_peak", "tau_left_peak")


def trajectories(trace: Trace, width: float) -> Picture:
    """Draws the paper's Figs. 2 and 3: paths of all robots, start and end as triangles in heading direction, the final
    formation's groups outlined, the desired and the real path of the centroid."""
    times_ns, states = trace.common()
    plan, place = trace.plan, drawable(states[:, :, [X, Y]])

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        if len(times_ns):
            wanted = Desired(plan).sample(np.linspace(0, times_ns[-1] / 1e9, 400))[:, 0]
            axes.plot(*wanted.T, color="#8d8d97", lw=1.6, dashes=(4, 2.5), zorder=2)
            _label(axes, wanted[-1], "desired centroid", "#70707a", (6, -2))
            axes.plot(*place.mean(axis=1).T, color=CENTROID, lw=0.9, zorder=3)
            size = extent(place) / 62
            for robot in plan.robots:
                look = Look.of_robot(plan, robot)
                path = place[:, robot.index]
                axes.plot(*path.T, color=look.colour, ls=look.dashes, lw=0.9, alpha=0.85, zorder=4)
                for at, filled in ((0, False), (-1, True)):
                    _robot(axes, path[at], states[at, robot.index, THETA], size, look.colour, filled)
            for number, (name, robots) in enumerate(_groups(plan)):
                corners = place[-1, robots]
                if np.isfinite(corners).all():
                    look = Look.of_group(number)
                    fill = {"fc": look.colour, "ec": look.colour, "ls": look.dashes}
                    axes.add_patch(Polygon(_hull(corners), closed=True, alpha=0.13, lw=0.8, **fill))
                    _label(axes, corners.mean(axis=0), name, look.colour, (0, -3), ha="center", weight="bold")
        as_map(axes)

    return Picture(width, map_height(place, width), draw)


def transformed_state(blocks: Blocks, plan: Plan, width: float) -> Picture:
    """Draws the paper's Fig. 4: every shape variable and the centroid against time, on a linear and on a log axis."""
    layers, time = _layers(blocks), TimeAxis.of(plan, blocks.times_ns)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(len(layers), 2, squeeze=False, sharey="row")
        for (layer, members), row in zip(layers, grid, strict=True):
            title = {
                "intra": "Intra-group shape variables",
                "middle": "Shape variables of the layers between",
                "inter": "Inter-group shape variables",
            }.get(layer, "Centroid")
            looks = {series.block.name: Look.of_block(plan, series.block) for series in members}
            for axes, log in zip(row, (False, True), strict=True):
                for place, series in enumerate(members):
                    look = looks[series.block.name]
                    every = (0.03 + 0.15 * place / len(members), 0.15) if len(members) > 1 else None
                    for number in range(series.block.size):
                        style = "-" if number % 2 == 0 else (0, (3, 1.2))
                        wanted = thin(blocks.times_ns, series.desired[:, number], log)
                        axes.plot(*wanted, color="#b9b9c2", lw=2.4, solid_capstyle="butt", zorder=1)
                        real = thin(blocks.times_ns, series.value[:, number], log)
                        marked = every if np.isfinite(real[1]).any() else None  # matplotlib marks no empty line
                        mark = {"marker": look.mark, "markevery": marked, "ms": 3.2, "mew": 0} if marked else {}
                        axes.plot(*real, color=look.colour, lw=1.0, ls=style, zorder=3, **mark)
                time.with_log(log).apply(axes, layer == layers[-1][0])
            row[0].set_title(title)
            row[0].set_ylabel("[m]")
            if len(members) > 1:
                marks = [Line2D([], [], color=look.colour, marker=look.mark, ms=3.6, mew=0) for look in looks.values()]
                columns = min(len(members), 8)
                row[1].legend(marks, looks, loc="lower right", bbox_to_anchor=(1, 1), ncols=columns, borderpad=0)

    return Picture(width, 1.75 * len(layers) + 0.5, draw)


def errors(blocks: Blocks, plan: Plan, width: float) -> Picture:
    """Draws |e| of every block on a logarithmic axis, with its settling to 5 % and 2 % marked and the claims."""
    time = TimeAxis.of(plan, blocks.times_ns)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_yscale("log")
        for series in blocks.series:
            if not series.block.size:
                continue
            look = Look.of_block(plan, series.block)
            line = time.thin(blocks.times_ns, positive(series.norm))
            axes.plot(*line, color=look.colour, ls=look.dashes, lw=1.3, zorder=3)
            for fraction, face in ((0.05, look.colour), (0.02, "white")):
                settled = settle(plan, series, blocks.times_ns, fraction).settled_ns
                if settled:
                    norm = series.norm[int(np.searchsorted(blocks.times_ns, settled))]
                    edge: dict[str, Any] = {"mfc": face, "mec": look.colour, "mew": 1.2}
                    axes.plot(settled / 1e9, norm, look.mark, ms=5.5, zorder=5, clip_on=False, **edge)
            line_only: dict[str, Any] = {"color": look.colour, "ls": look.dashes, "marker": look.mark}
            axes.plot([], [], lw=1.3, ms=5, label=series.block.name, **line_only)
        above(
            axes, time, width, [(claim.settled_by, f"{claim.block} by {claim.settled_by:g} s") for claim in plan.claims]
        )
        error_limits(axes, [blocks])
        time.apply(axes)
        axes.set_ylabel("|e| [m]")
        figure.legend(loc="outside lower center", ncols=min(len(blocks.series), 8), handlelength=3)

    return Picture(width, 3.5, draw)


def smallest_distance(near: Distances, plan: Plan, width: float) -> Picture:
    """Draws the smallest distance of all pairs over time, with the radii of avoidance and the closest encounter."""
    time = distance_time(near, plan)
    radius, sensing = plan.avoidance.avoidance_radius, plan.avoidance.sensing_radius
    shown = np.maximum(drawable(near.smallest), radius * 1e-3)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        radii(axes, radius, sensing)
        axes.plot(*time.thin(near.times_ns, shown), color=INK, lw=1.0, zorder=3)
        if near.closest is not None and time.shows(near.closest.time_ns / 1e9):
            at = near.closest.time_ns / 1e9, max(near.closest.distance, radius * 1e-3)
            axes.plot(*at, "o", ms=5, mfc="white", mec=INK, zorder=5, clip_on=False)
        distance_limits(axes, shown, radius, sensing)
        time.apply(axes)

    return Picture(width, 2.7, draw)


def wheel_torques(trace: Trace, width: float) -> Picture:
    """Draws both wheels' mean torque of every period, one small picture per robot (of many: those with the largest)."""
    plan = trace.plan
    right, left = TAUS
    largest = largest_torques(trace)
    chosen = sorted(sorted(range(len(largest)), key=lambda robot: -largest[robot])[:SMALL_MULTIPLES])
    columns = 3 if len(chosen) <= 9 else 4
    scale = TorqueScale.of([trace])
    time = torque_time(trace)

    def draw(figure: Figure) -> None:
        grid = small_multiples(figure, len(chosen), columns)
        for axes, robot in zip(grid.flat, chosen, strict=False):
            look = Look.of_robot(plan, plan.robots[robot])
            scale.apply(axes)
            for field, shade in ((left, "#a5a5ae"), (right, look.colour)):
                torque = time.thin(trace.times_ns[robot], trace.states[robot][:, field])
                axes.plot(*torque, color=shade, lw=0.9)
            torque_limit = plan.robots[robot].torque_limit
            if np.isfinite(torque_limit):
                for bound in (-torque_limit, torque_limit):
                    axes.axhline(bound, color=INK, lw=0.6, dashes=(3, 2))
            axes.set_title(plan.robots[robot].name, color=look.colour)
            time.apply(axes, robot >= chosen[-min(columns, len(chosen))])
        for row in grid:
            row[0].set_ylabel("torque [N m]")

    return Picture(width, 1.35 * -(-len(chosen) // columns) + 0.5, draw)


def small_multiples(figure: Figure, count: int, columns: int, sharey: bool = True) -> NDArray[Any]:
    """Returns so many small axes in rows."""
    grid: NDArray[Any] = figure.subplots(-(-count // columns), columns, squeeze=False, sharex=True, sharey=sharey)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for axes in grid.flat[max(count - columns, 0) : count]:  # the last of their columns
        axes.tick_params(labelbottom=True)
    return grid


def distance_time(near: Distances, plan: Plan) -> TimeAxis:
    """Returns the time axis for distances: while the smallest is more than 2 % off what it is in the end, and up to the
    closest encounter."""
    smallest, time = drawable(near.smallest), TimeAxis.of(plan, near.times_ns)
    if not len(smallest) or not np.isfinite(smallest).all():
        return time
    closest_s = 0.0 if near.closest is None else near.closest.time_ns / 1e9
    moves_s = _last_s(near.times_ns, np.abs(smallest - smallest[-1]) > CALM * abs(smallest[-1]))
    return time.until(max(moves_s, closest_s))


def torque_time(trace: Trace) -> TimeAxis:
    """Returns the time axis for torques: while any is more than 2 % of the largest."""
    bound, time = CALM * TorqueScale.of([trace]).limit, TimeAxis.of(trace.plan, max(trace.times_ns, key=len))
    with np.errstate(invalid="ignore"):
        active = [np.any(~(np.abs(states[:, TAUS]) <= bound), axis=1) for states in trace.states]
    return time.until(
        max((_last_s(times_ns, row) for times_ns, row in zip(trace.times_ns, active, strict=True)), default=0.0)
    )


def _last_s(times_ns: NDArray[np.int64], active: ArrayLike) -> float:
    """Returns the last instant [s] at which something is active, 0 if none is."""
    found = np.flatnonzero(active)
    return float(times_ns[found[-1]]) / 1e9 if found.size else 0.0


def largest_torques(trace: Trace) -> list[float]:
    """Returns the largest torque of each robot [N m]; 0 where none is finite."""
    with np.errstate(all="ignore"):
        return [float(np.fmax.reduce(states[:, PEAKS], axis=None, initial=0.0)) for states in trace.states]


@dataclass(frozen=True, slots=True)
class TorqueScale:
    """Torque [N m] as the y axis of small pictures: linear, or logarithmic beyond `linear` where the peaks dwarf the rest."""

    limit: float
    linear: float | None

    @classmethod
    def of(cls, traces: Sequence[Trace]) -> Self:
        """Returns the axis on which most can be seen of some runs."""
        largest = [torque for trace in traces for torque in largest_torques(trace) if np.isfinite(torque)]
        limit = min(max([*largest, 1e-3]), 1e12)
        taus = np.abs(np.concatenate([states[:, TAUS].ravel() for trace in traces for states in trace.states]))
        taus = taus[np.isfinite(taus) & (taus > 0)]
        if limit < PEAKED * (float(np.quantile(taus, 0.95)) if taus.size else limit):
            return cls(limit, None)
        return cls(limit, 10.0 ** (np.floor(np.log10(limit)) - 3))

    def apply(self, axes: Axes) -> None:
        """Makes torque the y axis."""
        axes.set_ylim(-1.6 * self.limit, 1.6 * self.limit)
        if self.linear is None:
            axes.set_ylim(-1.1 * self.limit, 1.1 * self.limit)
            axes.yaxis.set_major_locator(MaxNLocator(5))
            return
        axes.set_yscale("symlog", linthresh=self.linear, linscale=0.5)
        axes.set_ylim(-1.6 * self.limit, 1.6 * self.limit)
        ticks = [sign * self.linear * 10.0**power for power in (1, 3) for sign in (-1, 1)]
        axes.set_yticks([*ticks, 0.0], labels=[short(tick) for tick in [*ticks, 0.0]])

    @property
    def words(self) -> str:
        """How a caption says it."""
        return "" if self.linear is None else "Torque is logarithmic beyond the innermost marks."


def radii(axes: Axes, radius: float, sensing: float) -> None:
    """Draws the radii of avoidance."""
    axes.set_yscale("log")
    axes.axhspan(1e-12, radius, color="#d0342c", alpha=0.10, lw=0, zorder=0)
    for value, text, colour in (
        (radius, f"rₐ = {radius:g} m", "#d0342c"),
        (sensing, f"Rₛ = {sensing:g} m", QUIET),
    ):
        axes.axhline(value, color=colour, lw=0.9, dashes=(3, 2), zorder=2)
        axes.annotate(
            text, (1, value), xycoords=("axes fraction", "data"), xytext=(3, 0), textcoords="offset points",
            ha="left", va="center", fontsize=7.5, color=colour, annotation_clip=False,
        )  # fmt: skip


def distance_limits(axes: Axes, shown: Array, radius: float, sensing: float) -> None:
    """Shows the radii and all distances."""
    finite = shown[np.isfinite(shown)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (radius, sensing)
    axes.set_ylim(min(low, radius) / 1.6, max(high, sensing) * 1.6)
    axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    for set_formatter in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        set_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel("smallest distance [m]")


def positive(norm: Array) -> Array:
    """Returns |e| for a logarithmic axis: NaN where it is zero."""
    return np.where(norm > 0, norm, np.nan)


def as_map(axes: Axes) -> None:
    """Makes x and y places of the same scale."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def extent(place: Array) -> float:
    """Returns how far places are apart in x or y, at most [m]."""
    with np.errstate(all="ignore"):
        span = np.fmax.reduce(place, axis=(0, 1)) - np.fmin.reduce(place, axis=(0, 1))
    largest = float(np.fmax.reduce(span))
    return largest if np.isfinite(largest) and largest > 0 else 1.0


def map_height(place: Array, width: float) -> float:
    """Returns how tall a map must be to show its places in full width, within reason."""
    with np.errstate(all="ignore"):
        x, y = np.fmax.reduce(place, axis=(0, 1)) - np.fmin.reduce(place, axis=(0, 1)) if len(place) else (1.0, 1.0)
        ratio = float(y / x)
    return float(min(max(width * ratio if np.isfinite(ratio) else width, 0.6 * width), 1.3 * width, 7.4))


def error_limits(axes: Axes, several: Sequence[Blocks]) -> None:
    """Shows six decades: what zero crossings of the error dip to says nothing."""
    norms = [drawable(series.norm) for blocks in several for series in blocks.series]
    largest = max((float(np.fmax.reduce(norm, initial=0.0)) for norm in norms), default=0.0)
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
        fontsize=8, zorder=8, bbox={"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.75}, **style,
    )  # fmt: skip


FIGURES: Final = ("trajectories", "blocks", "errors", "distance", "torques")


def picture(name: str, trace: Trace, blocks: Blocks, width: float = 11.5) -> Picture:
    """Returns one of `FIGURES`, so many inches wide.  Raises KeyError for another name."""
    match name:
        case "trajectories":
            return trajectories(trace, width)
        case "blocks":
            return transformed_state(blocks, trace.plan, width)
        case "errors":
            return errors(blocks, trace.plan, width)
        case "distance":
            return smallest_distance(distances(trace), trace.plan, width)
        case "torques":
            return wheel_torques(trace, width)
    raise KeyError(f"no figure {name!r}; there are {', '.join(FIGURES)}")
