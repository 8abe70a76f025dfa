"""The lines about the CAN buses in a summary for a terminal: frames, stopped torques, faults, the referee's findings."""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final

from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.reports import CanReport

SHOWN: Final = 5
"""Items that a list shows in full; the rest are counted."""


def can_lines(can: CanReport | None) -> Iterator[str]:
    """Yields the lines; none without a bus or without frames."""
    if can is None or not can.frames:
        return
    facts = [f"{can.frames} frames"]
    lost, destroyed = sum(bus.lost for bus in can.buses), sum(bus.destroyed for bus in can.buses)
    facts += [f"{lost} lost"] if lost else []
    if can.path == "closed":
        facts += [f"{destroyed} destroyed and sent again"] if destroyed else []
    elif can.robots:  # the bridge has counted
        facts.append(f"{sum(robot.clipped for robot in can.robots.values())} clipped")
    if len(can.fit) == 1:
        yield f"  CAN      {', '.join(facts)}; {can.fit[0]}"
    else:
        yield f"  CAN      {', '.join(facts)}"
        yield from (f"  bus      {line}" for line in can.fit)
    if can.scheduled:
        yield f"  events   {some([f'{event.time:g} s {event.what}' for event in can.scheduled])}"
    if off := [event for bus in can.buses for event in bus.events if event.event == "bus-off"]:
        yield f"  bus-off  {some([f'{event.who} at {event.time:.4g} s' for event in off])}"
    if can.stopped:
        reasons = ", ".join(f"{number} {reason}" for reason, number in islice(can.stopped.items(), SHOWN))
        yield f"  stopped  torques that became zero before the bus: {reasons}"
    if faults := [f"{name} {row.fault}" for name, row in can.robots.items() if row.fault]:
        yield f"  drives   faults at the end: {some(faults)}"
    if idle := [name for name, row in can.robots.items() if row.enabled is False and not row.fault]:
        yield f"  drives   not enabled at the end: {some(idle)}"
    if can.intrusions:
        yield f"  others   frames with identifiers of this run: {some(intrusion_texts(can))}"
    if can.referee is not None:
        found = ", ".join(f"{number} {kind}" for kind, number in can.referee.kinds.items()) or "nothing wrong"
        yield f"  referee  {can.referee.frames} frames{can.referee.up_to}: {found}"
        if can.referee.after_stop:
            yield f"  stop     {can.referee.after_stop}"


def intrusion_texts(can: CanReport) -> list[str]:
    """Returns who sent what with identifiers of the run: `10.0.0.7 sent 100 on can0, 12 times`."""
    return [f"{row.sender} sent {row.id} on {row.bus}, {row.frames} times" for row in can.intrusions]


def finding_text(referee: RefereeReport) -> str:
    """Returns in a sentence how many findings there are, and the first one.  There must be one at least."""
    first = referee.findings[0]
    what = " ".join(filter(None, (first.bus, first.id, first.robot, first.kind)))
    total = sum(referee.kinds.values())
    return f"{total} finding(s) on the bus, the first at {first.time:.6g} s, {what}: {first.text}"


def some(texts: Sequence[str]) -> str:
    """Returns texts joined by commas: the first `SHOWN` of them, then how many more there are."""
    more = f", and {len(texts) - SHOWN} more" if len(texts) > SHOWN else ""
    return ", ".join(texts[:SHOWN]) + more
