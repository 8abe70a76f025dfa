"""The plan: a scenario as the roles need it, with every default filled in, every wildcard resolved and every instant an
integer of nanoseconds.  Plain frozen data: it is made once (`echelon.planning`) and handed to every process.

Members are numbered: robots first, in the order of the tree, then nodes, children before parents; the root is last.
Blocks of the transformed state (theory.md section 2) stand in the order of their nodes, then the centroid.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echelon.messages import Channel

Array = NDArray[np.float64]
COORDINATOR = "coordinator"
NEVER_NS = 1 << 62
"""Later than any instant of a run."""


class PlanError(Exception):
    """A scenario whose values do not fit together; the text begins with the key."""


@dataclass(frozen=True, slots=True)
class RobotPlan:
    """A robot: its place in the tree and its parameters (theory.md section 1), SI units."""

    index: int
    path: str
    parent: int
    child_number: int
    model: str
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
    drive: "DrivePlan"
    envelope: "EnvelopePlan"

    @property
    def name(self) -> str:
        """What people call it: its path."""
        return self.path

    @property
    def role(self) -> str:
        """`robot`"""
        return "robot"


@dataclass(frozen=True, slots=True)
class MotorPlan:
    """The motor of a wheel and its power stage, SI units, temperatures in °C."""

    torque_limit: float
    """Largest shaft torque [N m]"""
    rated_torque: float
    """Torque it can give for ever [N m]; what CiA 402 counts in thousandths of"""
    torque_slew: float
    """Largest change of the setpoint [N m/s]"""
    lag: float
    """Time constant of the current loop [s]; 0: the torque follows at once"""
    torque_constant: float
    """K_t [N m/A]"""
    resistance: float
    """Of the winding [Ω]: it is heated by resistance · current²"""
    thermal_resistance: float
    """Winding to ambient [K/W]"""
    thermal_time: float
    """Time constant of the winding's temperature [s]"""
    ambient: float
    derating_from: float
    """The torque limit falls linearly to zero from here to `temperature_limit`"""
    temperature_limit: float
    """Over-temperature fault from here on"""
    supply_voltage: float
    supply_resistance: float
    """Of battery and cables [Ω]: the bus voltage falls with the current that the motor draws"""
    brown_out: float
    """Under this bus voltage the drive gives up [V]"""
    encoder_counts: int
    """Per revolution of the wheel"""
    inertia: float
    """What the motor turns where no robot does [kg m²]: a wheel on a bench"""
    friction: float
    """The same wheel's friction [N m s/rad]"""


@dataclass(frozen=True, slots=True)
class DrivePlan:
    """The drives of a robot's wheels: their protocol, their place on the bus, their motor (both wheels have the same)."""

    protocol: str
    """`native`, `odrive` or `cia402`"""
    bus: int
    """Which of the plan's buses"""
    node_ids: tuple[int, int]
    """Of the right and the left wheel's drive; the robot's number, twice, for `native`"""
    period_ns: int
    """Between two torque frames, and between two feedback frames"""
    watchdog_ns: int
    """A drive that hears no command for so long stops, and stays stopped"""
    torque_scale: float
    """Of the native frame [N m per bit]"""
    recover_ns: int | None
    """So long after a fault the host clears it and enables the drive anew; None: never"""
    motor: MotorPlan


@dataclass(frozen=True, slots=True)
class EnvelopePlan:
    """What the last gate before the bus lets pass, for each wheel."""

    torque_limit: float
    """[N m]"""
    rise_limit: float
    """Largest growth of a torque's magnitude from frame to frame [N m]"""
    fall_limit: float
    """Largest decrease of a torque's magnitude from frame to frame [N m]"""
    window_limit: float
    """Largest difference between two torques within 250 ms [N m]"""
    stale_ns: int
    """Oldest command that may still become a frame"""


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
class TrajectoryPlan:
    """The desired trajectory of the centroid: a kind and its parameters (controller.trajectory)."""

    kind: str
    parameters: dict[str, Any]


