"""The measures of a run as records: blocks, separation of time scales, claims, distances, torques, links."""

from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Final, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from echelon.bridge.protocols.frame import WHEELS
from echelon.messages import STATE_FIELDS
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.results.block_series import Blocks, BlockSeries
from echelon.sim.results.distances import Distances
from echelon.sim.results.ending import Ending
from echelon.sim.results.measure_records import (
    BlockResult,
    DistanceResult,
    LinkResult,
    SeparationResult,
    TorqueResult,
    ViolationResult,
)
from echelon.sim.results.records import ClaimResult
from echelon.sim.results.settling import Settling, settle, start_error
from echelon.sim.results.trace import Array, Trace
from echelon.sim.results.verdict import Outcome

STARTED_NS: Final = 1_000_000_000
"""End of the first second [ns].  Saturation after it is also counted by itself: within it the errors at the start are the usual
cause."""


def block_result(plan: Plan, series: BlockSeries, times_ns: NDArray[np.int64], ending: Ending) -> BlockResult:
    """Returns settling times, decay rate, ending, peak, residual and error integrals of a block.

    The integrals are ∫|e|² dt, ∫|e| dt and ∫ t |e| dt by the trapezoidal rule; `times_ns` is (T,)."""
    norm, seconds = series.norm, times_ns / 1e9
    largest = int(np.argmax(norm)) if len(norm) else None
    to_2, to_5 = (settle(plan, series, times_ns, fraction) for fraction in (0.02, 0.05))
    with np.errstate(all="ignore"):
        return BlockResult(
            name=series.block.name,
            layer=series.block.layer,
            sigma=series.block.sigma,
            start_error=start_error(series, times_ns),
            dwell=to_5.dwell_ns / 1e9,
            settling_2=_seconds(to_2.settled_ns),
            band_2=to_2.band,
            settling_5=_seconds(to_5.settled_ns),
            band_5=to_5.band,
            decay_rate=None if ending.fit is None else ending.fit.rate,
            decay_fit=None if ending.fit is None else ending.fit.r_squared,
            ending=ending.kind,
            remark=ending.text,
            residual=None if largest is None else _finite(norm[-1]),
            peak_error=None if largest is None else _finite(norm[largest]),
            peak_time=None if largest is None else float(seconds[largest]),
            ise=_finite(np.trapezoid(norm**2, seconds)),
            iae=_finite(np.trapezoid(norm, seconds)),
            itae=_finite(np.trapezoid(norm * seconds, seconds)),
        )


def separation_results(rows: Sequence[BlockResult], blocks: Blocks) -> tuple[SeparationResult, ...]:
    """Returns each time scale σ compared with the next faster one.  `rows` are the results of `blocks`, in the same order."""
    shown = [row for row, series in zip(rows, blocks.series, strict=True) if series.block.size]
    scales: dict[float, list[BlockResult]] = {}
    for row in shown:
        scales.setdefault(row.sigma, []).append(row)
    layers = [row.layer for row in shown]
    ordered = sorted(scales.items())
    return tuple(
        SeparationResult(
            faster=_scale_name(fast, layers),
            slower=_scale_name(slow, layers),
            sigma_ratio=slow_sigma / fast_sigma,
            rate_ratio=_rate_ratio(slow, fast),
            rate_fit=_rate_fit([*slow, *fast]),
            settling_2_ratio=_ratio([row.settling_2 for row in slow], [row.settling_2 for row in fast]),
            settling_5_ratio=_ratio([row.settling_5 for row in slow], [row.settling_5 for row in fast]),
        )
        for (fast_sigma, fast), (slow_sigma, slow) in zip(ordered, ordered[1:], strict=False)
    )


def _rate_ratio(slow: Sequence[BlockResult], fast: Sequence[BlockResult]) -> float | None:
    """Returns the decay rate of the slowest of the fast blocks over that of the slowest of the slow blocks; None if a block
    does not decay, or has no decay rate."""
    if not _long_enough([*slow, *fast]):
        return None
    times = [
        [1 / row.decay_rate if row.decay_rate and row.decay_rate > 0 else None for row in rows] for rows in (slow, fast)
    ]
    return _ratio(*times)


def _rate_fit(rows: Sequence[BlockResult]) -> float | None:
    """Returns the smallest r² of the blocks' fits; None if there is none, or the run is too short for one of the blocks."""
    fits = [row.decay_fit for row in rows if row.decay_fit is not None]
    return min(fits, default=None) if _long_enough(rows) else None


def _long_enough(rows: Sequence[BlockResult]) -> bool:
    """True if the run is long enough for the decay rates of these blocks: in a short run the start of an oscillation would be
    taken for a decay."""
    return all(row.ending not in ("too short", "not finite") for row in rows)


def _ratio(slow: Sequence[float | None], fast: Sequence[float | None]) -> float | None:
    """Returns the longest of the slow times over the longest of the fast ones; None if a time is None, or the fast ones are
    0."""
    late, soon = _slowest(slow), _slowest(fast)
    return None if late is None or not soon else late / soon


