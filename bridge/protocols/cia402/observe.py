"""The observer of the CANopen frames of a robot's two drives.  Pure."""

from collections.abc import Iterable
from math import tau
from typing import Final

from echelon.bridge.protocols.cia402.codec import (
    AUTOMATIC,
    EMCY_ID,
    HEARTBEAT_ID,
    NMT_ID,
    RPDO1,
    RPDO2,
    RPDO_IDS,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO1,
    TPDO2,
    TPDO3,
    TPDO_IDS,
    Nmt,
    NmtCommand,
    State,
    check_node,
    emergency_of,
    error_text,
    heartbeat_state,
    newton_metres,
    next_state,
    rated_mnm,
    state_of,
)
from echelon.bridge.protocols.cia402.configuration import heartbeat_ns
from echelon.bridge.protocols.cia402.objects import CONTROLWORD, TARGET_TORQUE
from echelon.bridge.protocols.cia402.sdo import LENGTH, written
from echelon.bridge.protocols.frame import WHEELS, Frame
from echelon.bridge.protocols.observe import Finding, WheelReading
from echelon.plan.can_plan import DrivePlan, EnvelopePlan

_LENGTHS: Final = {
    RPDO_IDS[0]: RPDO1.size,
    RPDO_IDS[1]: RPDO2.size,
    TPDO_IDS[0]: TPDO1.size,
    TPDO_IDS[1]: TPDO2.size,
    TPDO_IDS[2]: TPDO3.size,
    SDO_REQUEST_ID: LENGTH,
    SDO_ANSWER_ID: LENGTH,
}
_FAULTS = frozenset((State.FAULT_REACTION_ACTIVE, State.FAULT))
_AFTER_POWER_ON = frozenset((State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED))


