"""Layouts: where each part of a message stands among its values, and how many values a message has.

A message is one run of float64 (`echelon.messages`).  How it is divided follows from the plan and from who says it: whoever
writes it and whoever reads it compute the same layout, once.  Parts are slices; a part that the plan does without is empty.

On the way up, what a child says of the blocks and robots below it becomes a part of what its node says (`Carried`).  On the
way down, a child node finds a part of its own in its parent's REFERENCE (`ReferencePart`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS, Channel
from echelon.plan.can_plan import BusRolePlan
from echelon.plan.plan import NodePlan, Plan, RobotPlan

CENTROID: Final = slice(0, len(GROUP_FIELDS))
"""`GROUP_FIELDS` of a child: in the GROUP_STATE of a node, and in the STATE of a robot, which begins with the same fields"""
POSITION: Final = slice(0, 2)
"""Position (x, y) of a robot in its STATE"""


@dataclass(frozen=True, slots=True)
class GroupStateLayout:
    """GROUP_STATE of a node; of the root, which has no parent to say it to, what it knows in the same order."""

    centroid: slice
    """`GROUP_FIELDS`"""
    rates: slice
    """Error rates (x, y) of the blocks below, child by child, then of the node's own shape, then, at the root, of the
    centroid, so that the root has those of all blocks; only where blocks are coupled"""
    own_rates: slice
    """Those of the node's own shape"""
    centroid_rates: slice
    """Those of the centroid; only at the root"""
    positions: slice
    """Positions (x, y) of the robots below, in their order; only where robots avoid each other"""
    size: int
    """How many values there are"""

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "GroupStateLayout":
        """Returns the layout of a node."""
        below, own, root = node.robots - len(node.children), len(node.children) - 1, int(node.parent is None)
        if not plan.coupled:
            below = own = root = 0
        robots = node.robots if plan.avoidance.enabled else 0
        centroid, of_below, of_own, of_centroid, positions = _in_a_row(
            len(GROUP_FIELDS), 2 * below, 2 * own, 2 * root, 2 * robots
        )
        rates = slice(of_below.start, of_centroid.stop)
        return cls(centroid, rates, of_own, of_centroid, positions, positions.stop)


class Carried(NamedTuple):
    """A part of what a child says that becomes a part of its node's GROUP_STATE.

    A named tuple, for all of them are taken apart in every period."""

    child: int
    """Number of the child"""
    said: slice
    """The part in the child's message"""
    here: slice
    """The part in the node's"""


@dataclass(frozen=True, slots=True)
class ReferenceLayout:
    """REFERENCE of a node."""

    accelerations: slice
    """Acceleration (x, y) of each child"""
    rates: slice
    """Error rates (x, y) of all blocks of the plan; only where blocks are coupled"""
    forces: slice
    """Avoidance force (x, y) on each robot below; only where robots avoid each other"""
    size: int
    """How many values there are"""

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "ReferenceLayout":
        """Returns the layout of what a node says to those of its children that are nodes."""
        blocks = len(plan.robots) if plan.coupled else 0
        robots = node.robots if plan.avoidance.enabled else 0
        accelerations, rates, forces = _in_a_row(2 * len(node.children), 2 * blocks, 2 * robots)
        return cls(accelerations, rates, forces, forces.stop)


@dataclass(frozen=True, slots=True)
class ReferencePart:
    """What a node finds for itself in its parent's REFERENCE."""

    acceleration: slice
    """Of its centroid (x, y)"""
    rates: slice
    """Of all blocks of the plan"""
    forces: slice
    """On each robot below it"""

    @classmethod
    def of(cls, plan: Plan, parent: NodePlan, node: NodePlan) -> "ReferencePart":
        """Returns the part of one of a parent's child nodes."""
        whole = ReferenceLayout.of(plan, parent)
        forces = _pairs(whole.forces, node.first_robot - parent.first_robot, node.robots)
        return cls(acceleration_of(node), whole.rates, forces)


@dataclass(frozen=True, slots=True)
class CommandLayout:
    """COMMAND of a node."""

    accelerations: slice
    """Acceleration (x, y) of each child"""
    size: int
    """How many values there are"""

    @classmethod
    def of(cls, node: NodePlan) -> "CommandLayout":
        """Returns the layout of what a node says to those of its children that are robots."""
        (accelerations,) = _in_a_row(2 * len(node.children))
        return cls(accelerations, accelerations.stop)


