"""The tables of a scenario file (TOML) as pydantic models.  Unknown keys are refused; every value has a range and a unit.

A robot's values come from three levels: `[robot]` for all robots, `robot` of its group and of the groups around that, and the
robot's own table.  `echelon.planning.loading` reads files, applies overrides and explains mistakes;
`echelon.planning.plan_maker` makes the plan that roles work with.  `echelon.scenario.law_tables` has the tables of the law and
of avoidance, `echelon.scenario.link_tables` those of links, `echelon.scenario.can_tables` those of the CAN bus.
"""

from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from echelon.parameters import Finite, NonNegative, Point, Positive
from echelon.scenario.can_tables import BusOff, Can, DriveFault, DriveTable, EnvelopeTable, ErrorFrames, Estop
from echelon.scenario.law_tables import Avoidance, Law
from echelon.scenario.link_tables import Blackout, Clock, CutOff, LinkRule
from echelon.scenario.part_fields import (
    PlantField,
    TrajectoryField,
)
from echelon.scenario.values import (
    Fraction,
    Limit,
    Name,
    Seconds,
    Table,
    alike,
)

BLOCK_NAMES = ("intra", "middle", "inter", "centroid")
"""Names of blocks and of layers of blocks.  Groups cannot have these names."""


RESERVED_NAMES = ("coordinator", "bridge", "drives", "recorder", "referee")
"""Names of processes.  Robots and groups cannot have these names."""


EVENT_DRIVEN: Final = "event_driven"
Timing = Literal["event_driven", "time_driven"]


class Periods(Table):
    """The periods of the run."""

    acceleration: Positive = 0.01
    """Acceleration period: the time for which accelerations are held [s], of all nodes that have no `period` of their own"""
    torque: Positive = 0.01
    """Torque period: the time for which wheel torques are held [s]; it must divide `acceleration`"""


class RobotTable(Table):
    """A robot, or values that all robots of a level share.

    Each key is taken from the robot's own table, else from `robot` of its group, else from `robot` of the groups around that,
    else from `[robot]`.  The symbols are those of docs/architecture.md, 2.1."""

    model: PlantField = None
    """Plant: `paper` (the paper's equations, the default), `rigid_body` (its mass is at the reference point), `hill` (with a
    load, on a slope), or your own"""
    mass: Positive | None = None
    """m1, mass [kg]; must be given on some level"""
    inertia: Positive | None = None
    """I, moment of inertia [kg m²], larger than mass·offset²; must be given on some level"""
    wheel_radius: Positive | None = None
    """r, wheel radius [m]; must be given on some level"""
    arm: Positive | None = None
    """R, lever arm of a wheel about the middle of the axle: half the track [m]; must be given on some level"""
    offset: Finite | None = None
    """d, distance from the axle to the reference point [m], positive in front; not zero; must be given on some level"""
    start: Point | None = None
    """Position of the reference point at the start [m]; must be given.  The robot starts at rest"""
    heading: Finite | None = None
    """θ, heading at the start, counter-clockwise from the x axis [rad]; 0 unless given"""
    timing: Timing | None = None
    """When it takes an acceleration; `timing` of its group unless given"""
    torque_limit: Limit | None = None
    """Largest torque of a wheel [N m]; unlimited unless given"""
    torque_rate_limit: Limit | None = None
    """Largest rate of change of a wheel's torque [N m/s]; unlimited unless given"""
    wheel_speed_limit: Limit | None = None
    """Wheel speed beyond which the motor gives no torque in the direction of motion [rad/s]; unlimited unless given"""
    bus: Name | None = None
    """The bus of its drives, one of `can.buses`; the first one unless given"""
    drive: DriveTable | None = None
    """The drives of its wheels"""
    envelope: EnvelopeTable | None = None
    """Limits of the torque commands that the bridge sends to its drives"""
    clock: Clock | None = None
    """Its clock; it shows the run time unless given"""


class Shape(Table):
    """Desired shape of a group: the desired places of its children relative to each other.  A child group's place is its
    centroid."""

    kind: Literal["triangle", "polygon", "line", "column", "wedge", "points", "vectors"]
    """`triangle` and `polygon` need `side`.  `line` (side by side for travel along x), `column` (one behind the other) and
    `wedge` (a V open to the rear) need `spacing`.  `points` and `vectors` need the key of the same name"""
    side: Positive | None = None
    """Distance between neighbours of a triangle or polygon [m]"""
    spacing: Positive | None = None
    """Distance between neighbours of a line, column or wedge [m]"""
    angle: Annotated[float, Field(strict=True, gt=0, lt=180)] = 90.0
    """Angle between the arms of a wedge [°]"""
    rotation: Finite = 0.0
    """Angle by which the shape is turned counter-clockwise [°]"""
    points: list[Point] | None = None
    """A position for each child, in their order [m]; only the differences between positions matter"""
    vectors: list[Point] | None = None
    """The shape variables (docs/architecture.md, 2.3), one fewer than there are children [m]"""

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
    """A node of the tree.  Its children are robots, groups, or both: first the robots, then the groups, each in the order of
    the file."""

    shape: Shape | None = None
    """Desired shape of its children; needed if it has several"""
    robot: RobotTable = RobotTable()
    """Values that all robots below it share"""
    robots: dict[Name, RobotTable] = {}
    """Its robots by name"""
    groups: dict[Name, "Group"] = {}
    """Its child groups by name"""
    period: Positive | None = None
    """Acceleration period of this node [s]: a multiple of its child groups' periods; `periods.acceleration` unless given"""
    timing: Timing | None = None
    """When this node, its robots and the groups below it act; `timing` of the group around it unless given"""
    clock: Clock | None = None
    """The clock of this node; it shows the run time unless given.  Robots' clocks are in `robot`"""

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


