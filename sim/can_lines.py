"""What a summary says of the bus, in lines for people: frames, what was stopped and why, faults, the referee's findings."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Final

SHOWN: Final = 5
"""How many of many are listed."""


def can_lines(can: Mapping[str, Any]) -> Iterator[str]:
    """Yields the lines of a terminal."""
    if not can.get("frames"):
        return
    facts = [f"{can['frames']} frames"]
    if can.get("path") == "closed":
        facts += [f"{number} {what}" for what, number in _bus_counts(can).items() if number]
    else:
        facts.append(f"{can.get('clipped', 0)} clipped")
    fit = can.get("fit", "")
    if isinstance(fit, str):
        yield f"  CAN      {', '.join(facts)}; {fit}"
    else:
        yield f"  CAN      {', '.join(facts)}"
        yield from (f"  bus      {line}" for line in fit)
    if events := can.get("scheduled"):
        told = [f"{event['time']:g} s {event['what']}" for event in events]
        yield f"  events   {_some(told)}"
    if off := [event for bus in can.get("buses", ()) for event in bus["events"] if event["event"] == "bus-off"]:
        told = [f"{event['who']} at {event['time']:.4g} s" for event in off]
        yield f"  bus-off  {_some(told)}"
    if stopped := stopped_by_reason(can):
        reasons = ", ".join(f"{number} {reason}" for reason, number in stopped.most_common(SHOWN))
        yield f"  stopped  torques that became zero before the bus: {reasons}"
    faults = [f"{name} {row['fault']}" for name, row in can.get("robots", {}).items() if row.get("fault")]
    if faults:
        yield f"  drives   faults at the end: {_some(faults)}"
    if idle := [
        name for name, row in can.get("robots", {}).items() if not row.get("enabled", True) and not row["fault"]
    ]:
        yield f"  drives   not enabled at the end: {_some(idle)}"
    if referee := can.get("referee"):
        found = ", ".join(f"{number} {kind}" for kind, number in referee["kinds"].items()) or "nothing wrong"
        yield f"  referee  {referee['frames']} frames: {found}"


def can_reasons(can: Mapping[str, Any]) -> list[str]:
    """Returns why the verdict fails for what was on the bus: the referee's findings."""
    referee = can.get("referee")
    if not referee or not referee["kinds"]:
        return []
    total, first = sum(referee["kinds"].values()), referee["findings"][0]
    what = " ".join(filter(None, (first["bus"], first["id"], first["robot"], first["kind"])))
    return [f"referee: {total} finding(s) on the bus, the first at {first['time']:.6g} s, {what}: {first['text']}"]


def stopped_by_reason(can: Mapping[str, Any]) -> Counter[str]:
    """Returns how many torques became zero before the bus, by reason, over all robots."""
    return sum((Counter(row.get("stopped", {})) for row in can.get("robots", {}).values()), Counter[str]())


def _bus_counts(can: Mapping[str, Any]) -> dict[str, int]:
    buses = can.get("buses", ())
    lost, destroyed = (sum(bus[what] for bus in buses) for what in ("lost", "destroyed"))
    return {"lost": lost, "destroyed and sent again": destroyed}


def _some(texts: list[str]) -> str:
    more = f", and {len(texts) - SHOWN} more" if len(texts) > SHOWN else ""
    return ", ".join(texts[:SHOWN]) + more
