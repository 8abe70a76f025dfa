"""A CANopen node: network management (NMT), SDO, heartbeats and errors; its PDOs are in `process_data`.  A device profile is a
class derived from it.

NMT state          entered when                               what the node does
BOOT UP            at the first call with a time; when the    hears nothing for `BOOT_NS` (the first time it is ready at once);
                   power is back; NMT reset node; NMT reset   sends its boot-up message, then PRE-OPERATIONAL
                   communication
PRE-OPERATIONAL    after boot-up; NMT command                 SDO, heartbeat, emergency messages
OPERATIONAL        NMT start                                  also PDOs
STOPPED            NMT stop                                   heartbeat only

The host's heartbeat (object 1016) is watched from the first one on.  If it is lost, the device reacts (`profile`), and object
1029 decides about the NMT state.  By default the NMT state stays, so that the host can see the reason.

Frames that are refused are counted by reason.
"""

from collections.abc import Mapping
from typing import Final

from echelon.bridge.protocols.cia402 import objects
from echelon.bridge.protocols.cia402.codec import (
    HEARTBEAT_ID,
    HOST_NODE,
    NMT_ID,
    RPDO_IDS,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    ErrorCode,
    Nmt,
    NmtCommand,
    emergency,
    heartbeat,
    heartbeat_state,
)
from echelon.bridge.protocols.cia402.objects import Dictionary
from echelon.bridge.protocols.cia402.pdo import COMMUNICATION, MAPPING, check_change
from echelon.bridge.protocols.cia402.process_data import ProcessData
from echelon.bridge.protocols.cia402.sdo import LENGTH, Abort, Key, SdoError, SdoServer, abort_code
from echelon.bridge.protocols.frame import Frame
from echelon.plan.can_plan import NEVER_NS

MS = 1_000_000
BOOT_NS: Final = 10 * MS
"""How long a node boots: so who has just sent a reset can begin to listen for the boot-up message"""


