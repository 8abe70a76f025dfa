"""The native observer: no findings on a healthy bus, and a finding for each violation."""

from math import inf

import numpy as np
import pytest
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]

from conformance.test_drives import Rig, enabled_rig
from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.faults import LATCHING, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import FaultCode, Feedback, NativeCodec, Status, encode_status
from echelon.bridge.protocols.native.observe import NativeObserver
from echelon.bridge.protocols.observe import Finding
from support.bench_drives import ENVELOPE, MS, drive_plan

ROBOT = 3
COMMAND, FEEDBACK, STATUS = 0x103, 0x183, 0x203
PLAN = drive_plan("native")
CODEC = NativeCodec(PLAN.torque_scale)
OFF, ON, FAULT = WheelState.DISABLED, WheelState.ENABLED, WheelState.FAULT
NONE = FaultCode.NONE


def with_crc(can_id: int, body: bytes) -> bytes:
    return body + bytes([Crc8SaeJ1850.calc(can_id.to_bytes(2, "little") + body)])


class Bus:
    """A bus with an observer, on which the test puts frames with correct counters."""

    def __init__(self) -> None:
        self.observer = NativeObserver(PLAN, ENVELOPE)
        self.counters = {COMMAND: 0, FEEDBACK: 0, STATUS: 0}
        self.time_ns = 0

    def put(self, can_id: int, data: bytes, remote: bool = False) -> list[str]:
        """Puts a frame on the bus; returns the kinds of its findings."""
        found = self.observer.observe(self.time_ns, Frame(can_id, data, remote))
        assert all((finding.time_ns, finding.can_id) == (self.time_ns, can_id) for finding in found)
        assert all(finding.text for finding in found)
        return [finding.kind for finding in found]

    def command(
        self,
        right: float = 0.0,
        left: float = 0.0,
        enable: tuple[bool, bool] = (True, True),
        clear: bool = False,
        skip: int = 1,
    ) -> list[str]:
        self.counters[COMMAND] += skip
        return self.put(
            COMMAND, CODEC.encode(ROBOT, right, left, self.counters[COMMAND], enable=enable, clear=clear)[0]
        )

    def feedback(
        self,
        right: float = 0.0,
        left: float = 0.0,
        states: tuple[WheelState, WheelState] = (ON, ON),
        faults: tuple[FaultCode, FaultCode] = (NONE, NONE),
        skip: int = 1,
    ) -> list[str]:
        self.counters[FEEDBACK] += skip
        feedback = Feedback(ROBOT, (right, left), states, faults, self.counters[FEEDBACK])
        return self.put(FEEDBACK, CODEC.encode_feedback(feedback))


@pytest.fixture
def bus() -> Bus:
    return Bus()


def findings(rig: Rig) -> list[Finding]:
    """Returns the findings in all frames of a rig's bus; at the same instant, drives' frames come first."""
    observer = NativeObserver(rig.plan, ENVELOPE)
    frames = sorted(rig.sent + rig.commanded, key=lambda timed: timed[0])
    return [finding for time_ns, frame in frames for finding in observer.observe(time_ns, frame)]


