"""The native torque frame: bytes, limits, and what is refused."""

import math
import struct

import pytest
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]
from hypothesis import given
from hypothesis import strategies as st

from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.native.codec import (
    LENGTH,
    MAX_ROBOTS,
    RAW_MAX,
    FaultCode,
    Feedback,
    NativeCodec,
    Refusal,
    Status,
    Torque,
    decode_status,
    encode_status,
    frame_id,
)
from echelon.bridge.protocols.native.counter import CounterCheck
from echelon.bridge.protocols.native.crc import crc8

MILLI = NativeCodec(0.001)


def torque(robot: int, right: float, left: float, counter: int, **flags: bool) -> Torque:
    """Returns a command that enables both wheels, with further `flags`."""
    plain = Torque(robot, right, left, True, True, False, False, False, False, counter)
    return plain._replace(**flags)  # type: ignore[arg-type]


def with_crc(can_id: int, body: bytes) -> bytes:
    return body + bytes([Crc8SaeJ1850.calc(can_id.to_bytes(2, "little") + body)])


# (codec, frame, identifier, bytes without CRC)
GOLDEN = [
    (MILLI, torque(3, 1.0, -1.5, 7), 0x103, "e80324fa030700"),
    (MILLI, torque(0, 0.0, 0.0, 0, enable_right=False, enable_left=False), 0x100, "00000000000000"),
    (MILLI, torque(126, 32.767, -32.767, 15, saturated=True), 0x17E, "ff7f0180130f00"),
    (NativeCodec(4.0), torque(8, 1e5, -4.0, 1), 0x108, "a861ffff030100"),
    (MILLI, torque(7, 0.0, 0.5, 4, enable_right=False), 0x107, "0000f401020400"),
    (MILLI, torque(7, 0.5, 0.0, 4, enable_left=False), 0x107, "f4010000010400"),
    (MILLI, torque(1, 0.0, 0.0, 9, enable_right=False, enable_left=False, clear=True), 0x101, "00000000040900"),
    (MILLI, torque(1, 0.0, 0.0, 9, enable_right=False, enable_left=False, estop=True), 0x101, "00000000200900"),
]


@pytest.mark.parametrize(("codec", "frame", "can_id", "text"), GOLDEN)
def test_golden_bytes_both_ways(codec: NativeCodec, frame: Torque, can_id: int, text: str) -> None:
    data, clipped = codec.encode(
        frame.robot,
        frame.tau_right,
        frame.tau_left,
        frame.counter,
        enable=(frame.enable_right, frame.enable_left),
        saturated=frame.saturated,
        clear=frame.clear,
        estop=frame.estop,
    )
    assert (frame_id(frame.robot), data, clipped) == (can_id, with_crc(can_id, bytes.fromhex(text)), 0)
    decoded = codec.decode(can_id, data)
    assert isinstance(decoded, Torque)
    assert decoded._replace(tau_right=frame.tau_right, tau_left=frame.tau_left) == frame
    assert decoded.tau_right == pytest.approx(frame.tau_right, abs=1e-12)
    assert decoded.tau_left == pytest.approx(frame.tau_left, abs=1e-12)


def test_golden_bytes_with_crc() -> None:
    """The bytes on the wire, computed by hand."""
    data, _ = MILLI.encode(0, 0.0, 0.0, 0, enable=(False, False))
    assert data.hex() == "0000000000000023"


@given(st.binary(max_size=40))
def test_crc_is_sae_j1850(data: bytes) -> None:
    assert crc8(data) == Crc8SaeJ1850.calc(data)


def test_crc_covers_the_identifier_as_documented() -> None:
    data, _ = MILLI.encode(5, 0.25, 0.5, 3)
    assert data[7] == Crc8SaeJ1850.calc(b"\x05\x01" + data[:7])
    assert MILLI.decode(0x106, data) is Refusal.CRC


scales = st.floats(1e-6, 1e3)
robots = st.integers(0, MAX_ROBOTS - 1)


