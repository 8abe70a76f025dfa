"""The native torque frame: bytes, limits, and what is refused."""

import math
from dataclasses import replace

import pytest
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]
from hypothesis import given
from hypothesis import strategies as st

from bridge.native.codec import LENGTH, MAX_ROBOTS, RAW_MAX, CounterCheck, NativeCodec, Refusal, Torque, crc8, frame_id

MILLI = NativeCodec(0.001)

# (codec, frame, identifier, bytes): encoded to the bytes, decoded to the frame
GOLDEN = [
    (MILLI, Torque(3, 1.0, -1.5, True, False, False, 7), 0x103, "e80324fa010700f3"),
    (MILLI, Torque(0, 0.0, 0.0, False, False, False, 0), 0x100, "0000000000000023"),
    (MILLI, Torque(126, 32.767, -32.767, True, False, True, 15), 0x17E, "ff7f0180050f001c"),
    (NativeCodec(4.0), Torque(8, 1e5, -4.0, True, False, False, 1), 0x108, "a861ffff01010084"),
]


@pytest.mark.parametrize(("codec", "frame", "can_id", "text"), GOLDEN)
def test_golden_bytes_both_ways(codec: NativeCodec, frame: Torque, can_id: int, text: str) -> None:
    data, clipped = codec.encode(
        frame.robot, frame.tau_right, frame.tau_left, frame.counter, enable=frame.enable, saturated=frame.saturated
    )
    assert (frame_id(frame.robot), data.hex(), clipped) == (can_id, text, 0)
    decoded = codec.decode(can_id, bytes.fromhex(text))
    assert isinstance(decoded, Torque)
    assert replace(decoded, tau_right=frame.tau_right, tau_left=frame.tau_left) == frame
    assert decoded.tau_right == pytest.approx(frame.tau_right, abs=1e-12)
    assert decoded.tau_left == pytest.approx(frame.tau_left, abs=1e-12)


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
    assert (clipped, frame.clipped, frame.saturated, frame.enable) == (0, False, saturated, True)
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
@pytest.mark.parametrize("enable", [True, False])
def test_torque_that_is_not_finite_is_refused(bad: float, enable: bool) -> None:
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


def with_crc(can_id: int, body: bytes) -> bytes:
    return body + bytes([Crc8SaeJ1850.calc(can_id.to_bytes(2, "little") + body)])


@given(robots, st.binary(min_size=7, max_size=7))
def test_any_body_with_a_right_crc(robot: int, body: bytes) -> None:
    frame = MILLI.decode(0x100 + robot, with_crc(0x100 + robot, body))
    if b"\x00\x80" in (body[0:2], body[2:4]):
        assert frame is Refusal.VALUE
        return
    assert isinstance(frame, Torque)
    assert abs(frame.tau_right) <= RAW_MAX * 0.001
    assert frame.enable or (frame.tau_right, frame.tau_left) == (0.0, 0.0)


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