@pytest.mark.parametrize("fault", [*LATCHING, Fault.SILENT])
def test_nothing_is_found_where_all_keep_the_rules(fault: Fault) -> None:
    rig, random = enabled_rig("native", recover_ns=100 * MS), np.random.default_rng(5)
    for at in range(400):
        if at % 100 == 50:
            rig.inject(at // 100 % 2, fault)
        if at % 100 == 70:
            rig.mend(at // 100 % 2, fault)
        rig.cycle(*random.uniform(-1.5, 1.5, 2))
    rig.to_drives(rig.time_ns, rig.host.stop(rig.time_ns))
    rig.cycles(20)
    assert findings(rig) == []
    assert sum(frame.can_id == FEEDBACK for _, frame in rig.sent) > 300


def test_a_watchdog_that_does_its_work_is_no_finding() -> None:
    rig = enabled_rig("native")
    rig.cycles(30, command=False)
    assert findings(rig) == []
    assert rig.drives[0].motors[0].torque == 0.0


def test_stuck_torque_is_found() -> None:
    rig = enabled_rig("native")
    rig.inject(0, Fault.STUCK_TORQUE)
    rig.cycles(5, 0.5, 0.0)
    rig.to_drives(rig.time_ns, rig.host.stop(rig.time_ns))
    rig.cycles(5)
    found = findings(rig)
    assert {finding.kind for finding in found} == {"torque while disabled"}
    assert all(finding.can_id == FEEDBACK and finding.text.startswith("right: 0.5 N m") for finding in found)
    assert 3 <= len(found) <= 5


def test_readings(bus: Bus) -> None:
    bus.time_ns = 7
    bus.command(0.25, -0.5, enable=(True, False))
    bus.time_ns = 8
    bus.feedback(0.125, 0.0, (ON, FAULT), (NONE, FaultCode.BROWN_OUT))
    bus.put(STATUS, encode_status(Status(ROBOT, (3.0, -4.0), 24.0, 30.0, 1)))
    right, left = bus.observer.wheels
    assert (right.commanded, right.commanded_ns, right.reported, right.reported_ns) == (0.25, 7, 0.125, 8)
    assert (right.state, right.fault, right.speed) == ("enabled", "", 3.0)
    assert (left.commanded, left.state, left.fault, left.speed) == (0.0, "fault", "brown out", -4.0)


def test_what_comes_regularly() -> None:
    observer = NativeObserver(PLAN, ENVELOPE)
    assert observer.cyclic == {COMMAND: 10 * MS, FEEDBACK: 10 * MS, STATUS: 100 * MS}
    assert observer.identifiers == {COMMAND, FEEDBACK, STATUS}


@pytest.mark.parametrize("can_id", [COMMAND, FEEDBACK, STATUS])
def test_frames_that_are_none(bus: Bus, can_id: int) -> None:
    assert bus.put(can_id, bytes(7)) == ["length"]
    assert bus.put(can_id, bytes(8)) == ["crc"]
    assert bus.put(can_id, b"", remote=True) == ["remote"]
    assert bus.put(can_id + 1, bytes(8)) == []
    assert bus.observer.wheels[0].commanded_ns is None


def test_a_value_that_is_never_sent(bus: Bus) -> None:
    assert bus.put(COMMAND, with_crc(COMMAND, bytes.fromhex("00800000030000"))) == ["value"]
    assert bus.put(FEEDBACK, with_crc(FEEDBACK, bytes.fromhex("00000000030000"))) == ["value"]


@pytest.mark.parametrize("can_id", [COMMAND, FEEDBACK])
def test_counters(bus: Bus, can_id: int) -> None:
    send = bus.command if can_id == COMMAND else bus.feedback
    assert send(skip=3) == []
    assert send() == []
    assert send(skip=3) == ["counter gap"]
    assert send(skip=0) == ["counter repeated"]
    assert send(skip=14) == ["counter gap"]


@pytest.mark.parametrize("sign", [1, -1])
def test_torque_above_the_envelopes(bus: Bus, sign: int) -> None:
    bus.command()
    assert bus.command(sign * 1.5, sign * 1.5004) == []
    assert bus.command(0.0, sign * 1.501) == ["torque above limit"]
    assert bus.feedback(sign * 1.5, 0.0) == []
    assert bus.feedback(sign * 1.501, sign * 1.6) == ["torque above limit"] * 2


def test_an_envelope_without_limit() -> None:
    observer = NativeObserver(PLAN, ENVELOPE.__class__(inf, inf, inf, inf, 1))
    data, _ = CODEC.encode(ROBOT, 32.767, -32.767, 0)
    assert observer.observe(0, Frame(COMMAND, data)) == []


def test_a_command_that_asks_without_enabling(bus: Bus) -> None:
    assert bus.put(COMMAND, with_crc(COMMAND, bytes.fromhex("f4010000020000"))) == ["torque while disabled"]
    assert bus.put(COMMAND, with_crc(COMMAND, bytes.fromhex("0000f401010100"))) == ["torque while disabled"]
    assert bus.put(COMMAND, with_crc(COMMAND, bytes.fromhex("0000f401030200"))) == ["enabled with torque"]


def test_enabling_with_torque(bus: Bus) -> None:
    assert bus.command(0.5, 0.5) == []  # the wheels may have been enabled before the first frame
    assert bus.command(0.5, 0.0, enable=(True, False)) == []
    assert bus.command(0.5, 0.5) == ["enabled with torque"]
    assert bus.command(0.5, 0.5) == []
    bus.command(enable=(False, False))
    assert bus.command() == []
    assert bus.command(0.5, 0.5) == []


def test_torque_reported_while_disabled(bus: Bus) -> None:
    assert bus.feedback(0.5, 0.0, (OFF, OFF)) == []  # the wheel may have been enabled before
    assert bus.feedback(0.5, 0.0, (OFF, OFF)) == ["torque while disabled"]
    bus.command()
    assert bus.feedback(0.5, 0.0, (OFF, OFF)) == []  # the wheel was enabled and disabled again since the last feedback
    assert bus.feedback(0.0, -0.001, (OFF, FAULT), (NONE, FaultCode.WATCHDOG)) == ["torque while disabled"]
    assert bus.feedback(0.0, 0.0, (OFF, FAULT), (NONE, FaultCode.WATCHDOG)) == []


def test_torque_reported_after_silence(bus: Bus) -> None:
    bus.command()
    bus.time_ns = PLAN.watchdog_ns + PLAN.period_ns
    assert bus.feedback(0.5, 0.0) == []
    bus.time_ns += 1
    assert bus.feedback(0.5, 0.0) == ["torque after silence"]
    assert bus.feedback(0.0, 0.0) == []


def test_torque_reported_though_nobody_ever_commanded(bus: Bus) -> None:
    assert bus.feedback(0.5, 0.0) == []
    bus.time_ns = PLAN.watchdog_ns + PLAN.period_ns + 1
    assert bus.feedback(0.5, 0.0) == ["torque after silence"]


def test_a_fault_left_without_clear(bus: Bus) -> None:
    broken = (FAULT, ON), (FaultCode.ENCODER_LOSS, NONE)
    bus.command()
    bus.feedback(0.0, 0.0, *broken)
    assert bus.feedback(0.0, 0.0, (OFF, ON)) == ["fault left without clear"]
    bus.feedback(0.0, 0.0, *broken)
    bus.command(enable=(False, True), clear=True)
    assert bus.feedback(0.0, 0.0, *broken) == []  # its cause was still there
    assert bus.feedback(0.0, 0.0, (OFF, ON)) == []
    bus.feedback(0.0, 0.0, *broken)
    assert bus.feedback(0.0, 0.0, (ON, ON)) == ["fault left without clear"]
