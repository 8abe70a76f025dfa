"""Keys of a scenario in words, with their units: labels of axes."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

SECONDS: Final = frozenset({
    "delay", "duration", "at", "timeout", "std", "min", "max", "mean", "scale", "acceleration", "torque", "period", "offset",
})  # fmt: skip
"""Last parts of keys whose values are in seconds"""
OF_LINKS: Final = {
    "delay": "delay",
    "delay.min": "smallest delay",
    "delay.max": "largest delay",
    "delay.mean": "mean delay",
    "delay.std": "standard deviation of the delay",
    "delay.scale": "scale of the delay",
    "delay.shape": "shape of the delay",
    "delay.correlation": "correlation of the delays",
    "delay.kind": "kind of delay",
    "loss": "loss",
    "loss.mean": "mean loss",
    "loss.burst": "mean length of bursts of losses [messages]",
    "duplicates": "share of duplicates",
    "timeout": "timeout",
    "policy": "policy",
    "channel": "channel",
}
"""What a key of a rule in `links` is about"""
WORDS: Final = {
    "law.epsilon": "ratio of time scales ε",
    "law.lead": "lead λ [acceleration periods]",
    "law.reference": "reference of the errors",
    "periods.acceleration": "acceleration period [s]",
    "periods.torque": "torque period [s]",
    "timing": "timing",
    "duration": "duration of the run [s]",
    "robot.model": "plant",
    "robot.mass": "mass of a robot [kg]",
    "robot.inertia": "moment of inertia of a robot [kg m²]",
    "robot.wheel_radius": "wheel radius [m]",
    "robot.arm": "lever arm of the wheels [m]",
    "robot.offset": "offset of the reference point [m]",
    "robot.torque_limit": "torque limit [N m]",
    "robot.torque_rate_limit": "limit of the torque's rate [N m/s]",
    "robot.wheel_speed_limit": "limit of wheel speeds [rad/s]",
    "avoidance.avoidance_radius": "avoidance radius [m]",
    "avoidance.sensing_radius": "sensing radius [m]",
    "avoidance.enabled": "avoidance",
    "trajectory.velocity": "velocity [m/s]",
    "trajectory.speed": "speed [m/s]",
    "trajectory.radius": "radius of the circle [m]",
}
"""Other keys"""
EVENTS: Final = {"blackout": "the blackout", "cut_off": "the time without contact"}


def label_of(key: str, scenario: Mapping[str, Any]) -> str:
    """Returns a key in words, with its unit.  `scenario` is the table of the scenario, as far as it is known: it says of which
    links a rule is.  A channel of "" varies."""
    if key in WORDS:
        return WORDS[key]
    head, *parts = key.split(".")
    last = parts[-1] if parts else head
    # an offset is one of a clock, or that of a robot's centre of mass from its axle
    unit = " [m]" if (head, last) == ("formation", "offset") else " [s]" if last in SECONDS else ""
    if head == "law" and parts[:1] == ["epsilon"] and last.isdigit():
        return f"ratio of time scales ε{int(last) + 1}"
    if head == "links" and len(parts) > 1 and (of := OF_LINKS.get(".".join(parts[1:]))):
        whole, bracket, rest = of.partition(" [")
        seconds = unit if parts[1] in ("delay", "timeout") else ""
        return f"{whole} of {_links(parts[0], scenario)}{bracket}{rest}{seconds}"
    if head == "events" and len(parts) == 2:
        event = EVENTS.get(str(_entry(scenario.get("events"), parts[0]).get("kind")), "the event")
        return f"{'begin' if last == 'at' else last} of {event}{unit}"
    if head == "formation" and last == "period":
        group = parts[-2] if len(parts) > 1 else "the coordinator"
        return f"period of {group}{unit}"
    place = " ".join(part for part in (head, *parts[:-1]) if not part.isdigit())
    return f"{last.replace('_', ' ')}{f' of {place}' if parts else ''}{unit}"


def _links(rule: str, scenario: Mapping[str, Any]) -> str:
    """Returns in words of which links a rule is."""
    table = _entry(scenario.get("links"), rule)
    if not rule.isdigit():
        table = next((each for each in _tables(scenario.get("links")) if each.get("name") == rule), table)
    channel = str(table.get("channel", "*"))
    ends = [f"from {table['source']}" if table.get("source", "**") != "**" else ""]
    ends.append(f"to {table['receiver']}" if table.get("receiver", "**") != "**" else "")
    if channel == "*" and not any(ends) and not rule.isdigit():
        return f"the links {rule}"
    kind = (
        "links" if not channel or not table else "all links" if channel == "*" else f"{channel.replace('_', ' ')} links"
    )
    return " ".join(each for each in (kind, *ends) if each)


def _entry(tables: Any, number: str) -> Mapping[str, Any]:
    found: Sequence[Mapping[str, Any]] = _tables(tables)
    return found[int(number)] if number.isdigit() and int(number) < len(found) else {}


def _tables(tables: Any) -> Sequence[Mapping[str, Any]]:
    return [each for each in tables if isinstance(each, Mapping)] if isinstance(tables, list) else []
