"""What disturbs buses on schedule: error frames, and controllers that go bus-off."""

from collections.abc import Sequence

from bridge.bus_model import BusModel
from bridge.frame_message import BRIDGE_NODE
from bridge.protocols import drive_places
from bridge.schedule import Schedule
from echelon.plan import Plan

KINDS = ("error_frames", "bus_off")


class Disturbances:
    """The scenario's events of these kinds, for models of the plan's buses; of the bridge's and the drives' controllers,
    only those that the models have."""

    def __init__(self, plan: Plan, buses: Sequence[BusModel], *, bridge: bool = True, drives: bool = True) -> None:
        self._buses = buses
        self._schedule = Schedule(event for event in plan.events if event.kind in KINDS)
        self._rates = [0.0] * len(buses)
        self._bridge = bridge
        self._places = drive_places(plan) if drives else []

    def apply(self, time_ns: int) -> None:
        """Makes happen what is due at an instant, which is that of the models' last call."""
        active, begun = self._schedule.at(time_ns)
        for number, bus in enumerate(self._buses):
            rate = max(
                (event.rate for event in active if event.kind == "error_frames" and number in event.buses), default=0.0
            )
            if rate != self._rates[number]:
                self._rates[number] = rate
                bus.set_error_rate(rate)
        for event in begun:
            if event.kind == "bus_off":
                for number in event.buses if self._bridge and not event.robots else ():
                    self._buses[number].bus_off(BRIDGE_NODE)
                for place in self._places:
                    if place.robot in event.robots:
                        self._buses[place.bus].bus_off(place.node)

    def next_ns(self, time_ns: int) -> int | None:
        """Returns the next instant after `time_ns` at which something begins or ends."""
        return self._schedule.next_ns(time_ns)
