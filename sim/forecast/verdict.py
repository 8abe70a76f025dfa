"""Warnings about claims and checks that a run is too short to test."""

from echelon.plan.plan import Plan
from echelon.sim.results.can_lines import some
from echelon.sim.results.settling import dwell_ns


def verdict_warnings(plan: Plan) -> list[str]:
    """Returns a line for each claim that the run is too short to test, and one if it is too short to test growth of errors."""
    end_ns = plan.duration_ns
    found = []
    for at, claim in enumerate(plan.claims):
        blocks = [block for block in plan.blocks if claim.block in ("*", block.name, block.layer)]
        scales = plan.health.dwell if claim.dwell is None else claim.dwell
        wait_ns = max(dwell_ns(block, scales) for block in blocks)
        if round(claim.settled_by * 1e9) > end_ns:
            found.append(
                f"claims.{at}.settled_by = {claim.settled_by:g}: the run ends before, at {end_ns / 1e9:g} s; "
                "a claim that is not tested fails"
            )
        elif wait_ns > end_ns:
            found.append(
                f"claims.{at}: cannot be tested, its dwell time is {wait_ns / 1e9:.4g} s and the run ends at {end_ns / 1e9:g} s"
            )
    short = [block.name for block in plan.blocks if block.size and 3 * dwell_ns(block, plan.health.dwell) > end_ns]
    if short:
        needed_s = 3 * max(dwell_ns(block, plan.health.dwell) for block in plan.blocks if block.size) / 1e9
        found.append(
            f"duration = {end_ns / 1e9:g}: too short to tell growth of {some(short)}; {needed_s:.4g} s is enough"
        )
    return found
