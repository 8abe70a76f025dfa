"""From the tables of a scenario to the plan's drives, envelopes, buses and events, with all checks.

All functions raise PlanError with the key, the value and what is allowed.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import ceil, inf
from typing import Any, Final

from echelon.plan.can_plan import NEVER_NS, BusPlan, CanPlan, DrivePlan, EnvelopePlan, EventPlan, MotorPlan
from echelon.plan.plan import PlanError, RobotPlan
from echelon.planning.node_ids import Place, ask, choose_nodes
from echelon.plugins import Part
from echelon.scenario.can_tables import BusOff, Can, CanEvent, DriveFault, DriveTable, EnvelopeTable, ErrorFrames, Estop
from echelon.scenario.values import path_matches

RAW_MAX: Final = 32767
"""Largest torque in a frame that holds torques as whole numbers of 16 bits."""
MOTOR_DEFAULTS: Final[dict[str, Any]] = {
    "torque_slew": inf,
    "lag": 0.0,
    "torque_constant": 0.1,
    "resistance": 0.0,
    "thermal_resistance": 2.0,
    "thermal_time": 60.0,
    "ambient": 25.0,
    "derating_from": 80.0,
    "temperature_limit": 100.0,
    "supply_voltage": 24.0,
    "supply_resistance": 0.0,
    "brown_out": 18.0,
    "encoder_counts": 4096,
    "inertia": 0.01,
    "friction": 0.01,
}
"""An ideal motor: its torque follows at once, and it never gets warm."""
FIRST_BUS: Final = "can0"
"""Name of the bus, also in can.log, if the scenario names none"""


def make_can(can: Can, cycle_ns: int) -> CanPlan:
    """Returns the plan of the buses; `cycle_ns` is the period of torque frames [ns].  Raises PlanError."""
    buses = [BusPlan(name, bus.url or can.url, bus.bitrate or can.bitrate) for name, bus in can.buses.items()] or [
        BusPlan(FIRST_BUS, can.url, can.bitrate)
    ]
    if not can.virtual_drives and can.path != "closed":
        raise PlanError("can.virtual_drives = false: needs can.path = 'closed'")
    if can.timing is not None and can.path != "closed":
        raise PlanError(f"can.timing = {can.timing!r}: needs can.path = 'closed'")
    if not can.virtual_drives and can.timing is not None:
        raise PlanError(
            f"can.timing = {can.timing!r}: not with can.virtual_drives = false; real buses take their own time"
        )
    if can.path == "closed" and can.watchdog * 1e9 < 2 * cycle_ns:
        raise PlanError(f"can.watchdog = {can.watchdog}: must be at least two torque periods, {2 * cycle_ns / 1e9} s")
    urls = [bus.url for bus in buses if bus.url not in ("auto", "virtual")]
    if twice := [url for url in urls if urls.count(url) > 1]:
        raise PlanError(f"can.buses: {twice[0]!r} is the url of more than one; each needs its own")
    return CanPlan(
        enabled=can.enabled,
        buses=tuple(buses),
        torque_scale=can.torque_scale,
        path=can.path,
        timing=can.timing or "bits",
        paced=can.timing == "bits",
        virtual_drives=can.virtual_drives,
        watchdog_ns=round(can.watchdog * 1e9),
        bring_up_ns=ceil(round(can.bring_up * 1e9) / cycle_ns) * cycle_ns,
        queue=can.queue,
        restart_ns=round(can.restart * 1e9),
    )


class DriveMaker:
    """Makes the drives of all robots: first `drive` for each robot, then `placed`, which chooses the node ids.

    `default` is the protocol of drives for which the scenario names none."""

    def __init__(self, can: Can, plan: CanPlan, default: Part[Any]) -> None:
        self._can, self._plan, self._default = can, plan, default
        self._places: list[Place] = []

    def drive(
        self, table: DriveTable, values: dict[str, Any], key: str, robot: int, path: str, period_ns: int
    ) -> DrivePlan:
        """Returns the drives of a robot, still without their node ids.

        `values` are the robot's values, inherited ones included; `bus` is removed from them.  Raises PlanError."""
        bus, protocol = self._bus(values.pop("bus", None), key), table.protocol or self._default
        self._places.append(Place(f"{key}.drive", path, robot, bus, protocol, table.node_ids))
        given = table.model_dump(exclude_none=True, exclude={"protocol", "node_ids", "recover_after"})
        most = min(values["torque_limit"], RAW_MAX * self._can.torque_scale)
        motor = MOTOR_DEFAULTS | {"torque_limit": most, "rated_torque": most} | given
        if motor["derating_from"] >= motor["temperature_limit"]:
            raise PlanError(
                f"{key}.drive.derating_from = {motor['derating_from']}: must be less than temperature_limit = "
                f"{motor['temperature_limit']}"
            )
        motor_plan = MotorPlan(**motor)
        if text := ask(protocol, f"{key}.drive", "refuses", motor_plan):
            raise PlanError(f"{key}.drive.{text}")
        return DrivePlan(
            protocol=protocol,
            bus=bus,
            node_ids=(robot, robot),
            period_ns=period_ns,
            watchdog_ns=self._plan.watchdog_ns,
            torque_scale=self._can.torque_scale,
            recover_ns=None if table.recover_after is None else round(table.recover_after * 1e9),
            motor=motor_plan,
        )

    def placed(self, robots: Sequence[RobotPlan]) -> tuple[RobotPlan, ...]:
        """Returns the robots with the node ids of their drives.  Raises PlanError if there are not enough free ones."""
        nodes = choose_nodes(self._places)
        return tuple(replace(robot, drive=replace(robot.drive, node_ids=nodes[robot.index])) for robot in robots)

    def envelope(self, values: dict[str, Any]) -> EnvelopePlan:
        """Returns the envelope of a robot.

        `values` are the robot's values, inherited ones included; `envelope` is removed from them."""
        table = EnvelopeTable(**values.pop("envelope", None) or {})
        return EnvelopePlan(
            torque_limit=values["torque_limit"] if table.torque_limit is None else table.torque_limit,
            rise_limit=inf if table.rise_limit is None else table.rise_limit,
            fall_limit=inf if table.fall_limit is None else table.fall_limit,
            window_limit=inf if table.window_limit is None else table.window_limit,
            stale_ns=self._plan.watchdog_ns if table.stale_after is None else round(table.stale_after * 1e9),
        )

    def _bus(self, name: str | None, key: str) -> int:
        """Returns the number of a robot's bus, the first one if it names none.  Raises PlanError."""
        names = [bus.name for bus in self._plan.buses]
        if name is None:
            return 0
        if name not in names:
            raise PlanError(f"{key}.bus = {name!r}: must be one of {', '.join(map(repr, names))}")
        return names.index(name)


