"""The part of a report that concerns the CAN bus: load, latencies, torques that were stopped, drives, the referee."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from echelon.sim.can_lines import stopped_by_reason
from echelon.sim.page import paragraph, subheading, table
from echelon.sim.summary import number

MAX_ROWS: Final = 60
"""Rows of a table; what is beyond is in summary.json."""
SIMPLE: Final = (
    "url",
    "listen",
    "path",
    "timing",
    "torque_scale",
    "frames",
    "sent",
    "failed",
    "dropped",
    "foreign",
)
"""What is shown as it stands."""


def can_section(can: dict[str, Any], frames: Sequence[Mapping[str, object]]) -> str:
    """Returns the section of one run, HTML; `can` is from its summary, `frames` are the first ones, decoded."""
    if not can or not can.get("frames"):
        return paragraph("No bus in this run.")
    text = paragraph(" ".join(_sentences(can)))
    fit = can.get("fit") or []
    text += "".join(paragraph(f"{line}.") for line in ([fit] if isinstance(fit, str) else fit))
    text += table(["", ""], [[key.replace("_", " "), _plain(can[key])] for key in SIMPLE if key in can], numeric_from=2)
    if advice := can.get("advice"):
        text += paragraph("To make it fit: " + "; ".join(advice) + ".")
    if referee := can.get("referee"):
        text += _referee(referee)
    text += _happened(can)
    text += _buses(can.get("buses", ()))
    text += _robots(can)
    if frames:
        keys = list(frames[0])
        rows = [[frame.get(key, "") for key in keys] for frame in frames[:MAX_ROWS]]
        text += subheading("First frames") + table(keys, rows, numeric_from=len(keys))
    return text


def _sentences(can: dict[str, Any]) -> list[str]:
    words = []
    if (mean := can.get("load_mean")) is not None:
        over = " — more than it can carry" if mean > 1 else ""
        which = "The busiest of the buses" if len(can.get("buses", ())) > 1 else "The bus"
        words.append(f"{which} would be loaded to {100 * mean:.3g} %{over}, if it were real.")
    stopped = stopped_by_reason(can)
    if stopped.total():
        reasons = ", ".join(f"{count} times {reason}" for reason, count in stopped.most_common())
        words.append(f"Torques that became zero before the bus: {reasons}.")
    if clipped := can.get("clipped"):
        words.append(f"In {clipped} frames a torque did not fit and was clipped.")
    if torque := can.get("torque"):
        words.append(
            f"From a robot's state to its torque frame: median {number(torque['latency_median'], 's')}, 99 % within "
            f"{number(torque['latency_p99'], 's')}, at most {number(torque['latency_max'], 's')}."
        )
    return words


def _referee(referee: dict[str, Any]) -> str:
    found = ", ".join(f"{count} {kind}" for kind, count in referee["kinds"].items()) or "nothing wrong"
    text = subheading("Referee") + paragraph(f"It looked at {referee['frames']} frames and found {found}.")
    rows = [
        [f"{row['time']:.6g}", row["bus"], row["id"], row["robot"], row["kind"], row["text"]]
        for row in referee["findings"][:MAX_ROWS]
    ]
    return text + (table(["t [s]", "bus", "identifier", "robot", "kind", "what"], rows, numeric_from=6) if rows else "")


def _happened(can: dict[str, Any]) -> str:
    """Returns what was on schedule, and which controllers left their bus, in order of time."""
    rows = [
        (event["time"], "scheduled", ", ".join(event["whom"]), event["what"] + _until(event["until"]))
        for event in can.get("scheduled", ())
    ]
    rows += [
        (event["time"], bus["name"], event["who"], event["event"])
        for bus in can.get("buses", ())
        for event in bus["events"]
    ]
    if not rows:
        return ""
    shown = [[f"{time:.6g}", *rest] for time, *rest in sorted(rows)[:MAX_ROWS]]
    return subheading("What happened") + table(["t [s]", "", "who", "what"], shown, numeric_from=4)


def _until(time_s: float | None) -> str:
    return "" if time_s is None else f", until {time_s:.6g} s"


def _buses(buses: Any) -> str:
    text = ""
    for bus in buses:
        rows = [_identifier(can_id, row) for can_id, row in list(bus["identifiers"].items())[:MAX_ROWS]]
        if rows and any(row[1] for row in rows):
            head = ["identifier", "frames", "lost", "sent again", "mean latency [ms]", "largest [ms]", "bound [ms]"]
            load = f"{bus['name']}: {100 * bus['load']:.3g} % of {bus['bitrate'] / 1e3:g} kbit/s"
            bound = "The bound is for cyclic frames alone: what brings drives up, clears faults or is sent again comes on top."
            text += subheading(load) + table(head, rows) + paragraph(bound)
    return text


def _identifier(can_id: str, row: dict[str, Any]) -> list[object]:
    latencies = (row["latency_mean"], row["latency_max"], row["latency_bound"])
    return [can_id, row["frames"], row["lost"], row["destroyed"], *map(_milliseconds, latencies)]


def _robots(can: dict[str, Any]) -> str:
    robots, drives = can.get("robots") or {}, can.get("drives", {}).get("robots", {})
    if not robots:
        return ""
    keys = [key for key, value in next(iter(robots.values())).items() if isinstance(value, int | float | str)]
    rows = []
    for name, row in list(robots.items())[:MAX_ROWS]:
        stopped = ", ".join(f"{count} {reason}" for reason, count in row.get("stopped", {}).items() if count)
        warm = [_plain(drives[name]["temperature"])] if name in drives else []
        rows.append([name, *(_plain(row.get(key)) for key in keys), stopped, *warm])
    head = ["robot", *(key.replace("_", " ") for key in keys), "stopped", *(["winding [°C]"] if drives else [])]
    return subheading("Robots") + table(head, rows)


def _milliseconds(seconds: float | None) -> str:
    return "–" if seconds is None else f"{1e3 * seconds:.4g}"


def _plain(value: object) -> str:
    if isinstance(value, list):
        return "; ".join(map(str, value))
    return number(value) if isinstance(value, float) else str(value)
