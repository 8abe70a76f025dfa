"""Guarded buses of a plan: what others send with identifiers of the run is counted and reported (bridge.can.guard)."""

from collections.abc import Container, Sequence

from echelon.bridge.can.bus import Bus, Received, open_bus
from echelon.bridge.protocols.registry import run_identifiers
from echelon.bridge.reports import IntrusionReport
from echelon.bridge.stations.waiting import drained
from echelon.plan.plan import Plan


def open_guarded(plan: Plan, urls: Sequence[str]) -> list[Bus]:
    """Opens the buses of a plan.  Raises ValueError for an invalid URL and OSError if a bus cannot be opened."""
    buses: list[Bus] = []
    try:
        for number, url in enumerate(urls):
            buses.append(open_bus(url, run_identifiers(plan, number)))
    except (ValueError, OSError):
        for bus in buses:
            bus.close()
        raise
    return buses


def check_sender(bus: Bus, spoken: Container[int], received: Received) -> None:
    """Counts a frame that another node sent with one of the identifiers `spoken`, which this process sends.

    A remote frame or an empty one asks for a frame, as anybody may."""
    if received.can_id in spoken and received.data:
        bus.guard.count(received.sender, received.can_id)


def look(buses: Sequence[Bus], spoken: Sequence[Container[int]], most: int) -> None:
    """Counts what others have sent with the identifiers that this process sends, `spoken` on each bus; uses none of it.

    It reads up to `most` frames from each bus."""
    for bus, own in zip(buses, spoken, strict=True):
        for received in drained(bus, most):
            check_sender(bus, own, received)
        bus.guard.look_outside()


def intrusions(plan: Plan, buses: Sequence[Bus]) -> tuple[IntrusionReport, ...]:
    """Returns what others sent so far."""
    found = []
    for planned, bus in zip(plan.can.buses, buses, strict=False):  # a run without a bus has none
        bus.guard.look_outside()
        found += [
            IntrusionReport(planned.name, sender, f"{can_id:03X}", frames)
            for sender, can_id, frames in bus.guard.intrusions
        ]
    return tuple(found)
