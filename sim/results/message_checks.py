"""Health checks of the messages: on links, from robots, at their receivers, in time, and in the recording."""

from collections.abc import Iterator

import numpy as np

from echelon.sim.results.can_lines import some
from echelon.sim.results.evidence import Evidence
from echelon.sim.results.records import RunFacts, StandstillResult
from echelon.sim.results.verdict import CheckResult, Outcome, count


def messages(evidence: Evidence) -> Iterator[CheckResult]:
    """On every link at least one message was used."""
    links = evidence.links
    if not links:
        if evidence.plan.links:
            yield CheckResult("messages", "not tested", "the messages of the links were not counted", unit="links")
        return
    unused = [row for row in links if not row.used]
    none_came = [row for row in unused if not row.delivered]
    if not unused:
        used = sum(row.used for row in links)
        text = f"messages were used on each of {count(len(links), 'link')}, {used} times in all"
        yield CheckResult("messages", "passed", text, 0.0, "links", 0.0)
        return
    shown = none_came or unused
    what = "no message arrived" if none_came else "messages arrived, but none was used, as too old or empty,"
    names = [f"{row.source} → {row.receiver} ({row.channel.replace('_', ' ')})" for row in shown]
    rest = f"; none was used on {len(unused) - len(shown)} more" if len(unused) > len(shown) else ""
    text = f"{what} on {len(shown)} of {count(len(links), 'link')}: {some(names)}{rest}"
    yield CheckResult("messages", "failed", text, float(len(unused)), "links", 0.0, tuple(names))


def silence(evidence: Evidence) -> Iterator[CheckResult]:
    """No robot was without a state for longer than `health.silence`, or two of its periods if that is longer."""
    plan, times = evidence.plan, evidence.trace.times_ns
    last_ns = max((int(each[-1]) for each in times if len(each)), default=0)
    gaps = []
    for robot, each in zip(plan.robots, times, strict=True):
        if len(each):
            instants_ns = np.concatenate([[0], each, [max(last_ns, int(each[-1]))]])
            widths_ns = np.diff(instants_ns)
            at = int(np.argmax(widths_ns))
            gaps.append((int(widths_ns[at]), robot, int(instants_ns[at])))
    if not gaps:
        yield CheckResult("silence", "failed", "no robot sent a state", None, "s", plan.health.silence)
        return
    gap_ns, robot, from_ns = max(gaps, key=lambda found: (found[0], -found[1].index))
    bound_s = max(plan.health.silence, 2 * robot.period_ns / 1e9)
    outcome: Outcome = "failed" if gap_ns / 1e9 > bound_s else "passed"
    text = f"{robot.name} sent no state for {gap_ns / 1e9:.4g} s from t = {from_ns / 1e9:g} s on, the longest of all robots"
    text += _busy(evidence.run) if outcome == "failed" else ""
    yield CheckResult("silence", outcome, text, gap_ns / 1e9, "s", bound_s, (robot.name,))


def refused(evidence: Evidence) -> Iterator[CheckResult]:
    """No message was refused: by a receiver, the recorder, the bridge or the drives."""
    refused = evidence.run.refused
    if evidence.can is not None:
        refused += sum(evidence.can.refused.values())
        refused += sum(evidence.can.drives.refused.values()) if evidence.can.drives is not None else 0
    text = f"{count(refused, 'message')} refused" if refused else "no message was refused"
    refusals = evidence.run.refusals
    if refusals:
        shown = [f"{each.receiver} {each.messages} of {each.source} ({each.reason})" for each in refusals]
        text += f": {some(shown)}"
    about = tuple(dict.fromkeys(each.source for each in refusals))
    yield CheckResult("refused", "failed" if refused else "passed", text, float(refused), "messages", 0.0, about)


def late(evidence: Evidence) -> Iterator[CheckResult]:
    """On a wall clock: at most the share `health.late` of the stages ran at their deadline without all of their inputs."""
    run, bound = evidence.run, evidence.plan.health.late
    if run.clock != "wall" or not run.stages:
        return
    share = run.late_stages / run.stages
    text = (
        f"{run.late_stages} of {run.stages} stages ran without all of their inputs, {100 * share:.3g} %; at most "
        f"{100 * bound:g} %"
    )
    yield CheckResult("late", "failed" if share > bound else "passed", text, share, "", bound)


def standstill(evidence: Evidence) -> Iterator[CheckResult]:
    """On a wall clock: no process that acts stood still for longer than `can.watchdog`, or `health.silence` if the run
    has no bus."""
    plan, run = evidence.plan, evidence.run
    if run.clock != "wall" or not run.standstills:
        return
    acting = [*(one.name for one in plan.formation), "bridge", "drives"]
    found = sorted(((name, run.standstills[name]) for name in acting if name in run.standstills), key=_lasted)[::-1]
    if not found:
        return
    bound_s = plan.health.silence if evidence.can is None else plan.can.watchdog_ns / 1e9
    over = [
        f"{name} for {one.lasted:.4g} s from t = {one.since:.4g} s on" for name, one in found if one.lasted > bound_s
    ]
    about = tuple(name for name, one in found if one.lasted > bound_s)
    who, longest = found[0]
    text = (
        f"stood still: {some(over)}; at most {bound_s:g} s"
        if over
        else f"{who} for {longest.lasted:.3g} s, the longest"
    )
    yield CheckResult("standstill", "failed" if over else "passed", text, longest.lasted, "s", bound_s, about)


def _lasted(found: tuple[str, StandstillResult]) -> float:
    return found[1].lasted


def recording(evidence: Evidence) -> Iterator[CheckResult]:
    """Between a robot's first and last state no state is missing, and no line of can.log is missing.

    A recording that was thinned by rule has the states of fewer instants, and lacks none of these."""
    plan, can, run = evidence.plan, evidence.can, evidence.run
    every_ns = round((run.recorded_every or 0.0) * 1e9)
    missing, whose = 0, []
    for robot, times_ns in zip(plan.robots, evidence.trace.times_ns, strict=True):
        step_ns = max(robot.period_ns, every_ns)
        lacks = (int(times_ns[-1]) - int(times_ns[0])) // step_ns + 1 - len(times_ns) if len(times_ns) else 0
        if lacks > 0:
            missing += lacks
            before_ns = int(times_ns[int(np.argmax(np.diff(times_ns) > step_ns))])
            whose.append(f"{lacks} of {robot.name} after t = {before_ns / 1e9:g} s")
    lost = (can.log_lost or 0) if can is not None else 0
    if missing or lost:
        parts = [f"{count(missing, 'state')} ({some(whose)})"] * bool(missing) + [f"{lost} lines of can.log"] * bool(
            lost
        )
        text = f"the recording lacks {' and '.join(parts)}{_busy(run)}"
    elif every_ns:
        text = f"thinned by rule, to an instant every {every_ns / 1e9:g} s ({run.thinned} messages); of these it lacks nothing"
    else:
        text = "the recording lacks nothing"
    outcome: Outcome = "failed" if missing or lost else "passed"
    yield CheckResult("recording", outcome, text, float(missing + lost), "messages", 0.0)


def _busy(run: RunFacts) -> str:
    """Returns the likely cause of missing messages on a wall clock, to be appended to a sentence; empty if no stage was
    late."""
    if run.clock != "wall" or not run.late_stages:
        return ""
    return f"; {100 * run.late_stages / run.stages:.3g} % of stages were late: was the machine busy?"
