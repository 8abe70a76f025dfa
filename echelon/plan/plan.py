"""The plan: a scenario as the roles need it, with every default filled in, every wildcard resolved and every instant an
integer of nanoseconds.  Plain frozen data: it is made once (`echelon.planning.plan_maker`) and handed to every
process.  What concerns the CAN bus stands in `echelon.plan.can_plan`.

Members are numbered: robots first, in the order of the tree, then nodes, children before parents; the root is last.
Blocks of the transformed state (theory.md section 2) stand in the order of their nodes, then the centroid.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echelon.errors import UserError
from echelon.messages import Channel
from echelon.plan.can_plan import DISTURBANCES, NEVER_NS, BusRolePlan, CanPlan, DrivePlan, EnvelopePlan, EventPlan
from echelon.plugins import Part

Array = NDArray[np.float64]
COORDINATOR = "coordinator"


class PlanError(UserError):
    """A scenario whose values do not fit together; each line begins with the key."""


@dataclass(frozen=True, slots=True)
class RobotPlan:
    """A robot: its place in the tree and its parameters (theory.md section 1), SI units."""

    index: int
    path: str
    parent: int
    child_number: int
    model: Part[Any]
    """An agents.plant.Plant"""
    mass: float
    inertia: float
    wheel_radius: float
    arm: float
    offset: float
    start: tuple[float, float]
    heading: float
    torque_limit: float
    torque_rate_limit: float
    wheel_speed_limit: float
    period_ns: int
    torque_period_ns: int
    drive: DrivePlan
    envelope: EnvelopePlan

    @property
    def name(self) -> str:
        """What people call it: its path."""
        return self.path

    @property
    def role(self) -> str:
        """`robot`"""
        return "robot"


@dataclass(frozen=True, slots=True)
class ShapePlan:
    """A node's desired shape: `points` are its children's positions, or the shape variables themselves [m]."""

    kind: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class NodePlan:
    """A node of the tree (group leader, or coordinator if it has no parent)."""

    index: int
    path: str
    parent: int | None
    child_number: int
    children: tuple[int, ...]
    weights: tuple[int, ...]
    first_robot: int
    depth: int
    period_ns: int
    shape: ShapePlan

    @property
    def name(self) -> str:
        """What people call it: its path, or `coordinator`."""
        return self.path or COORDINATOR

    @property
    def robots(self) -> int:
        """How many robots stand below it."""
        return sum(self.weights)

    @property
    def role(self) -> str:
        """`leader` or `coordinator`."""
        return "coordinator" if self.parent is None else "leader"


@dataclass(frozen=True, slots=True)
class BlockPlan:
    """A block of the transformed state: the shape of one node (its `node`), or the centroid (`node` None).

    It takes `size` numbers (x and y of each variable) from `offset` on; `layer` is `intra`
    (its children are robots), `middle`, `inter` (the root, over groups) or `centroid`.
    `sigma` [s] is its time scale; `k1`, `k2` are the gains K_fb1, K_fb2 before division by σ² and σ, (size, size).
    """

    name: str
    layer: str
    node: int | None
    offset: int
    size: int
    sigma: float
    k1: Array
    k2: Array


@dataclass(frozen=True, slots=True)
class AvoidancePlan:
    """Collision avoidance: radii r_a < R_s [m], cap of one pair's force [m/s²]; `enabled` False only watches r_a."""

    enabled: bool
    avoidance_radius: float
    sensing_radius: float
    force_limit: float


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """A directed link, applied where it ends: bounds of its delay [ns], i.i.d. loss, how long its messages may be held."""

    source: int
    receiver: int
    channel: Channel
    period_ns: int
    delay_min_ns: int = 0
    delay_max_ns: int = 0
    loss: float = 0.0
    timeout_ns: int = NEVER_NS
    """Age beyond which a message is not used any more (policy `hold_then_stop`); with policy `hold`: never"""
    first_ns: int = 0
    """Instant of message number 0: before the run begins where drives are brought up"""
    size: int | None = None
    """How many values a message has that says something (echelon.plan.layout); None: any number"""

    @property
    def ideal(self) -> bool:
        """True if every message is usable in the tick it was sent in."""
        return self.delay_max_ns == 0 and self.loss == 0.0


