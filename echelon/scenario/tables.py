"""The scenario: what a user writes, as pydantic models.  Every key is known, every value has a range and SI units.

A file is TOML.  Robots inherit in three levels: `[robot]` for all, `robot` of a group (and of the groups around it),
then the robot itself.  Reading, overriding and explaining mistakes is in `echelon.planning.loading`; the plan that
roles work with is made in `echelon.planning.plan_maker`; what concerns the CAN bus stands in `echelon.scenario.can_tables`.
"""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, SerializationInfo, Tag, field_serializer, model_validator

from echelon.scenario.can_tables import Can, DriveTable, EnvelopeTable, Event
from echelon.scenario.part_fields import (
    LawName,
    LawParameters,
    PlantField,
    TrajectoryField,
    WrittenLawName,
    written_use,
)
from echelon.scenario.values import (
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
    alike,
)
from echelon.scenario.values import number_or_table as _number_or_table

ChannelName = Literal["state", "group_state", "reference", "command", "torque", "*"]
BLOCK_NAMES = ("intra", "middle", "inter", "centroid")
"""Names of blocks and layers of blocks, which groups therefore cannot have."""


RESERVED_NAMES = ("coordinator", "bridge", "drives", "recorder", "referee")
"""Names of processes, which robots and groups therefore cannot have."""


class Periods(Table):
    """How often things happen."""

    acceleration: Positive = 0.01
    """Between two accelerations of every node and robot [s], unless a group has a `period` of its own"""
    torque: Positive = 0.01
    """Between two torques of a robot [s]; divides `acceleration`"""


class RobotTable(Table):
    """A robot, or what all robots of a level have in common.

    Each key is taken from the robot itself, else from its group's `robot`, else from the groups around it, else from
    `[robot]`."""

    model: PlantField = None
    """Plant: `paper` (the paper's equations, the default), `rigid_body` (its mass at the reference point), `hill` (with a load,
    on a slope), or your own"""
    mass: Positive | None = None
    """m1 [kg]; must be given on some level"""
    inertia: Positive | None = None
    """I [kg m²], larger than mass·offset²; must be given on some level"""
    wheel_radius: Positive | None = None
    """r [m]; must be given on some level"""
    arm: Positive | None = None
    """R, lever arm of a wheel about the robot's middle: half the track [m]; must be given on some level"""
    offset: Finite | None = None
    """d, from the axle to the reference point [m]; not zero, and must be given on some level"""
    start: Point | None = None
    """Position of the reference point at the start [m]; must be given.  The robot is at rest"""
    heading: Finite | None = None
    """θ at the start, counter-clockwise from the x axis, in radians [rad]; 0 unless given"""
    torque_limit: Limit | None = None
    """Largest torque of a wheel [N m]; none unless given"""
    torque_rate_limit: Limit | None = None
    """Largest change of a wheel's torque [N m/s]; none unless given"""
    wheel_speed_limit: Limit | None = None
    """Wheel speed beyond which the motor gives no torque in the direction of motion [rad/s]; none unless given"""
    bus: Name | None = None
    """Which of `can.buses` its drives are on; the first one unless given"""
    drive: DriveTable | None = None
    """The drives of its wheels"""
    envelope: EnvelopeTable | None = None
    """What the bridge lets pass to its drives"""


class Shape(Table):
    """Desired shape of a group: where its robots, or the centroids of its groups, are to be about each other."""

    kind: Literal["triangle", "polygon", "line", "column", "wedge", "points", "vectors"]
    """`triangle` and `polygon` need `side`; `line` (side by side for travel along x), `column` (one behind the other) and
    `wedge` (a V open to the rear) need `spacing`; or the `points` themselves, or the shape variables as `vectors`"""
    side: Positive | None = None
    """Between neighbours of a triangle or polygon [m]"""
    spacing: Positive | None = None
    """Between neighbours of a line, column or wedge [m]"""
    angle: Annotated[float, Field(strict=True, gt=0, lt=180)] = 90.0
    """Between the arms of a wedge, in degrees [°]"""
    rotation: Finite = 0.0
    """Turns the shape counter-clockwise, in degrees [°]"""
    points: list[Point] | None = None
    """One for each child, in their order [m]; only where they are to each other matters"""
    vectors: list[Point] | None = None
    """The shape variables, one fewer than there are children [m]"""

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
    """Desired shape of its children; may be left out for a single child"""
    robot: RobotTable = RobotTable()
    """What the robots below it have in common"""
    robots: dict[Name, RobotTable] = {}
    """Its robots by name"""
    groups: dict[Name, "Group"] = {}
    """The groups below it by name"""
    period: Positive | None = None
    """Between two accelerations of this node [s]; `periods.acceleration` unless given; a multiple of its children's"""

    @model_validator(mode="after")
    def _children(self) -> "Group":
        if not self.robots and not self.groups:
            raise ValueError("a group needs robots or groups")
        if twice := sorted(self.robots.keys() & self.groups.keys()):
            raise ValueError(f"{twice[0]!r} names a robot and a group")
        if (name := alike([*self.robots, *self.groups])) is not None:
            raise ValueError(f"{name!r} must differ from other names by more than hyphens and underscores")
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
    """Of the error"""
    k2: Gain = 1.0
    """Of the error's rate"""