class Node(ProcessData):
    """A node with the id `node`; `values` are those of objects without a default."""

    def __init__(self, node: int, values: Mapping[Key, int]) -> None:
        super().__init__(Dictionary(node, values))
        self.node = node
        self._sdo = SdoServer(self._od.read, self._write)
        self._now_ns = 0
        self._begun = False
        self._due: dict[tuple[str, int], int] = {}
        """Times of coming events [ns] by kind and number.  Kinds: `boot`; `heartbeat`; `host`: the host's heartbeat is lost;
        `tpdo`: the event timer or the inhibit time of a TPDO is over; `rpdo`: an RPDO did not come in time"""
        self._host_lost = False
        self._configure()

    # time

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""
        return self._identifiers

    @property
    def due_ns(self) -> int:
        """When `advance` must be called next."""
        return min(self._due.values(), default=NEVER_NS) if self._begun else -NEVER_NS

    def advance(self, time_ns: int) -> list[Frame]:
        """Lets time pass; returns the frames that the node sends by itself up to and including `time_ns`."""
        self._pass(time_ns)
        out, self._out = self._out, []
        return out

    def _pass(self, time_ns: int) -> None:
        """Lets all events up to and including `time_ns` happen, in order of time."""
        if not self._begun:
            self._begun = True
            self._power_on(time_ns, 0)
        due = self._due
        while due:
            what = min(due, key=due.__getitem__)
            due_ns = due[what]
            if due_ns > time_ns:
                break
            del due[what]
            self._physics(due_ns)
            self._happen(due_ns, *what)
        self._physics(time_ns)
        if self._unasked:
            self._send_changed(time_ns)

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a frame; returns the immediate answers."""
        out = self.advance(time_ns)
        if self.nmt is Nmt.BOOT_UP:
            return out
        self._now_ns = time_ns
        can_id, data, remote = frame
        numbers = self._numbers.get(can_id)
        if remote:
            self.refused["remote frame"] += 1
        elif numbers is not None:
            for number in numbers:
                self._rpdo(time_ns, self._rpdos[number], data)
        elif can_id == self._sync_id:
            self._sync(time_ns, data)
        elif can_id == NMT_ID:
            self._manage(time_ns, data)
        elif can_id == SDO_REQUEST_ID + self.node:
            self._request(data)
        elif can_id in (self._host_id, HEARTBEAT_ID + HOST_NODE):
            self._hear(time_ns, can_id, data)
        elif can_id != SYNC_ID:
            self.refused["PDO not valid" if can_id in self._identifiers else "identifier"] += 1
        return out + self.advance(time_ns)

    def _happen(self, time_ns: int, what: str, number: int) -> None:
        """Lets one event of `_due` happen."""
        match what:
            case "boot":
                self._out.append(heartbeat(self.node, Nmt.BOOT_UP))
                self.nmt = Nmt.PRE_OPERATIONAL
                self._beat_after(time_ns)
                self._booted(time_ns)
            case "heartbeat":
                self._out.append(heartbeat(self.node, self.nmt))
                self._beat_after(time_ns)
            case "host":
                self._lose_host(time_ns)
            case "rpdo":
                self._missed(time_ns)
            case "tpdo":
                self._send(time_ns, self._tpdos[number])

    def _set_due(self, what: str, number: int, time_ns: int, after_ns: int) -> None:
        if after_ns:
            self._due[what, number] = time_ns + after_ns
        else:
            self._due.pop((what, number), None)

    def _hasten(self, what: str, number: int, time_ns: int) -> None:
        self._due[what, number] = min(time_ns, self._due.get((what, number), NEVER_NS))

    def _drop_due(self, what: str) -> None:
        for key in [key for key in self._due if key[0] == what]:
            del self._due[key]

    def _beat_after(self, time_ns: int) -> None:
        """Schedules the next heartbeat."""
        self._set_due("heartbeat", 0, time_ns, self._od[objects.PRODUCER_HEARTBEAT] * MS)

    # network management

    def _power_on(self, time_ns: int, boot_ns: int = BOOT_NS) -> None:
        """Begins as after power-on: all objects have their first values."""
        self._od.reset()
        self._switch_on(time_ns)
        self._boot(time_ns, boot_ns)

    def _boot(self, time_ns: int, boot_ns: int = BOOT_NS) -> None:
        """Begins to boot: the node sends its boot-up message after `boot_ns`."""
        self.nmt = Nmt.BOOT_UP
        self._host_lost = False
        self._sdo.reset()
        self._due.clear()
        self._due["boot", 0] = time_ns + boot_ns
        self._configure()

    def _manage(self, time_ns: int, data: bytes) -> None:
        """Takes an NMT command."""
        if len(data) != 2:
            self.refused["length"] += 1
            return
        command, node = data
        if node not in (0, self.node):
            return
        match command:
            case NmtCommand.START:
                if self.nmt is not Nmt.OPERATIONAL:
                    self.nmt = Nmt.OPERATIONAL
                    self._begin_pdos(time_ns)
            case NmtCommand.STOP:
                self._leave(time_ns, Nmt.STOPPED)
            case NmtCommand.PRE_OPERATIONAL:
                self._leave(time_ns, Nmt.PRE_OPERATIONAL)
            case NmtCommand.RESET_NODE:
                self._leave(time_ns, Nmt.BOOT_UP)
                self._power_on(time_ns)
            case NmtCommand.RESET_COMMUNICATION:
                self._leave(time_ns, Nmt.BOOT_UP)
                self._od.reset(0x1000, 0x1FFF)
                self._boot(time_ns)
            case _:
                self.refused["NMT command"] += 1

    def _leave(self, time_ns: int, nmt: Nmt) -> None:
        """Changes the NMT state to one without PDOs."""
        if nmt is not self.nmt:
            self.nmt = nmt
            self._waiting.clear()
            self._drop_due("tpdo")
            self._rest(time_ns)

    def _hear(self, time_ns: int, can_id: int, data: bytes) -> None:
        """Takes a heartbeat of the host."""
        if heartbeat_state(data) is None:
            self.refused["heartbeat"] += 1
        elif can_id == self._host_id and self._host_ns:
            self._host_lost = False
            self._set_due("host", 0, time_ns, self._host_ns)

    def _lose_host(self, time_ns: int) -> None:
        """Reacts to the loss of the host's heartbeat."""
        self._host_lost = True
        self._without_host(time_ns)
        behaviour = self._od[objects.COMMUNICATION_ERROR]
        if self.nmt is Nmt.OPERATIONAL and behaviour != 1:
            self._leave(time_ns, Nmt.PRE_OPERATIONAL if behaviour == 0 else Nmt.STOPPED)

    def _report(self, errors: list[ErrorCode]) -> None:
        """Sends an emergency message with the last of the present errors, or with the code for no error."""
        code = errors[-1] if errors else ErrorCode.NONE
        register = 0
        for error in errors:
            register |= error.register
        od = self._od
        od[objects.ERROR_REGISTER] = register
        od[objects.ERROR_CODE] = code
        if code:
            for sub in range(objects.MAX_ERRORS, 1, -1):
                od[objects.ERRORS, sub] = od[objects.ERRORS, sub - 1]
            od[objects.ERRORS, 1] = code
            od[objects.ERRORS, 0] = min(od[objects.ERRORS, 0] + 1, objects.MAX_ERRORS)
        if self.nmt in (Nmt.PRE_OPERATIONAL, Nmt.OPERATIONAL):
            self._out.append(emergency(self.node, code, register))

    # objects

    def _configure(self) -> None:
        """Reads the configuration of PDOs, SYNC and the host's heartbeat from the objects."""
        self._read_pdos()
        od = self._od
        self._sync_id = od[objects.SYNC_COB_ID]
        host = od[objects.CONSUMER_HEARTBEAT]
        self._host_id, self._host_ns = HEARTBEAT_ID + (host >> 16 or HOST_NODE), (host & 0xFFFF) * MS
        fixed = (NMT_ID, SYNC_ID, self._sync_id, HEARTBEAT_ID + HOST_NODE, self._host_id, SDO_REQUEST_ID + self.node)
        self._identifiers = frozenset((*fixed, *self._numbers, *(base + self.node for base in RPDO_IDS)))

    def _request(self, data: bytes) -> None:
        """Takes an SDO request, and sends its answer."""
        if len(data) != LENGTH:
            self.refused["length"] += 1
        elif self.nmt not in (Nmt.PRE_OPERATIONAL, Nmt.OPERATIONAL):
            self.refused["SDO while stopped"] += 1
        else:
            answer = self._sdo.answer(data)
            if answer is not None:
                self._out.append(Frame(SDO_ANSWER_ID + self.node, answer))
                code = abort_code(answer)
                if code is not None:
                    self.refused[f"SDO {Abort(code).name.lower().replace('_', ' ')}"] += 1

    def _write(self, key: Key, data: bytes) -> None:
        """Writes an object for SDO.  Raises SdoError if this is not allowed."""
        od, time_ns = self._od, self._now_ns
        value = od.parse(key, data)
        check_change(od, key, value)
        if not self._allowed(key, value) or (key == objects.CONSUMER_HEARTBEAT and value >> 16 > HOST_NODE):
            raise SdoError(Abort.VALUE)
        if key[0] >= 0x2000:
            if not self._set(time_ns, key, value):
                raise SdoError(Abort.DEVICE_STATE)
            return
        od[key] = value
        if key == (objects.ERRORS, 0):
            od.reset(objects.ERRORS, objects.ERRORS)
        elif key == objects.PRODUCER_HEARTBEAT:
            self._beat_after(time_ns)
        elif key == objects.CONSUMER_HEARTBEAT:
            self._host_lost = False
            self._drop_due("host")
            self._configure()
        elif key == objects.SYNC_COB_ID:
            self._configure()
        elif key[0] in COMMUNICATION or key[0] in MAPPING:
            self._configure()
            if self.nmt is Nmt.OPERATIONAL:
                self._begin_pdos(time_ns)
