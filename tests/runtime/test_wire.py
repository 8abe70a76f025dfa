import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.messages import NULL, STATE_FIELDS, Channel, Message, field_index
from echelon.runtime.wire import (
    HEADER,
    SCHEMA_VERSION,
    WireError,
    data_key,
    decode,
    encode,
    join,
    split,
    token_key,
    watch_key,
)

GOLDEN = [  # bytes written by hand: version, channel, 0, source | sequence | time | count, 0 | values
    (
        Message(Channel.STATE, 3, 5, 5_000_000, np.array([1.0, -2.0])),
        "0100 01 00 03000000  0500000000000000  404b4c0000000000  02000000 00000000 000000000000f03f 00000000000000c0",
    ),
    (
        Message(Channel.GROUP_STATE, 9, 0, 0, NULL),
        "0100 02 00 09000000  0000000000000000  0000000000000000  00000000 00000000",
    ),
    (
        Message(Channel.REFERENCE, 2**32 - 1, 2**64 - 1, -1, np.array([np.inf])),
        "0100 03 00 ffffffff  ffffffffffffffff  ffffffffffffffff  01000000 00000000 000000000000f07f",
    ),
    (
        Message(Channel.COMMAND, 1, 256, 2**62, np.array([-0.0, 5e-324, 0.1])),
        "0100 04 00 01000000  0001000000000000  0000000000000040  03000000 00000000"
        "0000000000000080 0100000000000000 9a9999999999b93f",
    ),
    (
        Message(Channel.FRAMES, 13, 1, 1, np.array([0x101, 0xFFF8_0000_DEAD_BEEF], np.uint64).view(np.float64)),
        "0100 05 00 0d000000  0100000000000000  0100000000000000  02000000 00000000 0101000000000000 efbeadde0000f8ff",
    ),
]
VALID = encode(GOLDEN[0][0])
words = st.integers(0, 2**64 - 1)
messages = st.builds(
    Message,
    st.sampled_from(Channel),
    st.integers(0, 2**32 - 1),
    words,
    st.integers(-(2**63), 2**63 - 1),
    st.lists(words, max_size=40).map(lambda bits: np.array(bits, np.uint64).view(np.float64)),
)


def same(one: Message, other: Message) -> bool:
    """True if two messages are equal bit by bit, NaN included."""
    return one[:4] == other[:4] and one.values.tobytes() == other.values.tobytes()


@pytest.mark.parametrize(("message", "text"), GOLDEN)
def test_golden_bytes_both_ways(message, text):
    golden = bytes.fromhex(text)
    assert encode(message) == golden
    decoded = decode(golden)
    assert same(decoded, message)
    assert type(decoded.channel) is Channel


def test_the_header_is_four_words():
    assert HEADER.size == 32
    assert HEADER.format == "<HBBIQqII"


@given(messages)
def test_what_is_decoded_is_what_was_encoded(message):
    payload = encode(message)
    assert len(payload) == 32 + 8 * message.values.size
    assert same(decode(payload), message)


@given(messages)
def test_values_are_the_payloads_own_memory(message):
    payload = encode(message)
    values = decode(payload).values
    assert np.shares_memory(values, np.frombuffer(payload, np.uint8)) == (values.size > 0)
    assert values.dtype == np.float64
    assert not values.flags.writeable


def test_values_that_are_not_contiguous_are_encoded_in_order():
    values = np.arange(12.0).reshape(3, 4)
    assert decode(encode(Message(Channel.STATE, 0, 0, 0, values[:, 1]))).values.tolist() == [1.0, 5.0, 9.0]
    assert decode(encode(Message(Channel.STATE, 0, 0, 0, values[::2]))).values.tolist() == [0, 1, 2, 3, 8, 9, 10, 11]


@pytest.mark.slow
@settings(max_examples=2000)
@given(st.binary(max_size=80) | st.binary(max_size=60).map(lambda tail: VALID[:32] + tail))
def test_random_bytes_are_a_message_or_refused(payload):
    try:
        message = decode(payload)
    except WireError:
        return
    assert encode(message) == payload


