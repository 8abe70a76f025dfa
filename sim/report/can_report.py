"""The report's section about the CAN buses: load, latencies, stopped torques, drives, the referee."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Final

from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.reports import BusReport, CanReport, IdentifierReport
from echelon.sim.report.page import paragraph, rest, subheading, table
from echelon.sim.results.can_lines import intrusion_texts, some
from echelon.sim.results.summary import number

MAX_ROWS: Final = 60
"""Rows of a table; the rest is in summary.json."""
SIMPLE: Final = ("url", "listen", "path", "timing", "torque_scale", "frames", "sent", "failed", "dropped", "foreign")
"""Fields of `CanReport` that are shown as they are"""


def can_section(can: CanReport | None, frames: Sequence[Mapping[str, object]]) -> str:
    """Returns the section about one run as HTML; `frames` are the first frames, decoded, all with the same keys."""
    if can is None or not can.frames:
        return paragraph("No bus in this run.")
    text = paragraph(" ".join(_sentences(can)))
    if can.referee is not None and can.referee.after_stop:
        text += paragraph(f"{can.referee.after_stop}.".capitalize())
    text += "".join(paragraph(f"{line}.") for line in can.fit)
    text += table(["", ""], [[key.replace("_", " "), _plain(getattr(can, key))] for key in SIMPLE], numeric_from=2)
    if can.advice:
        text += paragraph("To make it fit: " + "; ".join(can.advice) + ".")
    if can.referee is not None:
        text += _referee(can.referee)
    text += _happened(can)
    text += "".join(map(_bus, can.buses))
    text += _robots(can)
    if frames:
        keys = list(frames[0])
        rows = [[frame.get(key, "") for key in keys] for frame in frames[:MAX_ROWS]]
        text += subheading("First frames") + table(keys, rows, numeric_from=len(keys), what="frames")
    return text


def _sentences(can: CanReport) -> list[str]:
    over = " — more than it can carry" if can.load_mean > 1 else ""
    which = "The busiest of the buses" if len(can.buses) > 1 else "The bus"
    words = [f"{which} would be loaded to {100 * can.load_mean:.3g} %{over}, if it were real."]
    if can.stopped:
        reasons = ", ".join(f"{count} times {reason}" for reason, count in can.stopped.items())
        words.append(f"Torques that became zero before the bus: {reasons}.")
    if can.intrusions:
        words.append(f"Frames with identifiers of this run came from elsewhere: {some(intrusion_texts(can))}.")
    if clipped := sum(robot.clipped for robot in can.robots.values()):
        words.append(f"In {clipped} frames a torque did not fit and was clipped.")
    if can.torque is not None:
        words.append(
            f"From a robot's state to its torque frame: median {number(can.torque.latency_median, 's')}, 99 % within "
            f"{number(can.torque.latency_p99, 's')}, at most {number(can.torque.latency_max, 's')}."
        )
    return words


def _referee(referee: RefereeReport) -> str:
    found = ", ".join(f"{count} {kind}" for kind, count in referee.kinds.items()) or "nothing wrong"
    words = subheading("Referee") + paragraph(f"Frames{referee.up_to}: {referee.frames}. Found: {found}.")
    rows = [[f"{row.time:.6g}", row.bus, row.id, row.robot, row.kind, row.text] for row in referee.findings[:MAX_ROWS]]
    if not rows:
        return words
    head = ["t [s]", "bus", "identifier", "robot", "kind", "what"]
    return words + table(head, rows, numeric_from=6, what="findings") + rest(len(referee.findings), MAX_ROWS)


def _happened(can: CanReport) -> str:
    """Returns a table of scheduled events and of events on the buses, bus-off for example, in order of time."""
    rows = [
        (event.time, "scheduled", ", ".join(event.whom), event.what + _until(event.until)) for event in can.scheduled
    ]
    rows += [(event.time, bus.name, event.who, event.event) for bus in can.buses for event in bus.events]
    if not rows:
        return ""
    shown = [[f"{time:.6g}", *rest] for time, *rest in sorted(rows)[:MAX_ROWS]]
    events = table(["t [s]", "", "who", "what"], shown, numeric_from=4, what="events")
    return subheading("What happened") + events + rest(len(rows), MAX_ROWS)


def _until(time_s: float | None) -> str:
    return "" if time_s is None else f", until {time_s:.6g} s"


def _bus(bus: BusReport) -> str:
    rows = [_identifier(can_id, row) for can_id, row in bus.identifiers.items()]
    if not any(row[1] for row in rows):
        return ""
    head = ["identifier", "frames", "lost", "sent again", "mean latency [ms]", "largest [ms]", "bound [ms]"]
    load = f"{bus.name}: {100 * bus.load:.3g} % of {bus.bitrate / 1e3:g} kbit/s"
    bound = "The bound is for cyclic frames alone: what brings drives up, clears faults or is sent again comes on top."
    return subheading(load) + paragraph(bound) + table(head, rows, what="identifiers")


def _identifier(can_id: str, row: IdentifierReport) -> list[object]:
    latencies = (row.latency_mean, row.latency_max, row.latency_bound)
    return [can_id, row.frames, row.lost, row.destroyed, *map(_milliseconds, latencies)]


def _robots(can: CanReport) -> str:
    if not can.robots:
        return ""
    drives = {} if can.drives is None else can.drives.robots
    first = next(iter(can.robots.values()))
    keys = [field.name for field in fields(first) if isinstance(getattr(first, field.name), int | float | str)]
    rows = []
    for name, row in list(can.robots.items())[:MAX_ROWS]:
        stopped = ", ".join(f"{count} {reason}" for reason, count in row.stopped.items() if count)
        warm = [_plain(drives[name].temperature)] if name in drives else []
        rows.append([name, *(_plain(getattr(row, key)) for key in keys), stopped, *warm])
    head = ["robot", *(key.replace("_", " ") for key in keys), "stopped", *(["winding [°C]"] if drives else [])]
    return subheading("Robots") + table(head, rows, what="robots") + rest(len(can.robots), MAX_ROWS)


def _milliseconds(seconds: float | None) -> str:
    return "–" if seconds is None else f"{1e3 * seconds:.4g}"


def _plain(value: object) -> str:
    if value is None:
        return "–"
    return number(value) if isinstance(value, float) else str(value)
