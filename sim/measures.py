"""What is measured of a run, as rows of plain values: settling, error integrals, separation, claims, torque, links.

Times in rows are seconds of run time; None stands for what there is not, as the settling time of what did not settle.
"""

from collections.abc import Iterable
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.link import LinkCounts
from echelon.messages import STATE_FIELDS
from echelon.plan import BlockPlan, Plan
from echelon.sim.blocks import Blocks, BlockSeries
from echelon.sim.distances import Distances
from echelon.sim.trace import Trace

Array = NDArray[np.float64]
Row = dict[str, Any]
ROUNDING: Final = 1e-9
"""Errors up to this [m] are rounding: a block within it is settled, however small its largest error was."""
STARTED_NS: Final = 1_000_000_000
"""Saturation in the first second is counted apart: the step at the start is its usual cause."""


def settling_ns(times_ns: NDArray[np.int64], norm: Array, fraction: float) -> int | None:
    """Returns the first instant [ns] from which on |e| stays within `fraction` of its largest value to the end, or None
    if the last |e| is outside, some |e| is not finite, or there is none.

    norm is |e| (T,) [m] at times_ns (T,); the answer is one of these instants: the one after the last that is outside.
    """
    if not len(norm) or not np.isfinite(norm).all():
        return None
    outside = np.flatnonzero(norm > max(fraction * float(norm.max()), ROUNDING))
    if not outside.size:
        return int(times_ns[0])
    after = int(outside[-1]) + 1
    return int(times_ns[after]) if after < len(norm) else None


def block_row(series: BlockSeries, times_ns: NDArray[np.int64]) -> Row:
    """Returns a block's settling times, peak and residual, and of its error e(t), by the trapezoidal rule,

    ISE = ∫|e|² dt [m² s],   IAE = ∫|e| dt [m s],   ITAE = ∫ t |e| dt [m s²].
    """
    norm, seconds = series.norm, times_ns / 1e9
    largest = int(np.argmax(norm)) if len(norm) else None
    with np.errstate(all="ignore"):
        return {
            "name": series.block.name,
            "layer": series.block.layer,
            "sigma": series.block.sigma,
            "settling_2": _seconds(settling_ns(times_ns, norm, 0.02)),
            "settling_5": _seconds(settling_ns(times_ns, norm, 0.05)),
            "residual": None if largest is None else norm[-1],
            "peak_error": None if largest is None else norm[largest],
            "peak_time": None if largest is None else seconds[largest],
            "ise": np.trapezoid(norm**2, seconds),
            "iae": np.trapezoid(norm, seconds),
            "itae": np.trapezoid(norm * seconds, seconds),
        }


def separation_rows(blocks: Blocks) -> list[Row]:
    """Returns each time scale σ compared with the next faster: a layer, or blocks where each has its own scale."""
    scales: dict[float, list[BlockSeries]] = {}
    for series in blocks.series:
        if series.block.size:
            scales.setdefault(series.block.sigma, []).append(series)
    layers = [series.block.layer for series in blocks.series if series.block.size]
    ordered = sorted(scales.items())
    rows = []
    for (fast_sigma, fast), (slow_sigma, slow) in zip(ordered, ordered[1:], strict=False):
        row: Row = {
            "faster": _scale_name(fast, layers),
            "slower": _scale_name(slow, layers),
            "sigma_ratio": slow_sigma / fast_sigma,
        }
        for percent in (2, 5):
            late, soon = (
                _slowest(settling_ns(blocks.times_ns, series.norm, percent / 100) for series in scale)
                for scale in (slow, fast)
            )
            row[f"settling_{percent}_ratio"] = None if late is None or not soon else late / soon
        rows.append(row)
    return rows


def _scale_name(scale: list[BlockSeries], layers: list[str]) -> str:
    layer = scale[0].block.layer
    whole = all(series.block.layer == layer for series in scale) and len(scale) == layers.count(layer)
    return layer if whole else ", ".join(series.block.name for series in scale)


