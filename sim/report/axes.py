"""Axes that the figures of one run and of several runs share: small axes in rows, time, torque, distance, errors, maps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator
from numpy.typing import NDArray

from echelon.messages import STATE_FIELDS, field_index
from echelon.plan.plan import Plan
from echelon.sim.report.drawing import QUIET, short
from echelon.sim.report.thinning import Change, drawable, pieces, span
from echelon.sim.report.time_axis import TimeAxis
from echelon.sim.results.block_series import Blocks
from echelon.sim.results.distances import Distances
from echelon.sim.results.trace import Trace

Array = NDArray[np.float64]
SMALL_MULTIPLES: Final = 16
"""Robots that the figure of torques shows, at most"""
CALM: Final = 0.02
"""A figure ends when torques stay below this share of the largest, or the distance within this share of its last value"""
CALM_TORQUE: Final = "no torque is more than 2 % of the largest"
CALM_DISTANCE: Final = "it stays within 2 % of its last value"
PEAKED: Final = 20.0
"""The axis of torques is logarithmic if the largest torque is more than this multiple of the 95th percentile"""
TAUS: Final = field_index(STATE_FIELDS, "tau_right", "tau_left")
PEAKS: Final = field_index(STATE_FIELDS, "tau_right_peak", "tau_left_peak")


def small_multiples(figure: Figure, count: int, columns: int, sharey: bool = True) -> NDArray[Any]:
    """Returns `count` small axes in rows of `columns`, as an array (rows, columns); those beyond `count` are invisible."""
    grid: NDArray[Any] = figure.subplots(-(-count // columns), columns, squeeze=False, sharex=True, sharey=sharey)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for axes in grid.flat[max(count - columns, 0) : count]:  # the lowest one of each column
        axes.tick_params(labelbottom=True)
    return grid


def distance_time(near: Distances, plan: Plan) -> TimeAxis:
    """Returns the time axis for distances.  It ends soon after the smallest distance stays within 2 % of its last value, but
    not before the closest encounter."""
    smallest, time = near.smallest, TimeAxis.of(plan, near.times_ns)
    if not all(np.isfinite(drawable(smallest[part])).all() for part in pieces(len(smallest))) or not len(smallest):
        return time
    closest_s = 0.0 if near.closest is None else near.closest.time_ns / 1e9
    moves_s = _last_s(near.times_ns, lambda part: np.abs(smallest[part] - smallest[-1]) > CALM * abs(smallest[-1]))
    return time.until(max(moves_s, closest_s))


def torque_time(trace: Trace) -> TimeAxis:
    """Returns the time axis for torques.  It ends soon after the last torque above 2 % of the largest."""
    bound, time = CALM * TorqueScale.of([trace]).limit, TimeAxis.of(trace.plan, max(trace.times_ns, key=len))

    def last_s(times_ns: NDArray[np.int64], states: Array) -> float:
        return _last_s(times_ns, lambda part: np.any(~(np.abs(states[part][:, TAUS]) <= bound), axis=1))

    with np.errstate(invalid="ignore"):
        return time.until(max(map(last_s, trace.times_ns, trace.states), default=0.0))


def _last_s(times_ns: NDArray[np.int64], active: Callable[[slice], NDArray[np.bool_]]) -> float:
    """Returns the last of the instants (T,) at which `active` is true [s], which tells it of a part; 0 if there is none."""
    for part in reversed(list(pieces(len(times_ns)))):
        found = np.flatnonzero(active(part))
        if found.size:
            return float(times_ns[part.start + found[-1]]) / 1e9
    return 0.0


def largest_torques(trace: Trace) -> list[float]:
    """Returns the largest torque of each robot within its periods [N m]; 0 if none is finite."""
    with np.errstate(all="ignore"):
        return [max((0.0, *(_largest(states[part]) for part in pieces(len(states))))) for states in trace.states]


def _largest(states: Array) -> float:
    return float(np.fmax.reduce(states[:, PEAKS], axis=None, initial=0.0))


@dataclass(frozen=True, slots=True)
class TorqueScale:
    """The y axis of torques [N m] that several small axes share."""

    limit: float
    """Largest torque"""
    linear: float | None
    """Torques up to this are on a linear scale, larger ones on a logarithmic scale; None: the whole axis is linear"""

    @classmethod
    def of(cls, traces: Sequence[Trace]) -> Self:
        """Returns the axis for some runs: logarithmic if their peaks are much larger than most of their torques (`PEAKED`)."""
        largest = [torque for trace in traces for torque in largest_torques(trace) if np.isfinite(torque)]
        limit = min(max([*largest, 1e-3]), 1e12)
        count = large = 0
        for states in (states for trace in traces for states in trace.states):
            for part in pieces(len(states)):
                taus = np.abs(states[part][:, TAUS])
                count += int(np.count_nonzero(np.isfinite(taus) & (taus > 0)))
                large += int(np.count_nonzero(np.isfinite(taus) & (taus > limit / PEAKED)))
        if large > 0.05 * count or not count:
            return cls(limit, None)
        return cls(limit, 10.0 ** (np.floor(np.log10(limit)) - 3))

    def apply(self, axes: Axes) -> None:
        """Sets the y axis of axes."""
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
        """The sentence about the axis in a caption; empty if it is linear."""
        return "" if self.linear is None else "Torque is logarithmic beyond the innermost marks."


def radii(axes: Axes, radius: float, sensing: float) -> None:
    """Draws the avoidance radius and the sensing radius [m] as lines, on a logarithmic axis of distances."""
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


def plain_numbers(axis: Axis) -> None:
    """Gives a logarithmic axis plain numbers: 0.2 instead of 2 × 10⁻¹; in less than two decades also those between."""
    low, high = axis.get_view_interval()
    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0) if low > 0 and high < 100 * low else ()))
    for set_formatter in (axis.set_major_formatter, axis.set_minor_formatter):
        set_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def shown_distance(radius: float) -> Change:
    """Returns what makes of distances [m] those that are drawn: on the logarithmic axis none is less than a thousandth of the
    avoidance radius."""
    return lambda values: np.maximum(drawable(values), radius * 1e-3)


def distance_limits(axes: Axes, several: Sequence[Array], radius: float, sensing: float) -> None:
    """Sets the limits and the label of an axis of distances so that both radii and all distances [m], (T,) each, are in it."""
    spans = [shown_distance(radius)(np.array(span(values))) for values in several]
    low, high = np.fmin.reduce(spans, axis=None), np.fmax.reduce(spans, axis=None)
    low, high = (float(low), float(high)) if np.isfinite(low) else (radius, sensing)
    axes.set_ylim(min(low, radius) / 1.6, max(high, sensing) * 1.6)
    plain_numbers(axes.yaxis)
    axes.set_ylabel("smallest distance [m]")


def positive(norm: Array) -> Array:
    """Returns |e| as it is drawn on a logarithmic axis: NaN where it is zero."""
    return drawable(np.where(norm > 0, norm, np.nan))


def as_map(axes: Axes) -> None:
    """Gives x and y [m] the same scale."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def extent(place: Array) -> float:
    """Returns the largest extent of positions (…, …, 2) in x or in y [m]; 1 if there is none."""
    with np.errstate(all="ignore"):
        span = np.fmax.reduce(place, axis=(0, 1)) - np.fmin.reduce(place, axis=(0, 1))
    largest = float(np.fmax.reduce(span))
    return largest if np.isfinite(largest) and largest > 0 else 1.0


def map_height(place: Array, width: float) -> float:
    """Returns the height of a map [inches] with positions (…, …, 2) and a given width: in proportion, within limits."""
    with np.errstate(all="ignore"):
        x, y = np.fmax.reduce(place, axis=(0, 1)) - np.fmin.reduce(place, axis=(0, 1)) if len(place) else (1.0, 1.0)
        ratio = float(y / x)
    return float(min(max(width * ratio if np.isfinite(ratio) else width, 0.6 * width), 1.3 * width, 7.4))


def error_limits(axes: Axes, several: Sequence[Blocks]) -> None:
    """Limits an axis of errors to six decades below the largest: near its zero crossings |e| is arbitrarily small, and that
    says nothing."""
    highs = [span(series.norm)[1] for blocks in several for series in blocks.series]
    largest = float(np.fmax.reduce([0.0, *highs]))
    if largest > 0:
        axes.set_ylim(largest * 1e-6, largest * 2)
