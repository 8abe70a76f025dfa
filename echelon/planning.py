"""From a scenario to a plan: inheritance, numbering, time scales, gains, coupling, links.

What a single model cannot see is checked here: periods that divide each other, shapes of the right size, gains of the
right shape, rules that fit nothing.  Raises PlanError with the key, the value and what is allowed.
"""

from math import isqrt, prod
from typing import Any

import numpy as np

from echelon import shapes
from echelon.messages import Channel
from echelon.plan import (
    COORDINATOR,
    Array,
    AvoidancePlan,
    BlockPlan,
    CanPlan,
    ClaimPlan,
    LinkPlan,
    NodePlan,
    Plan,
    RobotPlan,
    ShapePlan,
    TrajectoryPlan,
)
from echelon.scenario import Group, Matrix, RobotTable, Scenario, Shape, Uniform

ROBOT_DEFAULTS: dict[str, Any] = {
    "model": "paper",
    "heading": 0.0,
    "torque_limit": float("inf"),
    "torque_rate_limit": float("inf"),
    "wheel_speed_limit": float("inf"),
}
MAX_ROBOTS = 127
"""As many as the native torque frame has identifiers for."""


class PlanError(Exception):
    """A scenario whose values do not fit together; the text begins with the key."""


def make_plan(scenario: Scenario) -> Plan:
    """Returns the plan of a scenario.  Raises PlanError."""
    acceleration_ns = _nanoseconds(scenario.periods.acceleration, "periods.acceleration")
    torque_ns = _nanoseconds(scenario.periods.torque, "periods.torque")
    duration_ns = _nanoseconds(scenario.duration, "duration")
    tree = _Tree(scenario.robot, acceleration_ns, torque_ns)
    tree.add(scenario.formation, "", "formation", scenario.robot, 0)
    robots, nodes = tree.numbered()
    if duration_ns % nodes[-1].period_ns:
        raise PlanError(f"duration = {scenario.duration}: must be a multiple of {nodes[-1].period_ns / 1e9} s")
    display_ns = _nanoseconds(scenario.record.display_period, "record.display_period")
    blocks = _blocks(scenario, nodes)
    return Plan(
        name=scenario.name,
        seed=scenario.seed,
        duration_ns=duration_ns,
        display_period_ns=max(display_ns, acceleration_ns),
        robots=tuple(robots),
        nodes=tuple(nodes),
        blocks=blocks,
        coupling=_coupling(scenario, blocks),
        lead=scenario.law.lead,
        trajectory=TrajectoryPlan(scenario.trajectory.kind, scenario.trajectory.model_dump(exclude={"kind"})),
        avoidance=AvoidancePlan(**scenario.avoidance.model_dump()),
        links=_links(scenario, robots, nodes),
        can=CanPlan(**scenario.can.model_dump()),
        claims=tuple(
            ClaimPlan(claim.block, claim.settled_by, claim.band)
            for at, claim in enumerate(scenario.claims)
            if _fitting(blocks, claim.block, f"claims.{at}.block")
        ),
    )


def _nanoseconds(seconds: float, key: str) -> int:
    ns = round(seconds * 1e9)
    if ns <= 0 or ns >= 2**62 or abs(ns - seconds * 1e9) > 1e-3:
        raise PlanError(f"{key} = {seconds}: must be a whole number of nanoseconds, at least 1")
    return ns