@dataclass(frozen=True, slots=True)
class NodeLayout:
    """All layouts that a node needs."""

    state: GroupStateLayout
    """Of what it says to its parent"""
    carried: tuple[Carried, ...]
    """What it takes over into that from its children"""
    mine: ReferencePart | None
    """What it finds for itself in its parent's REFERENCE; None for the root"""
    reference: ReferenceLayout | None
    """Of what it says to its child nodes; None if it has none"""
    command: CommandLayout | None
    """Of what it says to its robots; None if it has none"""

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "NodeLayout":
        """Returns the layouts of a node."""
        parent = None if node.parent is None else _node(plan, node.parent)
        kinds = {child >= len(plan.robots) for child in node.children}
        return cls(
            GroupStateLayout.of(plan, node),
            tuple(_carried(plan, node)),
            None if parent is None else ReferencePart.of(plan, parent, node),
            ReferenceLayout.of(plan, node) if True in kinds else None,
            CommandLayout.of(node) if False in kinds else None,
        )


def acceleration_of(child: RobotPlan | NodePlan) -> slice:
    """Returns where a child finds its acceleration (x, y) in its parent's COMMAND or REFERENCE."""
    return slice(2 * child.child_number, 2 * child.child_number + 2)


def length(part: slice) -> int:
    """Returns how many values a part has."""
    return int(part.stop - part.start)


def says(plan: Plan, one: RobotPlan | NodePlan | BusRolePlan) -> dict[Channel, int | None]:
    """Returns on which channels a role of a plan says something, and how many values its messages have; None if that varies
    (frames)."""
    if isinstance(one, RobotPlan):
        state: dict[Channel, int | None] = {Channel.STATE: len(STATE_FIELDS)}
        return state | {Channel.TORQUE: len(TORQUE_FIELDS)} if plan.can.closed else state
    if isinstance(one, NodePlan):
        layout = NodeLayout.of(plan, one)
        said = {
            Channel.GROUP_STATE: None if one.parent is None else layout.state,
            Channel.REFERENCE: layout.reference,
            Channel.COMMAND: layout.command,
        }
        return {channel: each.size for channel, each in said.items() if each is not None}
    frames: dict[Channel, int | None] = {Channel.FRAMES: None}
    return frames | {Channel.WHEELS: 2 * len(plan.robots)} if one.role == "bridge" else frames


def said_by(plan: Plan) -> dict[tuple[int, Channel], int | None]:
    """Returns all that may be said in a run: by source and channel the number of values, None if it varies.

    Where torque is mirrored, the bridge is no role of the plan: it says frames under the number after the last."""
    found = {(one.index, channel): size for one in plan.all_roles for channel, size in says(plan, one).items()}
    if not plan.can.closed:
        found[len(plan.formation), Channel.FRAMES] = None
    return found


def sized(plan: Plan) -> Plan:
    """Returns a plan whose links say how many values their messages have."""
    sizes = said_by(plan)
    return replace(plan, links=tuple(replace(link, size=sizes[link.source, link.channel]) for link in plan.links))


def _carried(plan: Plan, node: NodePlan) -> Iterator[Carried]:
    """Yields what a node takes over from its children: rates of the blocks below each, then the positions of its robots."""
    own = GroupStateLayout.of(plan, node)
    blocks = robots = 0  # below the children before
    for number, (index, weight) in enumerate(zip(node.children, node.weights, strict=True)):
        theirs = None if index < len(plan.robots) else GroupStateLayout.of(plan, _node(plan, index))
        if plan.coupled and theirs is not None:
            yield Carried(number, theirs.rates, _pairs(own.rates, blocks, weight - 1))
        if plan.avoidance.enabled:
            positions = POSITION if theirs is None else theirs.positions
            yield Carried(number, positions, _pairs(own.positions, robots, weight))
        blocks, robots = blocks + weight - 1, robots + weight


def _node(plan: Plan, index: int) -> NodePlan:
    return plan.nodes[index - len(plan.robots)]


def _in_a_row(*lengths: int) -> Iterator[slice]:
    """Yields parts of these lengths, one behind the other."""
    start = 0
    for each in lengths:
        yield slice(start, start + each)
        start += each


def _pairs(part: slice, first: int, count: int) -> slice:
    """Returns `count` of the pairs (x, y) of a part, from number `first` on; nothing of an empty part."""
    return slice(part.start + 2 * first, part.start + 2 * (first + count)) if length(part) else part
