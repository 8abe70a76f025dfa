"""The process data of a CANopen node: RPDOs and TPDOs, with SYNC, event timers and inhibit times.

PDOs are exchanged in the NMT state OPERATIONAL only.

transmission type   an RPDO acts                    a TPDO is sent 0                   at the next SYNC                at a
SYNC, if a value in it has changed since it was last sent 1 .. 240            at the next SYNC                at every SYNC,
every second one, and so on 254, 255            when it comes                   when a state in it changes, not before its
inhibit time is over; and when its
                                                    event timer is over
"""

from abc import abstractmethod
from collections import Counter

from echelon.bridge.protocols.cia402 import objects
from echelon.bridge.protocols.cia402.codec import Nmt
from echelon.bridge.protocols.cia402.objects import Dictionary
from echelon.bridge.protocols.cia402.pdo import Pdo, pack, pdos
from echelon.bridge.protocols.cia402.profile import Profile
from echelon.bridge.protocols.frame import Frame
from echelon.plan.can_plan import NEVER_NS

_STATES = (objects.STATUSWORD, objects.MODE_DISPLAY, objects.ERROR_CODE, objects.ERROR_REGISTER)
"""Objects whose change triggers a TPDO of type 254 or 255."""


class ProcessData(Profile):
    """The PDOs of a node.  `_read_pdos` must be called after each change of the objects that configure them."""

    def __init__(self, od: Dictionary) -> None:
        self.nmt = Nmt.BOOT_UP
        self.refused: Counter[str] = Counter()
        """Number of refused frames by reason"""
        self._od = od
        self._out: list[Frame] = []
        """Frames that wait to be returned by `advance`"""
        self._waiting: dict[int, list[int]] = {}
        """Values of RPDOs that wait for SYNC, by number of the PDO"""
        self._syncs = 0
        """Number of SYNCs since OPERATIONAL was entered"""
        self._sent: dict[int, tuple[int, list[int]]] = {}
        """For each TPDO that was sent: when it was last sent [ns], and the values then whose change triggers it"""

    @abstractmethod
    def _set_due(self, what: str, number: int, time_ns: int, after_ns: int) -> None:
        """Schedules an event of the node `after_ns` after `time_ns`; 0 cancels it."""

    @abstractmethod
    def _hasten(self, what: str, number: int, time_ns: int) -> None:
        """Schedules an event of the node for `time_ns`, unless it is scheduled for an earlier time."""

    @abstractmethod
    def _drop_due(self, what: str) -> None:
        """Cancels all events of a kind."""

    def _read_pdos(self) -> None:
        """Reads the configuration of all PDOs from the objects."""
        od = self._od
        self._rpdos = {pdo.number: pdo for pdo in pdos(od, objects.RPDO_COMMUNICATION, objects.RPDO_MAPPING)}
        self._tpdos = {pdo.number: pdo for pdo in pdos(od, objects.TPDO_COMMUNICATION, objects.TPDO_MAPPING)}
        self._numbers: dict[int, list[int]] = {}
        """Numbers of the RPDOs by identifier"""
        for pdo in self._rpdos.values():
            self._numbers.setdefault(pdo.can_id, []).append(pdo.number)
        self._unasked = any(not pdo.synchronous for pdo in self._tpdos.values())
        """Whether a TPDO is sent without a SYNC"""

    def _begin_pdos(self, time_ns: int) -> None:
        """Begins the exchange of PDOs, when OPERATIONAL is entered or a PDO is configured anew."""
        self._syncs = 0
        self._waiting.clear()
        self._sent.clear()
        self._drop_due("tpdo")
        for pdo in self._tpdos.values():
            if not pdo.synchronous:
                self._set_due("tpdo", pdo.number, time_ns, pdo.timer_ns)

    def _sync(self, time_ns: int, data: bytes) -> None:
        """Takes a SYNC: sends the TPDOs that are due with it, then lets the RPDOs act that wait for it."""
        if len(data) > 1:
            self.refused["length"] += 1
        elif self.nmt is Nmt.OPERATIONAL:
            self._syncs += 1
            for pdo in self._tpdos.values():
                if pdo.synchronous and not (pdo.transmission and self._syncs % pdo.transmission):
                    self._send(time_ns, pdo)
            waiting, self._waiting = self._waiting, {}
            for number, values in waiting.items():
                self._take(time_ns, self._rpdos[number], values)

    def _send(self, time_ns: int, pdo: Pdo) -> None:
        """Sends a TPDO, except one of type 0 without a change."""
        values = [self._sample(time_ns, key) for key in pdo.keys]
        if pdo.transmission == 0 and self._sent.get(pdo.number, (0, None))[1] == values:
            return
        self._sent[pdo.number] = time_ns, self._states(pdo) if pdo.transmission else values
        self._out.append(Frame(pdo.can_id, pack(pdo, values)))
        if not pdo.synchronous:
            self._set_due("tpdo", pdo.number, time_ns, pdo.timer_ns)

    def _states(self, pdo: Pdo) -> list[int]:
        """Returns the values in a TPDO whose change triggers it."""
        return [self._od[key] for key in pdo.keys if key in _STATES]

    def _send_changed(self, time_ns: int) -> None:
        """Sends the TPDOs of type 254 and 255 whose states have changed, at the end of their inhibit time at the earliest."""
        if self.nmt is not Nmt.OPERATIONAL:
            return
        for pdo in self._tpdos.values():
            sent_ns, states = self._sent.get(pdo.number, (-NEVER_NS, None))
            if pdo.synchronous or states == self._states(pdo):
                continue
            free_ns = sent_ns + pdo.inhibit_ns
            if free_ns <= time_ns:
                self._send(time_ns, pdo)
            else:
                self._hasten("tpdo", pdo.number, free_ns)

    def _rpdo(self, time_ns: int, pdo: Pdo, data: bytes) -> None:
        """Takes the data of an RPDO: at once, or to wait for SYNC."""
        if self.nmt is not Nmt.OPERATIONAL:
            self.refused["not operational"] += 1
        elif len(data) != pdo.layout.size:
            self.refused["length"] += 1
        else:
            values = list(pdo.layout.unpack(data))
            if not all(self._allowed(key, value) for key, value in zip(pdo.keys, values, strict=True)):
                self.refused["value"] += 1
            elif pdo.synchronous:
                self._waiting[pdo.number] = values
            else:
                self._take(time_ns, pdo, values)

    def _take(self, time_ns: int, pdo: Pdo, values: list[int]) -> None:
        """Sets the objects of an RPDO; it counts as accepted only if none of them is refused."""
        refused = 0
        for key, value in zip(pdo.keys, values, strict=True):
            refused += not self._set(time_ns, key, value)
        if not refused:
            self._took(time_ns, pdo)