class _Drive:
    """One drive, by its frames."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.reading = WheelReading()
        self.nmt: Nmt | None = None  # None: not known
        self.start_ns: int | None = None  # time of the last NMT start
        self.state: State | None = None
        self.may_be: frozenset[State] | None = None  # states that the drive may be in by now; None: any
        self.controlword = 0
        self.words: list[tuple[int, int]] = []  # controlwords since the last statusword, each with the one before it
        self.live = False  # the drive may have had torque since the last statusword but one


class Cia402Observer:
    """Listens to the frames of one robot.  Kinds of findings:

    remote, length, heartbeat, statusword    an invalid frame
    torque above limit                       a commanded torque exceeds the envelope's by more than half a bit
    transition                               a state that cannot be reached from the last one with the controlwords seen
    enabled without command                  the same for OPERATION ENABLED
    torque while disabled                    torque is reported though the drive cannot have been in OPERATION ENABLED
                                             since the last report
    torque after silence                     torque is reported though no target torque came for the watchdog's time before
    not operational                          a PDO from or to a drive that is not OPERATIONAL by its heartbeat

    The first statusword may have any state, unless the drive's boot-up was seen.  An emergency message is no finding; it sets
    `WheelReading.fault`.
    """

    def __init__(self, plan: DrivePlan, envelope: EnvelopePlan) -> None:
        self._plan = plan
        self._rated = rated_mnm(plan.motor.rated_torque)
        self._limit = envelope.torque_limit + 0.500001 * newton_metres(1, self._rated)
        self._drives = (_Drive(WHEELS[0]), _Drive(WHEELS[1]))
        self.wheels = (self._drives[0].reading, self._drives[1].reading)
        nodes = [check_node(node) for node in plan.node_ids]
        self._nodes = dict(zip(nodes, self._drives, strict=True))
        bases = (EMCY_ID, *_LENGTHS, HEARTBEAT_ID)
        self._functions = {base + node: (base, self._nodes[node]) for base in bases for node in nodes}
        self.identifiers = frozenset((NMT_ID, SYNC_ID, *self._functions))
        self._syncs_ns: tuple[int, int] | None = None  # times of the last two SYNCs
        cyclic = (RPDO_IDS[1], *TPDO_IDS[:3])
        self.cyclic = {base + node: plan.period_ns for node in nodes for base in cyclic}
        beat_ns = heartbeat_ns(plan.period_ns, plan.watchdog_ns)
        self.cyclic |= {HEARTBEAT_ID + node: beat_ns for node in nodes}

    def observe(self, time_ns: int, frame: Frame) -> list[Finding]:
        """Takes a frame; returns its findings.  Frames of other robots are ignored."""
        if frame.can_id not in self.identifiers:
            return []
        if frame.remote:
            said = [("remote", "nobody answers remote frames")]
        elif frame.can_id == SYNC_ID:
            said = []
            self._syncs_ns = (self._syncs_ns[1], time_ns) if self._syncs_ns else (time_ns, time_ns)
        elif frame.can_id == NMT_ID:
            said = self._manage(time_ns, frame.data)
        else:
            base, drive = self._functions[frame.can_id]
            if len(frame.data) != _LENGTHS.get(base, len(frame.data)):
                said = [("length", f"{len(frame.data)} bytes, not {_LENGTHS[base]}")]
            else:
                said = list(self._take(time_ns, base, drive, frame.data))
        return [Finding(time_ns, frame.can_id, kind, text) for kind, text in said]

    def _manage(self, time_ns: int, data: bytes) -> list[tuple[str, str]]:
        if len(data) != 2:
            return [("length", f"{len(data)} bytes, not 2")]
        for node, drive in self._nodes.items():
            if data[1] in (0, node):
                drive.nmt = None
                if data[0] == NmtCommand.START:
                    drive.start_ns = time_ns
                elif drive.may_be is not None:
                    drive.may_be |= _AFTER_POWER_ON  # the drive is disabled, or begins as after power-on
        return []

    def _take(self, time_ns: int, base: int, drive: _Drive, data: bytes) -> Iterable[tuple[str, str]]:
        if (base in RPDO_IDS or base in TPDO_IDS) and drive.nmt not in (None, Nmt.OPERATIONAL):
            yield "not operational", f"{drive.name}: a PDO while {drive.nmt.name.lower().replace('_', '-')}"
        if base == RPDO_IDS[0]:
            self._control(drive, RPDO1.unpack(data)[0])
        elif base == RPDO_IDS[1]:
            yield from self._command(time_ns, drive, RPDO2.unpack(data)[0])
        elif base == SDO_REQUEST_ID:
            key, value = written(data)
            if key == CONTROLWORD:
                self._control(drive, value)
            elif key == TARGET_TORQUE:
                yield from self._command(time_ns, drive, value - (value >> 15 << 16))
        elif base == TPDO_IDS[0]:
            yield from self._status(drive, TPDO1.unpack(data)[0])
        elif base == TPDO_IDS[1]:
            yield from self._report(time_ns, drive, TPDO2.unpack(data)[1])
        elif base == TPDO_IDS[2]:
            drive.reading.speed = TPDO3.unpack(data)[0] / self._plan.motor.encoder_counts * tau
        elif base == EMCY_ID:
            said = emergency_of(data)
            if said is None:
                yield "length", f"{len(data)} bytes, not 8"
            else:
                drive.reading.fault = error_text(said.code) if said.code else ""
        elif base == HEARTBEAT_ID:
            nmt = heartbeat_state(data)
            if nmt is None:
                yield "heartbeat", f"{drive.name}: {data.hex().upper() or 'no data'} is no state"
            else:
                self._beat(time_ns, drive, nmt)

    def _beat(self, time_ns: int, drive: _Drive, nmt: Nmt) -> None:
        if nmt is Nmt.BOOT_UP:
            drive.may_be, drive.words, drive.controlword = _AFTER_POWER_ON, [], 0
        # a heartbeat that had to wait for the bus may be older than the NMT start
        just_started = drive.start_ns is not None and time_ns - drive.start_ns < self._plan.period_ns
        drive.nmt = None if just_started else nmt

    def _control(self, drive: _Drive, word: int) -> None:
        change = word, drive.controlword
        drive.controlword = word
        drive.words.append(change)
        if drive.may_be is not None:
            drive.may_be = _reachable(drive.may_be, [change])
            drive.live |= State.OPERATION_ENABLED in drive.may_be

    def _command(self, time_ns: int, drive: _Drive, value: int) -> Iterable[tuple[str, str]]:
        torque = newton_metres(value, self._rated)
        drive.reading.commanded, drive.reading.commanded_ns = torque, time_ns
        if abs(torque) > self._limit:
            yield "torque above limit", f"{drive.name}: {torque:g} N m"

    def _status(self, drive: _Drive, word: int) -> Iterable[tuple[str, str]]:
        state = state_of(word)
        if state is None:
            yield "statusword", f"{drive.name}: 0x{word:04X} tells no state"
            return
        may_be = drive.may_be
        if may_be is not None and state not in may_be and state not in _FAULTS:
            kind = "enabled without command" if state is State.OPERATION_ENABLED else "transition"
            yield kind, f"{drive.name}: {state.words} after {drive.reading.state or 'power-on'}"
        # controlwords since the last statusword may have arrived after this one was sampled
        drive.may_be = _reachable(frozenset((state,)), drive.words)
        drive.words = []
        drive.live = State.OPERATION_ENABLED in (drive.state, *drive.may_be)
        if state in _FAULTS:
            drive.reading.fault = drive.reading.fault or "fault"
        elif drive.state in _FAULTS:
            drive.reading.fault = ""
        drive.state, drive.reading.state = state, state.words

    def _report(self, time_ns: int, drive: _Drive, value: int) -> Iterable[tuple[str, str]]:
        torque = newton_metres(value, self._rated)
        drive.reading.reported, drive.reading.reported_ns = torque, time_ns
        if not value:
            return
        if drive.state is not None and not drive.live:
            yield "torque while disabled", f"{drive.name}: {torque:g} N m while {drive.state.words}"
        # the reported torque is the mean between the last two SYNCs
        since_ns = time_ns - self._plan.period_ns if self._syncs_ns is None else self._syncs_ns[0]
        commanded_ns = drive.reading.commanded_ns
        if commanded_ns is None or since_ns - commanded_ns > self._plan.watchdog_ns:
            yield "torque after silence", f"{drive.name}: {torque:g} N m without a target torque in time"


def _reachable(states: frozenset[State], words: Iterable[tuple[int, int]]) -> frozenset[State]:
    """Returns the states that may be reached from `states` by themselves or by controlwords, any of which may come later."""
    found = _settled(states)
    for word, before in words:
        found |= _settled(frozenset(next_state(state, word, before) for state in found))
    return found


def _settled(states: frozenset[State]) -> frozenset[State]:
    return states | {AUTOMATIC[state] for state in states if state in AUTOMATIC}