class _Tree:
    """Walks the scenario's tree and numbers its members."""

    def __init__(self, robot: RobotTable, acceleration_ns: int, torque_ns: int) -> None:
        self.acceleration_ns, self.torque_ns = acceleration_ns, torque_ns
        self.defaults = robot
        self.robots: list[dict[str, Any]] = []
        self.nodes: list[dict[str, Any]] = []

    def add(self, group: Group, path: str, key: str, inherited: RobotTable, depth: int) -> dict[str, Any]:
        """Adds a group and all below it; returns its node."""
        inherited = inherited.model_copy(update=group.robot.model_dump(exclude_unset=True))
        period = _nanoseconds(group.period, f"{key}.period") if group.period else self.acceleration_ns
        node: dict[str, Any] = {"path": path, "depth": depth, "period_ns": period, "first_robot": len(self.robots)}
        children: list[dict[str, Any]] = []
        for name, table in group.robots.items():
            children.append(
                self._add_robot(f"{path}/{name}".lstrip("/"), f"{key}.robots.{name}", inherited, table, period)
            )
        for name, sub in group.groups.items():
            child = self.add(sub, f"{path}/{name}".lstrip("/"), f"{key}.groups.{name}", inherited, depth + 1)
            if period % child["period_ns"]:
                raise PlanError(f"{key}.period = {period / 1e9}: must be a multiple of that of {name!r}")
            children.append(child)
        node["children"] = children
        node["weights"] = tuple(child.get("robots", 1) for child in children)
        node["robots"] = sum(node["weights"])
        node["shape"] = _shape(group.shape, len(children), f"{key}.shape")
        self.nodes.append(node)
        return node

    def _add_robot(
        self, path: str, key: str, inherited: RobotTable, table: RobotTable, period: int
    ) -> dict[str, Any]:
        values = ROBOT_DEFAULTS | inherited.model_dump(exclude_unset=True) | table.model_dump(exclude_unset=True)
        for needed in ("mass", "inertia", "wheel_radius", "arm", "offset", "start"):
            if values.get(needed) is None:
                raise PlanError(f"{key}.{needed}: missing (neither here, nor in its group, nor in [robot])")
        if values["offset"] == 0:
            raise PlanError(f"{key}.offset = 0: must not be zero, or the robot cannot be steered through its wheels")
        if values["inertia"] - values["mass"] * values["offset"] ** 2 <= 0:
            least = values["mass"] * values["offset"] ** 2
            raise PlanError(f"{key}.inertia = {values['inertia']}: must be larger than mass offset² = {least:.6g}")
        if period % self.torque_ns:
            raise PlanError(f"periods.torque = {self.torque_ns / 1e9}: must divide {period / 1e9}, the period of {path}")
        robot = values | {"path": path, "period_ns": period, "torque_period_ns": self.torque_ns}
        self.robots.append(robot)
        if len(self.robots) > MAX_ROBOTS:
            raise PlanError(f"formation: more than {MAX_ROBOTS} robots")
        return robot

    def numbered(self) -> tuple[list[RobotPlan], list[NodePlan]]:
        """Returns robots and nodes with their numbers and those of their parents and children."""
        number = {id(member): at for at, member in enumerate([*self.robots, *self.nodes])}
        place = {
            id(child): (number[id(node)], at) for node in self.nodes for at, child in enumerate(node["children"])
        }
        robots = []
        for robot in self.robots:
            parent, at = place[id(robot)]
            robots.append(RobotPlan(index=number[id(robot)], parent=parent, child_number=at, **robot))
        nodes = []
        for node in self.nodes:
            parent_or_none, at = place.get(id(node), (None, 0))
            values = {key: value for key, value in node.items() if key not in ("children", "robots")}
            children = tuple(number[id(child)] for child in node["children"])
            nodes.append(
                NodePlan(
                    index=number[id(node)], parent=parent_or_none, child_number=at, children=children, **values
                )
            )
        return robots, nodes


def _shape(shape: Shape | None, count: int, key: str) -> ShapePlan:
    if shape is None:
        return ShapePlan("points", ((0.0, 0.0),))
    kind, points = "points", shape.points or []
    side, spacing = shape.side or 0.0, shape.spacing or 0.0
    needed = count
    match shape.kind:
        case "triangle":
            points = shapes.triangle(side)
        case "polygon":
            points = shapes.polygon(count, side)
        case "line":
            points = shapes.line(count, spacing)
        case "column":
            points = shapes.column(count, spacing)
        case "wedge":
            points = shapes.wedge(count, spacing, shape.angle * np.pi / 180)
        case "vectors":
            kind, points, needed = "vectors", shape.vectors or [], count - 1
        case "points":
            pass
    if len(points) != needed:
        raise PlanError(f"{key}: {shape.kind} of {len(points)} does not fit {count} children; it takes {needed}")
    return ShapePlan(kind, tuple(shapes.rotated(points, shape.rotation)))


def _blocks(scenario: Scenario, nodes: list[NodePlan]) -> tuple[BlockPlan, ...]:
    """Numbers the blocks and gives each its time scale σ (theory.md section 3) and its gains."""
    epsilon = scenario.law.epsilon
    levels = max(node.depth for node in nodes) + 1
    needed = levels if scenario.law.time_scales == "three" else len(nodes)
    if len(epsilon) != needed:
        what = "layers of the tree" if scenario.law.time_scales == "three" else "groups, the formation included"
        raise PlanError(f"law.epsilon = {epsilon}: needs {needed} numbers, as many as {what}")
    blocks, offset = [], 0
    for at, node in enumerate(nodes):
        count = node.depth + 1 if scenario.law.time_scales == "three" else len(nodes) - at
        is_root = node.parent is None
        name = ("inter" if len(nodes) > 1 else "intra") if is_root else node.path
        layer = "inter" if any(child >= nodes[0].index for child in node.children) else "intra"
        size = 2 * (len(node.children) - 1)
        blocks.append((name, layer, node.index, offset, size, prod(epsilon[:count])))
        offset += size
    blocks.append(("centroid", "centroid", None, offset, 2, 1.0))
    gains: list[tuple[Array, Array]] = [(np.eye(size), np.eye(size)) for *_, size, _ in blocks]
    for at, rule in enumerate(scenario.law.gains):
        key = f"law.gains.{at}"
        fits = [number for number, block in enumerate(blocks) if rule.block in ("*", block[0], block[1])]
        if not fits:
            raise PlanError(f"{key}.block = {rule.block!r}: fits no block; there are {_names(blocks)}")
        for number in fits:
            size = blocks[number][4]
            gains[number] = (
                _square(rule.k1, size, f"{key}.k1", blocks[number][0]),
                _square(rule.k2, size, f"{key}.k2", blocks[number][0]),
            )
    return tuple(BlockPlan(*block, k1, k2) for block, (k1, k2) in zip(blocks, gains, strict=True))


