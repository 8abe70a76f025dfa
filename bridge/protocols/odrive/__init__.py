"""The protocol of ODrive: CANSimple, firmware 0.6, an axis for each wheel, torque control."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from echelon.bridge.protocols.protocol import DriveProtocol

if TYPE_CHECKING:
    from cantools.database.can import Message

    from echelon.bridge.protocols.frame import Drive, Host
    from echelon.bridge.protocols.observe import Observer
    from echelon.plan.can_plan import DrivePlan, EnvelopePlan


class ODrive(DriveProtocol):
    """An axis for each wheel; each axis is a node with 32 consecutive identifiers (bridge.protocols.odrive.codec)."""

    nodes: ClassVar[range] = range(63)
    empty_asks: ClassVar[bool] = True

    control_mode: Literal["position", "torque"] = "position"
    """The mode that is stored in a virtual drive, which it has from power-on: `position` as delivered, or `torque`.  With
    `torque` a host need not send `Set_Controller_Mode`"""

    def identifiers(self, node: int) -> frozenset[int]:
        """Returns the identifiers of a node's 32 commands."""
        from echelon.bridge.protocols.odrive.codec import frame_id

        return frozenset(frame_id(node, command) for command in range(32))

    def host(self, drive: DrivePlan) -> Host:
        """Returns the host of a robot's axes."""
        from echelon.bridge.protocols.odrive.host import ODriveHost

        return ODriveHost(drive)

    def drive(self, drive: DrivePlan, number: int) -> Drive:
        """Returns a virtual axis."""
        from echelon.bridge.protocols.odrive.config import ODriveConfig
        from echelon.bridge.protocols.odrive.drive import ODriveDrive
        from echelon.bridge.protocols.odrive.enums import ControlMode

        stored = ControlMode.TORQUE_CONTROL if self.control_mode == "torque" else ControlMode.POSITION_CONTROL
        return ODriveDrive(drive, number, ODriveConfig(control_mode=stored))

    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> Observer:
        """Returns the observer of a robot's frames; on the mirrored path it expects no heartbeats."""
        from echelon.bridge.protocols.odrive.config import ODriveConfig
        from echelon.bridge.protocols.odrive.observe import ODriveObserver

        return ODriveObserver(drive, envelope, ODriveConfig() if closed else ODriveConfig(heartbeat_msg_rate_ms=0))

    def messages(self, drive: DrivePlan, name: str) -> list[Message]:
        """Returns the vendor's messages for both axes."""
        from echelon.bridge.protocols.odrive.dbc import messages

        return messages(drive, name)

    def resolution(self, drive: DrivePlan) -> float:
        """Returns 0, since torques are floating point."""
        return 0.0
