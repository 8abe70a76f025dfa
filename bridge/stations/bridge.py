"""The interface of a bridge, and the bridge of a run without a bus.

torque path             class           role inside                   makes frames from
no bus                  NoBridge        –                             –
mirrored                MirrorBridge    bridge.roles.torque_mirror    copies of the robots' states
closed, virtual time    ClosedBridge    bridge.roles.commander        robots' torques, as a role in lockstep
closed, wall clock      WallBridge      a ClosedBridge                robots' torques, as soon as they come
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from echelon.bridge.reports import BridgeProgress, CanReport
from echelon.messages import Message


class Bridge(ABC):
    """Puts frames on the buses of a run and into can.log."""

    url: str = ""
    """URLs of the buses, separated by commas"""

    @abstractmethod
    def take(self, messages: Sequence[Message], copies: list[Message]) -> None:
        """Takes messages of the run in order of time; adds messages with the frames made of them to `copies`, for recorders.

        Raises PartRunError if a user's own protocol fails; the frames that were sent before are in `copies`."""

    @abstractmethod
    def stop(self) -> None:
        """Takes the torque away from all wheels and disables their drives.  Every run ends with this call.

        Raises PartRunError afterwards if a user's own protocol failed at it."""

    def interrupt(self) -> None:  # noqa: B027  most bridges wait for no bus
        """Ends any waiting for a bus that accepts no frames.  May be called from any thread when a run breaks off."""

    @abstractmethod
    def close(self) -> None:
        """Closes log and buses."""

    @abstractmethod
    def progress(self) -> BridgeProgress:
        """Returns the present state, for a live table."""

    @abstractmethod
    def report(self) -> CanReport | None:
        """Returns the report of the run; the wheels are as they were before `stop`.  None without a bus."""


class NoBridge(Bridge):
    """The bridge of a run without a bus."""

    def take(self, messages: Sequence[Message], copies: list[Message]) -> None:
        pass

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    def progress(self) -> BridgeProgress:
        return BridgeProgress()

    def report(self) -> None:
        return None
