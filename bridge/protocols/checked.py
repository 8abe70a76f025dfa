"""Hosts, drives, observers and masters of users' own protocols, with every call checked.

PartRunError, one line that names file, class, robot and call, is raised if

- a call raises;
- a call returns anything but frames;
- a frame has an identifier that the protocol does not name, since this may be another robot's.

The properties of a host are read and checked after each call.  So reading them later never raises: the code that takes the
torque away must not be stopped by them.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from inspect import get_annotations
from math import isfinite
from typing import Any, Self

from echelon.bridge.protocols.cyclic import CyclicHost
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Drive, Frame, Host, Master
from echelon.bridge.protocols.motor import Motor
from echelon.bridge.protocols.observe import Finding, Observer, WheelReading
from echelon.bridge.protocols.protocol import DriveProtocol
from echelon.errors import PartRunError
from echelon.plan.plan import RobotPlan
from echelon.plugins import PART_ERRORS, Part


class Caller:
    """Calls the code of a user's own protocol.

    Errors name the protocol and `whom` (" of r1"); `allowed` are the identifiers of the frames that it may send."""

    def __init__(self, part: Part[Any], whom: str, allowed: frozenset[int]) -> None:
        self.part, self.whom, self.allowed = part, whom, allowed
        self.busy = False
        """True while a call goes on"""

    @classmethod
    def of(cls, robot: RobotPlan) -> Self:
        """Returns the caller for the drives of a robot."""
        part, nodes = robot.drive.protocol, robot.drive.node_ids
        protocol: DriveProtocol = part.made
        allowed = protocol.shared_identifiers().union(*(protocol.identifiers(node) for node in nodes))
        return cls(part, f" of {robot.name}", allowed)

    def wrong(self, text: str) -> PartRunError:
        """Returns the error with this text."""
        return PartRunError(f"{self.part.use}{self.whom}: {text}")

    def call(self, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Calls a function and returns its result; `what` names the function in errors.

        If that function is a method of a base class, the error names the method of the protocol that it called."""
        self.busy = True
        try:
            return function(*arguments)
        except PART_ERRORS as error:
            whose, s, _ = what.rpartition("'s ")
            if s and (calls := self.part.calls_in(error)):
                what = f"{whose}{s}{calls[0][0]}"
            raise self.part.raised(self.whom, what, error) from error
        finally:
            self.busy = False

    def make(self, what: str, interface: type, function: Callable[..., Any], *arguments: Any) -> Any:
        """Calls a function that makes an object, and returns it if it has all attributes of an interface."""
        made = self.call(what, function, *arguments)
        asked = sorted(name for name in {*vars(interface), *get_annotations(interface)} if not name.startswith("_"))
        if lacking := [name for name in asked if not self.call(what, hasattr, made, name)]:
            raise self.wrong(f"what {what} returns lacks {', '.join(lacking)}")
        if "refused" in asked and not isinstance(made.refused, Counter):
            raise self.wrong(f"{what}: refused must be a Counter, not {made.refused!r:.60}")
        return made

    def identifiers(self, what: str, made: Any) -> frozenset[int]:
        """Returns the identifiers of a made object; they must be whole numbers."""
        found = self.call(what, lambda: made.identifiers)
        if not (isinstance(found, (set, frozenset)) and all(type(can_id) is int for can_id in found)):
            raise self.wrong(f"{what}: identifiers must be a set of numbers, not {found!r:.60}")
        return frozenset(found)

    def periods(self, what: str, function: Callable[..., Any], *arguments: Any) -> dict[int, int]:
        """Calls a function that returns periods [ns] by identifier."""
        found = self.call(what, function, *arguments)
        if not (isinstance(found, dict) and all(type(one) is int and one > 0 for one in found.values())):
            raise self.wrong(f"{what}: must be periods [ns] by identifier, not {found!r:.60}")
        return found

    def frames(self, what: str, function: Callable[..., Any], *arguments: Any) -> list[Frame]:
        """Calls a function that returns frames."""
        frames = self.call(what, function, *arguments)
        if not isinstance(frames, list):
            raise self.wrong(f"{what} must return a list of frames, not {frames!r:.60}")
        for frame in frames:
            self.check(what, frame)
        return frames

    def check(self, what: str, frame: Any) -> None:
        """Raises PartRunError for an invalid frame or identifier."""
        if not (isinstance(frame, Frame) and type(frame.can_id) is int and type(frame.remote) is bool):
            raise self.wrong(f"{what} must return frames (echelon.bridge.protocols.frame.Frame), not {frame!r:.60}")
        if not (isinstance(frame.data, bytes) and len(frame.data) <= 8):
            raise self.wrong(f"{what}: a frame has up to 8 bytes, not {frame.data!r:.60}")
        if frame.can_id not in self.allowed:
            raise self.wrong(f"{what} sends identifier {frame.can_id:#05x}, which `identifiers` does not name")


