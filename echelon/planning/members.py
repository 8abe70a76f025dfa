"""The members of a plan: walks the scenario's tree, gives robots their inherited values, and numbers robots and nodes."""

from dataclasses import dataclass, replace
from decimal import Decimal
from math import isfinite, radians
from pathlib import Path
from typing import Any, Final, TypeVar

from echelon.errors import Mistakes
from echelon.part_groups import Registry
from echelon.plan.can_plan import CanPlan
from echelon.plan.delay_tables import TRUE_CLOCK, ClockPlan
from echelon.plan.plan import NodePlan, PlanError, RobotPlan, ShapePlan
from echelon.planning import shapes
from echelon.planning.drives import DriveMaker, make_can
from echelon.plugins import Part
from echelon.scenario.can_tables import DriveTable
from echelon.scenario.link_tables import Clock
from echelon.scenario.tables import EVENT_DRIVEN, Group, RobotTable, Scenario, Shape, Timing
from echelon.scenario.values import Table

ROBOT_DEFAULTS: Final[dict[str, Any]] = {
    "heading": 0.0,
    "torque_limit": float("inf"),
    "torque_rate_limit": float("inf"),
    "wheel_speed_limit": float("inf"),
}
DEFAULT_PLANT: Final = "paper"
MAX_ROBOTS: Final = 127
"""Largest number of robots on a bus: it has identifiers for no more if each robot has three of its own."""
MOST_ROBOTS: Final = 1000
"""Largest number of robots without a bus: some matrices of a plan grow with the square of it."""
MAX_NS: Final = 2**62
"""Upper bound of durations [ns], 146 years: the sum of two of them still fits the message header."""


def nanoseconds(seconds: float, key: str) -> int:
    """Returns a duration in nanoseconds.  Raises PlanError if that is not a whole number, up to rounding errors of sums."""
    exact = Decimal(repr(seconds)) * 10**9  # from the written digits: a product of floats would lose some
    if not 1 <= exact < MAX_NS or abs(exact - round(exact)) > Decimal("1e-3"):
        raise PlanError(f"{key} = {seconds}: must be a whole number of nanoseconds, at least 1 and less than {MAX_NS}")
    return round(exact)


def make_members(scenario: Scenario, registry: Registry) -> tuple[tuple[RobotPlan, ...], tuple[NodePlan, ...], CanPlan]:
    """Returns the robots and the nodes in the order of their indices, and the plan of the buses.  Raises PlanError."""
    count = _count_robots(scenario.formation)
    if count > MAX_ROBOTS and scenario.can.enabled:
        raise PlanError(
            f"formation: {count} robots, but a bus has identifiers for {MAX_ROBOTS}; with can.enabled = false there may be "
            f"{MOST_ROBOTS}"
        )
    if count > MOST_ROBOTS:
        raise PlanError(f"formation: {count} robots: must be at most {MOST_ROBOTS}")
    torque_ns = nanoseconds(scenario.periods.torque, "periods.torque")
    can = make_can(scenario.can, torque_ns)
    walk = _Walk(
        acceleration_ns=nanoseconds(scenario.periods.acceleration, "periods.acceleration"),
        torque_ns=torque_ns,
        first_node=count,
        drives=DriveMaker(scenario.can, can, registry.default("protocols")),
        closed=can.closed,
        default_plant=registry.make("plants", DEFAULT_PLANT, {}, Path()),
    )
    walk.add_group(scenario.formation, _Place("formation", "", None, 0, 0), scenario.robot, scenario.timing)
    walk.check()
    return walk.drives.placed(walk.robots) if can.enabled else tuple(walk.robots), tuple(walk.nodes), can


def robot_key(path: str) -> str:
    """Returns the key of a robot in the scenario: `formation.groups.g1.robots.r2` for the path `g1/r2`."""
    *groups, robot = path.split("/")
    return ".".join(["formation", *(f"groups.{group}" for group in groups), "robots", robot])


def _count_robots(group: Group) -> int:
    """Returns the number of robots below a group."""
    return len(group.robots) + sum(_count_robots(sub) for sub in group.groups.values())


