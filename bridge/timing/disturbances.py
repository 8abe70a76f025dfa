"""What disturbs buses on schedule: error frames, and controllers that go bus-off."""

from collections.abc import Sequence

from echelon.bridge.frame_message import BRIDGE_NODE
from echelon.bridge.protocols.registry import drive_places
from echelon.bridge.timing.bus_model import BusModel
from echelon.bridge.timing.schedule import Schedule
from echelon.plan.can_plan import DISTURBANCES, NEVER_NS
from echelon.plan.plan import Plan


class Disturbances:
    """The scenario's events of these kinds, for models of the plan's buses; of the bridge's and the drives' controllers,
    only those that the models have."""

    def __init__(self, plan: Plan, buses: Sequence[BusModel], *, bridge: bool = True, drives: bool = True) -> None:
        self._buses = buses
        self._schedule = Schedule(event for event in plan.events if event.kind in DISTURBANCES)
        self._rates = [0.0] * len(buses)
        self._bridge = bridge
        self._applied_ns = -NEVER_NS
        self._places = drive_places(plan) if drives else []

    def apply(self, time_ns: int) -> None:
        """Makes happen what is due at an instant, which is that of the models' last call."""
        self._applied_ns = time_ns
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
                    if place.robot in event.robots and place.bus in event.buses:
                        self._buses[place.bus].bus_off(place.node)

    @property
    def due_ns(self) -> int:
        """When something next begins or ends."""
        next_ns = self._schedule.next_ns(self._applied_ns)
        return NEVER_NS if next_ns is None else next_ns
