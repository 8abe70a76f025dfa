"""The host of a robot's two CiA 402 drives, and what a CANopen bus has one of: the master's heartbeat and SYNC.

Each drive is brought up by itself, one SDO request per `poll`:

    pre-operational -> rated torque read and compared, heartbeats, PDOs, mode written -> NMT start
    -> controlwords 06, 07, 0F, as the statusword in TPDO1 goes on -> target torques in RPDO2

What is not answered is asked again.  If the plan says after what time, a fault is recovered from: by a reset, or by a new
bring-up of a drive that was silent or restarted.  A drive whose rated torque is not the plan's is not enabled, since
torques would mean something else there.
"""

import math
from collections import Counter
from typing import Final, NamedTuple

from bridge.cia402 import objects
from bridge.cia402.codec import (
    EMCY_ID,
    HEARTBEAT_ID,
    HOST_NODE,
    MODE_CYCLIC_TORQUE,
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
    Command,
    Nmt,
    NmtCommand,
    State,
    check_node,
    emergency_of,
    error_text,
    heartbeat,
    heartbeat_state,
    milliseconds,
    newton_metres,
    nmt,
    permille,
    rated_mnm,
    state_of,
)
from bridge.cia402.sdo import Abort, Key, SdoClient, name
from bridge.frame import Frame
from echelon.plan import DrivePlan

WHEELS: Final = ("right", "left")
PATIENCE: Final = 5
"""After so many periods without an answer something is sent again."""
_UP = {
    State.SWITCH_ON_DISABLED: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.ENABLE_OPERATION,
    State.OPERATION_ENABLED: Command.ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
}


