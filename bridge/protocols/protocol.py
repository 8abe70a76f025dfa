"""The base class of all drive protocols, built in or written by users (docs/architecture.md, 5.3).

A protocol is one class.  It makes the host (which commands a robot's drives), the virtual drives, the observer (which listens)
and the DBC messages, and says which identifiers and node ids the drives use.  No code outside its folder names a
protocol, except the registry of the built-in ones (bridge.protocols.registry).  docs/add-a-protocol.md shows how to write one.

All methods are pure.  Every process of a run imports the class with the plan, whether it needs the protocol or not.  So what
only types need is imported for type checks alone, and all other imports (cantools, host, drive) are inside the methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from echelon.plugins import Plugin

if TYPE_CHECKING:
    from cantools.database.can import Message

    from echelon.bridge.protocols.frame import Drive, Host, Master
    from echelon.bridge.protocols.observe import Observer
    from echelon.plan.can_plan import DrivePlan, EnvelopePlan, MotorPlan


class DriveProtocol(Plugin, ABC):
    """Base of all drive protocols.  The fields of a class are its parameters."""

    wheels: ClassVar[tuple[tuple[int, ...], ...]] = ((0,), (1,))
    """The wheels (0 right, 1 left) of each drive of a robot: ((0,), (1,)) is a drive for each wheel, ((0, 1),) one for both"""
    nodes: ClassVar[range] = range(127)
    """Node ids that a drive may have; planning gives 0 to a drive only if `by_number` is set or the scenario says so"""
    by_number: ClassVar[bool] = False
    """True: the node id of a robot's drives is the robot's number, and the scenario cannot choose another"""
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
        """Returns the identifiers of all frames from and to this node alone, the host's commands included.

        Two drives on a bus must not share one of them."""

    def shared_identifiers(self) -> frozenset[int]:
        """Returns the identifiers that all drives of the protocol on a bus share."""
        return frozenset()

    def refuses(self, motor: MotorPlan) -> str:
        """Returns which value of a motor the protocol cannot express, beginning with its key: `rated_torque = 1e9: …`.

        Returns "" if it can express all of them."""
        return ""

    def addresses(self, drive: DrivePlan) -> dict[str, dict[str, int]]:
        """Returns the addresses of a robot's drives for display: `nodes` by wheel, or `identifiers` by kind of frame."""
        from echelon.bridge.protocols.frame import WHEELS

        return {"nodes": dict(zip(WHEELS, drive.node_ids, strict=True))}

    # Hosts, drives, observers

    @abstractmethod
    def host(self, drive: DrivePlan) -> Host:
        """Returns the host of a robot's drives."""

    @abstractmethod
    def drive(self, drive: DrivePlan, number: int) -> Drive:
        """Returns the virtual drive of the wheels `wheels[number]`."""

    @abstractmethod
    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> Observer:
        """Returns the observer of a robot's frames.  `closed` is false on the mirrored path, where no drive answers."""

    def master(self, period_ns: int, watchdog_ns: int) -> Master | None:
        """Returns the master of a bus, or None if the protocol has none."""
        return None

    # Descriptions of the frames

    @abstractmethod
    def messages(self, drive: DrivePlan, name: str) -> list[Message]:
        """Returns the DBC messages of a robot's frames.  `name` is the robot's name as a DBC identifier of up to 23 characters.

        Each cyclic identifier must have a message, since the load of a bus is computed from them."""

    def shared_messages(self, period_ns: int, watchdog_ns: int) -> list[Message]:
        """Returns the DBC messages of `shared_identifiers`."""
        return []

    def shared_cyclic(self, period_ns: int, watchdog_ns: int) -> dict[int, int]:
        """Returns the cyclic ones of `shared_identifiers` with their periods [ns]."""
        return {}

    def resolution(self, drive: DrivePlan) -> float:
        """Returns the resolution of torques in the frames [N m per bit]; 0 for floating point."""
        return drive.torque_scale

    def boot_ups(self, drive: DrivePlan) -> Mapping[tuple[int, bytes], frozenset[int]]:
        """Returns boot-up messages, by identifier and data, with the cyclic identifiers that begin anew after them."""
        return {}
