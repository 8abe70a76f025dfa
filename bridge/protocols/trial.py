"""A trial of the users' own protocols in a plan, before a run starts.

It makes every object that a run will need.  An error raises PartRunError: one line that names file, class, robot and the error.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Final

from echelon.bridge.protocols.checked import Caller
from echelon.bridge.protocols.cyclic import CyclicDrive, CyclicHost
from echelon.bridge.protocols.frame import WHEELS, Frame
from echelon.bridge.protocols.registry import (
    DrivePlace,
    cyclic_of,
    make_drive,
    make_host,
    make_masters,
    make_observer,
    protocol_of,
    shared_protocols,
)
from echelon.plan.plan import Plan, RobotPlan

_TRIED: Final = (-20, 30)
"""Torques of the right and left wheel that a host is given in the trial, in bits; they differ in size and sign"""
_TRIED_FLOAT: Final = 0.001
"""What stands for a bit there if torques are floating point [N m]"""


def try_protocols(plan: Plan, patience: Callable[[str], AbstractContextManager[None]]) -> None:
    """Makes host, drives, observer, master and DBC messages of one robot for each user's own protocol.

    `patience(who)` is a context that limits the time in which `who` is tried.  Raises PartRunError for the first error."""
    others = {id(robot.drive.protocol): robot for robot in reversed(plan.robots) if not robot.drive.protocol.is_own}
    for robot in others.values():
        with patience(f"{robot.drive.protocol.use} of {robot.name}"):
            _try_robot(plan, robot)
    if others:
        with patience(" and ".join(dict.fromkeys(robot.drive.protocol.use for robot in others.values()))):
            make_masters(plan)


def _try_robot(plan: Plan, robot: RobotPlan) -> None:
    from echelon.bridge.protocols.plan_dbc import (
        identifiers,
    )  # imports cantools, which the built-in protocols do not need

    caller, protocol, drive = Caller.of(robot), protocol_of(robot), robot.drive
    host = make_host(robot)
    for wheels in protocol.wheels:
        make_drive(plan, DrivePlace(robot.index, wheels, drive.bus, 1))
    name, *_ = identifiers([robot.path])
    messages = _messages(caller, "messages", protocol.messages, drive, name)
    for one in shared_protocols(plan):
        if one.part.use == drive.protocol.use:
            times = one.period_ns, one.watchdog_ns
            messages += _messages(caller, "shared_messages", protocol.shared_messages, *times)
            cyclic = caller.periods("shared_cyclic", protocol.shared_cyclic, *times)
            _check_described(caller, "shared_cyclic", set(cyclic), messages)
    for closed in (True, False):
        observer = make_observer(robot, closed)
        _check_described(caller, "observer", set(cyclic_of(robot, observer, closed)), messages)
    caller.call("messages", _written, messages)
    _number(caller, "resolution", resolution := caller.call("resolution", protocol.resolution, drive))
    right, left = tried = tuple(bits * (resolution or _TRIED_FLOAT) for bits in _TRIED)
    _check_torques(caller, "encode", host.mirror(right, left, True), messages, tried, resolution)
    made, made_host = protocol.drive(drive, 0), protocol.host(drive)
    if isinstance(made, CyclicDrive):
        frames = caller.frames("its drive's report", made.report, tried)
        _check_torques(caller, "report", frames, messages, tried, resolution)
        if isinstance(made_host, CyclicHost):
            _check_feedback(caller, made_host, frames, tried, resolution)
    caller.call("boot_ups", lambda: dict(protocol.boot_ups(drive)))
    _check_addresses(caller, caller.call("addresses", protocol.addresses, drive))


def _messages(caller: Caller, what: str, function: Callable[..., Any], *arguments: Any) -> list[Any]:
    from cantools.database.can import Message

    found = caller.call(what, function, *arguments)
    if not (isinstance(found, list) and all(isinstance(message, Message) for message in found)):
        raise caller.wrong(f"{what} must return a list of cantools messages, not {found!r:.60}")
    if other := [message.frame_id for message in found if message.frame_id not in caller.allowed]:
        raise caller.wrong(f"{what} describes identifier {other[0]:#05x}, which `identifiers` does not name")
    return found


def _check_described(caller: Caller, what: str, cyclic: set[int], messages: list[Any]) -> None:
    """Raises PartRunError if a cyclic identifier has no DBC message, from which the load of a bus is computed."""
    if lacking := sorted(cyclic - {message.frame_id for message in messages}):
        raise caller.wrong(f"{what}: identifier {lacking[0]:#05x} comes regularly, but `messages` does not describe it")


def _check_torques(
    caller: Caller, what: str, frames: list[Frame], messages: list[Any], torques: tuple[float, ...], resolution: float
) -> None:
    """Raises PartRunError if the signals tau_right and tau_left [N m] of a DBC message differ from the torques that the method
    `what` put into frames.

    A protocol that names or scales its signals otherwise is not checked."""
    described = {message.frame_id: message for message in messages}
    for frame in frames:
        message = described.get(frame.can_id)
        if message is None or message.is_multiplexed():
            continue
        signals = {signal.name: signal for signal in message.signals}
        for wheel, torque in zip(WHEELS, torques, strict=True):
            signal = signals.get(f"tau_{wheel}")
            if signal is None or signal.unit not in (None, "Nm", "N m", "N.m"):
                continue
            if len(frame.data) < message.length:
                raise caller.wrong(
                    f"{message.name}: its DBC describes {message.length} bytes where {what} returned {len(frame.data)}"
                )
            read = message.decode(frame.data, decode_choices=False)[signal.name]
            if not abs(read - torque) <= resolution + 1e-6:
                raise caller.wrong(
                    f"{message.name}: its DBC reads {signal.name} = {read:.6g} where {what} was given {torque:.6g}"
                )


def _check_feedback(
    caller: Caller, host: CyclicHost, frames: list[Frame], torques: tuple[float, ...], resolution: float
) -> None:
    """Raises PartRunError if a host reads other torques from the frames of `report` than `report` was given."""
    for frame in frames:
        heard = caller.call("its host's decode", host.decode, frame)
        if isinstance(heard, str):
            raise caller.wrong(f"its host's decode refuses a frame of report, {frame.data.hex()}: {heard}")
        if heard is None:
            continue
        for wheel, read, torque in zip(WHEELS, heard.torques, torques, strict=True):
            if not abs(read - torque) <= resolution + 1e-6:
                raise caller.wrong(
                    f"its host's decode reads {read:.6g} for the {wheel} wheel where report was given {torque:.6g}"
                )


def _check_addresses(caller: Caller, found: Any) -> None:
    """Raises PartRunError unless `addresses` returned nodes or identifiers by name."""
    if not (
        isinstance(found, dict)
        and len(found) == 1
        and found.keys() <= {"nodes", "identifiers"}
        and all(
            isinstance(numbers, dict) and all(type(n) is int for n in numbers.values()) for numbers in found.values()
        )
    ):
        raise caller.wrong(f"addresses must be nodes or identifiers, numbers by name, not {found!r:.60}")


def _written(messages: list[Any]) -> str:
    from cantools.database import Database

    return Database(messages).as_dbc_string()


def _number(caller: Caller, what: str, value: Any) -> None:
    if not (isinstance(value, (int, float)) and 0 <= value < float("inf")):
        raise caller.wrong(f"{what} must be a finite number, 0 or more, not {value!r:.60}")