class Coupling(Table):
    """Velocity coupling K̄ of one pair of blocks: a number for every entry, or the full matrix."""

    block: str = "*"
    """Which blocks are acted on: a name, a layer, or `*`"""
    onto: str = "*"
    """The blocks whose error rates act on them"""
    value: CouplingGain
    """A number for every entry, or the full matrix"""


class Law(Table):
    """The control law: time scales, gains and coupling of the blocks (the groups' shapes, the formation's, the centroid)."""

    use: LawName = Field(default="linear", validate_default=True)
    """`linear` (the paper's), `integral`, `terminal_sliding`, or a law of your own (docs/add-a-law.md)"""
    parameters: LawParameters = Field(default_factory=dict, validate_default=True)
    """Of the law that `use` names"""  # validated, they are the law itself, a Part
    time_scales: Literal["three", "multi"] = "three"
    """`three`: one per layer of the tree; `multi`: one per block, groups settling in their order"""
    epsilon: Annotated[list[Annotated[float, Field(strict=True, gt=0, le=1)]], Field(min_length=1)] = [0.7, 0.7]
    """ε1, ε2, …: each block's σ is a product of the first ones; as many as the tree has layers, or with `multi` groups
    and the formation"""
    gains: list[Gains] = []
    """K_1 and K_2 of blocks, for laws that use them; later entries override earlier ones"""
    coupling: list[Coupling] = []
    """Coupling of blocks; later entries override earlier ones, and without any there is none"""
    lead: Fraction = 0.0
    """How far ahead the law looks, in periods, for laws that do: 0 is the law as it stands, 0.5 makes up for the hold"""

    @field_serializer("use")
    def _use(self, use: str, info: SerializationInfo) -> WrittenLawName:
        return written_use(self.parameters, info)


class Avoidance(Table):
    """Collision avoidance: a potential pushes robots apart that are closer than `sensing_radius`."""

    enabled: Flag = False
    """False: robots do not avoid each other, but distances below `avoidance_radius` are still violations"""
    avoidance_radius: Positive = 0.25
    """r_a: closer than this, two robots are a violation [m]"""
    sensing_radius: Positive = 1.0
    """R_s: closer than this, two robots push each other apart [m]"""
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
    """Any delay between two bounds, all equally likely."""

    min: NonNegative
    """[s]"""
    max: NonNegative
    """[s]"""

    @model_validator(mode="after")
    def _bounds(self) -> "Uniform":
        if self.max < self.min:
            raise ValueError(f"max = {self.max} must be at least min = {self.min}")
        return self


Delay = Annotated[
    Annotated[NonNegative, Tag("a number")] | Annotated[Uniform, Tag("a table")], Discriminator(_number_or_table)
]


class LinkRule(Table):
    """What links are like.  The last rule that fits a link holds, and only that one."""

    source: str = "**"
    """Who sends: a path in the tree (`g1/r2`) or `coordinator`; `*` stands for one chunk of a path, `**` for any number"""
    receiver: str = "**"
    """Who receives, in the same way"""
    channel: ChannelName = "*"
    """What is sent; `*` stands for all"""
    delay: Delay = 0.0
    """How long a message takes [s]: a number, or a table of two bounds.  It is used at the first tick at
    which it has come"""
    loss: Fraction = 0.0
    """Probability that a message is lost, independent of all others"""
    policy: Literal["hold", "hold_then_stop"] | None = None
    """What a receiver uses if nothing newer has come: the last message that came, for ever (`hold`) or until it is older
    than `timeout` (`hold_then_stop`).  Unless given: `hold` where torque is mirrored, `hold_then_stop` where the torque
    path is closed"""
    timeout: Seconds | None = None
    """Age from which on a message is not used any more, for `hold_then_stop` [s]; `can.watchdog` unless given"""


