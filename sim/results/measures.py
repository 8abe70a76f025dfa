"""What is measured of a run: settling, error integrals, separation, claims, distances, torque, links."""

from collections.abc import Iterable
from math import isfinite
from typing import Final, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from echelon.bridge.frame import WHEELS
from echelon.link import LinkCounts
from echelon.messages import STATE_FIELDS
from echelon.plan import BlockPlan, Plan
from echelon.sim.results.blocks import Blocks, BlockSeries
from echelon.sim.results.distances import Distances
from echelon.sim.results.records import (
    BlockResult,
    ClaimResult,
    DistanceResult,
    LinkResult,
    SeparationResult,
    TorqueResult,
    ViolationResult,
)
from echelon.sim.results.trace import Array, Trace

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


def block_result(series: BlockSeries, times_ns: NDArray[np.int64]) -> BlockResult:
    """Returns a block's settling times, peak, residual and error integrals."""
    norm, seconds = series.norm, times_ns / 1e9
    largest = int(np.argmax(norm)) if len(norm) else None
    with np.errstate(all="ignore"):
        return BlockResult(
            name=series.block.name,
            layer=series.block.layer,
            sigma=series.block.sigma,
            settling_2=_seconds(settling_ns(times_ns, norm, 0.02)),
            settling_5=_seconds(settling_ns(times_ns, norm, 0.05)),
            residual=None if largest is None else _finite(norm[-1]),
            peak_error=None if largest is None else _finite(norm[largest]),
            peak_time=None if largest is None else float(seconds[largest]),
            ise=_finite(np.trapezoid(norm**2, seconds)),
            iae=_finite(np.trapezoid(norm, seconds)),
            itae=_finite(np.trapezoid(norm * seconds, seconds)),
        )


def separation_results(blocks: Blocks) -> tuple[SeparationResult, ...]:
    """Returns each time scale σ compared with the next faster: a layer, or blocks where each has its own scale."""
    scales: dict[float, list[BlockSeries]] = {}
    for series in blocks.series:
        if series.block.size:
            scales.setdefault(series.block.sigma, []).append(series)
    layers = [series.block.layer for series in blocks.series if series.block.size]
    ordered = sorted(scales.items())
    return tuple(
        SeparationResult(
            faster=_scale_name(fast, layers),
            slower=_scale_name(slow, layers),
            sigma_ratio=slow_sigma / fast_sigma,
            settling_2_ratio=_settling_ratio(blocks, slow, fast, 0.02),
            settling_5_ratio=_settling_ratio(blocks, slow, fast, 0.05),
        )
        for (fast_sigma, fast), (slow_sigma, slow) in zip(ordered, ordered[1:], strict=False)
    )


def _settling_ratio(blocks: Blocks, slow: list[BlockSeries], fast: list[BlockSeries], band: float) -> float | None:
    late, soon = (_slowest(settling_ns(blocks.times_ns, one.norm, band) for one in scale) for scale in (slow, fast))
    return None if late is None or not soon else late / soon


def _scale_name(scale: list[BlockSeries], layers: list[str]) -> str:
    layer = scale[0].block.layer
    whole = all(series.block.layer == layer for series in scale) and len(scale) == layers.count(layer)
    return layer if whole else ", ".join(series.block.name for series in scale)


def claim_results(plan: Plan, blocks: Blocks) -> tuple[ClaimResult, ...]:
    """Returns each claim held against the slowest of its blocks."""
    results = []
    for claim in plan.claims:
        times = {
            series.block.name: settling_ns(blocks.times_ns, series.norm, claim.band)
            for series in blocks.series
            if _claimed(claim.block, series.block)
        }
        measured = _slowest(times.values())
        results.append(
            ClaimResult(
                block=claim.block,
                settled_by=claim.settled_by,
                band=claim.band,
                measured=_seconds(measured),
                blocks={name: _seconds(time) for name, time in times.items()},
                holds=measured is not None and measured <= round(claim.settled_by * 1e9),
            )
        )
    return tuple(results)


