"""What a bridge is to those who run it, whichever way the torques go; and the bridge of a run without a bus.

way of the torques          bridge                                      frames are made from
no bus                      NoBridge
mirror                      MirrorBridge (bridge.roles.torque_mirror)         robots' states, as the run passes by
closed, virtual time        ClosedBridge (bridge.roles.commander)             robots' torques, a role in the lockstep
closed, wall clock          WallBridge, around a ClosedBridge           robots' torques, as they come
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

from echelon.bridge.reports import BridgeProgress, CanReport
from echelon.bridge.roles.commander import Commander
from echelon.messages import Message
from echelon.plan.plan import Plan


class Bridge(ABC):
    """Puts frames on the buses of a run and into can.log."""

    url: str = ""
    """Where the frames can be heard, bus by bus"""

    @abstractmethod
    def take(self, messages: Sequence[Message]) -> list[Message]:
        """Takes what the run says, in order of time; returns the frames that it makes of it, for those who watch."""

    @abstractmethod
    def stop(self) -> None:
        """Takes the torque away from all wheels and disables their drives: the end of every run, however it ends.

        After that it raises PartRunError if a protocol that others wrote failed at it."""

    def interrupt(self) -> None:  # noqa: B027  most bridges wait for no bus
        """Waits no more for a bus that takes no frames.  To be called, in any thread, when the run breaks off."""

    @abstractmethod
    def close(self) -> None:
        """Closes log and buses."""

    @abstractmethod
    def progress(self) -> BridgeProgress:
        """Returns how it stands."""

    @abstractmethod
    def report(self) -> CanReport | None:
        """Returns what became of frames and torques; of the wheels' state, as it was before `stop`.  None without a bus."""


class NoBridge(Bridge):
    """The bridge of a run without a bus."""

    def take(self, messages: Sequence[Message]) -> list[Message]:
        return []

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    def progress(self) -> BridgeProgress:
        return BridgeProgress()

    def report(self) -> None:
        return None


def open_bridge(plan: Plan, urls: Sequence[str], folder: Path, commander: Commander | None = None) -> Bridge:
    """Returns the bridge of a run in one process.  On a closed torque path `commander` is its role, and the virtual drives get
    the frames from it directly: on the buses they are only shown.

    Raises ValueError or OSError if a bus or a file cannot be had."""
    if commander is not None:
        from echelon.bridge.stations.closed import ClosedBridge

        return ClosedBridge(plan, urls, folder, paired=False, role=commander)
    if urls:
        from echelon.bridge.stations.mirror import MirrorBridge

        return MirrorBridge(plan, urls, folder)
    return NoBridge()