class CheckedHost:
    """The host of a user's own protocol."""

    def __init__(self, robot: RobotPlan) -> None:
        self._caller = Caller.of(robot)
        self._host: Host = self._caller.make("host", Host, robot.drive.protocol.made.host, robot.drive)
        self.refused = self._host.refused
        self.identifiers = self._caller.identifiers("host", self._host)
        self.enabled, self.fault, self.torque, self.clipped = False, "", (0.0, 0.0), 0
        self.torque_ns: int | None = None
        self._read("host")

    @property
    def busy(self) -> bool:
        """True while a call goes on: seen from another thread, the host may hang."""
        return self._caller.busy

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns all due frames except torques."""
        return self._frames("poll", time_ns)

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m]."""
        return self._frames("command", time_ns, tau_right, tau_left, saturated)

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives."""
        return self._frames("stop", time_ns)

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the protocol's own emergency stop."""
        return self._frames("estop", time_ns)

    def start(self) -> None:
        """Lets `poll` enable the drives (again)."""
        self._caller.call("its host's start", self._host.start)
        self._read("start")

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""
        self._caller.call("its host's receive", self._host.receive, time_ns, frame)
        self._read("receive")

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m] on the mirrored path."""
        return self._frames("mirror", tau_right, tau_left, enable, saturated)

    def _frames(self, method: str, *arguments: Any) -> list[Frame]:
        kind, name = type(self._host), method
        if isinstance(self._host, CyclicHost) and getattr(kind, method) is getattr(CyclicHost, method):
            name = "encode"  # the frames are what this method of the protocol returned
        frames = self._caller.frames(f"its host's {name}", getattr(self._host, method), *arguments)
        self._read(method)
        return frames

    def _read(self, after: str) -> None:
        """Reads and checks the properties of the host; `after` names the call before."""
        host, what = self._host, f"its host after {after}"
        enabled, fault, torque, torque_ns, clipped = self._caller.call(
            what, lambda: (host.enabled, host.fault, host.torque, host.torque_ns, host.clipped)
        )
        if not isinstance(enabled, bool):
            raise self._caller.wrong(f"{what}: enabled must be True or False, not {enabled!r:.60}")
        if not isinstance(fault, str):
            raise self._caller.wrong(f"{what}: fault must be a text, not {fault!r:.60}")
        if not (isinstance(torque, tuple) and len(torque) == 2 and all(map(_is_finite, torque))):
            raise self._caller.wrong(f"{what}: torque must be two finite numbers [N m], not {torque!r:.60}")
        if not (torque_ns is None or type(torque_ns) is int):
            raise self._caller.wrong(f"{what}: torque_ns must be a time [ns] or None, not {torque_ns!r:.60}")
        if type(clipped) is not int:
            raise self._caller.wrong(f"{what}: clipped must be a whole number, not {clipped!r:.60}")
        self.enabled, self.fault, self.torque, self.clipped = enabled, fault, torque, clipped
        self.torque_ns = torque_ns


class CheckedDrive:
    """A virtual drive of a user's own protocol, number `number` of a robot."""

    def __init__(self, robot: RobotPlan, number: int) -> None:
        protocol: DriveProtocol = robot.drive.protocol.made
        self._caller = Caller.of(robot)
        self._drive: Drive = self._caller.make("drive", Drive, protocol.drive, robot.drive, number)
        self.refused = self._drive.refused
        self.identifiers = self._caller.identifiers("drive", self._drive)
        self.motors = self._caller.call("drive", lambda: tuple(self._drive.motors))
        count = len(protocol.wheels[number])
        if len(self.motors) != count or not all(isinstance(motor, Motor) for motor in self.motors):
            raise self._caller.wrong(
                f"drive: motors must be {count} echelon.bridge.protocols.motor.Motor, not {self.motors!r:.60}"
            )

    @property
    def due_ns(self) -> int:
        """When `advance` must be called next."""
        due_ns = self._caller.call("its drive's due_ns", lambda: self._drive.due_ns)
        if type(due_ns) is not int:
            raise self._caller.wrong(f"its drive's due_ns must be a time [ns], not {due_ns!r:.60}")
        return due_ns

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a frame; returns the immediate answers."""
        return self._caller.frames("its drive's receive", self._drive.receive, time_ns, frame)

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns the frames that the drive sends by itself."""
        frames = self._caller.frames("its drive's advance", self._drive.advance, time_ns)
        if (due_ns := self.due_ns) <= time_ns:
            raise self._caller.wrong(f"its drive's due_ns is {due_ns}, though advance({time_ns}) has done what was due")
        return frames

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault happen at one wheel."""
        return self._caller.frames("its drive's inject", self._drive.inject, time_ns, wheel, fault)

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Takes the cause of a fault away."""
        self._caller.call("its drive's mend", self._drive.mend, time_ns, wheel, fault)


