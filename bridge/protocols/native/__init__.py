"""The native protocol: both wheels of a robot in one frame, with counter and CRC."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from echelon.bridge.protocols.protocol import DriveProtocol

if TYPE_CHECKING:
    from cantools.database.can import Message

    from echelon.bridge.protocols.frame import Drive, Host
    from echelon.bridge.protocols.observe import Observer
    from echelon.plan.can_plan import DrivePlan, EnvelopePlan


class Native(DriveProtocol):
    """One drive for both wheels of a robot.  Its identifiers are a base plus the robot's number (see codec.py)."""

    wheels: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1),)
    nodes: ClassVar[range] = range(127)
    by_number: ClassVar[bool] = True

    def identifiers(self, node: int) -> frozenset[int]:
        """Returns the identifiers of command, feedback and status."""
        from echelon.bridge.protocols.native.codec import BASE_ID, FEEDBACK_ID, STATUS_ID

        return frozenset(base + node for base in (BASE_ID, FEEDBACK_ID, STATUS_ID))

    def addresses(self, drive: DrivePlan) -> dict[str, dict[str, int]]:
        """Returns the identifiers, since no node id is visible on the bus."""
        kinds = ("command", "feedback", "status")
        return {"identifiers": dict(zip(kinds, sorted(self.identifiers(drive.node_ids[0])), strict=True))}

    def host(self, drive: DrivePlan) -> Host:
        """Returns the host of a robot's drive."""
        from echelon.bridge.protocols.native.host import NativeHost

        return NativeHost(drive)

    def drive(self, drive: DrivePlan, number: int) -> Drive:
        """Returns the virtual drive of both wheels."""
        from echelon.bridge.protocols.native.drive import NativeDrive

        return NativeDrive(drive)

    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> Observer:
        """Returns the observer of a robot's frames."""
        from echelon.bridge.protocols.native.observe import NativeObserver

        return NativeObserver(drive, envelope)

    def messages(self, drive: DrivePlan, name: str) -> list[Message]:
        """Returns the DBC messages of command, feedback and status."""
        from echelon.bridge.protocols.native.dbc import messages

        return messages(drive, name)
