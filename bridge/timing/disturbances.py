"""The events of a scenario that disturb buses: error frames and bus-off."""

from collections.abc import Sequence

from echelon.bridge.frame_message import BRIDGE_NODE
from echelon.bridge.protocols.registry import drive_places
from echelon.bridge.timing.bus_model import BusModel
from echelon.bridge.timing.schedule import Schedule
from echelon.plan.can_plan import DISTURBANCES, NEVER_NS
from echelon.plan.plan import Plan


class Disturbances:
    """Applies the scenario's error frames and bus-offs to the models of the plan's buses.

    `bridge` and `drives` say whether the models hold the controllers of the bridge and of the drives; others are left alone."""

    def __init__(self, plan: Plan, buses: Sequence[BusModel], *, bridge: bool = True, drives: bool = True) -> None:
        self._buses = buses
        self._schedule = Schedule(event for event in plan.events if event.kind in DISTURBANCES)
        self._rates = [0.0] * len(buses)
        self._bridge = bridge
        self._applied_ns = -NEVER_NS
        self._places = drive_places(plan) if drives else []

    def apply(self, time_ns: int) -> None:
        """Applies the events that begin or end by `time_ns`, which must be the time of the models' last call."""
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
        """When the next event begins or ends [ns]."""
        next_ns = self._schedule.next_ns(self._applied_ns)
        return NEVER_NS if next_ns is None else next_ns