def _count_nodes(group: Group) -> int:
    """Returns the number of nodes of a group's subtree, the group included."""
    return 1 + sum(_count_nodes(sub) for sub in group.groups.values())


@dataclass(frozen=True, slots=True)
class _Place:
    """The place of a member in the tree."""

    key: str
    """Its key in the scenario"""
    path: str
    """Its path in the tree"""
    parent: int | None
    """Index of its parent node; None for the root"""
    child_number: int
    """Its number among the children of its parent"""
    depth: int
    """Its depth in the tree; the root has depth 0"""


class _Walk:
    """One walk through the tree.  A robot gets its index when the walk meets it, a node after everything below it.

    Mistakes are collected on the way.  The robots and nodes are valid only if `check` does not raise."""

    def __init__(
        self,
        acceleration_ns: int,
        torque_ns: int,
        first_node: int,
        drives: DriveMaker,
        closed: bool,
        default_plant: Part[Any],
    ) -> None:
        self._acceleration_ns, self._torque_ns, self._first_node = acceleration_ns, torque_ns, first_node
        self.drives, self._closed, self._default_plant = drives, closed, default_plant
        self._mistakes = Mistakes()
        self._robot_mistakes: dict[str, list[str]] = {}  # text of a mistake after the robot's key: keys of the robots
        self.robots: list[RobotPlan] = []
        self.nodes: list[NodePlan] = []

    def check(self) -> None:
        """Raises PlanError if there were mistakes.  A mistake that several robots share is reported for the first of them."""
        for text, keys in self._robot_mistakes.items():
            same = f"; the same holds for {len(keys) - 1} more" if len(keys) > 1 else ""
            self._mistakes.lines.append(f"{keys[0]}{text}{same}")
        self._mistakes.check(PlanError)

    def add_group(self, group: Group, place: _Place, inherited: RobotTable, timing: Timing) -> NodePlan:
        """Adds a group and everything below it; returns its node.  `inherited` and `timing` are of the groups around it."""
        index = self._first_node + len(self.nodes) + _count_nodes(group) - 1
        first_robot = len(self.robots)
        timing = group.timing or timing
        inherited = _overlaid(inherited, group.robot)
        period_key = "periods.acceleration" if group.period is None else f"{place.key}.period"
        period_ns = self._acceleration_ns if group.period is None else 0
        with self._mistakes.noted():
            if group.period is not None:
                period_ns = nanoseconds(group.period, period_key)
            if period_ns % self._torque_ns:
                raise PlanError(
                    f"periods.torque = {self._torque_ns / 1e9}: must divide {period_key} = {period_ns / 1e9}"
                )
        below = _Place(place.key, f"{place.path}/" if place.path else "", index, 0, place.depth + 1)
        children: list[int] = []
        weights: list[int] = []
        for name, table in group.robots.items():
            at = replace(below, key=f"{place.key}.robots.{name}", path=below.path + name, child_number=len(children))
            children.append(len(self.robots))
            weights.append(1)
            try:
                self.robots.append(self._robot(_overlaid(inherited, table), at, period_ns, timing))
            except PlanError as error:
                for line in error.lines:
                    self._robot_mistakes.setdefault(line.removeprefix(at.key), []).append(at.key)
        for name, sub in group.groups.items():
            at = replace(below, key=f"{place.key}.groups.{name}", path=below.path + name, child_number=len(children))
            child = self.add_group(sub, at, inherited, timing)
            children.append(child.index)
            weights.append(child.robots)
            with self._mistakes.noted():
                if child.period_ns and period_ns % child.period_ns:
                    raise PlanError(
                        f"{period_key} = {period_ns / 1e9}: must be a multiple of {child.period_ns / 1e9}, "
                        f"the period of {child.name}"
                    )
        shape = ShapePlan("points", ())
        with self._mistakes.noted():
            shape = _shape(group.shape, len(children), f"{place.key}.shape")
        node = NodePlan(
            index=index,
            path=place.path,
            parent=place.parent,
            child_number=place.child_number,
            children=tuple(children),
            weights=tuple(weights),
            first_robot=first_robot,
            depth=place.depth,
            period_ns=period_ns,
            shape=shape,
            event_driven=timing == EVENT_DRIVEN,
            clock=_clock(group.clock),
        )
        self.nodes.append(node)
        return node

    def _robot(self, table: RobotTable, place: _Place, period_ns: int, timing: Timing) -> RobotPlan:
        """Returns a robot from its table, inherited values included: all that a robot needs (`planning.missing_keys`).

        Raises PlanError."""
        values = ROBOT_DEFAULTS | table.model_dump(exclude_none=True, exclude={"model", "drive", "clock", "timing"})
        if values["offset"] == 0:
            raise PlanError(f"{place.key}.offset = 0: must not be zero, or the wheels cannot steer the reference point")
        least = values["mass"] * values["offset"] * values["offset"]
        if values["inertia"] <= least:
            raise PlanError(
                f"{place.key}.inertia = {values['inertia']}: must be larger than mass·offset² = {least:.6g}"
            )
        assert place.parent is not None
        index = len(self.robots)
        cycle_ns = self._torque_ns if self._closed else period_ns
        return RobotPlan(
            index=index,
            envelope=self.drives.envelope(values),
            drive=self.drives.drive(table.drive or DriveTable(), values, place.key, index, place.path, cycle_ns),
            path=place.path,
            parent=place.parent,
            child_number=place.child_number,
            period_ns=period_ns,
            torque_period_ns=self._torque_ns,
            model=table.model or self._default_plant,
            event_driven=(table.timing or timing) == EVENT_DRIVEN,
            clock=_clock(table.clock),
            **values,
        )