@dataclass(frozen=True, slots=True)
class AvoidancePlan:
    """Collision avoidance: radii r_a < R_s [m], cap of one pair's force [m/s²]; `enabled` False only watches r_a."""

    enabled: bool
    avoidance_radius: float
    sensing_radius: float
    force_limit: float


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """A directed link, applied where it ends: bounds of its delay [ns], i.i.d. loss, policy for a missing input."""

    source: int
    receiver: int
    channel: Channel
    period_ns: int
    delay_min_ns: int = 0
    delay_max_ns: int = 0
    loss: float = 0.0
    policy: str = "hold"
    timeout_ns: int = NEVER_NS
    """Age beyond which a message is not used any more (policy `hold_then_stop`)"""
    first_ns: int = 0
    """Instant of message number 0: before the run begins where drives are brought up"""
    size: int | None = None
    """How many values a message has that says something (echelon.layout); None: any number"""

    @property
    def ideal(self) -> bool:
        """True if every message is usable in the tick it was sent in."""
        return self.delay_max_ns == 0 and self.loss == 0.0


@dataclass(frozen=True, slots=True)
class BusPlan:
    """A CAN bus: its name, where it is, how fast [bit/s]."""

    name: str
    url: str
    bitrate: int


@dataclass(frozen=True, slots=True)
class CanPlan:
    """The buses, and the way of the torques: `mirror` or `closed`, frames taking time as on a real bus (`bits`) or none."""

    enabled: bool
    buses: tuple[BusPlan, ...]
    torque_scale: float
    path: str
    timing: str
    virtual_drives: bool
    watchdog_ns: int
    bring_up_ns: int
    queue: int
    restart_ns: int

    @property
    def closed(self) -> bool:
        """True if the plant takes its torque from the drives."""
        return self.path == "closed"


@dataclass(frozen=True, slots=True)
class EventPlan:
    """Something that happens from `at_ns` until `until_ns`: a kind and what it needs (echelon.can_tables)."""

    kind: str
    at_ns: int
    until_ns: int
    robots: tuple[int, ...] = ()
    wheels: tuple[int, ...] = (0, 1)
    fault: str = ""
    buses: tuple[int, ...] = ()
    rate: float = 0.0


@dataclass(frozen=True, slots=True)
class StationPlan:
    """A process between robots and their wheels, on the closed torque path: the bridge, or the virtual drives."""

    index: int
    role: str
    period_ns: int
    first_ns: int
    """When it begins, before the run: drives are brought up until 0"""

    @property
    def name(self) -> str:
        """What people call it."""
        return self.role

    @property
    def path(self) -> str:
        """Its place among the keys, which no group can have."""
        return f"@{self.role}"


@dataclass(frozen=True, slots=True)
class ClaimPlan:
    """What the run is expected to show: every block of `block` (a name or a layer) stays within `band` of its largest
    error from `settled_by` [s] on."""

    block: str
    settled_by: float
    band: float


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
    coupling: Array
    """K̄ of all blocks, (2N, 2N), zero on the diagonal blocks."""
    lead: float
    """How far ahead the law looks, in periods of its node (controller.law)."""
    trajectory: TrajectoryPlan
    avoidance: AvoidancePlan
    links: tuple[LinkPlan, ...]
    can: CanPlan
    claims: tuple[ClaimPlan, ...]
    events: tuple[EventPlan, ...] = ()
    stations: tuple[StationPlan, ...] = ()
    """Bridge and drives, in this order, where the torque path is closed; numbered after the nodes"""

    @property
    def root(self) -> NodePlan:
        """The coordinator's node."""
        return self.nodes[-1]

    @property
    def coupled(self) -> bool:
        """True if some block acts on another, so that error rates must travel."""
        return bool(self.coupling.any())

    @property
    def members(self) -> tuple[RobotPlan | NodePlan, ...]:
        """Robots and nodes by index."""
        return (*self.robots, *self.nodes)

    @property
    def everyone(self) -> "tuple[RobotPlan | NodePlan | StationPlan, ...]":
        """Robots, nodes and stations by index."""
        return (*self.robots, *self.nodes, *self.stations)

    def links_into(self, receiver: int) -> tuple[LinkPlan, ...]:
        """The links that end at a member."""
        return tuple(link for link in self.links if link.receiver == receiver)

    def block_of(self, node: int) -> BlockPlan:
        """The shape block of a node."""
        return next(block for block in self.blocks if block.node == node)
