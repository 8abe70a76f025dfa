"""What a drive protocol is: the base class of all of them, those built in and those that others write.

A protocol is one class.  It makes what commands a robot's drives (its host), the virtual drives, what listens (the observer)
and the DBC, and says where the drives are on a bus.  Nothing outside its folder or file names it, except for the registry of
those built in (bridge.protocols.registry).  docs/add-a-protocol.md shows how to write one.

All methods are pure.  A process of a run imports the class with the plan, whether it needs the protocol or not, so what takes
long to import (cantools, a host, a drive) is imported in the methods.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from echelon.bridge.protocols.frame import WHEELS, Drive, Host, Master
from echelon.bridge.protocols.observe import Observer
from echelon.plan.can_plan import DrivePlan, EnvelopePlan, MotorPlan
from echelon.plugins import Plugin

if TYPE_CHECKING:
    from cantools.database.can import Message


class DriveProtocol(Plugin, ABC):
    """Base of all drive protocols; the fields of a class are its parameters."""

    wheels: ClassVar[tuple[tuple[int, ...], ...]] = ((0,), (1,))
    """The wheels (0 right, 1 left) of each drive of a robot: a drive for each, or ((0, 1),), one for both"""
    nodes: ClassVar[range] = range(127)
    """Node ids that a drive may have; unless a robot's number or the scenario says so, no drive has 0"""
    by_number: ClassVar[bool] = False
    """True: a robot's number is the node id of its drives, and the scenario cannot choose another"""
    empty_asks: ClassVar[bool] = False
    """True: a frame without data asks for the frame with its identifier, as a remote frame does"""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.wheels not in (((0,), (1,)), ((0, 1),)):
            raise TypeError(f"{cls.__name__}.wheels must be ((0,), (1,)) or ((0, 1),), not {cls.wheels!r}")
        if not (isinstance(cls.nodes, range) and cls.nodes):
            raise TypeError(f"{cls.__name__}.nodes must be a range of node ids, not {cls.nodes!r}")

    # Where drives are on a bus

    @abstractmethod
    def identifiers(self, node: int) -> frozenset[int]:
        """Returns the identifiers of the frames that a node alone sends or is sent, so that no two drives use one.

        The host's frames count too."""

    def shared_identifiers(self) -> frozenset[int]:
        """Returns the identifiers that all drives of the protocol on a bus share."""
        return frozenset()

    def refuses(self, motor: MotorPlan) -> str:
        """Returns what the protocol cannot say of a motor, beginning with the key: `rated_torque = 1e9: …`; empty if it can say
        all."""
        return ""

    def addresses(self, drive: DrivePlan) -> dict[str, dict[str, int]]:
        """Returns how a host addresses a robot's drives, for people: its `nodes` by wheel, or its `identifiers` by kind."""
        return {"nodes": dict(zip(WHEELS, drive.node_ids, strict=True))}

    # Who speaks and who listens

    @abstractmethod
    def host(self, drive: DrivePlan) -> Host:
        """Returns what commands the drives of a robot."""

    @abstractmethod
    def drive(self, drive: DrivePlan, number: int) -> Drive:
        """Returns one of a robot's virtual drives: that of the wheels `wheels[number]`."""

    @abstractmethod
    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> Observer:
        """Returns what listens to a robot's frames.  Not `closed`: torque is mirrored and nobody answers."""

    def master(self, period_ns: int, watchdog_ns: int) -> Master | None:
        """Returns what a bus has one of, whatever the number of robots on it, if the protocol has that."""
        return None

    # What those who look at a bus need to know

    @abstractmethod
    def messages(self, drive: DrivePlan, name: str) -> "list[Message]":
        """Returns the DBC messages of a robot's frames; `name` stands for the robot, a DBC identifier of up to 23 characters.

        Each identifier that comes regularly has one: the load of a bus is computed from them."""

    def shared_messages(self, period_ns: int, watchdog_ns: int) -> "list[Message]":
        """Returns the DBC messages of `shared_identifiers`."""
        return []

    def shared_cyclic(self, period_ns: int, watchdog_ns: int) -> dict[int, int]:
        """Returns which of `shared_identifiers` come regularly, with their periods [ns]."""
        return {}

    def resolution(self, drive: DrivePlan) -> float:
        """Returns the step of torques in the protocol's frames [N m]; 0 for floating point."""
        return drive.torque_scale

    def boot_ups(self, drive: DrivePlan) -> Mapping[tuple[int, bytes], frozenset[int]]:
        """Returns which cyclic identifiers begin anew with a frame, by that frame's identifier and data."""
        return {}