def _names(blocks: Any) -> str:
    return ", ".join(sorted({getattr(block, "name", None) or block[0] for block in blocks}))


def _square(value: float | Matrix, size: int, key: str, block: str) -> Array:
    if isinstance(value, list):
        return _matrix(value, (size, size), key, block)
    return value * np.eye(size)


def _matrix(rows: Matrix, shape: tuple[int, int], key: str, block: str) -> Array:
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise PlanError(f"{key}: a matrix for {block} must be {shape[0]} rows of {shape[1]} numbers")
    return np.array(rows, dtype=float).reshape(shape)


def _fitting(blocks: tuple[BlockPlan, ...], name: str, key: str) -> list[BlockPlan]:
    fits = [block for block in blocks if name in ("*", block.name, block.layer)]
    if not fits:
        raise PlanError(f"{key} = {name!r}: fits no block; there are {_names(blocks)}, intra, inter, centroid, *")
    return fits


def _coupling(scenario: Scenario, blocks: tuple[BlockPlan, ...]) -> Array:
    size = blocks[-1].offset + blocks[-1].size
    coupling = np.zeros((size, size))
    for at, rule in enumerate(scenario.law.coupling):
        key = f"law.coupling.{at}"
        for block in _fitting(blocks, rule.block, f"{key}.block"):
            for onto in _fitting(blocks, rule.onto, f"{key}.onto"):
                if block is onto:
                    if rule.block == rule.onto == block.name:
                        raise PlanError(f"{key}.onto = {rule.onto!r}: a block is not coupled to itself")
                    continue
                rows = slice(block.offset, block.offset + block.size)
                columns = slice(onto.offset, onto.offset + onto.size)
                if isinstance(rule.value, list):
                    value: float | Array = _matrix(
                        rule.value, (block.size, onto.size), f"{key}.value", f"{block.name} onto {onto.name}"
                    )
                else:
                    value = rule.value
                coupling[rows, columns] = value
    return coupling


def _links(scenario: Scenario, robots: list[RobotPlan], nodes: list[NodePlan]) -> tuple[LinkPlan, ...]:
    """Lists the tree's links, receiver by receiver, and gives each what the last fitting rule says."""
    names = [member.name for member in (*robots, *nodes)]
    links = []
    by_index = {node.index: node for node in nodes}
    for node in nodes:
        for child in node.children:
            up = Channel.GROUP_STATE if child in by_index else Channel.STATE
            down = Channel.REFERENCE if child in by_index else Channel.COMMAND
            links.append((child, node.index, up, node.period_ns))
            links.append((node.index, child, down, node.period_ns))
    used = [False] * len(scenario.links)
    plans = []
    for source, receiver, channel, period_ns in sorted(links, key=lambda link: (link[1], link[2], link[0])):
        plan = LinkPlan(source, receiver, channel, period_ns)
        for at, rule in enumerate(scenario.links):
            if (
                rule.channel in ("*", channel.name.lower())
                and path_matches(rule.source, names[source])
                and path_matches(rule.receiver, names[receiver])
            ):
                used[at] = True
                low, high = (
                    (rule.delay.min, rule.delay.max) if isinstance(rule.delay, Uniform) else (rule.delay, rule.delay)
                )
                if high > 1e6:
                    raise PlanError(f"links.{at}.delay = {high}: must be at most 1e6 s")
                plan = LinkPlan(
                    source, receiver, channel, period_ns, round(low * 1e9), round(high * 1e9), rule.loss, rule.policy
                )
        plans.append(plan)
    for at, rule in enumerate(scenario.links):
        if not used[at]:
            raise PlanError(
                f"links.{at}: no link from {rule.source!r} to {rule.receiver!r} on channel {rule.channel!r}; members "
                f"are {', '.join(names[: isqrt(MAX_ROBOTS)])}{', …' if len(names) > isqrt(MAX_ROBOTS) else ''}"
            )
    return tuple(plans)


def path_matches(pattern: str, path: str) -> bool:
    """True if a path fits a pattern chunk by chunk: `*` stands for one chunk, `**` for any number of them."""
    return _chunks_match(pattern.split("/"), path.split("/"))


def _chunks_match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_chunks_match(pattern[1:], chunks[skip:]) for skip in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _chunks_match(pattern[1:], chunks[1:])


__all__ = ["COORDINATOR", "PlanError", "make_plan", "path_matches"]