class CheckedObserver:
    """The observer of a user's own protocol."""

    def __init__(self, robot: RobotPlan, closed: bool) -> None:
        make = robot.drive.protocol.made.observer
        self._caller = Caller.of(robot)
        self._observer: Observer = self._caller.make("observer", Observer, make, robot.drive, robot.envelope, closed)
        self.identifiers = self._caller.identifiers("observer", self._observer)
        self.cyclic = self._caller.periods("cyclic of its observer", lambda: self._observer.cyclic)
        self.wheels: tuple[WheelReading, WheelReading] = self._caller.call("observer", lambda: self._observer.wheels)
        if not (len(self.wheels) == 2 and all(isinstance(wheel, WheelReading) for wheel in self.wheels)):
            raise self._caller.wrong(f"observer: wheels must be two WheelReading, not {self.wheels!r:.60}")
        if not self.cyclic.keys() <= self.identifiers:
            raise self._caller.wrong(f"observer: cyclic must be of its identifiers, not {self.cyclic!r:.60}")

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns its findings."""
        found: list[Finding] = self._caller.call("its observer's observe", self._observer.observe, time_ns, frame)
        if not (isinstance(found, list) and all(isinstance(finding, Finding) for finding in found)):
            raise self._caller.wrong(f"its observer's observe must return a list of Finding, not {found!r:.60}")
        for wheel in self.wheels:
            for torque in (wheel.commanded, wheel.reported):
                if not (torque is None or _is_finite(torque)):
                    raise self._caller.wrong(f"its observer reads a torque that is no finite number: {torque!r:.60}")
        return found


class CheckedMaster:
    """The master of a user's own protocol."""

    def __init__(self, caller: Caller, master: Master) -> None:
        self._caller, self._master = caller, master

    @classmethod
    def made_by(cls, part: Part[Any], period_ns: int, watchdog_ns: int) -> Self | None:
        """Returns the master that a protocol makes, or None if it has none."""
        caller = Caller(part, "", part.made.shared_identifiers())
        if caller.call("master", part.made.master, period_ns, watchdog_ns) is None:
            return None
        return cls(caller, caller.make("master", Master, part.made.master, period_ns, watchdog_ns))

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns the due frames."""
        return self._caller.frames("its master's poll", self._master.poll, time_ns)

    def sync(self) -> Frame | None:
        """Returns the frame that must end with a period; None: there is none."""
        frame: Frame | None = self._caller.call("its master's sync", self._master.sync)
        if frame is not None:
            self._caller.check("its master's sync", frame)
        return frame


def those_at_rest_first(hosts: Iterable[tuple[int, Host]]) -> list[list[int]]:
    """Returns the numbers of hosts in up to two groups: those at rest, then those in the middle of a call.

    To stop wheels they are asked in this order: one that hangs keeps no other from being stopped."""
    rest, busy = list[int](), list[int]()
    for number, host in hosts:
        (busy if isinstance(host, CheckedHost) and host.busy else rest).append(number)
    return [group for group in (rest, busy) if group]


def _is_finite(number: Any) -> bool:
    return isinstance(number, (int, float)) and isfinite(number)
