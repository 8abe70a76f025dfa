"""CANSimple bytes, compared with the vendor's DBC in the package odrive-can, as cantools reads it."""

import math
import re
import struct
from collections.abc import Mapping
from typing import Any

import pytest
from cantools.database.can import Database, Message
from hypothesis import given
from hypothesis import strategies as st
from odrive_can import get_dbc

from echelon.bridge.protocols.odrive.codec import BROADCAST, MESSAGES, Refusal, Signal, frame_id
from echelon.bridge.protocols.odrive.enums import (
    AxisError,
    AxisState,
    Command,
    ControlMode,
    InputMode,
    ProcedureResult,
    RebootAction,
    error_names,
)

VENDOR: Database = get_dbc()
AXES = range(8)  # the axes in the DBC


def vendor(command: int, axis: int = 0) -> Message:
    return VENDOR.get_message_by_frame_id(frame_id(axis, command))


def decode(command: int, data: bytes, axis: int = 0, **options: bool) -> dict[str, Any]:
    decoded = vendor(command, axis).decode(data, **options) if vendor(command).signals else {}
    assert isinstance(decoded, dict)
    return decoded


def test_every_message_of_the_dbc_is_there_with_its_name_and_length() -> None:
    ours = {
        (frame_id(axis, command), f"Axis{axis}_{message.name}", message.length, message.reported)
        for axis in AXES
        for command, message in MESSAGES.items()
    }
    theirs = {(m.frame_id, m.name, m.length, "Master" not in m.senders) for m in VENDOR.messages}
    assert ours == theirs
    assert set(MESSAGES) == set(Command)


@pytest.mark.parametrize("command", MESSAGES)
def test_every_signal_is_the_dbcs(command: int) -> None:
    ours = {
        (signal.name, start, bits, signal.kind == "f", signal.kind == "h", signal.unit, signal.scale)
        for signal, start, bits in MESSAGES[command].bits()
    }
    theirs = {
        (s.name, s.start, s.length, s.is_float, s.is_signed and not s.is_float, unit_of(s.unit), float(s.scale))
        for s in vendor(command).signals
    }
    assert ours == theirs
    assert all(signal.byte_order == "little_endian" for signal in vendor(command).signals)


def unit_of(unit: str | None) -> str:
    return re.sub(r" \(default\).*", "", unit or "")  # "Nm (default) [#torque-ff-scale]_"


@pytest.mark.parametrize("command", MESSAGES)
def test_every_choice_is_the_dbcs(command: int) -> None:
    for signal in MESSAGES[command].signals:
        choices: Mapping[int, Any] = vendor(command).get_signal_by_name(signal.name).choices or {}
        ours = {} if signal.choices is None else {int(c): c.name for c in members(signal)}
        assert ours == {number: str(name) for number, name in choices.items()}


def members(signal: Signal) -> list[Any]:
    assert signal.choices is not None
    return [*signal.choices.__members__.values()]


def values_of(signal: Signal) -> st.SearchStrategy[Any]:
    if signal.kind == "f":
        return st.floats(width=32, allow_nan=False, allow_infinity=False)
    if signal.kind == "h":
        return st.integers(-(2**15), 2**15 - 1).map(lambda raw: raw * 0.001)
    if signal.choices is not None:
        return st.sampled_from([int(choice) for choice in members(signal)])
    return st.integers(0, 2 ** {"?": 1, "B": 8, "H": 16, "I": 32, "u48": 48}[signal.kind] - 1)


def whole_messages() -> st.SearchStrategy[tuple[int, int, list[Any]]]:
    return st.sampled_from(sorted(MESSAGES)).flatmap(
        lambda command: st.tuples(
            st.sampled_from(AXES),
            st.just(command),
            st.tuples(*(values_of(signal) for signal in MESSAGES[command].signals)).map(list),
        )
    )


@given(whole_messages())
def test_what_we_encode_the_dbc_decodes(message: tuple[int, int, list[Any]]) -> None:
    axis, command, values = message
    ours = MESSAGES[command]
    data = ours.encode(*values)
    decoded = decode(command, data, axis, decode_choices=False)
    assert [decoded[signal.name] for signal in ours.signals] == values
    assert ours.decode(data.ljust(ours.layout.size)) == tuple(values)


@given(whole_messages())
def test_what_the_dbc_encodes_we_decode(message: tuple[int, int, list[Any]]) -> None:
    axis, command, values = message
    ours = MESSAGES[command]
    named = {signal.name: value for signal, value in zip(ours.signals, values, strict=True)}
    assert ours.decode(vendor(command, axis).encode(named)) == tuple(values)


