"""The plan: a scenario as roles need it.  Every default is filled in, every wildcard is resolved, and instants are integers of
nanoseconds.  A plan is frozen data, made once (`echelon.planning.plan_maker`) and given to every process.
`echelon.plan.can_plan` has the part that concerns the CAN bus.

Members have an index: first the robots in the order of the tree, then the nodes, children before parents; the root is last.
The blocks of the transformed state (docs/architecture.md, 2.3) are in the order of their nodes; the centroid is last.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echelon.errors import UserError
from echelon.plan.can_plan import DISTURBANCES, BusRolePlan, CanPlan, DrivePlan, EnvelopePlan, EventPlan
from echelon.plan.delay_tables import TRUE_CLOCK, ClockPlan
from echelon.plan.link_plan import LinkPlan
from echelon.plugins import Part

Array = NDArray[np.float64]
COORDINATOR = "coordinator"


class PlanError(UserError):
    """The values of a scenario do not fit together.  Each line begins with the key."""


@dataclass(frozen=True, slots=True)
class RobotPlan:
    """A robot: its place in the tree, its parameters (docs/architecture.md, 2.1) in SI units, and its periods."""

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
    event_driven: bool = True
    """True if it takes an acceleration when it arrives; False if only at the beginning of its period (docs/architecture.md,
    4.6)"""
    clock: ClockPlan = TRUE_CLOCK

    @property
    def name(self) -> str:
        """Its name in texts: its path."""
        return self.path

    @property
    def role(self) -> str:
        """`robot`"""
        return "robot"


@dataclass(frozen=True, slots=True)
class ShapePlan:
    """A node's desired shape.  With the kind `points`, `points` are positions of its children; with the kind `vectors`, they
    are the shape variables [m]."""

    kind: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class NodePlan:
    """A node of the tree: the leader of a group, or the coordinator, which has no parent.

    `weights` are the numbers of robots below each child; `first_robot` is the index of the first robot below the node."""

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
    event_driven: bool = True
    """True if it acts when it has heard something newer; False if only at the beginning of its period (docs/architecture.md,
    4.6)"""
    clock: ClockPlan = TRUE_CLOCK

    @property
    def name(self) -> str:
        """Its name in texts: its path, or `coordinator`."""
        return self.path or COORDINATOR

    @property
    def robots(self) -> int:
        """The number of robots below it."""
        return sum(self.weights)

    @property
    def role(self) -> str:
        """`leader` or `coordinator`."""
        return "coordinator" if self.parent is None else "leader"


@dataclass(frozen=True, slots=True)
class BlockPlan:
    """A block of the transformed state: the shape of the node with index `node`, or the centroid (`node` is None).

    In the transformed state it has `size` numbers (x and y of each variable) from `offset` on.  `layer` is `intra`, `middle`,
    `inter` or `centroid` (docs/architecture.md, 2.3).  `sigma` is its time scale σ [s].  `k1` and `k2` are the gains K_fb1 and
    K_fb2 before division by σ² and σ, (size, size) (docs/architecture.md, 2.4).
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
    """Collision avoidance: the radii r_a < R_s [m] and the largest force of a pair [m/s²] (docs/architecture.md, 2.6).

    If `enabled` is False, robots do not avoid each other, but violations of r_a are still counted."""

    enabled: bool
    avoidance_radius: float
    sensing_radius: float
    force_limit: float


@dataclass(frozen=True, slots=True)
class ClaimPlan:
    """A claim about the errors of the blocks that `block` (a name or a layer) stands for.

    From `settled_by` [s] to the end of the run, each error stays within the fraction `band` of the error at the start.  This
    lasts for at least `dwell` time scales of the block; None: `HealthPlan.dwell`."""

    block: str
    settled_by: float
    band: float
    dwell: float | None


@dataclass(frozen=True, slots=True)
class HealthPlan:
    """Limits of the checks that are made of every run, whatever it claims (docs/architecture.md, 6.5)."""

    off: frozenset[str]
    """Names of checks that are left out"""
    dwell: float | None
    """How long an error must stay in its band before the end to be settled, in time scales of its block; None: 3/√k1"""
    floor: float
    """Errors up to this size are not judged [m]"""
    growth: float
    """Largest ratio of an error in the last sixth of the run to that in the sixth before"""
    saturation: float
    """Largest share of the time in which a robot's limits act"""
    silence: float
    """Longest time in which a robot sends nothing [s]"""
    late: float
    """Largest share of late stages"""


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of a whole run."""

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
    """The coupling K̄ of all blocks, (2N, 2N) for N robots; a block is not coupled to itself"""
    lead: float
    """λ, how far ahead the law looks, in acceleration periods of the node (docs/architecture.md, 2.5)"""
    reference: str
    """`message` or `now`: of which time the reference is that a state is compared with (docs/architecture.md, 2.5)"""
    trajectory: Part[Any]
    """The desired trajectory of the centroid, a controller.trajectory.Trajectory"""
    avoidance: AvoidancePlan
    links: tuple[LinkPlan, ...]
    can: CanPlan
    claims: tuple[ClaimPlan, ...]
    health: HealthPlan
    events: tuple[EventPlan, ...] = ()
    bus_roles: tuple[BusRolePlan, ...] = ()
    """On the closed torque path (`can.closed`) the bridge, then the virtual drives if there are any; otherwise empty.  Their
    indices come after those of the nodes"""
    coupled: bool = field(init=False, repr=False, compare=False)
    """True if a block is coupled to another block, so that messages must carry error rates"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "coupled", bool(self.coupling.any()))

    @property
    def root(self) -> NodePlan:
        """The coordinator's node."""
        return self.nodes[-1]

    @property
    def formation(self) -> tuple[RobotPlan | NodePlan, ...]:
        """Robots and nodes, in the order of their indices."""
        return (*self.robots, *self.nodes)

    @property
    def all_roles(self) -> tuple[RobotPlan | NodePlan | BusRolePlan, ...]:
        """Robots and nodes, and on the closed torque path bridge and virtual drives, in the order of their indices."""
        return (*self.robots, *self.nodes, *self.bus_roles)

    @property
    def bridge(self) -> BusRolePlan | None:
        """The bridge; None if the torque path is not closed."""
        return self.bus_roles[0] if self.bus_roles else None

    @property
    def drives(self) -> BusRolePlan | None:
        """The virtual drives; None if the drives are real, or if the torque path is not closed."""
        return self.bus_roles[1] if len(self.bus_roles) > 1 else None

    def links_into(self, receiver: int) -> tuple[LinkPlan, ...]:
        """Returns the links that end at a member."""
        return tuple(link for link in self.links if link.receiver == receiver)

    def block_of(self, node: int) -> BlockPlan:
        """Returns the block of a node's shape."""
        return next(block for block in self.blocks if block.node == node)


def on_wall_clock(plan: Plan) -> Plan:
    """Returns the plan for roles that use a bus on a wall clock.

    If the bus is not paced, it takes its own time: `timing` becomes `ideal`, and events that disturb a bus are removed."""
    if plan.can.paced:
        return plan
    events = tuple(event for event in plan.events if event.kind not in DISTURBANCES)
    return replace(plan, can=replace(plan.can, timing="ideal"), events=events)
