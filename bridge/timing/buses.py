"""The models of a plan's buses, and their reports."""

from collections.abc import Mapping

from echelon.bridge.frame_message import BRIDGE_NODE
from echelon.bridge.protocols.frame import WHEELS
from echelon.bridge.protocols.registry import DrivePlace, drive_places
from echelon.bridge.reports import EVENTS, BusEvent, BusReport, IdentifierReport, ScheduledEvent
from echelon.bridge.timing.arbitration import ArbitratedBus
from echelon.bridge.timing.bus_model import BusModel, Traffic
from echelon.bridge.timing.ideal_bus import IdealBus
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan


def make_buses(plan: Plan, part: int = 0) -> list[ArbitratedBus | IdealBus]:
    """Returns the models of all buses.

    Where several processes model the same buses, each process has its own number `part`, so that it draws its own errors."""
    can, count = plan.can, len(plan.can.buses)
    if can.timing == "ideal":
        return [IdealBus() for _ in range(count)]
    return [
        ArbitratedBus(bus.bitrate, plan.seed, part * count + number, capacity=can.queue, restart_ns=can.restart_ns)
        for number, bus in enumerate(can.buses)
    ]


def bus_report(plan: Plan, number: int, model: BusModel, bounds_ns: Mapping[int, int | None]) -> BusReport:
    """Returns the report of bus `number`; `bounds_ns` are the worst-case response times of its cyclic frames."""
    bus, traffic = plan.can.buses[number], dict(sorted(model.traffic.items()))
    names = {place.node: _name(plan, place) for place in drive_places(plan)} | {BRIDGE_NODE: "bridge"}
    return BusReport(
        name=bus.name,
        bitrate=bus.bitrate,
        load=model.load,
        lost=sum(row.lost for row in traffic.values()),
        destroyed=sum(row.retransmitted for row in traffic.values()),
        events=tuple(
            BusEvent(event.time_ns / 1e9, event.node, names[event.node], event.kind.value)
            for event in model.events[:EVENTS]
        ),
        identifiers={f"{can_id:03X}": _identifier(row, bounds_ns.get(can_id)) for can_id, row in traffic.items()},
    )


def _name(plan: Plan, place: DrivePlace) -> str:
    robot = plan.robots[place.robot].name
    return robot if len(place.wheels) == 2 else f"{robot} {WHEELS[place.wheels[0]]}"


def scheduled(plan: Plan) -> tuple[ScheduledEvent, ...]:
    """Returns the events of the plan in words."""
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
            ScheduledEvent(
                event.at_ns / 1e9,
                None if event.until_ns == NEVER_NS else event.until_ns / 1e9,
                " ".join(filter(None, what)),
                tuple(whom),
            )
        )
    return tuple(rows)


def lost_report(plan: Plan, number: int, lost: Mapping[int, int]) -> BusReport:
    """Returns a report that holds only losses: frames that were lost before they came to a bus, counted by identifier."""
    identifiers = {f"{can_id:03X}": _identifier(Traffic(lost=count), None) for can_id, count in lost.items()}
    bus = plan.can.buses[number]
    return BusReport(bus.name, bus.bitrate, 0.0, lost=sum(lost.values()), identifiers=identifiers)


def _identifier(row: Traffic, bound_ns: int | None) -> IdentifierReport:
    return IdentifierReport(
        frames=row.delivered,
        lost=row.lost,
        destroyed=row.retransmitted,
        latency_mean=row.latency_mean_ns / 1e9,
        latency_max=row.latency_max_ns / 1e9,
        latency_bound=None if bound_ns is None else bound_ns / 1e9,
    )
