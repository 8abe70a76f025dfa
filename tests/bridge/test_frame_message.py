import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from echelon.bridge.frame_message import TimedFrame, pack, unpack
from echelon.bridge.protocols.frame import Frame

frames = st.builds(
    TimedFrame,
    st.integers(-(2**62), 2**62),
    st.integers(0, 255),
    st.integers(0, 2**16),
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)),
)


@given(st.lists(frames, max_size=5), st.integers(0, 5))
def test_frames_survive_as_numbers(sent: list[TimedFrame], remote: int) -> None:
    sent = [
        timed._replace(frame=Frame(timed.frame.can_id, b"", True)) if at == remote else timed
        for at, timed in enumerate(sent)
    ]
    values = pack(sent)
    assert unpack(values) == sent
    assert unpack(np.frombuffer(values.tobytes())) == sent  # bits that are no number, too, on their way over the wire


@given(st.binary(max_size=100))
def test_any_bytes_are_frames_or_nothing(garbage: bytes) -> None:
    values = np.frombuffer(garbage[: len(garbage) // 8 * 8])
    found = unpack(values)
    assert len(found) == len(values) // 3
    for _, bus, node, (can_id, data, _) in found:
        assert (can_id < 0x800, len(data) <= 8, bus < 256, node >= 0) == (True,) * 4