@given(scales, robots, st.floats(-1, 1), st.floats(-1, 1), st.integers(0, 2**40), st.booleans())
def test_round_trip_is_within_half_a_bit(
    scale: float, robot: int, right: float, left: float, counter: int, saturated: bool
) -> None:
    codec = NativeCodec(scale)
    right, left = right * codec.limit, left * codec.limit
    data, clipped = codec.encode(robot, right, left, counter, saturated=saturated)
    frame = codec.decode(frame_id(robot), data)
    assert isinstance(frame, Torque)
    assert abs(frame.tau_right - right) <= scale * (0.5 + 1e-9)
    assert abs(frame.tau_left - left) <= scale * (0.5 + 1e-9)
    assert (clipped, frame.clipped, frame.saturated, frame.enable_right, frame.enable_left) == (
        0,
        False,
        saturated,
        True,
        True,
    )
    assert (frame.robot, frame.counter) == (robot, counter % 16)


@pytest.mark.parametrize(
    ("torque", "clipped"),
    [(32.767, 0), (32.76749, 0), (32.7676, 1), (1e300, 1), (-32.767, 0), (-32.76749, 0), (-32.7676, 1), (-1e300, 1)],
)
def test_what_does_not_fit_is_clipped_and_counted(torque: float, clipped: int) -> None:
    data, count = MILLI.encode(1, torque, 1.0, 0)
    frame = MILLI.decode(0x101, data)
    assert isinstance(frame, Torque)
    assert frame.tau_right == pytest.approx(math.copysign(MILLI.limit, torque))
    assert (count, frame.clipped) == (clipped, bool(clipped))
    data, count = MILLI.encode(1, torque, torque, 0)
    assert count == 2 * clipped


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("enable", [(True, True), (False, False)])
def test_torque_that_is_not_finite_is_refused(bad: float, enable: tuple[bool, bool]) -> None:
    with pytest.raises(ValueError, match="finite"):
        MILLI.encode(0, bad, 0.0, 0, enable=enable)
    with pytest.raises(ValueError, match="finite"):
        MILLI.encode(0, 0.0, bad, 0, enable=enable)


@pytest.mark.parametrize("robot", [-1, 127])
def test_robot_out_of_range(robot: int) -> None:
    with pytest.raises(ValueError, match=str(robot)):
        MILLI.encode(robot, 0.0, 0.0, 0)
    with pytest.raises(ValueError, match=str(robot)):
        frame_id(robot)
    assert MILLI.decode(0x100 + robot, bytes(8)) is Refusal.ID


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_bad_scale(scale: float) -> None:
    with pytest.raises(ValueError, match="torque scale"):
        NativeCodec(scale)


@given(robots, st.binary(min_size=7, max_size=7))
def test_any_body_with_a_right_crc(robot: int, body: bytes) -> None:
    frame = MILLI.decode(0x100 + robot, with_crc(0x100 + robot, body))
    if b"\x00\x80" in (body[0:2], body[2:4]):
        assert frame is Refusal.VALUE
        return
    assert isinstance(frame, Torque)
    assert abs(frame.tau_right) <= RAW_MAX * 0.001
    assert frame.enable_right or frame.tau_right == 0.0
    assert frame.enable_left or frame.tau_left == 0.0


@pytest.mark.parametrize("body", ["00800000010000", "00000080010000"])
def test_the_value_that_is_never_sent_is_refused(body: str) -> None:
    assert MILLI.decode(0x102, with_crc(0x102, bytes.fromhex(body))) is Refusal.VALUE


@given(st.integers(-5, 2**32), st.binary(max_size=16))
def test_arbitrary_bytes_never_raise_nor_give_torque_without_crc(can_id: int, data: bytes) -> None:
    frame = MILLI.decode(can_id, data)
    if isinstance(frame, Torque):
        assert with_crc(can_id, data[:7]) == data
    else:
        assert frame in Refusal
    if not 0x100 <= can_id <= 0x17E:
        assert frame is Refusal.ID


@pytest.mark.parametrize("length", [n for n in range(17) if n != LENGTH])
def test_wrong_length(length: int) -> None:
    assert MILLI.decode(0x100, bytes(length)) is Refusal.LENGTH


@given(robots, st.integers(0, 63))
def test_every_single_flipped_bit_is_noticed(robot: int, bit: int) -> None:
    data, _ = MILLI.encode(robot, 1.0, -1.0, robot)
    flipped = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(8, "little")
    assert MILLI.decode(frame_id(robot), flipped) is Refusal.CRC


