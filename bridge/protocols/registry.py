"""The registry of built-in drive protocols, and the hosts, drives, observers and masters of a plan.

Those of users' own protocols are wrapped in checks (bridge.protocols.checked).
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from echelon.bridge.protocols.checked import CheckedDrive, CheckedHost, CheckedMaster, CheckedObserver
from echelon.bridge.protocols.cia402 import Cia402
from echelon.bridge.protocols.frame import Drive, Host, Master
from echelon.bridge.protocols.native import Native
from echelon.bridge.protocols.observe import Observer
from echelon.bridge.protocols.odrive import ODrive
from echelon.bridge.protocols.protocol import DriveProtocol
from echelon.plan.plan import Plan, RobotPlan
from echelon.plugins import Part, Plugin

if TYPE_CHECKING:
    from cantools.database.can import Message

PROTOCOLS: Final[dict[str, type[Plugin]]] = {"native": Native, "odrive": ODrive, "cia402": Cia402}
"""The built-in protocols by name."""
DEFAULT: Final = "native"
"""The protocol of robots whose scenario names none."""


def protocol_of(robot: RobotPlan) -> DriveProtocol:
    """Returns the protocol of a robot's drives."""
    protocol: DriveProtocol = robot.drive.protocol.made
    return protocol


class DrivePlace(NamedTuple):
    """The place of a virtual drive: its robot, its wheels (0 right, 1 left), its bus, and its node number there."""

    robot: int
    wheels: tuple[int, ...]
    bus: int
    node: int


def drive_places(plan: Plan) -> list[DrivePlace]:
    """Returns the places of all drives of a plan; their nodes are numbered from 1 on, since the bridge is node 0."""
    places: list[DrivePlace] = []
    for robot in plan.robots:
        for wheels in protocol_of(robot).wheels:
            places.append(DrivePlace(robot.index, wheels, robot.drive.bus, len(places) + 1))
    return places


def make_host(robot: RobotPlan) -> Host:
    """Returns the host of a robot's drives."""
    return protocol_of(robot).host(robot.drive) if robot.drive.protocol.is_own else CheckedHost(robot)


def make_drive(plan: Plan, place: DrivePlace) -> Drive:
    """Returns the virtual drive at a place."""
    robot = plan.robots[place.robot]
    number = protocol_of(robot).wheels.index(place.wheels)
    return protocol_of(robot).drive(robot.drive, number) if robot.drive.protocol.is_own else CheckedDrive(robot, number)


def make_observer(robot: RobotPlan, closed: bool) -> Observer:
    """Returns the observer of a robot's frames; `closed` is false on the mirrored path."""
    if robot.drive.protocol.is_own:
        return protocol_of(robot).observer(robot.drive, robot.envelope, closed)
    return CheckedObserver(robot, closed)


def cyclic_of(robot: RobotPlan, observer: Observer, closed: bool) -> dict[int, int]:
    """Returns the cyclic identifiers of a robot with their periods [ns].

    On the closed path these are the observer's.  On the mirrored path they are the torque commands, once per acceleration
    period."""
    if closed:
        return observer.cyclic
    return {frame.can_id: robot.period_ns for frame in make_host(robot).mirror(0.0, 0.0, True)}


def run_identifiers(plan: Plan, bus: int) -> frozenset[int]:
    """Returns the identifiers of all frames on a bus that bridge and drives may send."""
    found: set[int] = set()
    for robot in plan.robots:
        if robot.drive.bus == bus:
            protocol = protocol_of(robot)
            found |= protocol.shared_identifiers().union(*map(protocol.identifiers, robot.drive.node_ids))
    return frozenset(found)


class SharedProtocol(NamedTuple):
    """A protocol in use on a bus.

    `part` is the protocol of the first robot that uses it there; `period_ns` is the smallest period of all robots there."""

    bus: int
    part: Part[Any]
    period_ns: int
    watchdog_ns: int

    @property
    def made(self) -> DriveProtocol:
        """The protocol."""
        made: DriveProtocol = self.part.made
        return made


def shared_protocols(plan: Plan) -> Iterator[SharedProtocol]:
    """Yields the protocols in use on each bus."""
    for bus in range(len(plan.can.buses)):
        drives = [robot.drive for robot in plan.robots if robot.drive.bus == bus]
        for part in {drive.protocol.use: drive.protocol for drive in reversed(drives)}.values():
            yield SharedProtocol(bus, part, min(drive.period_ns for drive in drives), plan.can.watchdog_ns)


def make_masters(plan: Plan) -> list[tuple[int, Master]]:
    """Returns the masters of all buses, each with the number of its bus."""
    found = []
    for one in shared_protocols(plan):
        if one.part.is_own:
            master = one.made.master(one.period_ns, one.watchdog_ns)
        else:
            master = CheckedMaster.made_by(one.part, one.period_ns, one.watchdog_ns)
        if master is not None:
            found.append((one.bus, master))
    return found


def shared_cyclic(plan: Plan) -> list[tuple[int, int, int]]:
    """Returns the cyclic frames on buses that belong to no robot: bus, identifier, period [ns]."""
    return [
        (one.bus, can_id, period_ns)
        for one in shared_protocols(plan)
        for can_id, period_ns in one.made.shared_cyclic(one.period_ns, one.watchdog_ns).items()
    ]


def dbc_messages(robot: RobotPlan, name: str) -> "list[Message]":
    """Returns the DBC messages of a robot's frames; `name` is the robot's name in them."""
    return protocol_of(robot).messages(robot.drive, name)


def shared_messages(plan: Plan, bus: int) -> "list[Message]":
    """Returns the DBC messages of a bus that belong to no robot."""
    return [
        message
        for one in shared_protocols(plan)
        if one.bus == bus
        for message in one.made.shared_messages(one.period_ns, one.watchdog_ns)
    ]
