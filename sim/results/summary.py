"""The summary of a run, and the summary as lines for a terminal."""

from collections.abc import Iterator, Sequence

import numpy as np

from echelon.bridge.reports import CanReport
from echelon.runtime.link import LinkCounts
from echelon.sim.results.block_series import block_series
from echelon.sim.results.can_lines import can_lines
from echelon.sim.results.checks import verdict
from echelon.sim.results.distances import distances
from echelon.sim.results.ending import endings
from echelon.sim.results.evidence import Evidence
from echelon.sim.results.measure_records import LinkResult
from echelon.sim.results.measures import (
    block_result,
    claim_results,
    distance_result,
    link_result,
    separation_results,
    torque_result,
)
from echelon.sim.results.records import (
    FORMAT,
    PartResult,
    RunFacts,
    Summary,
)
from echelon.sim.results.trace import Trace
from echelon.sim.results.verdict import count


def summarise(
    trace: Trace,
    links: Sequence[LinkCounts],
    can: CanReport | None,
    run: RunFacts,
    parts: tuple[PartResult, ...] = (),
) -> Summary:
    """Returns the summary of a run.  A run that diverged, broke off or never began raises nothing: its verdict says so.

    `can` is None if the run had no bus; `parts` are the parts that are not built in."""
    plan = trace.plan
    blocks = block_series(trace)
    near = distances(trace)
    ended = endings(plan, blocks, links)
    claims = claim_results(plan, blocks, ended)
    rows = tuple(
        block_result(plan, series, blocks.times_ns, ending) for series, ending in zip(blocks.series, ended, strict=True)
    )
    torque = tuple(torque_result(trace, robot) for robot in range(len(plan.robots)))
    of_links = tuple(link_result(plan, counts) for counts in links)
    return Summary(
        format=FORMAT,
        scenario=plan.name,
        seed=plan.seed,
        robots=len(plan.robots),
        duration=plan.duration_ns / 1e9,
        simulated=int(blocks.times_ns[-1]) / 1e9 if len(blocks.times_ns) else None,
        instants=len(blocks.times_ns),
        largest_gap=float(np.diff(blocks.times_ns).max()) / 1e9 if len(blocks.times_ns) > 1 else None,
        verdict=verdict(Evidence(trace, blocks, ended, near, torque, of_links, can, run), claims),
        claims=tuple(claim for claim, _ in claims),
        blocks=rows,
        separation=separation_results(rows, blocks),
        distance=distance_result(plan, near),
        torque=torque,
        links=of_links,
        can=can,
        run=run,
        trace_digest=trace.digest(),
        parts=parts,
    )


def summary_text(summary: Summary) -> str:
    """Returns a summary as lines for a terminal."""
    return "\n".join(_lines(summary))


def _lines(summary: Summary) -> Iterator[str]:
    yield f"{summary.scenario}: {summary.verdict.sentence}"
    yield from (f"  because  {reason}" for reason in summary.verdict.reasons)
    yield from (f"  untested {text}" for text in summary.verdict.not_tested)
    yield from (f"  claim    {check.text}" for check in summary.verdict.claims if check.outcome == "passed")
    for block in summary.blocks:
        if block.settling_5 is None:
            settled = f"not settled: it {block.remark}"
        else:
            within = (number(block.settling_5, "s"), number(block.settling_2, "s"))
            settled = f"settled to 5 % {within[0]:<9}  2 % {within[1]:<9} residual {number(block.residual, 'm')}"
        yield f"  block    {block.name:<10} {settled}"
    for row in summary.separation:
        settled = f"settling {number(row.settling_5_ratio)}, σ {number(row.sigma_ratio)}"
        yield f"  scales   {row.slower} over {row.faster}: {number(row.rate_ratio)} times as slow ({settled})"
    distance = summary.distance
    if distance.pair:
        where = f"{' and '.join(distance.pair)} at {number(distance.time, 's')}"
        yield f"  closest  {number(distance.smallest, 'm')}, {where}; {len(distance.violations)} violation(s)"
    if torques := [(row.peak, row.robot) for row in summary.torque if row.peak is not None]:
        peak, robot = max(torques)
        share = max(row.saturation_share or 0.0 for row in summary.torque)
        of_time = f"saturated at most {100 * share:.3g} % of the time"
        yield (
            f"  torque   peak {number(peak, 'N m')} ({robot}), {of_time}"
            if peak > 0
            else "  torque   none: all are zero"
        )
    if summary.links:
        sent, lost = sum(link.sent for link in summary.links), sum(link.lost for link in summary.links)
        twice = sum(link.duplicates for link in summary.links)
        counts = f"{sent} messages, {lost} lost{f', {twice} twice' if twice else ''}"
        yield f"  links    {counts}, {_ages(summary.links)}"
    yield from can_lines(summary.can)
    run = summary.run
    for each in run.refusals:
        yield f"  refused  {count(each.messages, 'message')} of {each.source} by {each.receiver}: {each.reason}"
    if run.clock == "wall" and run.stages:
        if run.recorded_every is not None:
            yield f"  recorded an instant every {number(run.recorded_every, 's')}, {run.thinned} messages left out by rule"
        yield f"  late     {run.late_stages} of {run.stages} stages, at most {number(run.latest, 's')}"
    if run.wall_time is not None:
        yield f"  wall     {number(run.wall_time, 's')}, {number(run.real_time_factor)} times real time"
    yield f"  digest   {summary.trace_digest}"


def _ages(links: Sequence[LinkResult]) -> str:
    """Returns the largest age, and of the link on which it is largest the age that 99 % of the uses do not exceed."""
    ages = [(link.age_p99, link.age_max, f"{link.source} → {link.receiver}") for link in links]
    used = [(p99, largest, name) for p99, largest, name in ages if p99 is not None and largest is not None]
    if not used:
        under_way = sum(link.in_flight for link in links)
        return f"no message was used{f', {under_way} are still under way' if under_way else ''}"
    oldest = f"oldest in use {number(max(largest for _, largest, _ in used), 's')}"
    p99, _, name = max(used)
    return f"{oldest}; 99 % of uses up to {number(p99, 's')} ({name})" if any(p < q for p, q, _ in used) else oldest


def number(value: float | None, unit: str = "", missing: str = "–") -> str:
    """Returns a number with four digits and its unit, or `missing` for None."""
    if value is None:
        return missing
    return f"{value:.4g} {unit}".rstrip()
