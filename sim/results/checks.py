"""All checks of a run, and the verdict that they give.

A check has an outcome, a number with its unit, and a bound.  docs/scenario.md says under `health` what each health check is
about.  A health check that does not apply to a run gives no result: lateness in virtual time, the referee in a run without a
bus.  One that applies but has nothing to look at is *not tested*: avoidance that never acted, for example.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from echelon.sim.results.bus_checks import drives, referee, senders
from echelon.sim.results.evidence import Check, Evidence
from echelon.sim.results.message_checks import late, messages, recording, refused, silence, standstill
from echelon.sim.results.motion_checks import avoidance, distance, end, finite, growth, saturation, whole
from echelon.sim.results.records import ClaimResult
from echelon.sim.results.verdict import CLAIM, CheckResult, Verdict

CHECKS: Final[Mapping[str, Check]] = MappingProxyType({
    "whole": whole,
    "finite": finite,
    "growth": growth,
    "end": end,
    "distance": distance,
    "avoidance": avoidance,
    "saturation": saturation,
    "messages": messages,
    "silence": silence,
    "standstill": standstill,
    "refused": refused,
    "late": late,
    "drives": drives,
    "referee": referee,
    "senders": senders,
    "recording": recording,
})  # fmt: skip
"""All health checks by name, in the order in which they are reported; `health.off` in a scenario takes these names"""


def verdict(evidence: Evidence, claims: Sequence[tuple[ClaimResult, str]]) -> Verdict:
    """Returns the verdict of a run; `claims` with their sentences."""
    checks = [
        CheckResult(CLAIM, claim.outcome, text, claim.measured, "s", claim.settled_by, (claim.block,))
        for claim, text in claims
    ]
    off = evidence.plan.health.off
    for name, check in CHECKS.items():
        if name in off:
            if found := list(check(evidence)):
                checks.append(CheckResult(name, "not tested", "switched off by the scenario", about=found[0].about))
        else:
            checks += check(evidence)
    failed = any(check.outcome == "failed" for check in checks)
    claimed = [check.outcome for check in checks if check.name == CLAIM]
    if failed or any(outcome != "passed" for outcome in claimed):
        return Verdict("FAILS", tuple(checks))
    return Verdict("HOLDS" if claimed else "HEALTHY", tuple(checks))