def heartbeat_ns(period_ns: int, watchdog_ns: int) -> int:
    """Returns the period of heartbeats: at most two fifths of the watchdog's, in whole periods, one at least."""
    return max(1, watchdog_ns * 2 // 5 // period_ns) * period_ns


class Master:
    """What goes out once per bus, whatever the number of robots; the smallest watchdog of them counts."""

    def __init__(self, period_ns: int, watchdog_ns: int) -> None:
        if period_ns <= 0 or watchdog_ns <= 0:
            raise ValueError(f"period and watchdog must be positive, not {period_ns!r} and {watchdog_ns!r} ns")
        self._every_ns = heartbeat_ns(period_ns, watchdog_ns)
        self._next_ns: int | None = None

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns the host's heartbeat when it is due; to be called once per period."""
        if self._next_ns is not None and time_ns < self._next_ns:
            return []
        self._next_ns = time_ns + self._every_ns
        return [heartbeat(HOST_NODE, Nmt.OPERATIONAL)]

    def sync(self) -> Frame:
        """Returns the SYNC; at its end the drives sample what they report."""
        return Frame(SYNC_ID)


class _Step(NamedTuple):
    """An object to write; to read and compare, if `read`."""

    key: Key
    data: bytes
    read: bool = False


def _pdo_steps(
    communication: int, mapping: int, cob_id: int, mapped: tuple[Key, ...], kind: int, timer_ms: int
) -> list[_Step]:
    def u32(value: int) -> bytes:
        return value.to_bytes(4, "little")

    steps = [
        _Step((communication, objects.COB_ID), u32(cob_id | objects.NOT_VALID)),
        _Step((communication, objects.TRANSMISSION), bytes((kind,))),
        _Step((mapping, 0), b"\0"),
    ]
    if timer_ms:
        steps.append(_Step((communication, objects.EVENT_TIMER), timer_ms.to_bytes(2, "little")))
    steps += [_Step((mapping, sub), u32(objects.mapping_value(key))) for sub, key in enumerate(mapped, 1)]
    return [*steps, _Step((mapping, 0), bytes((len(mapped),))), _Step((communication, objects.COB_ID), u32(cob_id))]


def _steps(plan: DrivePlan, node: int) -> list[_Step]:
    """What makes a drive of one that was just switched on, whatever it had before."""
    watchdog = milliseconds(plan.watchdog_ns)
    beat_ns = heartbeat_ns(plan.period_ns, plan.watchdog_ns)
    beat = milliseconds(beat_ns)
    # a host that is gone is noticed by its torques first
    host = milliseconds(plan.watchdog_ns + beat_ns)
    steps = [
        _Step(objects.RATED_TORQUE, rated_mnm(plan.motor.rated_torque).to_bytes(4, "little"), read=True),
        _Step(objects.PRODUCER_HEARTBEAT, beat.to_bytes(2, "little")),
        _Step(objects.CONSUMER_HEARTBEAT, (HOST_NODE << 16 | host).to_bytes(4, "little")),
        _Step(objects.ABORT_CONNECTION, b"\x01\0"),
        _Step(objects.MODE, bytes((MODE_CYCLIC_TORQUE,))),
    ]
    for number, mapped in enumerate(objects.RPDO_MAPPED[:2]):
        index, mapping, timer = objects.RPDO_COMMUNICATION + number, objects.RPDO_MAPPING + number, number * watchdog
        steps += _pdo_steps(index, mapping, RPDO_IDS[number] + node, mapped, 255, timer)
    for number, mapped in enumerate(objects.TPDO_MAPPED[:3]):
        index, mapping = objects.TPDO_COMMUNICATION + number, objects.TPDO_MAPPING + number
        steps += _pdo_steps(index, mapping, TPDO_IDS[number] + node | objects.NO_REMOTE, mapped, 1, 0)
    return steps


class _Wheel:
    """One drive as its host sees it."""

    def __init__(self, plan: DrivePlan, wheel: int) -> None:
        self.plan = plan
        self.node = check_node(plan.node_ids[wheel])
        self.steps = _steps(plan, self.node)
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
        """Begins anew, with a drive of which nothing is known."""
        self.heard_ns: int | None = None
        self.sdo = SdoClient()
        self.step = -1  # -1: to be made pre-operational first
        self.asked_ns: int | None = None
        self.started_ns: int | None = None
        self.nmt: Nmt | None = None
        self.state: State | None = None
        self.mode = 0
        self.controlword: int | None = None
        self.controlled_ns = 0

    @property
    def enabled(self) -> bool:
        """Whether it takes torque, as far as it said."""
        there = self.state is State.OPERATION_ENABLED and self.mode == MODE_CYCLIC_TORQUE
        return there and self.nmt is Nmt.OPERATIONAL and not self.fault

    def fail(self, time_ns: int, text: str) -> None:
        """Notes what is wrong; what came first stays, unless it says less."""
        if not self.fault or self.recovering:
            self.fault_ns = time_ns
        if not self.fault or self.fault == _FAULT:
            self.fault = text
        self.recovering = False

    def poll(self, time_ns: int, started: bool) -> list[Frame]:
        """Returns what is to be sent to it now."""
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
        """Whether it says nothing although its heartbeat is set, which is the second step."""
        heard_ns = self.heard_ns if self.step > 1 and self.fault != _SILENT else None
        return heard_ns is not None and time_ns - heard_ns >= self.plan.watchdog_ns

    def _late(self, time_ns: int, since_ns: int | None) -> bool:
        return since_ns is None or time_ns - since_ns >= self.retry_ns

    def _recover(self, time_ns: int) -> bool:
        """Whether something may be done about the fault now."""
        after_ns = self.plan.recover_ns
        if after_ns is None or time_ns - self.fault_ns < after_ns:
            return False
        if not self.recovering:
            self.recovering = True
            if self.state is not State.FAULT:
                self.bring_up()
        return True

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
        """Leads the state machine up, or down if it is not to be enabled."""
        if self.state is State.FAULT:
            if not self.recovering:
                return []
            # a rising edge is needed, and one that did not help is made again
            reset = self.controlword == Command.DISABLE_VOLTAGE.value
            if reset or self._late(time_ns, self.controlled_ns):
                return [self.control(time_ns, Command.FAULT_RESET if reset else Command.DISABLE_VOLTAGE)]
            return []
        if self.state is None:
            # it should say something after each SYNC
            if self._late(time_ns, self.started_ns):
                self.nmt = None
            return []
        command = _UP.get(self.state) if started else Command.DISABLE_VOLTAGE
        if command is Command.ENABLE_OPERATION and self.mode != MODE_CYCLIC_TORQUE and self.controlword is not None:
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
        """Takes data of the frame with identifier `base` + node; returns why it is refused, or nothing."""
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
        # what a PDO says of NMT holds until the next heartbeat: only an operational node sends it
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
            # nothing here needs segments
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


_FAULT = "fault"
_SILENT = "silent"


def _abort_text(code: int) -> str:
    try:
        return Abort(code).name.lower().replace("_", " ")
    except ValueError:
        return f"0x{code:08X}"


class Cia402Host:
    """Commands both drives of robot number `robot`.  Raises ValueError for bad node ids, or twice the same."""

    def __init__(self, plan: DrivePlan, robot: int) -> None:
        if plan.node_ids[0] == plan.node_ids[1]:
            raise ValueError(f"each wheel needs a node id of its own, not twice {plan.node_ids[0]}")
        self.plan = plan
        self.robot = robot
        self.refused: Counter[str] = Counter()
        self._wheels = (_Wheel(plan, 0), _Wheel(plan, 1))
        bases = (EMCY_ID, *TPDO_IDS[:3], SDO_ANSWER_ID, HEARTBEAT_ID)
        self._listeners = {base + wheel.node: (wheel, base) for wheel in self._wheels for base in bases}
        self._started = True
        self._ready = False  # a zero torque was sent since both are enabled

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it listens to."""
        return frozenset(self._listeners)

    @property
    def torque(self) -> tuple[float, float]:
        """Torque of the right and left wheel as the drives last reported it, means between two SYNCs [N m]."""
        right, left = self._wheels
        return right.torque, left.torque

    @property
    def torque_ns(self) -> int | None:
        """When the older of the two came; None before both did."""
        right, left = (wheel.torque_ns for wheel in self._wheels)
        return None if right is None or left is None else min(right, left)

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, as far as their drives said."""
        right, left = self._wheels
        return self._started and right.enabled and left.enabled

    @property
    def fault(self) -> str:
        """What a drive reports to be wrong, in words; empty if nothing is."""
        return "; ".join(
            f"{name}: {wheel.fault}" for name, wheel in zip(WHEELS, self._wheels, strict=True) if wheel.fault
        )

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns what is due besides torques: to bring drives up, or clear a fault and enable anew."""
        return [frame for wheel in self._wheels for frame in wheel.poll(time_ns, self._started)]

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m], finite ones; zeros are sent while a drive is not enabled."""
        if not (math.isfinite(tau_right) and math.isfinite(tau_left)):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        enabled = self.enabled
        torques = (tau_right, tau_left) if enabled and self._ready else (0.0, 0.0)
        self._ready = enabled
        return [
            wheel.target(torque)
            for wheel, torque in zip(self._wheels, torques, strict=True)
            if wheel.nmt is Nmt.OPERATIONAL
        ]

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives; they stay so until `start`."""
        self._started = self._ready = False
        return [
            frame
            for wheel in self._wheels
            if wheel.nmt is Nmt.OPERATIONAL
            for frame in (wheel.target(0.0), wheel.control(time_ns, Command.DISABLE_VOLTAGE))
        ]

    def start(self) -> None:
        """Lets `poll` enable the drives (again).  A new host is started."""
        self._started = True

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""
        listener = self._listeners.get(frame.can_id)
        if frame.remote or listener is None:
            self.refused["remote frame" if frame.remote else "identifier"] += 1
            return
        wheel, base = listener
        why = wheel.receive(time_ns, base, frame.data)
        if why:
            self.refused[why] += 1
