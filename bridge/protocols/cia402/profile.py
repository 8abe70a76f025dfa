"""What a device profile adds to a CANopen node: node.py asks, the device in drive.py answers."""

from abc import ABC, abstractmethod

from echelon.bridge.protocols.cia402.pdo import Pdo
from echelon.bridge.protocols.cia402.sdo import Key


class Profile(ABC):
    """The device behind a node; instants in ns."""

    @abstractmethod
    def _switch_on(self, time_ns: int) -> None:
        """Begins as after power-on; objects have their first values again."""

    @abstractmethod
    def _booted(self, time_ns: int) -> None:
        """The boot-up message is sent."""

    @abstractmethod
    def _physics(self, time_ns: int) -> None:
        """Lets the device's own time pass."""

    @abstractmethod
    def _sample(self, time_ns: int, key: Key) -> int:
        """The value of an object for a TPDO."""

    @abstractmethod
    def _allowed(self, key: Key, value: int) -> bool:
        """Whether an object of the profile may ever have a value, besides its limits."""

    @abstractmethod
    def _set(self, time_ns: int, key: Key, value: int) -> bool:
        """Gives an object of the profile an allowed value, with all that follows; false if it is refused now."""

    @abstractmethod
    def _took(self, time_ns: int, pdo: Pdo) -> None:
        """An RPDO was taken."""

    @abstractmethod
    def _missed(self, time_ns: int) -> None:
        """An RPDO did not come in time."""

    @abstractmethod
    def _rest(self, time_ns: int) -> None:
        """The node is no longer operational."""

    @abstractmethod
    def _without_host(self, time_ns: int) -> None:
        """The host's heartbeat is lost."""