def claim_rows(plan: Plan, blocks: Blocks) -> list[Row]:
    """Returns each claim held against the slowest of its blocks."""
    rows = []
    for claim in plan.claims:
        times = {
            series.block.name: settling_ns(blocks.times_ns, series.norm, claim.band)
            for series in blocks.series
            if _claimed(claim.block, series.block)
        }
        measured = _slowest(times.values())
        rows.append(
            {
                "block": claim.block,
                "settled_by": claim.settled_by,
                "band": claim.band,
                "measured": _seconds(measured),
                "blocks": {name: _seconds(time) for name, time in times.items()},
                "holds": measured is not None and measured <= round(claim.settled_by * 1e9),
            }
        )
    return rows


def _claimed(name: str, block: BlockPlan) -> bool:
    return name in ("*", block.name, block.layer)


def distance_row(plan: Plan, near: Distances) -> Row:
    """Returns the closest encounter and every violation, with robots' names."""
    names = [robot.name for robot in plan.robots]
    closest = near.closest
    return {
        "smallest": closest and closest.distance,
        "pair": closest and [names[robot] for robot in closest.pair],
        "time": closest and closest.time_ns / 1e9,
        "between_instants": "straight lines at constant speed",
        "avoidance_enabled": plan.avoidance.enabled,
        "avoidance_radius": plan.avoidance.avoidance_radius,
        "sensing_radius": plan.avoidance.sensing_radius,
        "violations": [
            {
                "pair": [names[robot] for robot in violation.pair],
                "first": violation.first_ns / 1e9,
                "last": violation.last_ns / 1e9,
                "smallest": violation.smallest,
            }
            for violation in near.violations
        ],
    }


def torque_row(trace: Trace, robot: int) -> Row:
    """Returns a robot's wheel torques over its whole run [N m].

    The RMS is of the mean squares of the periods, both wheels; the share of saturation is of the inner torque periods.
    """
    plan = trace.plan.robots[robot]
    # The state at the start has no period behind it.
    began = trace.times_ns[robot] > 0
    times_ns = trace.times_ns[robot][began]
    fields = dict(zip(STATE_FIELDS, trace.states[robot][began].T, strict=True))
    row: Row = {"robot": plan.name, "torque_limit": plan.torque_limit}
    with np.errstate(all="ignore"):
        squares = {wheel: _mean(fields[f"tau_{wheel}_square"]) for wheel in ("right", "left")}
        row["rms"] = ((squares["right"] + squares["left"]) / 2) ** 0.5
        row |= {f"rms_{wheel}": square**0.5 for wheel, square in squares.items()}
    peaks = np.stack([fields["tau_right_peak"], fields["tau_left_peak"]])
    if len(times_ns):
        wheel, at = np.unravel_index(np.argmax(peaks), peaks.shape)
        row |= {"peak": peaks[wheel, at], "peak_wheel": ("right", "left")[wheel], "peak_time": times_ns[at] / 1e9}
    else:
        row |= {"peak": 0.0, "peak_wheel": None, "peak_time": None}
    saturated = fields["saturated"]
    inner = plan.period_ns // plan.torque_period_ns
    row["saturation_share"] = _mean(saturated) / inner
    row["saturated_after_first_second"] = _whole(saturated[times_ns > STARTED_NS].sum())
    return row


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else 0.0


def _whole(value: float) -> int | None:
    return int(value) if isfinite(value) else None


def link_row(plan: Plan, counts: LinkCounts) -> Row:
    """Returns one link's counts with its members' names, ages in seconds: a row of `links.csv`."""
    members = plan.all_roles
    return {
        "source": members[counts.source].name,
        "receiver": members[counts.receiver].name,
        "channel": counts.channel.name.lower(),
        "sent": counts.sent,
        "delivered": counts.delivered,
        "lost": counts.lost,
        "in_flight": counts.in_flight,
        "used": counts.used,
        "held": counts.held,
        "age_mean": counts.age_mean_ns / 1e9,
        "age_max": counts.age_max_ns / 1e9,
    }


def _slowest(times: Iterable[int | None]) -> int | None:
    """Returns the latest settling time, None if one of them did not settle."""
    known = list(times)
    return None if None in known or not known else max(time for time in known if time is not None)


def _seconds(time_ns: int | None) -> float | None:
    return None if time_ns is None else time_ns / 1e9