def _scale_name(scale: Sequence[BlockResult], layers: Sequence[str]) -> str:
    """Returns the layer's name if the blocks of a time scale are exactly one layer, otherwise the names of the blocks."""
    layer = scale[0].layer
    whole = all(row.layer == layer for row in scale) and len(scale) == layers.count(layer)
    return layer if whole else ", ".join(row.name for row in scale)


def claim_results(plan: Plan, blocks: Blocks, endings: Sequence[Ending]) -> tuple[tuple[ClaimResult, str], ...]:
    """Returns the result of each claim, which the slowest of its blocks decides, with a sentence about it."""
    end_ns = int(blocks.times_ns[-1]) if len(blocks.times_ns) else None
    if end_ns is not None and end_ns >= plan.duration_ns - plan.root.period_ns:
        end_ns = plan.duration_ns  # the last instant that all robots share may be one period of the root before the end
    results = []
    for claim in plan.claims:
        by_ns = round(claim.settled_by * 1e9)
        found = [
            (series.block.name, settle(plan, series, blocks.times_ns, claim.band, claim.dwell), ending)
            for series, ending in zip(blocks.series, endings, strict=True)
            if claim.block in ("*", series.block.name, series.block.layer)
        ]
        times = {name: _seconds(settling.settled_ns) for name, settling, _ in found}
        measured = _slowest(times.values())
        outcomes = [_claim_outcome(name, settling, ending, by_ns) for name, settling, ending in found]
        outcome: Outcome
        lost = any(ending.kind == "not finite" for _, _, ending in found)
        if end_ns is None or (by_ns > end_ns and not lost):
            ended = "nothing was simulated" if end_ns is None else f"the run ended at {end_ns / 1e9:g} s"
            outcome, why = "not tested", ended
        else:
            outcome, why = min(outcomes, key=lambda one: ("failed", "not tested", "passed").index(one[0]))
        if outcome == "passed" and measured is not None:
            slowest = max(found, key=lambda one: times[one[0]] or 0.0)
            why = f"{slowest[0]} as the last at {measured:.6g} s, to {slowest[1].band:.3g} m" if len(found) > 1 else why
        results.append(
            (
                ClaimResult(
                    block=claim.block,
                    settled_by=claim.settled_by,
                    band=claim.band,
                    measured=measured,
                    blocks=times,
                    bands={name: settling.band for name, settling, _ in found},
                    outcome=outcome,
                ),
                f"{claim.block} within {100 * claim.band:g} % by {claim.settled_by:g} s: {why}",
            )
        )
    return tuple(results)


def _claim_outcome(name: str, settling: Settling, ending: Ending, by_ns: int) -> tuple[Outcome, str]:
    """Returns whether a block settled by `by_ns`, and a phrase that says when, or why not."""
    entered_ns, band = settling.entered_ns, f"{settling.band:.3g} m"
    if entered_ns is None:
        return "failed", f"{name} did not settle to {band}: it {ending.text}"
    if entered_ns > by_ns:
        return "failed", f"{name} took {entered_ns / 1e9:.6g} s, to {band}"
    if settling.settled_ns is None:
        stayed_s, dwell_s = (settling.end_ns - entered_ns) / 1e9, settling.dwell_ns / 1e9
        return "not tested", (
            f"{name} was within {band} from {entered_ns / 1e9:.6g} s on, for {stayed_s:.4g} s; it must stay for {dwell_s:.4g} s"
        )
    return "passed", f"{name} took {entered_ns / 1e9:.6g} s, to {band}"


def distance_result(plan: Plan, near: Distances) -> DistanceResult:
    """Returns the closest encounter and every violation, with the robots' names."""
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
    """Returns root mean square, peak and saturation of the wheel torques of a robot (by index) over the run."""
    plan = trace.plan.robots[robot]
    # The state at time 0 is not the result of a period, so it has no torque.
    began = int(np.searchsorted(trace.times_ns[robot], 0, side="right"))
    times_ns = trace.times_ns[robot][began:]
    fields = dict(zip(STATE_FIELDS, trace.states[robot][began:].T, strict=True))
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
    """Returns the counts of a link with the names of its ends: a row of `links.csv`."""
    members = plan.all_roles
    ages = counts.age_mean_ns, counts.age_p50_ns, counts.age_p95_ns, counts.age_p99_ns, counts.age_max_ns
    mean, p50, p95, p99, largest = (age_ns / 1e9 if counts.used else None for age_ns in ages)
    return LinkResult(
        source=members[counts.source].name,
        receiver=members[counts.receiver].name,
        channel=counts.channel.name.lower(),
        sent=counts.sent,
        delivered=counts.delivered,
        lost=counts.lost,
        in_flight=counts.in_flight,
        duplicates=counts.duplicates,
        used=counts.used,
        held=counts.held,
        age_mean=mean,
        age_p50=p50,
        age_p95=p95,
        age_p99=p99,
        age_max=largest,
    )


def _slowest(times: Iterable[float | None]) -> float | None:
    """Returns the longest of some times; None without times, or if one of them is None."""
    known = list(times)
    return None if None in known or not known else max(time for time in known if time is not None)


def _seconds(time_ns: int | None) -> float | None:
    return None if time_ns is None else time_ns / 1e9