class Record(Table):
    """The recording."""

    display_period: Positive = 0.02
    """Time between two transforms, markers, odometry messages and joint states of a robot [s of run time], at least
    `periods.acceleration`; states are all recorded"""


class Claim(Table):
    """A claim: errors that settle by a given time.  A claim that fails fails the verdict of the run."""

    block: str
    """The blocks: a name (`g1`, `inter`, `centroid`), a layer (`intra`), or `*`"""
    settled_by: Positive
    """The time by which the error of each of these blocks settles [s of run time]"""
    band: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.05
    """An error is settled if it stays within this fraction of the block's error at the start, to the end of the run.  The error
    at the start is the largest error within the first 3 σ/√k1, where k1 is the smallest gain of the block's error.  A block
    that starts within `health.floor` must stay there"""
    dwell: NonNegative | None = None
    """How long the error must at least stay in its band before the run ends, in multiples of the block's time scale σ;
    `health.dwell` unless given"""


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
    "standstill",
    "refused",
    "late",
    "drives",
    "referee",
    "senders",
    "recording",
]


class Health(Table):
    """Checks of every run, whatever it claims.  A check that fails fails the verdict.

    `whole`: the run reaches its end.  `finite`: all states are finite, and within the bounds of all messages.  `growth`: no
    error grows in the last third of the run.  `end`: no block ends with a larger error than it started with.  `distance`, if
    avoidance is off: robots keep `avoidance.avoidance_radius` nevertheless.  `avoidance`, if it is on: robots keep that
    radius, and avoidance acted at least once.  `saturation`: no robot's limits act for too long.  `messages`: on every link
    messages arrive and are used.  `silence`: no robot is silent for too long.  `standstill`, on a wall clock: no process
    stands still for longer than `can.watchdog`, or `silence` if the run has no bus.  `refused`: no message is refused.
    `late`, on a wall clock: stages run in time.  `drives`, if the torque path is closed: all drives come up, and at the end
    no drive has a fault without an event that explains it.  `referee`: nothing on the bus breaks the contract.  `senders`:
    nobody else sends frames with identifiers of the run.  `recording`: the recording is complete"""

    off: list[CheckName] = []
    """Checks that are left out"""
    dwell: NonNegative | None = None
    """How long an error must stay in its band before the run ends to count as settled, in multiples of the block's time scale
    σ; unless given 3/√k1, nearly half a period of the block's own oscillation"""
    floor: Positive = 0.001
    """Errors up to this size are not judged [m]; a block that starts with such an error need not get closer"""
    growth: Annotated[float, Field(strict=True, ge=1, allow_inf_nan=False)] = 1.05
    """Largest ratio of an error in the last sixth of the run to the error in the sixth before"""
    saturation: Fraction = 0.2
    """Largest share of the time in which a robot's limits act"""
    silence: Seconds = 0.5
    """Longest time in which a robot sends nothing [s]; never less than two of its periods"""
    late: Fraction = 0.1
    """Largest share of stages that run at their deadline without all of their inputs, on a wall clock"""


Event = Annotated[DriveFault | Estop | ErrorFrames | BusOff | Blackout | CutOff, Field(discriminator="kind")]


class Scenario(Table):
    """A whole scenario: one TOML file.  Numbers are in SI units.  The angles `heading` and `phase` and the angular speed `rate`
    use radians, the angles `rotation` and `angle` degrees."""

    name: Name
    """Name of the scenario; the folders of its runs begin with it"""
    description: str = ""
    """What the scenario shows, in words"""
    duration: Positive
    """Length of the run [s of run time]; a multiple of the coordinator's period"""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**63)] = 1
    """Seed of all random draws: delays, losses, error frames"""
    periods: Periods = Periods()
    """The periods of accelerations and torques"""
    timing: Timing = EVENT_DRIVEN
    """When nodes and robots act, unless a group or a robot says otherwise (docs/architecture.md, 4.6).  `event_driven`: in each
    of its periods a node acts as soon as every input has something newer, at the latest at the end of the period, and a robot
    takes an acceleration when it arrives.  `time_driven`: they act at the beginning of each period with what has arrived, so
    any delay costs at least a period.  On the closed torque path robots take accelerations when a torque period begins"""
    robot: RobotTable = RobotTable()
    """Values that all robots share"""
    formation: Group
    """The root of the tree"""
    trajectory: TrajectoryField
    """Desired trajectory of the centroid of all robots: `line`, `circle`, `sine`, `waypoints`, or your own"""
    law: Law = Field(default_factory=dict, validate_default=True)
    """The control law"""
    avoidance: Avoidance = Avoidance()
    """Collision avoidance"""
    links: list[LinkRule] = []
    """Delay and loss of the links between robots, leaders and coordinator; without a rule a link has neither"""
    can: Can = Can()
    """The CAN bus, or buses"""
    record: Record = Record()
    """The recording"""
    claims: list[Claim] = []
    """Claims: what the run shows if all is well"""
    health: Health = Health()
    """Limits of the checks that are made of every run"""
    events: list[Event] = []
    """Scheduled events: faults of drives, emergency stops, disturbances of a bus, blackouts of links, members cut off"""
