"""The native drive and host: their own properties.  tests/conformance has those of all protocols."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.cyclic.drive import CAUSE_PERSISTS, FIRST_NOT_ZERO, NOT_CLEARED
from echelon.bridge.protocols.cyclic.frames import REMOTE
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import (
    FaultCode,
    Feedback,
    NativeCodec,
    Refusal,
    Status,
    Torque,
    decode_status,
    encode_status,
)
from echelon.bridge.protocols.native.drive import REPEATED, NativeDrive
from echelon.bridge.protocols.native.host import NativeHost
from support.bench_drives import MS, drive_plan

ROBOT = 3
COMMAND, FEEDBACK, STATUS = 0x103, 0x183, 0x203
PERIOD_NS, WATCHDOG_NS = 10 * MS, 100 * MS
PLAN = drive_plan("native")
CODEC = NativeCodec(PLAN.torque_scale)
OFF, ON, FAULT = WheelState.DISABLED, WheelState.ENABLED, WheelState.FAULT
FINE = (FaultCode.NONE, FaultCode.NONE)


class Sender:
    """Makes commands with consecutive counters."""

    def __init__(self) -> None:
        self.counter = 0

    def __call__(
        self,
        right: float = 0.0,
        left: float = 0.0,
        enable: tuple[bool, bool] = (True, True),
        clear: bool = False,
        estop: bool = False,
    ) -> Frame:
        self.counter += 1
        data, _ = CODEC.encode(ROBOT, right, left, self.counter, enable=enable, clear=clear, estop=estop)
        return Frame(COMMAND, data)


@pytest.fixture
def send() -> Sender:
    return Sender()


@pytest.fixture
def drive() -> NativeDrive:
    made = NativeDrive(PLAN)
    made.advance(0)
    return made


def torques(drive: NativeDrive) -> list[float]:
    return [motor.torque for motor in drive.motors]


def said(frames: list[Frame]) -> Feedback:
    (frame,) = [frame for frame in frames if frame.can_id == FEEDBACK]
    feedback = CODEC.decode_feedback(*frame[:2])
    assert isinstance(feedback, Feedback)
    return feedback


def test_feedback_and_status_come_at_their_times() -> None:
    drive = NativeDrive(PLAN)
    times = []
    for time_ms in range(-3, 250):
        for can_id, _, remote in drive.advance(time_ms * MS):
            assert not remote
            times.append((time_ms, can_id))
    feedback = [time_ms for time_ms, can_id in times if can_id == FEEDBACK]
    assert feedback == list(range(0, 250, 10))
    assert [time_ms for time_ms, can_id in times if can_id == STATUS] == [0, 100, 200]
    assert drive.due_ns == 250 * MS


def test_feedback_tells_means_states_and_counts_itself(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    drive.receive(2 * MS, send(1.0, -0.5))
    drive.receive(6 * MS, send(-1.0, 0.5))
    first, second = said(drive.advance(10 * MS)), said(drive.advance(20 * MS))
    assert first.torques == pytest.approx((0.0, 0.0), abs=1e-9)  # 2 ms zero, 4 ms forward, 4 ms backward
    assert second.torques == pytest.approx((-1.0, 0.5))
    assert (first.states, first.faults, first.robot) == ((ON, ON), FINE, ROBOT)
    assert (first.counter, second.counter) == (1, 2)


def test_status_tells_of_the_bench(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    frames = []
    for time_ns in range(0, 2001 * MS, PERIOD_NS):
        frames += drive.advance(time_ns)
        drive.receive(time_ns, send(0.2, -0.1))
    status = decode_status(*[frame for frame in frames if frame.can_id == STATUS][-1][:2])
    assert isinstance(status, Status)
    right, left = drive.motors
    # the encoder has 8192 counts per turn, and 10 ms to count them
    assert status.speeds == pytest.approx((right.omega, left.omega), abs=2 * np.pi / 8192 / 0.01 + 0.01)
    assert status.speeds[0] > 5.0
    assert abs(status.voltage - right.bus_voltage) <= 0.25 + 1e-9
    assert abs(status.temperature - right.temperature) <= 0.5 + 1e-9
    assert right.temperature > left.temperature > 25.0
    assert right.bus_voltage < left.bus_voltage


def test_each_wheel_is_enabled_by_a_zero_of_its_own(drive: NativeDrive, send: Sender) -> None:
    drive.receive(MS, send(0.0, 0.4))
    assert (drive.states, torques(drive), drive.refused) == ([ON, OFF], [0.0, 0.0], {FIRST_NOT_ZERO: 1})
    drive.receive(2 * MS, send(0.3, 0.0004))  # less than half a bit
    assert (drive.states, torques(drive)) == ([ON, ON], [pytest.approx(0.3), 0.0])
    drive.receive(3 * MS, send(0.3, 0.4, enable=(False, True)))
    assert (drive.states, torques(drive)) == ([OFF, ON], [0.0, pytest.approx(0.4)])
    drive.receive(4 * MS, send(0.001, 0.4))
    assert (drive.states, drive.refused[FIRST_NOT_ZERO]) == ([OFF, ON], 2)


def test_a_fault_is_left_step_by_step(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    drive.inject(MS, 1, Fault.BROWN_OUT)
    assert said(drive.advance(10 * MS)).states == (ON, FAULT)
    drive.receive(11 * MS, send(0.5, 0.5))
    assert (torques(drive), drive.refused) == ([0.5, 0.0], {NOT_CLEARED: 1})
    drive.receive(12 * MS, send(0.5, 0.0, clear=True))
    assert (drive.states, drive.refused[CAUSE_PERSISTS]) == ([ON, FAULT], 1)
    drive.mend(13 * MS, 1, Fault.BROWN_OUT)
    drive.receive(14 * MS, send(0.5, 0.0))
    assert drive.states == [ON, FAULT]
    drive.receive(15 * MS, send(0.5, 0.0, clear=True))
    assert drive.states == [ON, OFF]  # the command that clears does not enable
    drive.receive(16 * MS, send(0.5, 0.5))
    assert (drive.states, drive.refused[FIRST_NOT_ZERO]) == ([ON, OFF], 1)
    drive.receive(17 * MS, send(0.5, 0.0))
    drive.receive(18 * MS, send(0.5, 0.5))
    assert (drive.states, torques(drive)) == ([ON, ON], [0.5, 0.5])
    assert said(drive.advance(20 * MS)).faults == FINE


@pytest.mark.parametrize(
    ("fault", "code"),
    [(Fault.OVER_TEMPERATURE, 1), (Fault.ENCODER_LOSS, 2), (Fault.BROWN_OUT, 3)],
)
def test_fault_codes(drive: NativeDrive, fault: Fault, code: int) -> None:
    drive.inject(MS, 0, fault)
    assert said(drive.advance(10 * MS)).faults == (code, 0)


def test_the_first_fault_is_the_one_that_is_told(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    drive.inject(MS, 0, Fault.ENCODER_LOSS)
    drive.inject(2 * MS, 0, Fault.BROWN_OUT)
    frames = drive.advance(WATCHDOG_NS)
    last = CODEC.decode_feedback(*[frame for frame in frames if frame.can_id == FEEDBACK][-1][:2])
    assert isinstance(last, Feedback)
    assert (last.states, last.faults) == ((FAULT, FAULT), (FaultCode.ENCODER_LOSS, FaultCode.WATCHDOG))


def test_emergency_stop(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    drive.receive(MS, send(0.5, 0.5))
    drive.receive(2 * MS, send(0.5, 0.5, estop=True))
    assert (drive.states, torques(drive)) == ([FAULT, FAULT], [0.0, 0.0])
    assert said(drive.advance(10 * MS)).faults == (FaultCode.ESTOP, FaultCode.ESTOP)
    drive.receive(11 * MS, send(clear=True))
    assert drive.states == [OFF, OFF]


def bad_frames(good: Frame) -> dict[str, Frame]:
    """Returns frames that must be refused, by the reason."""
    body = good.data[:4] + b"\x03" + good.data[5:7]
    never = b"\x00\x80" + body[2:]
    return {
        "length": Frame(COMMAND, good.data[:7]),
        "crc": Frame(COMMAND, good.data[:7] + bytes([good.data[7] ^ 1])),
        "value": Frame(COMMAND, never + bytes([Crc8SaeJ1850.calc(b"\x03\x01" + never)])),
        "identifier": Frame(0x104, good.data),
        "remote": Frame(COMMAND, b"", remote=True),
    }


@pytest.mark.parametrize("reason", [*bad_frames(Frame(COMMAND, bytes(8))), REPEATED])
def test_what_is_refused_does_not_feed_the_watchdog(drive: NativeDrive, send: Sender, reason: str) -> None:
    drive.receive(0, send())
    last = send(0.5, 0.5)
    drive.receive(MS, last)
    for time_ms in range(2, 100):
        frame = last if reason == REPEATED else bad_frames(send(-0.5, 0.5))[reason]
        drive.receive(time_ms * MS, frame)
        assert torques(drive) == [0.5, 0.5]
    assert drive.refused == {reason: 98}
    drive.advance(MS + WATCHDOG_NS - 1)
    assert drive.states == [ON, ON]
    assert drive.due_ns == MS + WATCHDOG_NS
    drive.advance(MS + WATCHDOG_NS)
    assert (drive.states, torques(drive)) == ([FAULT, FAULT], [0.0, 0.0])


def test_a_gap_is_counted_and_accepted(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    send.counter += 4
    drive.receive(MS, send(0.25, 0.25))
    assert (torques(drive), drive.counter.missed, drive.refused) == ([0.25, 0.25], 4, {})


def test_power_on_takes_any_counter_and_knows_no_fault(drive: NativeDrive, send: Sender) -> None:
    drive.receive(0, send())
    drive.advance(2 * WATCHDOG_NS)
    assert drive.states == [FAULT, FAULT]
    drive.inject(2 * WATCHDOG_NS, 0, Fault.SILENT)
    drive.inject(2 * WATCHDOG_NS, 1, Fault.SILENT)
    drive.mend(2 * WATCHDOG_NS + MS, 0, Fault.SILENT)
    send.counter -= 1
    assert (
        drive.receive(2 * WATCHDOG_NS + 2 * MS, send()) == []
    )  # the fault at the other wheel still silences the drive
    drive.mend(2 * WATCHDOG_NS + 3 * MS, 1, Fault.SILENT)
    send.counter -= 1
    drive.receive(2 * WATCHDOG_NS + 4 * MS, send())
    assert (drive.states, drive.faults, drive.refused) == ([ON, ON], [None, None], {})
    assert said(drive.advance(2 * WATCHDOG_NS + PERIOD_NS)).torques == (0.0, 0.0)


def test_robot_numbers() -> None:
    for make in (NativeDrive, NativeHost):
        with pytest.raises(ValueError, match="127"):
            make(replace(PLAN, node_ids=(127, 127)))
    last = replace(PLAN, node_ids=(126, 126))
    assert NativeDrive(last).identifiers == {0x17E}
    assert NativeHost(last).identifiers == {0x1FE, 0x27E}


Step = tuple[bool, bool, int, int, bool, bool, int]
"""Enable right and left, torque right and left [bits], clear, emergency stop, time since the step before [ms]"""
small = st.sampled_from([0, 0, 0, 1, -250])
steps = st.lists(
    st.tuples(
        st.booleans(), st.booleans(), small, small, st.booleans(), st.sampled_from([False] * 9 + [True]),
        st.sampled_from([0, 1, 7, 10, 50, 99, 100, 101])),
    max_size=40,
)  # fmt: skip
causes = st.lists(st.tuples(st.integers(0, 39), st.integers(0, 1), st.booleans()), max_size=6)


@settings(max_examples=300, deadline=None)
@given(steps, causes)
def test_states_are_those_of_the_table(given_steps: list[Step], given_causes: list[tuple[int, int, bool]]) -> None:
    """Compares the states of each wheel with a second implementation: a table of the rules."""
    drive, sender, time_ms, heard_ms = NativeDrive(PLAN), Sender(), 0, 0
    states, present, wanted = ["off", "off"], [False, False], [0, 0]
    for number, (enable_right, enable_left, right, left, clear, estop, wait_ms) in enumerate(given_steps):
        time_ms += wait_ms
        if time_ms - heard_ms >= 100:
            states = ["fault" if state == "on" else state for state in states]
        for _, wheel, on in (cause for cause in given_causes if cause[0] == number):
            if on:
                drive.inject(time_ms * MS, wheel, Fault.ENCODER_LOSS)
                states[wheel] = "fault"
            else:
                drive.mend(time_ms * MS, wheel, Fault.ENCODER_LOSS)
            present[wheel] = on
        command = sender(right * 0.001, left * 0.001, (enable_right, enable_left), clear, estop)
        drive.advance(time_ms * MS)
        drive.receive(time_ms * MS, command)
        heard_ms = time_ms
        for wheel, enable, bits in ((0, enable_right, right), (1, enable_left, left)):
            ask = bits if enable else 0
            if estop:
                states[wheel] = "fault"
            else:
                states[wheel], wanted[wheel] = {
                    ("on", True): ("on", ask),
                    ("on", False): ("off", 0),
                    ("off", True): ("off", 0) if ask else ("on", 0),
                    ("off", False): ("off", 0),
                    ("fault", enable): ("off" if clear and not present[wheel] else "fault", 0),
                }[states[wheel], enable]
            expected = wanted[wheel] * 0.001 if states[wheel] == "on" else 0.0
            assert drive.motors[wheel].torque == pytest.approx(expected, abs=1e-12)
        assert [{"off": OFF, "on": ON, "fault": FAULT}[state] for state in states] == drive.states


def random_frames(seed: int, number: int, own: int, others: tuple[int, ...]) -> Iterator[Frame]:
    """Yields random frames: noise, valid frames, and valid ones with flipped bits, other lengths or other identifiers."""
    random = np.random.default_rng(seed)
    kinds, data = random.integers(0, 8, number), random.integers(0, 256, (number, 8), dtype=np.uint8)
    for counter, (kind, noise) in enumerate(zip(kinds.tolist(), data, strict=True)):
        body, can_id = bytearray(noise.tobytes()), own
        if kind > 0:  # all but noise get a correct CRC before they are changed
            body[5] = counter % 16
            if kind > 1:  # plausible torques; states and faults that exist
                body[:4] = (0, 0, 0, 0) if kind > 5 else (body[0], body[1] % 4, body[2], 255 - body[3] % 4)
                body[4] = 0x11 if kind > 5 and own == FEEDBACK else body[4] & (0x33 if own == FEEDBACK else 0x1F)
                body[6] &= 0x33
            elif noise[7] < 32:
                body[:2] = b"\x00\x80"  # which is never sent
            body[7] = Crc8SaeJ1850.calc(own.to_bytes(2, "little") + body[:7])
        if kind == 3:
            bit = int(noise[0]) % 64
            body[bit // 8] ^= 1 << bit % 8
        if kind == 4 and noise[1] % 4 == 0:
            can_id = others[noise[2] % len(others)]
        length = int(noise[3]) % 8 if kind == 5 and noise[4] % 4 == 0 else 8
        yield Frame(can_id, bytes(body[:length]), remote=kind == 6 and noise[5] % 16 == 0)


WHOLE_FRAMES = (*Refusal, REMOTE, REPEATED)


@pytest.mark.slow
def test_whatever_comes_the_drive_gives_no_torque_unless_enabled() -> None:
    drive, time_ns, number = NativeDrive(PLAN), 0, 120_000
    drive.advance(0)
    random = np.random.default_rng(1)
    seen = set()
    for wait_us, frame in zip(
        random.exponential(2000, number).tolist(), random_frames(2, number, COMMAND, (0, 0x104, 0x183, 0x7FF)),
        strict=True,
    ):  # fmt: skip
        time_ns += int(wait_us * 1000)
        drive.advance(time_ns)
        before, refused = (list(drive.states), torques(drive)), drive.refused.total()
        drive.receive(time_ns, frame)
        for state, torque in zip(drive.states, torques(drive), strict=True):
            assert torque == 0.0 or state is ON
            assert abs(torque) <= 1.5
        said_well = isinstance(CODEC.decode(frame.can_id, frame.data), Torque) and not frame.remote
        if not said_well:
            assert drive.refused.total() == refused + 1
            assert (drive.states, torques(drive)) == before
        seen.update(drive.states)
    assert seen == set(WheelState)
    accepted = drive.counter.frames - drive.counter.repeated
    assert accepted + sum(drive.refused[reason] for reason in WHOLE_FRAMES) == number
    assert {REMOTE, REPEATED, FIRST_NOT_ZERO, NOT_CLEARED, *Refusal} <= set(drive.refused)
    assert accepted > number / 3


@pytest.mark.slow
def test_whatever_comes_the_host_survives_and_counts() -> None:
    host, number = NativeHost(drive_plan("native", recover_ns=50 * MS)), 120_000
    others = (0, 0x103, 0x184, 0x7FF)
    # every fourth frame is a status; now and then comes a healthy drive's feedback
    feedback, status = random_frames(3, number, FEEDBACK, others), random_frames(4, number // 4, STATUS, others)
    well = accepted = enabled = 0
    for at in range(number):
        frame = next(status) if at % 4 == 3 else next(feedback)
        host.receive(at * MS, frame)
        was_enabled = host.enabled
        host.poll(at * MS)
        (command,) = host.command(at * MS, 0.5, -0.5)
        torque = CODEC.decode(*command[:2])
        assert isinstance(torque, Torque)
        assert torque.counter == at % 16
        assert host.enabled or (torque.tau_right, torque.tau_left) == (0.0, 0.0)
        enabled += was_enabled
        well += frame.can_id in host.identifiers and not frame.remote
    for check in (host.counter, host._status_counter):
        accepted += check.frames - check.repeated
    assert accepted + host.refused.total() == number
    assert number / 3 < accepted < well
    assert enabled > 100
    assert set(host.refused) == {*Refusal, REMOTE, REPEATED}


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans()), max_size=20))
def test_noise_does_nothing(frames: list[tuple[int, bytes, bool]]) -> None:
    drive, host, sender = NativeDrive(PLAN), NativeHost(PLAN), Sender()
    drive.advance(0)
    drive.receive(0, sender())
    drive.receive(0, sender(0.5, 0.5))
    for can_id, data, remote in frames:
        if len(data) == 8:
            data = data[:7] + bytes([Crc8SaeJ1850.calc(can_id.to_bytes(2, "little") + data[:7]) ^ 1])
        drive.receive(MS, Frame(can_id, data, remote))
        host.receive(MS, Frame(can_id, data, remote))
    assert torques(drive) == [0.5, 0.5]
    assert (drive.refused.total(), host.refused.total()) == (len(frames), len(frames))
    assert (host.torque_ns, host.torque, host.fault, host.enabled) == (None, (0.0, 0.0), "", False)


def feedback_frame(counter: int, states: tuple[WheelState, WheelState], faults: tuple[FaultCode, FaultCode]) -> Frame:
    return Frame(FEEDBACK, CODEC.encode_feedback(Feedback(ROBOT, (0.5, -0.5), states, faults, counter)))


def test_host_words_for_faults() -> None:
    host = NativeHost(PLAN)
    host.receive(0, feedback_frame(0, (ON, ON), FINE))
    assert (host.enabled, host.fault, host.torque, host.torque_ns) == (True, "", (0.5, -0.5), 0)
    host.receive(MS, feedback_frame(1, (FAULT, FAULT), (FaultCode.OVER_TEMPERATURE, FaultCode.WATCHDOG)))
    assert (host.enabled, host.fault) == (False, "right: over temperature, left: watchdog")
    host.receive(2 * MS, feedback_frame(2, (OFF, FAULT), (FaultCode.NONE, FaultCode.ESTOP)))
    assert host.fault == "left: estop"


def test_host_hears_status() -> None:
    host = NativeHost(PLAN)
    host.receive(0, Frame(STATUS, encode_status(Status(ROBOT, (1.0, -2.0), 24.0, 50.0, 0))))
    assert host.status == Status(ROBOT, (1.0, -2.0), 24.0, 50.0, 0)
    assert host.torque_ns is None


def test_host_sends_one_command_per_cycle_and_counts_what_does_not_fit() -> None:
    host = NativeHost(PLAN)
    host.receive(0, feedback_frame(0, (ON, ON), FINE))
    (frame,) = host.command(0, 100.0, -0.25, saturated=True)
    torque = CODEC.decode(*frame[:2])
    assert torque == Torque(ROBOT, pytest.approx(32.767), -0.25, True, True, False, True, True, False, 0)
    assert (host.clipped, host.poll(0)) == (1, [])


def test_host_stops_for_an_emergency(drive: NativeDrive) -> None:
    host = NativeHost(drive_plan("native", recover_ns=0))
    for time_ns in range(0, 50 * MS, PERIOD_NS):
        for frame in drive.advance(time_ns):
            host.receive(time_ns, frame)
        host.poll(time_ns)
        drive.receive(time_ns, *host.command(time_ns, 0.5, 0.5))
    assert torques(drive) == [0.5, 0.5]
    drive.receive(45 * MS, *host.estop(45 * MS))
    assert (torques(drive), drive.faults) == ([0.0, 0.0], [Fault.ESTOP] * 2)
    for time_ns in range(50 * MS, 200 * MS, PERIOD_NS):
        for frame in drive.advance(time_ns):
            host.receive(time_ns, frame)
        host.poll(time_ns)
        drive.receive(time_ns, *host.command(time_ns, 0.5, 0.5))
        assert (drive.states, torques(drive)) == ([FAULT, FAULT], [0.0, 0.0])  # until it is started again
    host.start()
    for time_ns in range(200 * MS, 300 * MS, PERIOD_NS):
        for frame in drive.advance(time_ns):
            host.receive(time_ns, frame)
        host.poll(time_ns)
        drive.receive(time_ns, *host.command(time_ns, 0.5, 0.5))
    assert torques(drive) == [0.5, 0.5]
