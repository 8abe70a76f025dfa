"""CiA 402 over CANopen: a drive for each wheel, cyclic synchronous torque mode."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from echelon.bridge.protocols.protocol import DriveProtocol

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cantools.database.can import Message

    from echelon.bridge.protocols.cia402.host import Master
    from echelon.bridge.protocols.frame import Drive, Host
    from echelon.bridge.protocols.observe import Observer
    from echelon.plan.can_plan import DrivePlan, EnvelopePlan, MotorPlan


class Cia402(DriveProtocol):
    """A CANopen node for each wheel; a bus has one SYNC and one heartbeat of the host (bridge.protocols.cia402.codec)."""

    nodes: ClassVar[range] = range(1, 127)

    def identifiers(self, node: int) -> frozenset[int]:
        """Returns the identifiers that the predefined set gives a node."""
        from echelon.bridge.protocols.cia402.codec import NODE_IDS

        return frozenset(base + node for base in NODE_IDS)

    def shared_identifiers(self) -> frozenset[int]:
        """Returns the identifiers of NMT, SYNC, and the host's heartbeat."""
        from echelon.bridge.protocols.cia402.codec import HEARTBEAT_ID, HOST_NODE, NMT_ID, SYNC_ID

        return frozenset((NMT_ID, SYNC_ID, HEARTBEAT_ID + HOST_NODE))

    def refuses(self, motor: MotorPlan) -> str:
        """Returns an error for a rated torque that object 6076 cannot hold; torques are thousandths of it."""
        if 1e-3 <= motor.rated_torque < 2**32 * 1e-3:
            return ""
        return f"rated_torque = {motor.rated_torque}: CiA 402 says it in 32 bits of 0.001 N m"

    def host(self, drive: DrivePlan) -> Host:
        """Returns the host of a robot's drives."""
        from echelon.bridge.protocols.cia402.host import Cia402Host

        return Cia402Host(drive)

    def drive(self, drive: DrivePlan, number: int) -> Drive:
        """Returns the virtual drive of a wheel."""
        from echelon.bridge.protocols.cia402.drive import Cia402Drive

        return Cia402Drive(drive, number)

    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> Observer:
        """Returns the observer of a robot's frames."""
        from echelon.bridge.protocols.cia402.observe import Cia402Observer

        return Cia402Observer(drive, envelope)

    def master(self, period_ns: int, watchdog_ns: int) -> Master:
        """Returns the master, which sends SYNC and the host's heartbeat."""
        from echelon.bridge.protocols.cia402.host import Master

        return Master(period_ns, watchdog_ns)

    def messages(self, drive: DrivePlan, name: str) -> list[Message]:
        """Returns PDOs, SDOs, emergency messages and heartbeats of both drives."""
        from echelon.bridge.protocols.cia402.dbc import messages

        return messages(drive, name)

    def shared_messages(self, period_ns: int, watchdog_ns: int) -> list[Message]:
        """Returns NMT, SYNC, and the host's heartbeat."""
        from echelon.bridge.protocols.cia402.dbc import shared_messages

        return shared_messages(period_ns, watchdog_ns)

    def shared_cyclic(self, period_ns: int, watchdog_ns: int) -> dict[int, int]:
        """Returns SYNC and the host's heartbeat."""
        from echelon.bridge.protocols.cia402.codec import HEARTBEAT_ID, HOST_NODE, SYNC_ID
        from echelon.bridge.protocols.cia402.configuration import heartbeat_ns

        return {SYNC_ID: period_ns, HEARTBEAT_ID + HOST_NODE: heartbeat_ns(period_ns, watchdog_ns)}

    def resolution(self, drive: DrivePlan) -> float:
        """Returns a thousandth of the rated torque."""
        return max(1, round(1000 * drive.motor.rated_torque)) * 1e-6

    def boot_ups(self, drive: DrivePlan) -> Mapping[tuple[int, bytes], frozenset[int]]:
        """Returns the boot-up messages of both nodes, with the identifiers of their reports and heartbeats."""
        from echelon.bridge.protocols.cia402.codec import HEARTBEAT_ID, TPDO_IDS, Nmt

        boot_up = bytes((Nmt.BOOT_UP,))
        return {
            (HEARTBEAT_ID + node, boot_up): frozenset(base + node for base in (*TPDO_IDS, HEARTBEAT_ID))
            for node in drive.node_ids
        }
