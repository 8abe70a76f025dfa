"""Health checks of the buses: whether drives work, and whether the frames keep the contract."""

from collections.abc import Iterator

from echelon.sim.results.can_lines import finding_text, intrusion_texts, some
from echelon.sim.results.evidence import Evidence
from echelon.sim.results.verdict import CheckResult, count


def drives(evidence: Evidence) -> Iterator[CheckResult]:
    """On a closed torque path: all drives came up, and at the end none has a fault that no event explains."""
    plan, can = evidence.plan, evidence.can
    if can is None or not plan.can.closed:
        return
    if not can.robots:
        yield CheckResult("drives", "not tested", "the bridge gave no report", unit="robots")
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
        text = f"the drives of {count(len(can.robots), 'robot')} came up, and none has a fault that no event explains"
    yield CheckResult("drives", "failed" if wrong else "passed", text, float(len(wrong)), "robots", 0.0, tuple(wrong))


def referee(evidence: Evidence) -> Iterator[CheckResult]:
    """The referee found nothing on the buses that breaks the contract (docs/architecture.md, 5.7)."""
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


def senders(evidence: Evidence) -> Iterator[CheckResult]:
    """On a bus that other programs can reach: nobody else sent frames with identifiers of the run."""
    can = evidence.can
    if can is None or not can.listen:
        return
    total = sum(row.frames for row in can.intrusions)
    if total:
        who = tuple(dict.fromkeys(row.sender for row in can.intrusions))
        text = f"{count(total, 'frame')} with identifiers of this run came from elsewhere: {some(intrusion_texts(can))}"
        yield CheckResult("senders", "failed", text, float(total), "frames", 0.0, who)
    else:
        yield CheckResult(
            "senders", "passed", "nobody else sent frames with identifiers of this run", 0.0, "frames", 0.0
        )
