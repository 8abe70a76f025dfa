"""The models of a plan's buses, and what there is to tell of them in a summary."""

from collections.abc import Mapping, Sequence
from typing import Any

from echelon.bridge.bus_model import BusModel, Traffic
from echelon.bridge.bus_time import BusTime
from echelon.bridge.frame import WHEELS
from echelon.bridge.frame_message import BRIDGE_NODE
from echelon.bridge.ideal_bus import IdealBus
from echelon.bridge.protocols import DrivePlace, drive_places
from echelon.can_plan import NEVER_NS
from echelon.plan import Plan

EVENTS = 1000
"""Told of a bus, at most"""


def make_buses(plan: Plan, part: int = 0) -> list[BusTime | IdealBus]:
    """Returns the models of all buses.  Where several processes have models of the same buses, each is a `part` of its own
    and draws errors of its own."""
    can, count = plan.can, len(plan.can.buses)
    if can.timing == "ideal":
        return [IdealBus() for _ in range(count)]
    return [
        BusTime(bus.bitrate, plan.seed, part * count + number, capacity=can.queue, restart_ns=can.restart_ns)
        for number, bus in enumerate(can.buses)
    ]


def bus_row(plan: Plan, number: int, model: BusModel, bounds_ns: Mapping[int, int | None]) -> dict[str, Any]:
    """Returns what became of the frames on one bus; latencies [s] are from the queue to the end of the frame, and
    their bounds those of the cyclic frames without errors."""
    bus, traffic = plan.can.buses[number], dict(sorted(model.traffic.items()))
    names = {place.node: _name(plan, place) for place in drive_places(plan)} | {BRIDGE_NODE: "bridge"}
    return {
        "name": bus.name,
        "bitrate": bus.bitrate,
        "load": model.load,
        "lost": sum(row.lost for row in traffic.values()),
        "destroyed": sum(row.retransmitted for row in traffic.values()),
        "events": [
            {"time": event.time_ns / 1e9, "node": event.node, "who": names[event.node], "event": event.kind.value}
            for event in model.events[:EVENTS]
        ],
        "identifiers": {f"{can_id:03X}": _identifier(row, bounds_ns.get(can_id)) for can_id, row in traffic.items()},
    }


def _name(plan: Plan, place: DrivePlace) -> str:
    robot = plan.robots[place.robot].name
    return robot if len(place.wheels) == 2 else f"{robot} {WHEELS[place.wheels[0]]}"


def scheduled(plan: Plan) -> list[dict[str, Any]]:
    """Returns the plan's events, for people: when, until when (None: for good), what, and to whom."""
    rows = []
    for event in plan.events:
        robots = [plan.robots[robot].name for robot in event.robots]
        whom = robots or [plan.can.buses[bus].name for bus in event.buses]
        what = [event.kind.replace("_", " "), event.fault.replace("_", " ")]
        if event.kind == "drive_fault" and len(event.wheels) == 1:
            what.append(WHEELS[event.wheels[0]])
        if event.kind == "error_frames":
            what.append(f"rate {event.rate:g}")
        rows.append(
            {
                "time": event.at_ns / 1e9,
                "until": None if event.until_ns == NEVER_NS else event.until_ns / 1e9,
                "what": " ".join(filter(None, what)),
                "whom": whom,
            }
        )
    return rows


def lost_row(lost: Mapping[int, int]) -> dict[str, Any]:
    """Returns a row of frames that were lost before they came to a bus, by identifier."""
    identifiers = {f"{can_id:03X}": _identifier(Traffic(lost=number), None) for can_id, number in lost.items()}
    return {"lost": sum(lost.values()), "destroyed": 0, "events": [], "identifiers": identifiers}


def _identifier(row: Traffic, bound_ns: int | None) -> dict[str, Any]:
    return {
        "frames": row.delivered,
        "lost": row.lost,
        "destroyed": row.retransmitted,
        "latency_mean": row.latency_mean_ns / 1e9,
        "latency_max": row.latency_max_ns / 1e9,
        "latency_bound": None if bound_ns is None else bound_ns / 1e9,
    }


def merge_rows(rows: Sequence[dict[str, Any]], others: Sequence[Mapping[str, Any]]) -> None:
    """Adds to rows what another part knows of the same buses: its identifiers, what it lost, what happened to its nodes."""
    for row, other in zip(rows, others, strict=True):
        row["lost"] += other["lost"]
        row["destroyed"] += other["destroyed"]
        row["events"] = sorted([*row["events"], *other["events"]], key=lambda event: event["time"])[:EVENTS]
        identifiers = row["identifiers"]
        for can_id, more in other["identifiers"].items():
            if can_id in identifiers:
                identifiers[can_id]["lost"] += more["lost"]
            else:
                identifiers[can_id] = more
        row["identifiers"] = dict(sorted(identifiers.items()))
