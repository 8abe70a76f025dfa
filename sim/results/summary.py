"""The summary of a run, and its plain-text rendering."""

from collections.abc import Iterator, Sequence

import numpy as np

from echelon.bridge.reports import CanReport
from echelon.link import LinkCounts
from echelon.plan import Plan
from echelon.sim.can_lines import can_lines, can_reasons
from echelon.sim.results.blocks import block_series
from echelon.sim.results.distances import Distances, distances
from echelon.sim.results.measures import (
    block_result,
    claim_results,
    distance_result,
    link_result,
    separation_results,
    torque_result,
)
from echelon.sim.results.records import FORMAT, ClaimResult, RunFacts, Summary, Verdict
from echelon.sim.results.trace import Trace


def summarise(trace: Trace, links: Sequence[LinkCounts], can: CanReport | None, run: RunFacts) -> Summary:
    """Returns what a run showed.  Nothing is raised for one that diverged, broke off or never began: its verdict says so."""
    plan = trace.plan
    blocks = block_series(trace)
    near = distances(trace)
    end_ns = int(blocks.times_ns[-1]) if len(blocks.times_ns) else None
    claims = claim_results(plan, blocks)
    broken_off = [run.failure.splitlines()[0]] if run.failure else []
    reasons = [*broken_off, *_broken(trace, end_ns), *_failed(claims), *_too_close(plan, near), *can_reasons(can)]
    return Summary(
        format=FORMAT,
        scenario=plan.name,
        seed=plan.seed,
        robots=len(plan.robots),
        duration=plan.duration_ns / 1e9,
        simulated=None if end_ns is None else end_ns / 1e9,
        instants=len(blocks.times_ns),
        largest_gap=float(np.diff(blocks.times_ns).max()) / 1e9 if len(blocks.times_ns) > 1 else None,
        verdict=Verdict(not reasons, tuple(reasons)),
        claims=claims,
        blocks=tuple(block_result(series, blocks.times_ns) for series in blocks.series),
        separation=separation_results(blocks),
        distance=distance_result(plan, near),
        torque=tuple(torque_result(trace, robot) for robot in range(len(plan.robots))),
        links=tuple(link_result(plan, counts) for counts in links),
        can=can,
        run=run,
        trace_digest=trace.digest(),
    )


def summary_text(summary: Summary) -> str:
    """Returns a summary as plain lines for a terminal."""
    return "\n".join(_lines(summary))


def _lines(summary: Summary) -> Iterator[str]:
    yield f"{summary.scenario}: {'HOLDS' if summary.verdict.holds else 'FAILS'}"
    yield from (f"  because  {reason}" for reason in summary.verdict.reasons)
    for claim in summary.claims:
        what = f"{claim.block} within {100 * claim.band:g} % by {claim.settled_by:g} s"
        measured, word = number(claim.measured, "s", "not settled"), "holds" if claim.holds else "fails"
        yield f"  claim    {what}: {measured}, {word}"
    for block in summary.blocks:
        settled = f"5 % {number(block.settling_5, 's', 'never'):<9}  2 % {number(block.settling_2, 's', 'never'):<9}"
        yield f"  block    {block.name:<10} settled to {settled} residual {number(block.residual, 'm')}"
    for row in summary.separation:
        ratio = f"{number(row.settling_5_ratio)} times the settling (σ: {number(row.sigma_ratio)})"
        yield f"  scales   {row.slower} over {row.faster}: {ratio}"
    distance = summary.distance
    if distance.pair:
        where = f"{' and '.join(distance.pair)} at {number(distance.time, 's')}"
        yield f"  closest  {number(distance.smallest, 'm')}, {where}; {len(distance.violations)} violation(s)"
    if torques := [(row.peak, row.robot) for row in summary.torque if row.peak is not None]:
        peak, robot = max(torques)
        share = max(row.saturation_share or 0.0 for row in summary.torque)
        yield f"  torque   peak {number(peak, 'N m')} ({robot}), saturated at most {100 * share:.3g} % of the time"
    if summary.links:
        sent, lost = sum(link.sent for link in summary.links), sum(link.lost for link in summary.links)
        age = max(link.age_max for link in summary.links)
        yield f"  links    {sent} messages, {lost} lost, oldest in use {number(age, 's')}"
    yield from can_lines(summary.can)
    run = summary.run
    if run.clock == "wall" and run.stages:
        yield f"  late     {run.late_stages} of {run.stages} stages, at most {number(run.latest, 's')}"
    if run.wall_time is not None:
        yield f"  wall     {number(run.wall_time, 's')}, {number(run.real_time_factor)} times real time"
    yield f"  digest   {summary.trace_digest}"


def number(value: float | None, unit: str = "", missing: str = "–") -> str:
    """Returns a number for people, four digits and its unit, or `missing`."""
    if value is None:
        return missing
    return f"{value:.4g} {unit}".rstrip()


def _broken(trace: Trace, end_ns: int | None) -> list[str]:
    """Says what is not finite, and whether the run reached its end: the last instant that all robots share may be one
    period of the coordinator before it."""
    plan = trace.plan
    reasons = []
    lost: list[tuple[int, str]] = []
    for robot, states, times_ns in zip(plan.robots, trace.states, trace.times_ns, strict=True):
        wrong = np.flatnonzero(~np.isfinite(states).all(axis=1))
        if wrong.size:
            lost.append((int(times_ns[wrong[0]]), robot.name))
    if lost:
        first_ns, name = min(lost)
        others = f", as of {len(lost)} robots in the end" if len(lost) > 1 else ""
        reasons.append(f"{name}: a state is not finite from {first_ns / 1e9:g} s on{others}")
    wanted = plan.duration_ns
    needed = wanted - plan.root.period_ns
    early = [
        f"{robot.name} at {times_ns[-1] / 1e9:g} s" if len(times_ns) else f"{robot.name} before it began"
        for robot, times_ns in zip(plan.robots, trace.times_ns, strict=True)
        if not len(times_ns) or times_ns[-1] < needed
    ]
    if early:
        who = "every robot ended early, the first" if len(early) == len(plan.robots) else "ended early:"
        shown = early[:1] if len(early) == len(plan.robots) else early
        reasons.append(f"{who} {', '.join(shown)} of {wanted / 1e9:g} s")
    elif end_ns is None or end_ns < needed:
        reasons.append(f"the robots have no instant in common at the end of {wanted / 1e9:g} s")
    return reasons


def _failed(claims: Sequence[ClaimResult]) -> list[str]:
    return [
        f"claim: {claim.block} within {claim.band:.3g} of its largest error by {claim.settled_by:g} s, but "
        + ("it did not settle" if claim.measured is None else f"that took {claim.measured:.6g} s")
        for claim in claims
        if not claim.holds
    ]


def _too_close(plan: Plan, near: Distances) -> list[str]:
    if not plan.avoidance.enabled or not near.violations:
        return []
    worst = min(near.violations, key=lambda violation: violation.smallest)
    one, other = (plan.robots[robot].name for robot in worst.pair)
    return [
        f"avoidance: {len(near.violations)} violation(s) of {plan.avoidance.avoidance_radius:g} m; {one} and {other} "
        f"came to {worst.smallest:.4g} m after {worst.first_ns / 1e9:.6g} s"
    ]