class Record(Table):
    """The recording."""

    display_period: Positive = 0.02
    """Between transforms, markers, odometry and joint states [s of run time], at least the period of accelerations;
    of states all are recorded"""


class Claim(Table):
    """What the run is expected to show; the verdict fails if it does not."""

    block: str
    """Which blocks: a name (`g1`, `inter`, `centroid`), a layer (`intra`), or `*`"""
    settled_by: Positive
    """When its error is to be settled [s of run time]"""
    band: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.05
    """Settled means: stays within this fraction of the error that the block starts with, to the end of the run.  That is its
    largest error within the first 3 σ/√k1 (k1: the smallest gain of its error); a block that starts within `health.floor` must
    stay there"""
    dwell: NonNegative | None = None
    """For how long, at least, it must stay there until the run ends, in multiples of the block's time scale σ; `health.dwell`
    unless given"""


CheckName = Literal[
    "whole",
    "finite",
    "growth",
    "end",
    "distance",
    "avoidance",
    "saturation",
    "messages",
    "silence",
    "refused",
    "late",
    "drives",
    "referee",
    "recording",
]


class Health(Table):
    """The checks that every run is put to, whatever it claims.

    `whole`: the run reaches its end.  `finite`: all states are finite numbers.  `growth`: no error grows in the last third of
    the run.  `end`: no block ends with a larger error than it started with.  `distance`, where robots do not avoid each
    other: they keep `avoidance.avoidance_radius` all the same.  `avoidance`, where they do: they keep it, and avoidance had
    something to do. `saturation`: no robot's limits act for too long.  `messages`: something arrives, and is used, over every
    link.  `silence`: no robot says nothing for too long.  `refused`: no message is refused.  `late`, on a wall clock: stages
    run in time.  `drives`, where the torque path is closed: all drives come up, and none is in fault at the end that the
    scenario has no event for. `referee`: nothing on the bus breaks the contract.  `recording`: it lacks nothing"""

    off: list[CheckName] = []
    """Checks that this scenario is not put to"""
    dwell: NonNegative | None = None
    """For how long an error must stay in its band until the run ends to count as settled, in multiples of the block's time
    scale σ; 3/√k1 unless given, nearly half a period of its own oscillation"""
    floor: Positive = 0.001
    """Errors up to this are not judged, nor need a block that starts within it get closer [m]"""
    growth: Annotated[float, Field(strict=True, ge=1, allow_inf_nan=False)] = 1.05
    """How many times as large an error may be in the last sixth of the run as in the sixth before"""
    saturation: Fraction = 0.2
    """Share of the time in which a robot's limits may act"""
    silence: Seconds = 0.5
    """For how long a robot may say nothing [s]; at least two of its periods"""
    late: Fraction = 0.1
    """Share of the stages that may run at their deadline without something they wanted, on a wall clock"""


class Scenario(Table):
    """A whole scenario: one TOML file.  Numbers are in SI units; of angles, `heading`, `phase` and `rate` are in radians,
    `rotation` and `angle` in degrees."""

    name: Name
    """What it is called; runs are called after it"""
    description: str = ""
    """What it shows, for people"""
    duration: Positive
    """How long it runs [s of run time]; a multiple of the coordinator's period"""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**63)] = 1
    """Of everything random: delays, losses, error frames"""
    periods: Periods = Periods()
    """How often things happen"""
    robot: RobotTable = RobotTable()
    """What all robots have in common"""
    formation: Group
    """The root of the tree"""
    trajectory: TrajectoryField
    """Where the centroid of all robots is to be: `line`, `circle`, `sine`, `waypoints`, or a trajectory of your own"""
    law: Law = Field(default_factory=dict, validate_default=True)
    """The control law"""
    avoidance: Avoidance = Avoidance()
    """Collision avoidance"""
    links: list[LinkRule] = []
    """Delay and loss between robots, leaders and coordinator; without any, messages are there in the tick they are sent in"""
    can: Can = Can()
    """The CAN bus, or buses"""
    record: Record = Record()
    """The recording"""
    claims: list[Claim] = []
    """What the run is expected to show"""
    health: Health = Health()
    """Checks that every run is put to, whatever it claims"""
    events: list[Event] = []
    """What happens on schedule, in run time"""
