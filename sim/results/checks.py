"""The verdict: every claim and every health check as a named check with its number, its bound and its outcome.

What a check is about is in docs/scenario.md, under `health`.  A check that does not apply to a run (lateness in virtual time,
the referee of a run without a bus) is not there; one that applies but found nothing to look at is *not tested*, and no pass.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from echelon.bridge.reports import CanReport
from echelon.plan.plan import Plan
from echelon.sim.results.block_series import Blocks
from echelon.sim.results.can_lines import finding_text, some
from echelon.sim.results.distances import Distances
from echelon.sim.results.ending import Ending
from echelon.sim.results.records import (
    CLAIM,
    CheckResult,
    ClaimResult,
    LinkResult,
    Outcome,
    RunFacts,
    TorqueResult,
    Verdict,
    count,
)
from echelon.sim.results.settling import start_error
from echelon.sim.results.trace import Trace


@dataclass(frozen=True, slots=True)
class Evidence:
    """All that checks look at."""

    trace: Trace
    blocks: Blocks
    endings: tuple[Ending, ...]
    near: Distances
    torque: tuple[TorqueResult, ...]
    links: tuple[LinkResult, ...]
    can: CanReport | None
    run: RunFacts

    @property
    def plan(self) -> Plan:
        """What was run."""
        return self.trace.plan

    @property
    def end_ns(self) -> int | None:
        """The last instant that all robots share; None if there is none."""
        return int(self.blocks.times_ns[-1]) if len(self.blocks.times_ns) else None


Check = Callable[[Evidence], Iterator[CheckResult]]


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


def _whole(evidence: Evidence) -> Iterator[CheckResult]:
    plan, run = evidence.plan, evidence.run
    wanted_s, end_ns = plan.duration_ns / 1e9, evidence.end_ns
    end_s = None if end_ns is None else end_ns / 1e9

    def told(outcome: Outcome, text: str, about: Sequence[str] = ()) -> CheckResult:
        return CheckResult("whole", outcome, text, end_s, "s", wanted_s, tuple(about))

    at = "before it began" if end_s is None else f"at {end_s:g} s of {wanted_s:g} s"
    if run.failure:
        what = run.failure.splitlines()[0]
        yield told("failed", what if " at t = " in what else f"{what} ({at})")
        return
    if run.stopped:
        yield told("failed", f"the run was stopped {at}")
        return
    # The last instant that all robots share may be one period of the coordinator before the end.
    needed_ns = plan.duration_ns - plan.root.period_ns
    early = {
        robot.name: f"at {times_ns[-1] / 1e9:g} s" if len(times_ns) else "before it began"
        for robot, times_ns in zip(plan.robots, evidence.trace.times_ns, strict=True)
        if not len(times_ns) or times_ns[-1] < needed_ns
    }
    if len(early) == len(plan.robots):
        first = next(iter(early))
        yield told("failed", f"every robot ended early, the first {first} {early[first]} of {wanted_s:g} s")
    elif early:
        shown = some([f"{name} {when}" for name, when in early.items()])
        yield told("failed", f"ended early: {shown} of {wanted_s:g} s", list(early))
    elif end_ns is None or end_ns < needed_ns:
        yield told("failed", f"the robots have no instant in common at the end of {wanted_s:g} s")
    else:
        yield told("passed", f"the run reached {end_s:g} s of {wanted_s:g} s")


def _finite(evidence: Evidence) -> Iterator[CheckResult]:
    lost: list[tuple[int, str]] = []
    for robot, states, times_ns in zip(
        evidence.plan.robots, evidence.trace.states, evidence.trace.times_ns, strict=True
    ):
        wrong = np.flatnonzero(~np.isfinite(states).all(axis=1))
        if wrong.size:
            lost.append((int(times_ns[wrong[0]]), robot.name))
    if not lost:
        yield CheckResult("finite", "passed", "all states are finite", 0.0, "robots", 0.0)
        return
    first_ns, name = min(lost)
    others = f", as of {len(lost)} robots in the end" if len(lost) > 1 else ""
    text = f"{name}: a state is not finite from {first_ns / 1e9:g} s on{others}"
    yield CheckResult(
        "finite", "failed", text, float(len(lost)), "robots", 0.0, tuple(name for _, name in sorted(lost))
    )


def _growth(evidence: Evidence) -> Iterator[CheckResult]:
    names = [series.block.name for series in evidence.blocks.series]
    judged = [
        (ending.growth or 0.0, name, ending)
        for name, ending, series in zip(names, evidence.endings, evidence.blocks.series, strict=True)
        if ending.judged and series.block.size
    ]
    bound = evidence.plan.health.growth
    growing = [found for found in judged if found[2].kind == "grows"]
    for growth, name, ending in growing:
        yield CheckResult("growth", "failed", f"{name} {ending.text}", growth, "", bound, (name,))
    if judged and not growing:
        growth, name, ending = max(judged, key=lambda found: (found[2].level > found[2].floor, found[0]))
        if ending.level <= ending.floor:
            text = f"no error grows; all are at most {max(one.floor for _, _, one in judged):.3g} m by then"
        else:
            text = (
                f"no error grows; that of {name} is {growth:.3g} times as large in the last sixth of the run as before"
            )
            text += f", {ending.level:.3g} m: {ending.spared}" if ending.spared else ""
        yield CheckResult("growth", "passed", text, growth, "", bound, tuple(name for _, name, _ in judged))
    yield from _too_short("growth", evidence)


def _too_short(name: str, evidence: Evidence) -> Iterator[CheckResult]:
    """Says of which blocks a run is too short to tell."""
    short = [
        series.block.name
        for series, ending in zip(evidence.blocks.series, evidence.endings, strict=True)
        if ending.kind == "too short" and series.block.size
    ]
    if short:
        text = f"{some(short)}: a third of the run is shorter than the dwell time"
        yield CheckResult(name, "not tested", text, about=tuple(short))


def _end(evidence: Evidence) -> Iterator[CheckResult]:
    times_ns = evidence.blocks.times_ns
    judged = []
    for series, ending in zip(evidence.blocks.series, evidence.endings, strict=True):
        start = start_error(series, times_ns)
        if ending.judged and start is not None and series.block.size:
            judged.append((series.block.name, float(series.norm[-1]), max(start, ending.floor)))
    higher = [found for found in judged if found[1] > found[2]]
    for name, end, start in higher:
        yield CheckResult(
            "end", "failed", f"{name} ends {end:.4g} m from where it should be, and began with {start:.4g} m",
            end, "m", start, (name,),
        )  # fmt: skip
    if judged and not higher:
        name, end, start = max(judged, key=lambda found: found[1] / found[2])
        text = f"no block ends above where it began; {name} comes closest to that with {end:.3g} m of {start:.3g} m"
        yield CheckResult("end", "passed", text, end, "m", start, tuple(found[0] for found in judged))
    yield from _too_short("end", evidence)


def _distance(evidence: Evidence) -> Iterator[CheckResult]:
    if not evidence.plan.avoidance.enabled:
        yield from _kept("distance", evidence)


def _avoidance(evidence: Evidence) -> Iterator[CheckResult]:
    avoidance, closest = evidence.plan.avoidance, evidence.near.closest
    if not avoidance.enabled:
        return
    if closest is not None and closest.distance > avoidance.sensing_radius:
        text = (
            f"nobody came within {avoidance.sensing_radius:g} m, where it begins; the smallest distance was "
            f"{closest.distance:.4g} m"
        )
        yield CheckResult("avoidance", "not tested", text, closest.distance, "m", avoidance.avoidance_radius)
    else:
        yield from _kept("avoidance", evidence)


def _kept(name: str, evidence: Evidence) -> Iterator[CheckResult]:
    """Says whether robots kept the avoidance radius."""
    plan, near = evidence.plan, evidence.near
    radius = plan.avoidance.avoidance_radius
    if near.closest is None:
        text = "there is one robot" if len(plan.robots) == 1 else "no two robots had a distance"
        yield CheckResult(name, "not tested", text, None, "m", radius)
    elif near.violations:
        worst = min(near.violations, key=lambda violation: violation.smallest)
        one, other = (plan.robots[robot].name for robot in worst.pair)
        text = (
            f"{len(near.violations)} violation(s) of {radius:g} m; {one} and {other} came to {worst.smallest:.4g} m "
            f"after {worst.first_ns / 1e9:.6g} s"
        )
        yield CheckResult(name, "failed", text, worst.smallest, "m", radius, (one, other))
    else:
        text = f"no two robots came closer than {near.closest.distance:.4g} m"
        yield CheckResult(name, "passed", text, near.closest.distance, "m", radius)


def _saturation(evidence: Evidence) -> Iterator[CheckResult]:
    bound = evidence.plan.health.saturation
    robots = evidence.plan.robots
    limited = [
        row
        for row, robot in zip(evidence.torque, robots, strict=True)
        if min(robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit) < float("inf")
    ]
    shares = [(row.saturation_share, row.robot) for row in limited if row.saturation_share is not None]
    if not limited:
        yield CheckResult("saturation", "not tested", "no robot has a limit of torque or speed", None, "", bound)
    elif not shares:
        yield CheckResult("saturation", "not tested", "nobody knows for how long limits acted", None, "", bound)
    else:
        share, robot = max(shares)
        over = tuple(name for each, name in sorted(shares, reverse=True) if each > bound)
        more = f", and those of {len(over) - 1} more for more than {100 * bound:g} %" if len(over) > 1 else ""
        text = f"limits of {robot} acted for {100 * share:.3g} % of the time{more}; at most {100 * bound:g} %"
        yield CheckResult("saturation", "failed" if over else "passed", text, share, "", bound, over or (robot,))


def _messages(evidence: Evidence) -> Iterator[CheckResult]:
    links = evidence.links
    if not links:
        if evidence.plan.links:
            yield CheckResult("messages", "not tested", "nobody counted the messages of the links", unit="links")
        return
    unused = [row for row in links if not row.used]
    none_came = [row for row in unused if not row.delivered]
    if not unused:
        sent = sum(row.used for row in links)
        text = f"over each of {count(len(links), 'link')} something came and was used, {sent} times in all"
        yield CheckResult("messages", "passed", text, 0.0, "links", 0.0)
        return
    shown = none_came or unused
    what = "nothing ever arrived" if none_came else "nothing that arrived was ever used, as too old or empty,"
    names = [f"{row.source} → {row.receiver} ({row.channel.replace('_', ' ')})" for row in shown]
    rest = f"; nothing was used on {len(unused) - len(shown)} more" if len(unused) > len(shown) else ""
    text = f"{what} over {len(shown)} of {count(len(links), 'link')}: {some(names)}{rest}"
    yield CheckResult("messages", "failed", text, float(len(unused)), "links", 0.0, tuple(names))


def _silence(evidence: Evidence) -> Iterator[CheckResult]:
    plan, times = evidence.plan, evidence.trace.times_ns
    last_ns = max((int(each[-1]) for each in times if len(each)), default=0)
    gaps = []
    for robot, each in zip(plan.robots, times, strict=True):
        if len(each):
            spoken_ns = np.concatenate([[0], each, [max(last_ns, int(each[-1]))]])
            widths_ns = np.diff(spoken_ns)
            at = int(np.argmax(widths_ns))
            gaps.append((int(widths_ns[at]), robot, int(spoken_ns[at])))
    if not gaps:
        yield CheckResult("silence", "failed", "no robot ever said anything", None, "s", plan.health.silence)
        return
    gap_ns, robot, from_ns = max(gaps, key=lambda found: (found[0], -found[1].index))
    bound_s = max(plan.health.silence, 2 * robot.period_ns / 1e9)
    outcome: Outcome = "failed" if gap_ns / 1e9 > bound_s else "passed"
    text = (
        f"{robot.name} said nothing for {gap_ns / 1e9:.4g} s from t = {from_ns / 1e9:g} s on, the longest of all robots"
    )
    text += _busy(evidence.run) if outcome == "failed" else ""
    yield CheckResult("silence", outcome, text, gap_ns / 1e9, "s", bound_s, (robot.name,))


def _busy(run: RunFacts) -> str:
    """Returns what may be why messages are missing on a wall clock, in words that follow others."""
    if run.clock != "wall" or not run.late_stages:
        return ""
    return f"; {100 * run.late_stages / run.stages:.3g} % of stages were late: was the machine busy?"


def _refused(evidence: Evidence) -> Iterator[CheckResult]:
    refused = evidence.run.refused
    if evidence.can is not None:
        refused += sum(evidence.can.refused.values())
        refused += sum(evidence.can.drives.refused.values()) if evidence.can.drives is not None else 0
    text = f"{count(refused, 'message')} refused" if refused else "no message was refused"
    yield CheckResult("refused", "failed" if refused else "passed", text, float(refused), "messages", 0.0)


def _late(evidence: Evidence) -> Iterator[CheckResult]:
    run, bound = evidence.run, evidence.plan.health.late
    if run.clock != "wall" or not run.stages:
        return
    share = run.late_stages / run.stages
    text = (
        f"{run.late_stages} of {run.stages} stages ran without something they wanted, {100 * share:.3g} %; at most "
        f"{100 * bound:g} %"
    )
    yield CheckResult("late", "failed" if share > bound else "passed", text, share, "", bound)


def _drives(evidence: Evidence) -> Iterator[CheckResult]:
    plan, can = evidence.plan, evidence.can
    if can is None or not plan.can.closed:
        return
    planned = {plan.robots[robot].name for event in plan.events for robot in event.robots}
    upset = {bus for event in plan.events for bus in event.buses}
    planned |= {robot.name for robot in plan.robots if robot.drive.bus in upset}
    down = {name: "never came up" for name, row in can.robots.items() if row.came_up is None}
    faults = {
        name: f"in fault at the end ({row.fault})"
        for name, row in can.robots.items()
        if row.fault and name not in planned and name not in down
    }
    wrong = down | faults
    if wrong:
        text = some([f"{name} {what}" for name, what in wrong.items()])
    else:
        text = f"the drives of {count(len(can.robots), 'robot')} came up, and none is in fault unplanned"
    yield CheckResult("drives", "failed" if wrong else "passed", text, float(len(wrong)), "robots", 0.0, tuple(wrong))


def _referee(evidence: Evidence) -> Iterator[CheckResult]:
    can = evidence.can
    if can is None or can.referee is None:
        return
    if not can.referee.frames:
        yield CheckResult("referee", "not tested", "no frame was on the bus", unit="findings")
        return
    total = sum(can.referee.kinds.values())
    text = (
        finding_text(can.referee)
        if total
        else f"nothing breaks the contract in {can.referee.frames} frames{can.referee.up_to}"
    )
    yield CheckResult("referee", "failed" if total else "passed", text, float(total), "findings", 0.0)


def _recording(evidence: Evidence) -> Iterator[CheckResult]:
    plan, can = evidence.plan, evidence.can
    missing, whose = 0, []
    for robot, times_ns in zip(plan.robots, evidence.trace.times_ns, strict=True):
        lacks = (int(times_ns[-1]) - int(times_ns[0])) // robot.period_ns + 1 - len(times_ns) if len(times_ns) else 0
        if lacks:
            missing += lacks
            before_ns = int(times_ns[int(np.argmax(np.diff(times_ns) > robot.period_ns))])
            whose.append(f"{lacks} of {robot.name} after t = {before_ns / 1e9:g} s")
    lost = (can.log_lost or 0) if can is not None else 0
    if missing or lost:
        parts = [f"{count(missing, 'state')} ({some(whose)})"] * bool(missing) + [f"{lost} lines of can.log"] * bool(
            lost
        )
        text = f"the recording lacks {' and '.join(parts)}{_busy(evidence.run)}"
    else:
        text = "the recording lacks nothing"
    outcome: Outcome = "failed" if missing or lost else "passed"
    yield CheckResult("recording", outcome, text, float(missing + lost), "messages", 0.0)


CHECKS: Final[dict[str, Check]] = {
    "whole": _whole,
    "finite": _finite,
    "growth": _growth,
    "end": _end,
    "distance": _distance,
    "avoidance": _avoidance,
    "saturation": _saturation,
    "messages": _messages,
    "silence": _silence,
    "refused": _refused,
    "late": _late,
    "drives": _drives,
    "referee": _referee,
    "recording": _recording,
}
"""All health checks, by the names that `health.off` takes, in the order in which they are told."""
