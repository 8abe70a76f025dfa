"""The host's side of one drive: bring-up, enabling, faults and recovery.

phase        entered when                               what the host sends
configure    at first; by recovery, except from the     NMT pre-operational; then the steps of `configuration`, one SDO request
             drive's state FAULT                        at a time: compare the rated torque, write heartbeats, PDOs and mode
start        all steps are done                         NMT start, until a heartbeat or a PDO shows OPERATIONAL
lead         the node is OPERATIONAL                    controlwords 06, 07, 0F, each when the statusword in TPDO1 shows the
                                                        state before it
enabled      OPERATION ENABLED and mode 10 are          target torques in RPDO2
             reported
fault        emergency message, silence, restart,       nothing; if the plan has a recovery time, a fault reset then (drive in
             refused step, state FAULT, or OPERATION    FAULT), or a new bring-up
             ENABLED left without command
stopped      `stop` or `estop` of the host              controlword 00 or 02, again if it seems to be lost

A request without an answer is repeated.  A drive whose rated torque is not the plan's is not enabled: torques on the bus are
thousandths of it.
"""

from typing import Final

from echelon.bridge.protocols.cia402.codec import (
    EMCY_ID,
    HEARTBEAT_ID,
    MODE_CYCLIC_TORQUE,
    RPDO1,
    RPDO2,
    RPDO_IDS,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    TPDO1,
    TPDO2,
    TPDO3,
    TPDO_IDS,
    Command,
    Nmt,
    NmtCommand,
    State,
    check_node,
    emergency_of,
    error_text,
    heartbeat_state,
    newton_metres,
    nmt,
    permille,
    rated_mnm,
    state_of,
)
from echelon.bridge.protocols.cia402.configuration import steps
from echelon.bridge.protocols.cia402.sdo import Abort, SdoClient, name
from echelon.bridge.protocols.frame import Frame, recovers_after_ns
from echelon.plan.can_plan import DrivePlan

