"""The scenario: what a user writes, as pydantic models.  Every key is known, every value has a range and SI units.

A file is TOML.  Robots inherit in three levels: `[robot]` for all, `robot` of a group (and of the groups around it),
then the robot itself.  Reading, overriding and explaining mistakes is in `echelon.load`; the plan that roles work with
is made in `echelon.planning`; what concerns the CAN bus stands in `echelon.can_tables`.
"""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, SerializationInfo, Tag, field_serializer, model_validator

from echelon.can_tables import Can, DriveTable, EnvelopeTable, Event
from echelon.part_fields import LawName, LawParameters, PlantField, TrajectoryField, written_use
from echelon.values import (
    CouplingGain,
    Finite,
    Flag,
    Fraction,
    Gain,
    Limit,
    Name,
    NonNegative,
    Point,
    Positive,
    Seconds,
    Table,
)
from echelon.values import number_or_table as _number_or_table

ChannelName = Literal["state", "group_state", "reference", "command", "torque", "*"]
BLOCK_NAMES = ("intra", "middle", "inter", "centroid")
"""Names of blocks and layers of blocks, which groups therefore cannot have."""


RESERVED_NAMES = ("coordinator", "bridge", "drives", "recorder", "referee")
"""Names of processes, which robots and groups therefore cannot have."""


class Periods(Table):
    """How often things happen [s]."""

    acceleration: Positive = 0.01
    """Accelerations: every node and robot, unless a group sets a `period` of its own."""
    torque: Positive = 0.01
    """The torque loop inside the robot; divides `acceleration`."""


class RobotTable(Table):
    """A robot, or what all robots of a level have in common (theory.md section 1)."""

    model: PlantField = None
    """Plant: `paper` (the paper's equations), `rigid_body` (its mass at the reference point), or another (echelon.plugins)"""
    mass: Positive | None = None
    """m1 [kg]"""
    inertia: Positive | None = None
    """I [kg m²]; I − m1 d² must be positive"""
    wheel_radius: Positive | None = None
    """r [m]"""
    arm: Positive | None = None
    """R, lever arm of a wheel about the robot's middle: half the track [m]"""
    offset: Finite | None = None
    """d, from the axle to the reference point [m]; not zero"""
    start: Point | None = None
    """Position of the reference point at the start [m]; the robot is at rest"""
    heading: Finite | None = None
    """θ at the start [rad]"""
    torque_limit: Limit | None = None
    """Largest torque of a wheel [N m]"""
    torque_rate_limit: Limit | None = None
    """Largest change of a wheel's torque [N m/s]"""
    wheel_speed_limit: Limit | None = None
    """Wheel speed beyond which the motor gives no torque in the direction of motion [rad/s]"""
    bus: Name | None = None
    """Which of `can.buses` its drives are on; the first one unless given"""
    drive: DriveTable | None = None
    envelope: EnvelopeTable | None = None


class Shape(Table):
    """Desired shape of a node's children: a named one, their `points`, or the shape variables as `vectors` [m]."""

    kind: Literal["triangle", "polygon", "line", "column", "wedge", "points", "vectors"]
    side: Positive | None = None
    spacing: Positive | None = None
    angle: Annotated[float, Field(strict=True, gt=0, lt=180)] = 90.0
    """Between the arms of a wedge [degrees]"""
    rotation: Finite = 0.0
    """Counter-clockwise [degrees]"""
    points: list[Point] | None = None
    vectors: list[Point] | None = None

    @model_validator(mode="after")
    def _complete(self) -> "Shape":
        needs = {"triangle": "side", "polygon": "side", "line": "spacing", "column": "spacing", "wedge": "spacing"}
        needed = needs.get(self.kind, self.kind)
        if getattr(self, needed) is None:
            raise ValueError(f"kind = {self.kind!r} needs the key {needed!r}")
        for other in ("side", "spacing", "points", "vectors"):
            if other != needed and getattr(self, other) is not None:
                raise ValueError(f"kind = {self.kind!r} takes {needed!r}, not {other!r}")
        return self


class Group(Table):
    """A node of the tree: its children are robots, groups, or both; their order is that of the file."""

    shape: Shape | None = None
    """May be left out for a single child"""
    robot: RobotTable = RobotTable()
    """What its robots have in common"""
    robots: dict[Name, RobotTable] = {}
    groups: dict[Name, "Group"] = {}
    period: Positive | None = None
    """Period of this node's accelerations [s], if not `periods.acceleration`; a multiple of its children's"""

    @model_validator(mode="after")
    def _children(self) -> "Group":
        if not self.robots and not self.groups:
            raise ValueError("a group needs robots or groups")
        if twice := sorted(self.robots.keys() & self.groups.keys()):
            raise ValueError(f"{twice[0]!r} names a robot and a group")
        if reserved := sorted((self.robots.keys() | self.groups.keys()) & set(RESERVED_NAMES)):
            raise ValueError(f"{reserved[0]!r} is the name of a process that every run has")
        if taken := sorted(self.groups.keys() & set(BLOCK_NAMES)):
            raise ValueError(f"a group cannot be called {taken[0]!r}: {', '.join(BLOCK_NAMES)} are names of blocks")
        if len(self.robots) + len(self.groups) > 1 and self.shape is None:
            raise ValueError("a group of several children needs a shape")
        return self


