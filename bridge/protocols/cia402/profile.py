"""The interface of a device profile: the methods of the device (drive.py) that the CANopen node (node.py) calls."""

from abc import ABC, abstractmethod

from echelon.bridge.protocols.cia402.pdo import Pdo
from echelon.bridge.protocols.cia402.sdo import Key


class Profile(ABC):
    """The device behind a node; instants are in ns."""

    @abstractmethod
    def _switch_on(self, time_ns: int) -> None:
        """Begins as after power-on.  The objects already have their first values."""

    @abstractmethod
    def _booted(self, time_ns: int) -> None:
        """Called when the boot-up message has been sent."""

    @abstractmethod
    def _physics(self, time_ns: int) -> None:
        """Lets time pass for the device."""

    @abstractmethod
    def _sample(self, time_ns: int, key: Key) -> int:
        """Returns the value of an object for a TPDO."""

    @abstractmethod
    def _allowed(self, key: Key, value: int) -> bool:
        """Returns whether an object of the profile may have a value within its limits."""

    @abstractmethod
    def _set(self, time_ns: int, key: Key, value: int) -> bool:
        """Sets an object of the profile to an allowed value and reacts to it; returns false if it is refused now."""

    @abstractmethod
    def _took(self, time_ns: int, pdo: Pdo) -> None:
        """Called when an RPDO has been accepted."""

    @abstractmethod
    def _missed(self, time_ns: int) -> None:
        """Called when an RPDO did not come in time."""

    @abstractmethod
    def _rest(self, time_ns: int) -> None:
        """Called when the node has left the NMT state OPERATIONAL."""

    @abstractmethod
    def _without_host(self, time_ns: int) -> None:
        """Called when the host's heartbeat is lost."""