@pytest.mark.slow
@settings(max_examples=1000)
@given(messages, st.data())
def test_a_flipped_byte_of_the_header_never_passes_unseen(message, data):
    payload = bytearray(encode(message))
    at = data.draw(st.integers(0, 31))
    payload[at] ^= data.draw(st.integers(1, 255))
    try:
        decoded = decode(bytes(payload))
    except WireError:
        return
    assert not same(decoded, message)
    assert 2 <= at < 24  # changes of the version, the length and the last zeros are refused


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "too short"),
        (b"\x01", "too short"),
        (VALID[:31], "too short"),
        (VALID[:-1], "length does not match"),
        (VALID + b"\0", "length does not match"),
        (b"\x02\x00" + VALID[2:], "another schema version"),
        (b"\x02\x00", "another schema version"),  # another version may have a shorter header
        (b"\x02\x00\x77" + bytes(60), "another schema version"),  # and may have other channels
        (VALID[:2] + b"\x08" + VALID[3:], "unknown channel"),
        (VALID[:2] + b"\x00" + VALID[3:], "unknown channel"),
        (VALID[:3] + b"\x01" + VALID[4:], "reserved bytes are not zero"),
        (VALID[:28] + b"\x01" + VALID[29:], "reserved bytes are not zero"),
        (VALID[:24] + b"\xff\xff\xff\xff" + VALID[28:], "length does not match"),
    ],
)
def test_refusals_say_why(payload, reason):
    with pytest.raises(WireError) as caught:
        decode(payload)
    assert caught.value.reason == str(caught.value) == reason
    assert SCHEMA_VERSION == 1


@given(st.lists(st.binary(max_size=50)))
def test_split_undoes_join(payloads):
    assert split(join(payloads)) == payloads


def test_a_batch_is_lengths_and_payloads():
    assert join([b"ab", b"", b"c"]) == bytes.fromhex("02000000 6162 00000000 01000000 63")


@given(st.lists(st.binary(min_size=1, max_size=20), min_size=1, max_size=5), st.data())
def test_a_cut_batch_is_refused_unless_the_cut_is_between_messages(payloads, data):
    batch = join(payloads)
    cut = data.draw(st.integers(0, len(batch) - 1))
    whole = [sum(4 + len(payload) for payload in payloads[:count]) for count in range(len(payloads))]
    if cut in whole:
        assert split(batch[:cut]) == payloads[: whole.index(cut)]
    else:
        with pytest.raises(WireError, match=r"batch cut in a (length|message)"):
            split(batch[:cut])


@given(st.binary(max_size=100))
def test_random_batches_are_batches_or_refused(batch):
    try:
        payloads = split(batch)
    except WireError:
        return
    assert join(payloads) == batch


def test_keys():
    assert data_key("lab-7f3a", "g1/r3", Channel.STATE) == "echelon/lab-7f3a/g1/r3/state"
    assert data_key("lab", "", Channel.REFERENCE) == "echelon/lab/reference"
    assert data_key("lab", "g1", Channel.GROUP_STATE) == "echelon/lab/g1/group_state"
    assert token_key("lab", "robot", "g1/r3", "b0") == "echelon/lab/@alive/1/robot/g1.r3/b0"
    assert len(token_key("lab", "robot", "a/b/c/d", "b0").split("/")) == 7
    assert watch_key("lab", "robot", "g1/r3").startswith("echelon/lab/@watch/")
    assert str(SCHEMA_VERSION) not in data_key("lab", "g/r", Channel.STATE)


def test_messages():
    assert field_index(STATE_FIELDS, "vx", "theta") == [2, 4]
    assert len(set(STATE_FIELDS)) == len(STATE_FIELDS) == 16
    assert Message(Channel.STATE, 0, 0, 0, NULL).is_null
    assert not Message(Channel.STATE, 0, 0, 0, np.zeros(1)).is_null
    assert not NULL.flags.writeable