class Gains(Table):
    """Gains before division by the time scale: K_1 = k1/σ², K_2 = k2/σ; a number, or a full matrix of the block."""

    block: str = "*"
    """Which blocks: a name (`g1`, `inter`, `centroid`), a layer (`intra`), or `*`"""
    k1: Gain = 1.0
    k2: Gain = 1.0


class Coupling(Table):
    """Velocity coupling K̄ of one pair of blocks: a number for every entry, or the full matrix."""

    block: str = "*"
    onto: str = "*"
    """The block whose error rate acts on `block`"""
    value: CouplingGain


class Law(Table):
    """The control law (theory.md section 3)."""

    use: LawName = Field(default="linear", validate_default=True)
    """`linear`, `integral`, `terminal_sliding` (controller.laws), or another (docs/add-a-law.md)"""
    parameters: LawParameters = Field(default_factory=dict, validate_default=True)
    """Those of the law that `use` names; validated, they are the law itself, a Part"""
    time_scales: Literal["three", "multi"] = "three"
    """`three`: one per layer of the tree; `multi`: one per block, groups settling in their order"""
    epsilon: Annotated[list[Annotated[float, Field(strict=True, gt=0, le=1)]], Field(min_length=1)] = [0.1, 0.1]
    """ε1, ε2, …: each block's σ is a product of the first ones"""
    gains: list[Gains] = []
    """K_1 and K_2 of each block, for laws that use them; later entries override earlier ones"""
    coupling: list[Coupling] = []
    """Later entries override earlier ones; none means no coupling"""
    lead: Fraction = 0.0
    """How far ahead the law looks, in periods, for laws that do: 0 is the law as it stands, 0.5 makes up for the hold"""

    @field_serializer("use")
    def _use(self, use: str, info: SerializationInfo) -> str:
        return written_use(self.parameters, info)


class Avoidance(Table):
    """Collision avoidance (theory.md section 4)."""

    enabled: Flag = False
    """False: robots do not avoid each other, but distances below `avoidance_radius` are still violations"""
    avoidance_radius: Positive = 0.25
    """r_a [m]"""
    sensing_radius: Positive = 1.0
    """R_s [m]"""
    force_limit: Positive = 1e4
    """Cap of one pair's ∇f [m/s²], also inside r_a, where the potential is not defined"""

    @model_validator(mode="after")
    def _radii(self) -> "Avoidance":
        if self.sensing_radius <= self.avoidance_radius:
            raise ValueError(
                f"sensing_radius = {self.sensing_radius} must be larger than avoidance_radius = {self.avoidance_radius}"
            )
        return self


class Uniform(Table):
    """Any delay between two bounds [s], equally likely."""

    min: NonNegative
    max: NonNegative

    @model_validator(mode="after")
    def _bounds(self) -> "Uniform":
        if self.max < self.min:
            raise ValueError(f"max = {self.max} must be at least min = {self.min}")
        return self


Delay = Annotated[
    Annotated[NonNegative, Tag("a number")] | Annotated[Uniform, Tag("a table")], Discriminator(_number_or_table)
]


class LinkRule(Table):
    """What links are like.  `source` and `receiver` are paths in the tree or `coordinator`; `*` stands for one chunk of
    a path, `**` for any.  The last rule that fits a link holds, and only that one."""

    source: str = "**"
    receiver: str = "**"
    channel: ChannelName = "*"
    delay: Delay = 0.0
    """[s]"""
    loss: Fraction = 0.0
    """Probability that a message is lost, independent of all others"""
    policy: Literal["hold", "hold_then_stop"] | None = None
    """What a receiver uses if nothing newer has come: the last that came, for ever or until it is older than `timeout`.
    Unless given: `hold` where torque is mirrored, `hold_then_stop` where the torque path is closed"""
    timeout: Seconds | None = None
    """For `hold_then_stop` [s]; `can.watchdog` unless given"""


class Record(Table):
    """The recording."""

    display_period: Positive = 0.02
    """Between transforms, markers, odometry and joint states [s of run time], at least the period of accelerations;
    states themselves are all recorded"""


class Claim(Table):
    """What the run is expected to show; the verdict fails if it does not."""

    block: str
    settled_by: Positive
    """[s]"""
    band: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.05
    """Settled means: stays within this fraction of the block's largest error"""


class Scenario(Table):
    """A whole scenario."""

    name: Name
    description: str = ""
    duration: Positive
    """[s of run time]"""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**63)] = 1
    periods: Periods = Periods()
    robot: RobotTable = RobotTable()
    """What all robots have in common"""
    formation: Group
    """The root of the tree"""
    trajectory: TrajectoryField
    """Of the centroid: `line`, `circle`, `sine` or `waypoints` with their parameters (controller.trajectory), or another"""
    law: Law = Field(default_factory=dict, validate_default=True)
    avoidance: Avoidance = Avoidance()
    links: list[LinkRule] = []
    can: Can = Can()
    record: Record = Record()
    claims: list[Claim] = []
    events: list[Event] = []
    """What happens on schedule, in run time"""
