"""The models of a plan's buses, and what there is to tell of them in a summary."""

from collections.abc import Mapping, Sequence
from typing import Any

from bridge.bus_model import BusEventKind, BusModel
from bridge.bus_time import BusTime
from bridge.ideal_bus import IdealBus
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
    events = [event for event in model.events if event.kind is not BusEventKind.ERROR]
    return {
        "name": bus.name,
        "bitrate": bus.bitrate,
        "load": model.load,
        "lost": sum(row.lost for row in traffic.values()),
        "destroyed": sum(row.retransmitted for row in traffic.values()),
        "events": [
            {"time": event.time_ns / 1e9, "node": event.node, "event": event.kind.value} for event in events[:EVENTS]
        ],
        "identifiers": {
            f"{can_id:03X}": {
                "frames": row.delivered,
                "lost": row.lost,
                "destroyed": row.retransmitted,
                "latency_mean": row.latency_mean_ns / 1e9,
                "latency_max": row.latency_max_ns / 1e9,
                "latency_bound": None if (bound := bounds_ns.get(can_id)) is None else bound / 1e9,
            }
            for can_id, row in traffic.items()
        },
    }


def merge_rows(rows: Sequence[dict[str, Any]], others: Sequence[Mapping[str, Any]]) -> None:
    """Adds to rows what another part knows of the same buses: its identifiers, what it lost, what happened to its nodes."""
    for row, other in zip(rows, others, strict=True):
        row["lost"] += other["lost"]
        row["destroyed"] += other["destroyed"]
        row["events"] = sorted([*row["events"], *other["events"]], key=lambda event: event["time"])[:EVENTS]
        row["identifiers"] = dict(sorted((other["identifiers"] | row["identifiers"]).items()))