_FAULT = "fault"
_SILENT = "silent"
PATIENCE: Final = 5
"""After this many periods without an answer a frame is sent again."""
_UP = {
    State.SWITCH_ON_DISABLED: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.ENABLE_OPERATION,
    State.OPERATION_ENABLED: Command.ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


class Wheel:
    """The host's view of the drive of one wheel."""

    def __init__(self, plan: DrivePlan, wheel: int) -> None:
        self.plan = plan
        self.node = check_node(plan.node_ids[wheel])
        self.steps = steps(plan, self.node)
        self.retry_ns = PATIENCE * plan.period_ns
        self.torque = 0.0
        self.position = 0
        self.velocity = 0
        self.torque_ns: int | None = None
        self.fault = ""
        self.fault_ns = 0
        self.recovering = False
        self.bring_up()

    def bring_up(self) -> None:
        """Begins the bring-up anew; the drive's state is unknown."""
        self.heard_ns: int | None = None
        self.sdo = SdoClient()
        self.step = -1  # number of the next step; -1: NMT pre-operational comes first
        self.asked_ns: int | None = None
        self.started_ns: int | None = None
        self.nmt: Nmt | None = None
        self.state: State | None = None
        self.mode = 0
        self.controlword: int | None = None
        self.controlled_ns: int | None = None

    @property
    def enabled(self) -> bool:
        """Whether the drive takes torque, by what it reported."""
        there = self.state is State.OPERATION_ENABLED and self.mode == MODE_CYCLIC_TORQUE
        return there and self.nmt is Nmt.OPERATIONAL and not self.fault

    def fail(self, time_ns: int, text: str) -> None:
        """Notes a fault.  The first one stays, unless it was only the unspecific `fault`."""
        if not self.fault or self.recovering:
            self.fault_ns = time_ns
        if not self.fault or self.fault == _FAULT:
            self.fault = text
        self.recovering = False

    def poll(self, time_ns: int, started: bool) -> list[Frame]:
        """Returns the frames that are due now."""
        if self._is_silent(time_ns):
            self.fault = ""
            self.fail(time_ns, _SILENT)
        if self.fault and not (started and self._recover(time_ns)):
            return []
        if self.step < len(self.steps):
            return self._configure(time_ns)
        if self.nmt is not Nmt.OPERATIONAL:
            if not self._late(time_ns, self.started_ns):
                return []
            self.started_ns = time_ns
            return [nmt(NmtCommand.START, self.node)]
        return self._lead(time_ns, started)

    def _is_silent(self, time_ns: int) -> bool:
        """Whether nothing came for the watchdog's time, although the heartbeat is configured (by the second step)."""
        heard_ns = self.heard_ns if self.step > 1 and self.fault != _SILENT else None
        return heard_ns is not None and time_ns - heard_ns >= self.plan.watchdog_ns

    def _late(self, time_ns: int, since_ns: int | None) -> bool:
        return since_ns is None or time_ns - since_ns >= self.retry_ns

    def _recover(self, time_ns: int) -> bool:
        """Begins the recovery from a fault if it is time; returns whether it is under way."""
        after_ns = recovers_after_ns(self.plan, time_ns)
        if after_ns is not None and time_ns - self.fault_ns >= after_ns:
            self.recover()
        return self.recovering

    def recover(self) -> None:
        """Lets `poll` clear the fault and enable the drive again."""
        if self.fault and not self.recovering:
            self.recovering = True
            if self.state is not State.FAULT:
                self.bring_up()

    def _configure(self, time_ns: int) -> list[Frame]:
        frames = []
        if self.step < 0:
            self.step = 0
            frames.append(nmt(NmtCommand.PRE_OPERATIONAL, self.node))
        if self.sdo.busy and not self._late(time_ns, self.asked_ns):
            return frames
        step = self.steps[self.step]
        self.asked_ns = time_ns
        request = self.sdo.upload(step.key) if step.read else self.sdo.download(step.key, step.data)
        return [*frames, Frame(SDO_REQUEST_ID + self.node, request)]

    def _lead(self, time_ns: int, started: bool) -> list[Frame]:
        """Returns the controlword that leads the drive up to OPERATION ENABLED, or down if it is not started."""
        if self.state is State.FAULT:
            if not self.recovering:
                return []
            # a fault reset is a rising edge: 00, then 80; it is repeated if it had no effect
            reset = self.controlword == Command.DISABLE_VOLTAGE.value
            if reset or self._late(time_ns, self.controlled_ns):
                return [self.control(time_ns, Command.FAULT_RESET if reset else Command.DISABLE_VOLTAGE)]
            return []
        if self.state is None:
            # a drive in OPERATIONAL reports after each SYNC: if it does not, start it again
            if self._late(time_ns, self.started_ns):
                self.nmt = None
            return []
        stopping = not started and self.controlword == Command.QUICK_STOP.value
        if stopping and self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
            # the drive stops by itself, as it is configured; only a lost controlword is sent again
            lost = self.state is State.OPERATION_ENABLED and self._late(time_ns, self.controlled_ns)
            return [self.control(time_ns, Command.QUICK_STOP)] if lost else []
        command = _UP.get(self.state) if started else Command.DISABLE_VOLTAGE
        if command is Command.ENABLE_OPERATION and self.mode != MODE_CYCLIC_TORQUE:
            command = Command.SWITCH_ON
        there = self.state is (State.OPERATION_ENABLED if started else State.SWITCH_ON_DISABLED)
        if command is None or (
            command.value == self.controlword and (there or not self._late(time_ns, self.controlled_ns))
        ):
            return []
        return [self.control(time_ns, command)]

    def control(self, time_ns: int, command: Command) -> Frame:
        """Returns RPDO1 with a controlword."""
        self.controlword, self.controlled_ns = command.value, time_ns
        return Frame(RPDO_IDS[0] + self.node, RPDO1.pack(command.value, MODE_CYCLIC_TORQUE))

    def target(self, torque: float) -> Frame:
        """Returns RPDO2 with a torque [N m]."""
        return Frame(RPDO_IDS[1] + self.node, RPDO2.pack(permille(torque, rated_mnm(self.plan.motor.rated_torque))))

    def receive(self, time_ns: int, base: int, data: bytes) -> str:
        """Takes the data of the frame with identifier `base` + node; returns the reason if they are refused, otherwise ""."""
        why = self._take(time_ns, base, data)
        if not why:
            self.heard_ns = time_ns
        return why

    def _take(self, time_ns: int, base: int, data: bytes) -> str:
        if base == SDO_ANSWER_ID:
            return self._answered(time_ns, data)
        if base == HEARTBEAT_ID:
            state = heartbeat_state(data)
            if state is None:
                return "heartbeat"
            if state is Nmt.BOOT_UP and self.step > 0:
                self.bring_up()
                self.fail(time_ns, "restarted")
            self.nmt = state
        elif base == EMCY_ID:
            said = emergency_of(data)
            if said is None:
                return "length"
            if said.code >> 8:
                self.fail(time_ns, error_text(said.code))
        elif base == TPDO_IDS[0]:
            if len(data) != TPDO1.size:
                return "length"
            return self._status(time_ns, *TPDO1.unpack(data))
        elif base == TPDO_IDS[1]:
            if len(data) != TPDO2.size:
                return "length"
            self.position, value = TPDO2.unpack(data)
            self.torque, self.torque_ns = newton_metres(value, rated_mnm(self.plan.motor.rated_torque)), time_ns
        else:
            if len(data) != TPDO3.size:
                return "length"
            (self.velocity,) = TPDO3.unpack(data)
        return ""

    def _status(self, time_ns: int, word: int, mode: int) -> str:
        state = state_of(word)
        if state is None:
            return "statusword"
        before, self.state, self.mode = self.state, state, mode
        # only an OPERATIONAL node sends PDOs, so the next heartbeat need not be awaited
        self.nmt = Nmt.OPERATIONAL
        if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            if not self.fault:
                self.fail(time_ns, _FAULT)
        elif self.recovering and self.step == len(self.steps):
            self.fault, self.recovering = "", False
        elif (
            before is State.OPERATION_ENABLED
            and state is not before
            and self.controlword == Command.ENABLE_OPERATION.value
        ):
            self.fail(time_ns, f"left OPERATION ENABLED for {state.words}")
        return ""

    def _answered(self, time_ns: int, data: bytes) -> str:
        try:
            follows = self.sdo.receive(data)
        except ValueError:
            return "SDO answer"
        if follows is not None or self.sdo.busy:
            # no object of the configuration needs segments
            self.sdo = SdoClient()
            return "SDO answer"
        step = self.steps[self.step]
        if self.sdo.abort is not None:
            self.fail(time_ns, f"SDO {name(step.key)} refused: {_abort_text(self.sdo.abort)}")
        elif step.read and self.sdo.data != step.data:
            value, wanted = int.from_bytes(self.sdo.data, "little"), int.from_bytes(step.data, "little")
            self.fail(time_ns, f"SDO {name(step.key)} is {value}, but {wanted} in the plan")
        else:
            self.step += 1
        return ""


def _abort_text(code: int) -> str:
    try:
        return Abort(code).name.lower().replace("_", " ")
    except ValueError:
        return f"0x{code:08X}"
