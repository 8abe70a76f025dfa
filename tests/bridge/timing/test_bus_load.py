"""Frame lengths and bus load, compared with frames built bit by bit and with published numbers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.bridge.timing.bus_load import bus_load, frame_bits, many_frame_bits, worst_case_bits


def by_hand(can_id: int, data: bytes, remote: bool = False) -> int:
    """Returns `frame_bits` from a string of bits: CRC by long division, stuffing by replacement."""
    bits = f"0{can_id:011b}{remote:b}00{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    remainder = int(bits, 2) << 15
    divisor = 0b1100010110011001  # the CRC-15 polynomial of CAN
    while remainder.bit_length() > 15:
        remainder ^= divisor << (remainder.bit_length() - 16)
    bits += f"{remainder:015b}"
    sent = ""
    for bit in bits:
        sent += bit
        if sent[-5:] in ("00000", "11111"):
            sent += "1" if bit == "0" else "0"
    return len(sent) + len("1") + len("01") + len("1" * 7) + len("111")


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_length_of_any_frame(can_id: int, data: bytes) -> None:
    bits = frame_bits(can_id, data)
    assert bits == by_hand(can_id, data)
    assert 47 + 8 * len(data) <= bits <= worst_case_bits(len(data))


@pytest.mark.parametrize(("can_id", "data"), [(0, bytes(8)), (0x7FF, b"\xff" * 8), (0, b""), (0x555, b"\x55" * 8)])
def test_length_of_extreme_frames(can_id: int, data: bytes) -> None:
    assert frame_bits(can_id, data) == by_hand(can_id, data)


@given(st.integers(0, 0x7FF))
def test_length_of_any_remote_frame(can_id: int) -> None:
    bits = frame_bits(can_id, b"", remote=True)
    assert bits == by_hand(can_id, b"", remote=True)
    assert 47 <= bits <= worst_case_bits(0)


def test_published_numbers() -> None:
    # Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis", 2007: (55 + 10 n) bit times
    assert [worst_case_bits(n) for n in range(9)] == [55 + 10 * n for n in range(9)]
    assert (
        min(frame_bits(0x2AA, data.to_bytes(8, "big")) for data in range(0x5555555555555555, 0x5555555555555955)) == 111
    )


def test_load() -> None:
    assert bus_load(9000, 1_000_000, 130) == pytest.approx(1.17)
    assert bus_load(900, 1_000_000) == pytest.approx(0.1215)


def test_refused() -> None:
    with pytest.raises(ValueError, match="0x800"):
        frame_bits(0x800, b"")
    with pytest.raises(ValueError, match="not 9"):
        frame_bits(1, bytes(9))
    with pytest.raises(ValueError, match="no data, not 2"):
        frame_bits(1, bytes(2), remote=True)
    with pytest.raises(ValueError, match="not -1"):
        worst_case_bits(-1)
    with pytest.raises(ValueError, match="bit rate"):
        bus_load(1, 0)


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8)), max_size=40))
def test_many_frames_at_once(frames: list[tuple[int, bytes]]) -> None:
    bits = many_frame_bits([can_id for can_id, _ in frames], b"".join(data for _, data in frames))
    assert bits.tolist() == [frame_bits(can_id, data) for can_id, data in frames]


@pytest.mark.parametrize(("can_ids", "data"), [([0x800], bytes(8)), ([-1], bytes(8)), ([1], bytes(7)), ([], bytes(8))])
def test_many_frames_that_are_none(can_ids: list[int], data: bytes) -> None:
    with pytest.raises(ValueError, match="11 bits with 8 bytes each"):
        many_frame_bits(can_ids, data)