def _claimed(name: str, block: BlockPlan) -> bool:
    return name in ("*", block.name, block.layer)


def distance_result(plan: Plan, near: Distances) -> DistanceResult:
    """Returns the closest encounter and every violation, with robots' names."""
    names, closest = [robot.name for robot in plan.robots], near.closest
    return DistanceResult(
        smallest=None if closest is None else closest.distance,
        pair=None if closest is None else (names[closest.pair[0]], names[closest.pair[1]]),
        time=None if closest is None else closest.time_ns / 1e9,
        between_instants="straight lines at constant speed",
        avoidance_enabled=plan.avoidance.enabled,
        avoidance_radius=plan.avoidance.avoidance_radius,
        sensing_radius=plan.avoidance.sensing_radius,
        violations=tuple(
            ViolationResult(
                pair=(names[violation.pair[0]], names[violation.pair[1]]),
                first=violation.first_ns / 1e9,
                last=violation.last_ns / 1e9,
                smallest=violation.smallest,
            )
            for violation in near.violations
        ),
    )


def torque_result(trace: Trace, robot: int) -> TorqueResult:
    """Returns a robot's wheel torques over its whole run."""
    plan = trace.plan.robots[robot]
    # The state at the start has no period behind it.
    began = trace.times_ns[robot] > 0
    times_ns = trace.times_ns[robot][began]
    fields = dict(zip(STATE_FIELDS, trace.states[robot][began].T, strict=True))
    peaks = np.stack([fields["tau_right_peak"], fields["tau_left_peak"]])
    peak, peak_wheel, peak_time = 0.0, None, None
    if len(times_ns):
        wheel, at = np.unravel_index(np.argmax(peaks), peaks.shape)
        peak, peak_wheel, peak_time = float(peaks[wheel, at]), WHEELS[wheel], float(times_ns[at] / 1e9)
    saturated = fields["saturated"]
    with np.errstate(all="ignore"):
        right, left = _mean(fields["tau_right_square"]), _mean(fields["tau_left_square"])
        share = _mean(saturated) / (plan.period_ns // plan.torque_period_ns)
        late = float(saturated[times_ns > STARTED_NS].sum())
    with np.errstate(all="ignore"):
        rms, rms_right, rms_left = (_finite(np.sqrt(square)) for square in ((right + left) / 2, right, left))
    return TorqueResult(
        robot=plan.name,
        torque_limit=_finite(plan.torque_limit),
        rms=rms,
        rms_right=rms_right,
        rms_left=rms_left,
        peak=_finite(peak),
        peak_wheel=peak_wheel,
        peak_time=peak_time,
        saturation_share=_finite(share),
        saturated_after_first_second=int(late) if isfinite(late) else None,
    )


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else 0.0


def _finite(value: SupportsFloat) -> float | None:
    number = float(value)
    return number if isfinite(number) else None


def link_result(plan: Plan, counts: LinkCounts) -> LinkResult:
    """Returns one link's counts with its members' names: a row of `links.csv`."""
    members = plan.all_roles
    return LinkResult(
        source=members[counts.source].name,
        receiver=members[counts.receiver].name,
        channel=counts.channel.name.lower(),
        sent=counts.sent,
        delivered=counts.delivered,
        lost=counts.lost,
        in_flight=counts.in_flight,
        used=counts.used,
        held=counts.held,
        age_mean=counts.age_mean_ns / 1e9,
        age_max=counts.age_max_ns / 1e9,
    )


def _slowest(times: Iterable[int | None]) -> int | None:
    """Returns the latest settling time, None if one of them did not settle."""
    known = list(times)
    return None if None in known or not known else max(time for time in known if time is not None)


def _seconds(time_ns: int | None) -> float | None:
    return None if time_ns is None else time_ns / 1e9
