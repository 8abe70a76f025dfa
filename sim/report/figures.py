"""The figures of one run: trajectories, transformed state, errors, distances, wheel torques."""

from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from echelon.plan.plan import Plan
from echelon.sim.report.axes import (
    SMALL_MULTIPLES,
    TAUS,
    TorqueScale,
    distance_limits,
    distance_time,
    error_limits,
    largest_torques,
    positive,
    radii,
    shown_distance,
    small_multiples,
    torque_time,
)
from echelon.sim.report.drawing import INK, QUIET, Look, Picture, explained
from echelon.sim.report.thinning import thin
from echelon.sim.report.time_axis import TimeAxis, above
from echelon.sim.report.trajectory_map import trajectories
from echelon.sim.results.block_series import Blocks, BlockSeries
from echelon.sim.results.distances import Distances, distances
from echelon.sim.results.settling import settle
from echelon.sim.results.trace import Trace

FIGURES: Final = ("trajectories", "blocks", "errors", "distance", "torques")


def picture(name: str, trace: Trace, blocks: Blocks, width: float = 11.5) -> Picture:
    """Returns one of `FIGURES`, `width` inches wide.  Raises KeyError for another name."""
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


def transformed_state(blocks: Blocks, plan: Plan, width: float) -> Picture:
    """Draws figures like the paper's Fig. 4: every shape variable and the centroid over time, on a linear and on a logarithmic
    time axis."""
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
            several = len(members) > 1
            marks = [
                Line2D([], [], color=look.colour, marker=look.mark if several else "", ms=3.6, mew=0)
                for look in looks.values()
            ]
            columns = min(len(members), 8)
            row[1].legend(marks, looks, loc="lower right", bbox_to_anchor=(1, 1), ncols=columns, borderpad=0)
        explained(
            figure,
            {
                "x": {"color": QUIET, "lw": 1.0},
                "y": {"color": QUIET, "lw": 1.0, "ls": (0, (3, 1.2))},
                "desired": {"color": "#b9b9c2", "lw": 2.4},
            },
        )

    return Picture(width, 1.75 * len(layers) + 0.5, draw)


def errors(blocks: Blocks, plan: Plan, width: float) -> Picture:
    """Draws |e| of every block on a logarithmic axis, with marks where it settles to 5 % and to 2 %, and with the claims."""
    time = TimeAxis.of(plan, blocks.times_ns)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_yscale("log")
        for series in blocks.series:
            if not series.block.size:
                continue
            look = Look.of_block(plan, series.block)
            line = time.thin(blocks.times_ns, series.norm, positive)
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
        for text, face in (("settled to 5 %", QUIET), ("to 2 %", "white")):
            axes.plot([], [], "o", ms=5, mfc=face, mec=QUIET, mew=1.2, label=text)
        figure.legend(loc="outside lower center", ncols=min(len(blocks.series) + 2, int(width)), handlelength=3)

    return Picture(width, 3.5, draw)


def smallest_distance(near: Distances, plan: Plan, width: float) -> Picture:
    """Draws the smallest distance of all pairs over time, with avoidance radius, sensing radius and the closest encounter."""
    time = distance_time(near, plan)
    radius, sensing = plan.avoidance.avoidance_radius, plan.avoidance.sensing_radius

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        radii(axes, radius, sensing)
        axes.plot(*time.thin(near.times_ns, near.smallest, shown_distance(radius)), color=INK, lw=1.0, zorder=3)
        if near.closest is not None and time.shows(near.closest.time_ns / 1e9):
            at = near.closest.time_ns / 1e9, max(near.closest.distance, radius * 1e-3)
            axes.plot(*at, "o", ms=5, mfc="white", mec=INK, zorder=5, clip_on=False)
        distance_limits(axes, [near.smallest], radius, sensing)
        time.apply(axes)

    return Picture(width, 2.7, draw)


def wheel_torques(trace: Trace, width: float) -> Picture:
    """Draws the mean torque of both wheels in every period, on small axes for each robot; of more than `SMALL_MULTIPLES` robots
    for those with the largest torques."""
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
        explained(
            figure,
            {
                "right wheel, in the group's colour": {"color": Look.of_robot(plan, plan.robots[chosen[0]]).colour},
                "left wheel": {"color": "#a5a5ae"},
            },
        )

    return Picture(width, 1.35 * -(-len(chosen) // columns) + 0.5, draw)


def _layers(blocks: Blocks) -> list[tuple[str, list[BlockSeries]]]:
    """Returns the layers by name, each with its blocks; blocks without variables are left out."""
    layers: dict[str, list[BlockSeries]] = {}
    for series in blocks.series:
        if series.block.size:
            layers.setdefault(series.block.layer, []).append(series)
    return list(layers.items())
