"""Layouts: the place of each part of a message among its values, and the number of values of a message.

The values of a message are one array of float64 (`echelon.messages`).  Its parts follow from the plan and from the sender, so
sender and receiver compute the same layout, once per run.  Parts are slices; a part that the plan does not need is empty.

On the way up the tree, parts of a child's message are copied into the message of its node (`Carried`).  On the way down, a
node takes its own part from the REFERENCE of its parent (`ReferencePart`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS, Channel
from echelon.plan.can_plan import BusRolePlan
from echelon.plan.plan import NodePlan, Plan, RobotPlan

CENTROID: Final = slice(0, len(GROUP_FIELDS))
"""Place of `GROUP_FIELDS` in the GROUP_STATE of a node, and in the STATE of a robot, which begins with the same fields"""
POSITION: Final = slice(0, 2)
"""Place of a robot's position (x, y) in its STATE"""


@dataclass(frozen=True, slots=True)
class GroupStateLayout:
    """The layout of a node's GROUP_STATE.  The root sends none, but keeps the same values in this order."""

    centroid: slice
    """`GROUP_FIELDS`"""
    rates: slice
    """Error rates (x, y): of the blocks below, child by child; then of the node's own shape; then, at the root, of the
    centroid.  So the root has those of all blocks.  Empty if no blocks are coupled"""
    own_rates: slice
    """Error rates of the node's own shape, a part of `rates`"""
    centroid_rates: slice
    """Error rates of the centroid, a part of `rates`; empty but at the root"""
    positions: slice
    """Positions (x, y) of the robots below, in their order; empty if avoidance is off"""
    size: int
    """Number of values"""

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "GroupStateLayout":
        """Returns the layout of a node's GROUP_STATE."""
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
    """A part of a child's message that a node copies into its GROUP_STATE.

    This is a named tuple because all of them are unpacked in every period."""

    child: int
    """Number of the child"""
    there: slice
    """Place in the child's message"""
    here: slice
    """Place in the node's message"""


@dataclass(frozen=True, slots=True)
class ReferenceLayout:
    """The layout of a node's REFERENCE."""

    accelerations: slice
    """Acceleration (x, y) of each child"""
    rates: slice
    """Error rates (x, y) of all blocks of the plan; empty if no blocks are coupled"""
    forces: slice
    """Avoidance force (x, y) on each robot below; empty if avoidance is off"""
    size: int
    """Number of values"""

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "ReferenceLayout":
        """Returns the layout of the REFERENCE that a node sends to its child nodes."""
        blocks = len(plan.robots) if plan.coupled else 0
        robots = node.robots if plan.avoidance.enabled else 0
        accelerations, rates, forces = _in_a_row(2 * len(node.children), 2 * blocks, 2 * robots)
        return cls(accelerations, rates, forces, forces.stop)


@dataclass(frozen=True, slots=True)
class ReferencePart:
    """The parts of a parent's REFERENCE that one child node uses."""

    acceleration: slice
    """Acceleration (x, y) of the child's centroid"""
    rates: slice
    """Error rates of all blocks of the plan"""
    forces: slice
    """Avoidance force (x, y) on each robot below the child"""

    @classmethod
    def of(cls, plan: Plan, parent: NodePlan, node: NodePlan) -> "ReferencePart":
        """Returns the parts for the child `node` of `parent`."""
        whole = ReferenceLayout.of(plan, parent)
        forces = _pairs(whole.forces, node.first_robot - parent.first_robot, node.robots)
        return cls(acceleration_of(node), whole.rates, forces)


@dataclass(frozen=True, slots=True)
class CommandLayout:
    """The layout of a node's COMMAND."""

    accelerations: slice
    """Acceleration (x, y) of each child"""
    size: int
    """Number of values"""

    @classmethod
    def of(cls, node: NodePlan) -> "CommandLayout":
        """Returns the layout of the COMMAND that a node sends to its robots."""
        (accelerations,) = _in_a_row(2 * len(node.children))
        return cls(accelerations, accelerations.stop)


@dataclass(frozen=True, slots=True)
class NodeLayout:
    """All layouts of the messages that a node sends and receives."""

    state: GroupStateLayout
    """Layout of the GROUP_STATE to its parent"""
    carried: tuple[Carried, ...]
    """Parts of its children's messages that it copies into its GROUP_STATE"""
    mine: ReferencePart | None
    """The parts of its parent's REFERENCE that it uses; None for the root"""
    reference: ReferenceLayout | None
    """Layout of the REFERENCE to its child nodes; None if it has none"""
    command: CommandLayout | None
    """Layout of the COMMAND to its robots; None if it has none"""

    @classmethod
    def of(cls, plan: Plan, node: NodePlan) -> "NodeLayout":
        """Returns all layouts of a node."""
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
    """Returns the place of a child's acceleration (x, y) in its parent's COMMAND or REFERENCE."""
    return slice(2 * child.child_number, 2 * child.child_number + 2)


def length(part: slice) -> int:
    """Returns the number of values of a part."""
    return int(part.stop - part.start)


def message_sizes_of(plan: Plan, one: RobotPlan | NodePlan | BusRolePlan) -> dict[Channel, int | None]:
    """Returns the channels on which a role sends, with the number of values of the messages; None if it varies (frames)."""
    if isinstance(one, RobotPlan):
        state: dict[Channel, int | None] = {Channel.STATE: len(STATE_FIELDS)}
        return state | {Channel.TORQUE: len(TORQUE_FIELDS)} if plan.can.closed else state
    if isinstance(one, NodePlan):
        layout = NodeLayout.of(plan, one)
        layouts = {
            Channel.GROUP_STATE: None if one.parent is None else layout.state,
            Channel.REFERENCE: layout.reference,
            Channel.COMMAND: layout.command,
        }
        return {channel: each.size for channel, each in layouts.items() if each is not None}
    frames: dict[Channel, int | None] = {Channel.FRAMES: None}
    return frames | {Channel.WHEELS: 2 * len(plan.robots)} if one.role == "bridge" else frames


def message_sizes(plan: Plan) -> dict[tuple[int, Channel], int | None]:
    """Returns the number of values of all messages of a run, by source and channel; None if it varies.

    Where torque is mirrored, the bridge is not a role of the plan.  It sends frames with the index after that of the last
    node."""
    found = {
        (one.index, channel): size for one in plan.all_roles for channel, size in message_sizes_of(plan, one).items()
    }
    if not plan.can.closed:
        found[len(plan.formation), Channel.FRAMES] = None
    return found


def with_message_sizes(plan: Plan) -> Plan:
    """Returns a plan in which each link has the number of values of its messages (`LinkPlan.size`)."""
    sizes = message_sizes(plan)
    return replace(plan, links=tuple(replace(link, size=sizes[link.source, link.channel]) for link in plan.links))


def _carried(plan: Plan, node: NodePlan) -> Iterator[Carried]:
    """Yields the parts that a node copies from each child: the error rates of the blocks and the positions of the robots below
    the child."""
    own = GroupStateLayout.of(plan, node)
    blocks = robots = 0  # how many there are below the children before this one
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
    """Yields adjacent parts of these lengths, the first from 0 on."""
    start = 0
    for each in lengths:
        yield slice(start, start + each)
        start += each


def _pairs(part: slice, first: int, count: int) -> slice:
    """Returns the place of `count` pairs (x, y) of a part, from pair number `first` on; an empty part stays empty."""
    return slice(part.start + 2 * first, part.start + 2 * (first + count)) if length(part) else part
