"""What can be told of a verdict before the run: what it cannot test, and what fails whatever the run does."""

from collections.abc import Iterator

from echelon.plan.plan import Plan
from echelon.sim.results.can_lines import some
from echelon.sim.results.records import count
from echelon.sim.results.settling import dwell_ns


def beforehand(plan: Plan) -> Iterator[str]:
    """Yields the sentences; none where everything can be tested."""
    end_ns = plan.duration_ns
    for claim in plan.claims:
        blocks = [block for block in plan.blocks if claim.block in ("*", block.name, block.layer)]
        scales = plan.health.dwell if claim.dwell is None else claim.dwell
        wait_ns = max(dwell_ns(block, scales) for block in blocks)
        what = f"claim: {claim.block} by {claim.settled_by:g} s"
        if round(claim.settled_by * 1e9) > end_ns:
            yield f"{what} cannot be tested, for the run ends at {end_ns / 1e9:g} s; a claim that is not tested fails"
        elif wait_ns > end_ns:
            yield f"{what} cannot be tested, for its dwell time is {wait_ns / 1e9:.4g} s and the run ends at {end_ns / 1e9:g} s"
    dead = [link for link in plan.links if link.loss >= 1 or link.delay_min_ns > end_ns]
    if dead:
        names = [f"{plan.all_roles[one.source].name} → {plan.all_roles[one.receiver].name}" for one in dead]
        yield f"messages: nothing can arrive over {len(dead)} of {count(len(plan.links), 'link')}: {some(names)}"
    short = [block.name for block in plan.blocks if block.size and 3 * dwell_ns(block, plan.health.dwell) > end_ns]
    if short:
        needed_s = 3 * max(dwell_ns(block, plan.health.dwell) for block in plan.blocks if block.size) / 1e9
        yield f"growth, end: cannot be tested of {some(short)}; a run of {needed_s:.4g} s or more tells"