@dataclass(frozen=True, slots=True)
class ClaimPlan:
    """What the run is expected to show: from `settled_by` [s] on, every block of `block` (a name or a layer) stays within
    `band` of the error that it starts with, to the end and for `dwell` time scales at least (None: as `HealthPlan` says)."""

    block: str
    settled_by: float
    band: float
    dwell: float | None


@dataclass(frozen=True, slots=True)
class HealthPlan:
    """What every run is checked for, whatever it claims (docs/architecture.md, 6.5)."""

    off: frozenset[str]
    """Names of checks that are left out"""
    dwell: float | None
    """How long an error must stay in its band until the end to be settled, in time scales of its block; None: 3/√k1"""
    floor: float
    """Errors up to this are not judged [m]"""
    growth: float
    """Largest ratio of an error in the last sixth of the run to that in the sixth before"""
    saturation: float
    """Largest share of the time in which a robot's limits act"""
    silence: float
    """Longest time in which a robot says nothing [s]"""
    late: float
    """Largest share of late stages"""


@dataclass(frozen=True, slots=True)
class Plan:
    """A whole run."""

    name: str
    seed: int
    duration_ns: int
    display_period_ns: int
    robots: tuple[RobotPlan, ...]
    nodes: tuple[NodePlan, ...]
    blocks: tuple[BlockPlan, ...]
    law: Part[Any]
    """A controller.laws.Law"""
    coupling: Array
    """K̄ of all blocks, (2N, 2N), zero on the diagonal blocks."""
    lead: float
    """How far ahead the law looks, in periods of its node (controller.laws.linear)."""
    trajectory: Part[Any]
    """Of the centroid: a controller.trajectory.Trajectory"""
    avoidance: AvoidancePlan
    links: tuple[LinkPlan, ...]
    can: CanPlan
    claims: tuple[ClaimPlan, ...]
    health: HealthPlan
    events: tuple[EventPlan, ...] = ()
    bus_roles: tuple[BusRolePlan, ...] = ()
    """The bridge, then the virtual drives if there are any, where the torque path is closed (`can.closed`); otherwise
    empty.  They are numbered after the nodes."""

    @property
    def root(self) -> NodePlan:
        """The coordinator's node."""
        return self.nodes[-1]

    @property
    def coupled(self) -> bool:
        """True if some block acts on another, so that error rates must travel."""
        return bool(self.coupling.any())

    @property
    def formation(self) -> tuple[RobotPlan | NodePlan, ...]:
        """Robots and nodes by index."""
        return (*self.robots, *self.nodes)

    @property
    def all_roles(self) -> tuple[RobotPlan | NodePlan | BusRolePlan, ...]:
        """Robots, nodes, and bridge and drives where the torque path is closed, by index."""
        return (*self.robots, *self.nodes, *self.bus_roles)

    @property
    def bridge(self) -> BusRolePlan | None:
        """The bridge's role; None where the torque path is not closed."""
        return self.bus_roles[0] if self.bus_roles else None

    @property
    def drives(self) -> BusRolePlan | None:
        """The virtual drives' role; None where the drives are real, or the torque path is not closed."""
        return self.bus_roles[1] if len(self.bus_roles) > 1 else None

    def links_into(self, receiver: int) -> tuple[LinkPlan, ...]:
        """The links that end at a member."""
        return tuple(link for link in self.links if link.receiver == receiver)

    def block_of(self, node: int) -> BlockPlan:
        """The shape block of a node."""
        return next(block for block in self.blocks if block.node == node)


def on_wall_clock(plan: Plan) -> Plan:
    """Returns the plan as those have it who are on a bus on a wall clock: the bus takes its own time unless it is paced."""
    if plan.can.paced:
        return plan
    events = tuple(event for event in plan.events if event.kind not in DISTURBANCES)
    return replace(plan, can=replace(plan.can, timing="ideal"), events=events)