def make_events(events: Iterable[object], robots: Sequence[RobotPlan], can: CanPlan) -> tuple[EventPlan, ...]:
    """Returns the events of drives and buses in the order of their instants.  Raises PlanError."""
    plans = []
    for number, event in enumerate(events):
        if not isinstance(event, CanEvent):
            continue
        key = f"events.{number}"
        if not can.closed:
            raise PlanError(f"{key}.kind = {event.kind!r}: needs can.path = 'closed'")
        if event.kind in ("error_frames", "bus_off") and can.timing != "bits":
            raise PlanError(f"{key}.kind = {event.kind!r}: needs can.timing = 'bits'")
        at_ns = round(event.at * 1e9)
        duration = getattr(event, "duration", None)
        until_ns = NEVER_NS if duration is None else at_ns + round(duration * 1e9)
        match event:
            case DriveFault():
                wheels = {"right": (0,), "left": (1,), "both": (0, 1)}[event.wheel]
                hit = _robots(event.robot, robots, key)
                plans.append(EventPlan(event.kind, at_ns, until_ns, hit, wheels, event.fault))
            case Estop():
                plans.append(EventPlan(event.kind, at_ns, until_ns, _robots(event.robot, robots, key)))
            case ErrorFrames():
                buses = _buses(event.bus, can, key)
                plans.append(EventPlan(event.kind, at_ns, until_ns, buses=buses, rate=event.rate))
            case BusOff():
                hit = () if event.robot is None else _robots(event.robot, robots, key)
                plans.append(EventPlan(event.kind, at_ns, until_ns, hit, buses=_buses(event.bus, can, key)))
    return tuple(sorted(plans, key=lambda plan: plan.at_ns))


def _robots(pattern: str, robots: Sequence[RobotPlan], key: str) -> tuple[int, ...]:
    """Returns the indices of the robots whose paths fit a pattern.  Raises PlanError if there are none."""
    found = tuple(robot.index for robot in robots if path_matches(pattern, robot.path))
    if not found:
        raise PlanError(f"{key}.robot = {pattern!r}: fits no robot")
    return found


def _buses(name: str | None, can: CanPlan, key: str) -> tuple[int, ...]:
    """Returns the number of the bus with a name, or the numbers of all buses.  Raises PlanError."""
    names = [bus.name for bus in can.buses]
    if name is None:
        return tuple(range(len(names)))
    if name not in names:
        raise PlanError(f"{key}.bus = {name!r}: must be one of {', '.join(map(repr, names))}")
    return (names.index(name),)