def _clock(table: Clock | None) -> ClockPlan:
    """Returns the clock of a process."""
    return TRUE_CLOCK if table is None else ClockPlan(round((table.offset or 0.0) * 1e9), table.drift or 0.0)


_T = TypeVar("_T", bound=Table)


def _overlaid(table: _T, over: _T) -> _T:
    """Returns a table in which the keys that `over` gives replace those of `table`; inner tables are merged in the same way."""
    merged = {}
    for key in type(table).model_fields:
        below, above = getattr(table, key), getattr(over, key)
        if isinstance(below, Table) and isinstance(above, Table):
            merged[key] = _overlaid(below, above)
        else:
            merged[key] = below if above is None else above
    return table.model_copy(update=merged)


def _shape(shape: Shape | None, count: int, key: str) -> ShapePlan:
    """Returns the desired shape of a node with `count` children.  Raises PlanError."""
    if shape is None:
        return ShapePlan("points", ((0.0, 0.0),))
    points, kind, needed = _points(shape, count), "points", count
    if shape.kind == "vectors":
        kind, needed = "vectors", count - 1
    if len(points) != needed:
        what = f"{shape.kind}: " if shape.kind in ("points", "vectors") else f"kind = {shape.kind!r}: "
        noun = "vector" if kind == "vectors" else "place"
        gives = f"{len(points)} {noun}{'' if len(points) == 1 else 's'}"
        raise PlanError(f"{key}.{what}gives {gives}; a group of {count} needs {needed}")
    turned = tuple(shapes.rotated(points, shape.rotation))
    if not all(isfinite(number) for point in turned for number in point):
        raise PlanError(f"{key}: too large to be computed with")
    return ShapePlan(kind, turned)


def _points(shape: Shape, count: int) -> list[shapes.Point]:
    """Returns the children's positions of a shape, or its shape variables for `vectors` [m]; neither is turned yet."""
    side, spacing = shape.side or 0.0, shape.spacing or 0.0
    match shape.kind:
        case "triangle":
            return shapes.triangle(side)
        case "polygon":
            return shapes.polygon(count, side)
        case "line":
            return shapes.line(count, spacing)
        case "column":
            return shapes.column(count, spacing)
        case "wedge":
            return shapes.wedge(count, spacing, radians(shape.angle))
        case "vectors":
            return shape.vectors or []
        case "points":
            return shape.points or []
