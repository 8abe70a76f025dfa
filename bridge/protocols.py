"""The drive protocols by their names in a scenario: which host, drives, observer and DBC messages go with each."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, NamedTuple

from echelon.bridge.cia402.codec import HEARTBEAT_ID, HOST_NODE, SYNC_ID
from echelon.bridge.cia402.configuration import heartbeat_ns
from echelon.bridge.frame import Drive, Host
from echelon.bridge.observe import Observer
from echelon.can_plan import DrivePlan
from echelon.plan import Plan, RobotPlan

PREFIX: Final = {"native": "Native", "odrive": "ODrive", "cia402": "Cia402"}
"""How the classes of a protocol begin; its modules are `bridge.<protocol>.host` and so on."""


def _part(protocol: str, module: str, kind: str) -> Any:
    return getattr(import_module(f"echelon.bridge.{protocol}.{module}"), PREFIX[protocol] + kind)


class DrivePlace(NamedTuple):
    """Where a virtual drive is: its robot, the wheels (0 right, 1 left) whose motors it has, its bus, its node there."""

    robot: int
    wheels: tuple[int, ...]
    bus: int
    node: int


def drive_places(plan: Plan) -> list[DrivePlace]:
    """Lists the drives of a plan; their nodes are numbered from 1 on, after the bridge."""
    places: list[DrivePlace] = []
    for robot in plan.robots:
        for wheels in ((0, 1),) if robot.drive.protocol == "native" else ((0,), (1,)):
            places.append(DrivePlace(robot.index, wheels, robot.drive.bus, len(places) + 1))
    return places


def make_host(robot: RobotPlan) -> Host:
    """Returns what commands a robot's drives."""
    host: Host = _part(robot.drive.protocol, "host", "Host")(robot.drive, robot.index)
    return host


def make_drive(plan: Plan, place: DrivePlace) -> Drive:
    """Returns a virtual drive."""
    drive = plan.robots[place.robot].drive
    which = place.robot if drive.protocol == "native" else place.wheels[0]
    made: Drive = _part(drive.protocol, "drive", "Drive")(drive, which)
    return made


def make_observer(robot: RobotPlan) -> Observer:
    """Returns what listens to a robot's frames."""
    observer: Observer = _part(robot.drive.protocol, "observe", "Observer")(robot.drive, robot.envelope, robot.index)
    return observer


def shared_cyclic(plan: Plan) -> list[tuple[int, int, int]]:
    """Returns what is cyclic on CANopen buses without being a robot's, SYNC and the host's heartbeat: bus, identifier,
    period [ns]."""
    found = []
    for bus in sorted({robot.drive.bus for robot in plan.robots if robot.drive.protocol == "cia402"}):
        period_ns = min(robot.drive.period_ns for robot in plan.robots if robot.drive.bus == bus)
        found.append((bus, SYNC_ID, period_ns))
        found.append((bus, HEARTBEAT_ID + HOST_NODE, heartbeat_ns(period_ns, plan.can.watchdog_ns)))
    return found


def torque_frames(robot: RobotPlan) -> Callable[[float, float], list[tuple[int, bytes]]]:
    """Returns what makes the frames of torques [N m], right and left, of a robot whose drives are not native: those
    alone, as the mirrored path shows them."""
    motor, (right, left) = robot.drive.motor, robot.drive.node_ids
    if robot.drive.protocol == "odrive":
        from echelon.bridge.odrive.codec import MESSAGES, frame_id
        from echelon.bridge.odrive.enums import Command

        torque, command = MESSAGES[Command.SET_INPUT_TORQUE], Command.SET_INPUT_TORQUE
        ids = frame_id(right, command), frame_id(left, command)
        return lambda *taus: [(can_id, torque.encode(tau)) for can_id, tau in zip(ids, taus, strict=True)]
    from echelon.bridge.cia402.codec import RPDO2, RPDO_IDS, permille, rated_mnm

    rated = rated_mnm(motor.rated_torque)
    ids = RPDO_IDS[1] + right, RPDO_IDS[1] + left
    return lambda *taus: [(can_id, RPDO2.pack(permille(tau, rated))) for can_id, tau in zip(ids, taus, strict=True)]


def dbc_messages(drive: DrivePlan, robot: str, number: int) -> list[Any]:
    """Returns the DBC messages of a robot's drives."""
    make = import_module(f"echelon.bridge.{drive.protocol}.dbc").messages
    found: list[Any] = make(drive, robot, number) if drive.protocol == "native" else make(drive, robot)
    return found
