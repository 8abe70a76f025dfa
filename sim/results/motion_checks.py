"""Health checks of how the robots moved: to the end, with finite states, without growing errors, apart, within limits."""

from collections.abc import Iterator, Sequence

import numpy as np

from echelon.runtime.admission import LARGEST
from echelon.sim.results.can_lines import some
from echelon.sim.results.evidence import Evidence
from echelon.sim.results.settling import start_error
from echelon.sim.results.verdict import CheckResult, Outcome


def whole(evidence: Evidence) -> Iterator[CheckResult]:
    """The run reached its end: it did not break off, was not stopped, and every robot has states up to the end."""
    plan, run = evidence.plan, evidence.run
    wanted_s, end_ns = plan.duration_ns / 1e9, evidence.end_ns
    end_s = None if end_ns is None else end_ns / 1e9

    def result(outcome: Outcome, text: str, about: Sequence[str] = ()) -> CheckResult:
        return CheckResult("whole", outcome, text, end_s, "s", wanted_s, tuple(about))

    at = "before it began" if end_s is None else f"at {end_s:g} s of {wanted_s:g} s"
    if run.failure:
        what = run.failure.splitlines()[0]
        yield result("failed", what if " at t = " in what else f"{what} ({at})")
        return
    if run.stopped:
        yield result("failed", f"the run was stopped {at}: {run.stopped}")
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
        yield result("failed", f"every robot ended early, the first {first} {early[first]} of {wanted_s:g} s")
    elif early:
        shown = some([f"{name} {when}" for name, when in early.items()])
        yield result("failed", f"ended early: {shown} of {wanted_s:g} s", list(early))
    elif end_ns is None or end_ns < needed_ns:
        yield result("failed", f"the robots have no instant in common at the end of {wanted_s:g} s")
    else:
        yield result("passed", f"the run reached {end_s:g} s of {wanted_s:g} s")


def finite(evidence: Evidence) -> Iterator[CheckResult]:
    """All states are finite, and within the bounds of all messages (`echelon.runtime.admission`)."""
    lost: list[tuple[int, str, bool]] = []
    for robot, states, times_ns in zip(
        evidence.plan.robots, evidence.trace.states, evidence.trace.times_ns, strict=True
    ):
        with np.errstate(over="ignore", invalid="ignore"):
            wrong = np.flatnonzero(~(np.linalg.norm(states, axis=1) <= LARGEST))  # also where it is not a number
        if wrong.size:
            lost.append((int(times_ns[wrong[0]]), robot.name, bool(np.isfinite(states[wrong[0]]).all())))
    if not lost:
        yield CheckResult("finite", "passed", "all states are finite", 0.0, "robots", 0.0)
        return
    first_ns, name, is_finite = min(lost)
    others = f"; {len(lost) - 1} more robots have such states, too" if len(lost) > 1 else ""
    what = "beyond all bounds" if is_finite else "not finite"
    text = f"{name}: a state is {what} from {first_ns / 1e9:g} s on{others}"
    yield CheckResult(
        "finite", "failed", text, float(len(lost)), "robots", 0.0, tuple(name for _, name, _ in sorted(lost))
    )


def growth(evidence: Evidence) -> Iterator[CheckResult]:
    """No error grows in the last third of the run (results.ending); one result for each block whose error grows."""
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
            largest = max(one.floor for _, _, one in judged)
            text = f"no error grows; in the last sixth of the run all are at most {largest:.3g} m"
        else:
            text = f"no error grows; that of {name} in the last sixth of the run is {growth:.3g} times that in the sixth before"
            text += f", {ending.level:.3g} m: {ending.spared}" if ending.spared else ""
        yield CheckResult("growth", "passed", text, growth, "", bound, tuple(name for _, name, _ in judged))
    yield from _too_short("growth", evidence)


def _too_short(name: str, evidence: Evidence) -> Iterator[CheckResult]:
    """Yields a result that names the blocks for which the run is too short; nothing if there are none."""
    short = [
        series.block.name
        for series, ending in zip(evidence.blocks.series, evidence.endings, strict=True)
        if ending.kind == "too short" and series.block.size
    ]
    if short:
        text = f"{some(short)}: a third of the run is shorter than the dwell time"
        yield CheckResult(name, "not tested", text, about=tuple(short))


def end(evidence: Evidence) -> Iterator[CheckResult]:
    """No block ends with a larger error than it started with, `health.floor` at least."""
    times_ns = evidence.blocks.times_ns
    judged = []
    for series, ending in zip(evidence.blocks.series, evidence.endings, strict=True):
        start = start_error(series, times_ns)
        if ending.judged and start is not None and series.block.size:
            judged.append((series.block.name, float(series.norm[-1]), max(start, ending.floor)))
    higher = [found for found in judged if found[1] > found[2]]
    for name, end, start in higher:
        yield CheckResult(
            "end", "failed", f"{name} ends with an error of {end:.4g} m, and started with {start:.4g} m",
            end, "m", start, (name,),
        )  # fmt: skip
    if judged and not higher:
        name, end, start = max(judged, key=lambda found: found[1] / found[2])
        text = (
            f"no block ends with a larger error than at the start; largest ratio: {name}, {end:.3g} m of {start:.3g} m"
        )
        yield CheckResult("end", "passed", text, end, "m", start, tuple(found[0] for found in judged))
    yield from _too_short("end", evidence)


def distance(evidence: Evidence) -> Iterator[CheckResult]:
    """Avoidance is off: the robots stayed farther apart than the avoidance radius all the same."""
    if not evidence.plan.avoidance.enabled:
        yield from _kept("distance", evidence)


def avoidance(evidence: Evidence) -> Iterator[CheckResult]:
    """Avoidance is on: the robots stayed farther apart than the avoidance radius; not tested if avoidance never acted."""
    avoidance, closest = evidence.plan.avoidance, evidence.near.closest
    if not avoidance.enabled:
        return
    if closest is not None and closest.distance > avoidance.sensing_radius:
        text = (
            f"no two robots came within {avoidance.sensing_radius:g} m, where avoidance begins; the smallest distance was "
            f"{closest.distance:.4g} m"
        )
        yield CheckResult("avoidance", "not tested", text, closest.distance, "m", avoidance.avoidance_radius)
    else:
        yield from _kept("avoidance", evidence)


def _kept(name: str, evidence: Evidence) -> Iterator[CheckResult]:
    """Yields whether all distances between robots were larger than the avoidance radius."""
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
            f"in the one that began at {worst.first_ns / 1e9:.6g} s"
        )
        yield CheckResult(name, "failed", text, worst.smallest, "m", radius, (one, other))
    else:
        text = f"no two robots came closer than {near.closest.distance:.4g} m"
        yield CheckResult(name, "passed", text, near.closest.distance, "m", radius)


def saturation(evidence: Evidence) -> Iterator[CheckResult]:
    """The limits of each robot acted for at most the share `health.saturation` of the time."""
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
        yield CheckResult("saturation", "not tested", "it is not known for how long limits acted", None, "", bound)
    else:
        share, robot = max(shares)
        over = tuple(name for each, name in sorted(shares, reverse=True) if each > bound)
        more = f", and those of {len(over) - 1} more for more than {100 * bound:g} %" if len(over) > 1 else ""
        text = f"limits of {robot} acted for {100 * share:.3g} % of the time{more}; at most {100 * bound:g} %"
        yield CheckResult("saturation", "failed" if over else "passed", text, share, "", bound, over or (robot,))