@given(st.sampled_from(sorted(MESSAGES)), st.binary(max_size=12))
def test_any_bytes_are_decoded_as_the_dbc_does_or_refused(command: int, data: bytes) -> None:
    ours, theirs = MESSAGES[command], vendor(command)
    values = ours.decode(data)
    needed = max(((s.start + s.length + 7) // 8 for s in theirs.signals), default=0)
    if len(data) > 8 or (ours.reported and len(data) < needed):
        assert values is Refusal.LENGTH
        return
    data = data.ljust(needed, b"\0")  # what a command lacks is zero
    decoded = decode(command, data, decode_choices=False, allow_truncated=True)
    if not all(math.isfinite(value) for value in decoded.values()):
        assert values is Refusal.NOT_FINITE
        return
    assert values == tuple(decoded[signal.name] for signal in ours.signals)


# the vendor's own example: (command, values, bytes by struct)
GOLDEN = [
    (Command.SET_AXIS_STATE, (8,), struct.pack("<II", 8, 0)),
    (Command.SET_INPUT_TORQUE, (-1.5,), struct.pack("<ff", -1.5, 0.0)),
    (Command.SET_CONTROLLER_MODE, (1, 1), struct.pack("<II", 1, 1)),
    (Command.HEARTBEAT, (0x1000200, 8, 3, 1), struct.pack("<IBBBB", 0x1000200, 8, 3, 1, 0)),
    (Command.SET_INPUT_POS, (0.5, -32.768, 32.767), struct.pack("<fhh", 0.5, -32768, 32767)),
    (Command.ADDRESS, (63, 0x0123456789AB), bytes.fromhex("3fab896745230100")),
    (Command.CLEAR_ERRORS, (0,), b"\0"),
    (Command.ESTOP, (), b""),
]


@pytest.mark.parametrize(("command", "values", "data"), GOLDEN)
def test_golden_bytes(command: Command, values: tuple[float, ...], data: bytes) -> None:
    assert MESSAGES[command].encode(*values) == data
    assert MESSAGES[command].decode(data) == values


@pytest.mark.parametrize("command", [Command.SET_AXIS_STATE, Command.SET_INPUT_TORQUE])
def test_short_frames_of_common_hosts_are_taken(command: Command) -> None:
    body = MESSAGES[command].encode(8)
    assert MESSAGES[command].decode(body[:4]) == MESSAGES[command].decode(body) == (8,)
    assert MESSAGES[command].decode(body[:3]) == MESSAGES[command].decode(body[:3] + bytes(5))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_neither_sent_nor_taken(bad: float) -> None:
    for message in MESSAGES.values():
        for at, signal in enumerate(message.signals):
            values = [0.0 if s.kind == "f" else 0 for s in message.signals]
            values[at] = bad
            with pytest.raises(ValueError, match=f"{signal.name}.*{bad!r}"):
                message.encode(*values)
            if signal.kind == "f":
                data = bytearray(8)
                struct.pack_into("<f", data, 4 * at, bad)  # floats come first in all messages
                assert message.decode(bytes(data)) is Refusal.NOT_FINITE


@pytest.mark.parametrize(
    ("command", "values"),
    [
        (Command.SET_INPUT_TORQUE, (1e39,)),
        (Command.SET_INPUT_POS, (0.0, 32.768, 0.0)),
        (Command.REBOOT, (256,)),
        (Command.SET_AXIS_STATE, (-1,)),
        (Command.ADDRESS, (0, 2**48)),
    ],
)
def test_what_does_not_fit_is_refused(command: Command, values: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=MESSAGES[command].name):
        MESSAGES[command].encode(*values)


def test_too_few_values() -> None:
    with pytest.raises(ValueError, match="Get_Iq has 2 values, not 1"):
        MESSAGES[Command.GET_IQ].encode(1.0)


@pytest.mark.parametrize("node", [-1, 64])
def test_node_out_of_range(node: int) -> None:
    with pytest.raises(ValueError, match=str(node)):
        frame_id(node, Command.ESTOP)


def test_identifiers() -> None:
    assert frame_id(BROADCAST, Command.ADDRESS) == 0x7E6
    assert frame_id(1, Command.SET_INPUT_POS) == 0x2C  # the vendor's example of an identifier


@given(st.sets(st.sampled_from([error for error in AxisError if error])))
def test_combined_errors_have_names_where_the_dbc_has_a_number(errors: set[AxisError]) -> None:
    bits = sum(errors)
    data = MESSAGES[Command.HEARTBEAT].encode(bits, AxisState.IDLE, ProcedureResult.DISARMED, 0)
    shown = decode(Command.HEARTBEAT, data)["Axis_Error"]
    if len(errors) > 1:
        assert shown == bits
        assert not isinstance(shown, str)
    elif errors:
        assert str(shown) == error_names(bits)
    assert set(filter(None, error_names(bits).split("|"))) == {error.name for error in errors}


def test_errors_without_a_name() -> None:
    assert error_names(0) == ""
    assert error_names(0x80 | AxisError.DRV_FAULT | 0x80000000) == "DRV_FAULT|0x80000080"


def test_enumerations_have_the_dbcs_values() -> None:
    assert (AxisState.CLOSED_LOOP_CONTROL, ControlMode.TORQUE_CONTROL, InputMode.PASSTHROUGH) == (8, 1, 1)
    assert (ProcedureResult.INVALID_STATE, RebootAction.reboot) == (13, 0)