def test_counter_gaps() -> None:
    check = CounterCheck()
    assert [check.step(n) for n in (14, 15, 0, 3, 3, 4)] == [0, 0, 0, 2, -1, 0]
    assert (check.frames, check.missed, check.repeated) == (6, 2, 1)


wheel_states = st.sampled_from(WheelState)
fault_codes = st.sampled_from(FaultCode)


@given(
    scales,
    robots,
    st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
    st.tuples(wheel_states, wheel_states),
    st.tuples(fault_codes, fault_codes),
    st.integers(0, 15),
)
def test_feedback_bytes_and_round_trip(
    scale: float,
    robot: int,
    share: tuple[float, float],
    states: tuple[WheelState, WheelState],
    faults: tuple[FaultCode, FaultCode],
    counter: int,
) -> None:
    codec = NativeCodec(scale)
    torques = share[0] * codec.limit, share[1] * codec.limit
    data = codec.encode_feedback(Feedback(robot, torques, states, faults, counter))
    bits = [max(-RAW_MAX, min(RAW_MAX, round(part / scale))) for part in torques]
    tail = bytes([states[0] + 16 * states[1], counter, faults[0] + 16 * faults[1]])
    assert data == with_crc(0x180 + robot, struct.pack("<hh", *bits) + tail)
    said = codec.decode_feedback(0x180 + robot, data)
    assert said == Feedback(robot, (bits[0] * scale, bits[1] * scale), states, faults, counter)


@given(robots, st.floats(-400, 400), st.floats(-400, 400), st.floats(-5, 140), st.floats(-80, 250))
def test_status_bytes_and_round_trip(robot: int, right: float, left: float, voltage: float, temperature: float) -> None:
    data = encode_status(Status(robot, (right, left), voltage, temperature, 29))
    bits = [max(-RAW_MAX, min(RAW_MAX, round(speed / 0.01))) for speed in (right, left)]
    volts, warm = max(0, min(255, round(voltage / 0.5))), max(0, min(255, round(temperature + 40)))
    assert data == with_crc(0x200 + robot, struct.pack("<hhBBB", *bits, volts, 13, warm))
    said = decode_status(0x200 + robot, data)
    assert said == Status(robot, (bits[0] * 0.01, bits[1] * 0.01), volts / 2, warm - 40, 13)


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("00800000000000", Refusal.VALUE),
        ("00000080000000", Refusal.VALUE),
        ("00000000030000", Refusal.VALUE),  # states and faults that do not exist
        ("00000000300000", Refusal.VALUE),
        ("00000000000006", Refusal.VALUE),
        ("00000000000060", Refusal.VALUE),
        ("00000000120045", None),
    ],
)
def test_feedback_that_says_nothing_known_is_refused(body: str, why: Refusal | None) -> None:
    data = with_crc(0x183, bytes.fromhex(body))
    said = MILLI.decode_feedback(0x183, data)
    assert said is why or isinstance(said, Feedback) == (why is None)
    assert MILLI.decode_feedback(0x184, data) is Refusal.CRC
    assert MILLI.decode_feedback(0x183, data[:7]) is Refusal.LENGTH
    assert MILLI.decode_feedback(0x103, data) is Refusal.ID
    assert decode_status(0x183, data) is Refusal.ID


def test_what_a_drive_cannot_say() -> None:
    quiet, fine = (WheelState.DISABLED,) * 2, (FaultCode.NONE,) * 2
    with pytest.raises(ValueError, match="finite"):
        MILLI.encode_feedback(Feedback(0, (math.nan, 0.0), quiet, fine, 0))
    with pytest.raises(ValueError, match="127"):
        MILLI.encode_feedback(Feedback(127, (0.0, 0.0), quiet, fine, 0))
    with pytest.raises(ValueError, match="finite"):
        encode_status(Status(0, (0.0, 0.0), math.inf, 0.0, 0))
    with pytest.raises(ValueError, match="finite"):
        encode_status(Status(0, (0.0, math.nan), 0.0, 0.0, 0))


def test_a_counter_that_begins_anew() -> None:
    check = CounterCheck()
    check.step(7)
    check.forget()
    assert check.step(7) == 0
    assert check.repeated == 0
