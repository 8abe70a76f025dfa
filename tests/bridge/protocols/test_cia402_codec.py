"""The frames, words and tables of CiA 402 and CANopen, compared with the package `canopen`."""

import struct
from pathlib import Path

import canopen
import pytest
from canopen.emcy import EMCY_STRUCT
from canopen.nmt import NMT_COMMANDS, NMT_STATES
from canopen.objectdictionary import ODArray, ODRecord, ODVariable
from canopen.profiles.p402 import OperationMode, State402
from hypothesis import given
from hypothesis import strategies as st

from echelon.bridge.protocols import cia402
from echelon.bridge.protocols.cia402 import codec
from echelon.bridge.protocols.cia402.codec import (
    AUTOMATIC,
    TRANSITIONS,
    Command,
    ErrorCode,
    Nmt,
    NmtCommand,
    State,
    command_of,
    state_of,
)
from echelon.bridge.protocols.cia402.eds import eds
from echelon.bridge.protocols.cia402.objects import INDICES, OBJECTS, RPDO_MAPPED, TPDO_MAPPED, Dictionary, Type
from echelon.bridge.protocols.frame import Frame

EDS = Path(cia402.__file__).with_name("drive.eds")
COMMANDS = {
    State402.CW_DISABLE_VOLTAGE: Command.DISABLE_VOLTAGE,
    State402.CW_QUICK_STOP: Command.QUICK_STOP,
    State402.CW_SHUTDOWN: Command.SHUTDOWN,
    State402.CW_SWITCH_ON: Command.SWITCH_ON,
    State402.CW_OPERATION_ENABLED: Command.ENABLE_OPERATION,
    State402.CW_SWITCH_ON_DISABLED: Command.FAULT_RESET,
}


def test_states_are_those_of_the_package() -> None:
    assert {state.words: (mask, bits) for state in State for bits, mask in [state.value]} == State402.SW_MASK


@given(st.integers(0, 0xFFFF))
def test_every_statusword_tells_what_the_package_reads(word: int) -> None:
    read = [name for name, (mask, bits) in State402.SW_MASK.items() if word & mask == bits]
    state = state_of(word)
    assert ([state.words] if state else []) == read


def test_transitions_are_those_of_the_package() -> None:
    ours = {(before.words, command, after.words) for (before, command), after in TRANSITIONS.items()}
    by_itself = {("START", "NOT READY TO SWITCH ON"), ("NOT READY TO SWITCH ON", "SWITCH ON DISABLED")}
    by_itself |= {("FAULT REACTION ACTIVE", "FAULT")}
    theirs = {(a, COMMANDS[word], b) for (a, b), word in State402.TRANSITIONTABLE.items() if (a, b) not in by_itself}
    assert theirs <= ours
    assert ours - theirs == {  # the package has no such request
        ("READY TO SWITCH ON", Command.ENABLE_OPERATION, "OPERATION ENABLED"),
        ("READY TO SWITCH ON", Command.QUICK_STOP, "SWITCH ON DISABLED"),
        ("SWITCHED ON", Command.QUICK_STOP, "SWITCH ON DISABLED"),
    }
    assert {(a.words, b.words) for a, b in AUTOMATIC.items()} == by_itself - {("START", "NOT READY TO SWITCH ON")} | {
        ("QUICK STOP ACTIVE", "SWITCH ON DISABLED")
    }


@pytest.mark.parametrize(("word", "command"), COMMANDS.items())
def test_controlwords(word: int, command: Command) -> None:
    assert command.value == word
    assert command_of(word, 0) is command
    assert command_of(word | 0xFE00, 0) is command  # other bits say something else


def test_a_fault_reset_is_an_edge() -> None:
    assert command_of(0x8F, 0x0F) is Command.FAULT_RESET
    assert command_of(0x8F, 0x80) is Command.ENABLE_OPERATION
    assert command_of(0x80, 0x80) is Command.DISABLE_VOLTAGE


def test_network_management() -> None:
    assert {state.value for state in Nmt} == {0, 4, 5, 127}
    assert {NMT_STATES[state].replace("INITIALISING", "BOOT_UP").replace("-", "_") for state in Nmt} == {
        state.name for state in Nmt
    }
    names = {"START": "OPERATIONAL", "STOP": "STOPPED", "PRE_OPERATIONAL": "PRE-OPERATIONAL"}
    names |= {"RESET_NODE": "RESET", "RESET_COMMUNICATION": "RESET COMMUNICATION"}
    assert {command.name: command.value for command in NmtCommand} == {
        name: NMT_COMMANDS[theirs] for name, theirs in names.items()
    }
    assert codec.nmt(NmtCommand.START, 5) == Frame(0, b"\x01\x05")
    assert codec.heartbeat(5, Nmt.OPERATIONAL) == Frame(0x705, b"\x05")
    assert [codec.heartbeat_state(data) for data in (b"\x7f", b"", b"\x05\x05", b"\x06")] == [127, None, None, None]


def test_emergency_messages() -> None:
    frame = codec.emergency(5, ErrorCode.HEARTBEAT, ErrorCode.HEARTBEAT.register)
    assert frame == Frame(0x085, EMCY_STRUCT.pack(0x8130, 0x11, bytes(5)))
    assert codec.emergency_of(frame.data) == (0x8130, 0x11)
    assert codec.emergency_of(b"") is None
    assert codec.emergency_of(bytes(7)) is None
    assert all(code.register & 1 for code in ErrorCode if code)
    assert codec.error_text(0x8250) == "0x8250 rpdo timeout"
    assert codec.error_text(0x1234) == "0x1234"


def test_modes_are_those_of_the_package() -> None:
    assert codec.MODE_PROFILE_TORQUE == OperationMode.PROFILED_TORQUE
    assert codec.MODE_CYCLIC_TORQUE == OperationMode.CYCLIC_SYNCHRONOUS_TORQUE
    bits = OperationMode.SUPPORTED["PROFILED TORQUE"] | OperationMode.SUPPORTED["CYCLIC SYNCHRONOUS TORQUE"]
    assert OBJECTS[0x6502, 0].default == bits


@given(st.floats(-40, 40), st.integers(1, 10**7))
def test_torque_there_and_back_is_within_half_a_thousandth(torque: float, rated: int) -> None:
    value = codec.permille(torque, rated)
    back = codec.newton_metres(value, rated)
    if abs(torque) <= 32.767 * rated * 1e-3:
        assert abs(back - torque) <= 0.5000001 * rated * 1e-6
    else:
        assert value == (32767 if torque > 0 else -32767)


@pytest.mark.parametrize("bad", [0.0, -1.0, 0.0001, float("nan"), float("inf"), 5e6])
def test_rated_torque_out_of_range(bad: float) -> None:
    with pytest.raises(ValueError, match="rated torque"):
        codec.rated_mnm(bad)


@pytest.mark.parametrize("node", [0, 127, -1])
def test_node_id_out_of_range(node: int) -> None:
    with pytest.raises(ValueError, match=r"1 \.\. 126"):
        codec.check_node(node)


def test_times() -> None:
    ms = 1_000_000
    assert [codec.milliseconds(ns) for ns in (1, ms, 100 * ms - 1, 10**6 * ms)] == [1, 1, 99, 65535]


# The electronic data sheet


def entries(node: int) -> dict[tuple[int, int], ODVariable]:
    """Returns the objects that the package reads from drive.eds."""
    found = {}
    for index, entry in canopen.import_od(str(EDS), node).items():
        if isinstance(entry, ODVariable):
            found[index, 0] = entry
        else:
            assert isinstance(entry, ODArray | ODRecord)
            found |= {(index, sub): entry.subindices[sub] for sub in entry.subindices}
    return found


def test_the_data_sheet_is_that_of_the_object_dictionary() -> None:
    assert EDS.read_text() == eds()


@pytest.mark.parametrize("node", [1, 126])
def test_the_package_reads_every_object_in_it(node: int) -> None:
    read, values = entries(node), Dictionary(node, {})
    assert set(read) == set(OBJECTS)
    for key, entry in OBJECTS.items():
        said = read[key]
        assert (said.name, said.data_type, said.access_type) == (entry.name, entry.type.number, entry.access)
        assert (said.pdo_mappable, said.min, said.max) == (entry.mapped, entry.low, entry.high)
        if entry.default is None:
            assert said.default is None
        else:
            assert said.encode_raw(said.default) == values.read(key)
        assert len(said) == (entry.type.size * 8 or 8)


def test_mandatory_objects_and_those_of_the_profile_are_there() -> None:
    assert {0x1000, 0x1001, 0x1018, 0x1016, 0x1017, 0x1029, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6502} <= INDICES
    assert {0x6007, 0x603F, 0x6040, 0x6041, 0x605A, 0x6060, 0x6061, 0x6064, 0x606C} <= INDICES
    assert {0x6071, 0x6072, 0x6074, 0x6075, 0x6076, 0x6077, 0x6078, 0x6079, 0x6087} <= INDICES


def test_pdos_are_mapped_as_their_layouts_say() -> None:
    layouts = {RPDO_MAPPED[0]: codec.RPDO1, RPDO_MAPPED[1]: codec.RPDO2}
    layouts |= {TPDO_MAPPED[0]: codec.TPDO1, TPDO_MAPPED[1]: codec.TPDO2, TPDO_MAPPED[2]: codec.TPDO3}
    for mapped, layout in layouts.items():
        assert layout.format == "<" + "".join(OBJECTS[key].type.layout.format[1:] for key in mapped)


@pytest.mark.parametrize("kind", [kind for kind in Type if kind is not Type.TEXT])
def test_numbers_of_all_types(kind: Type) -> None:
    for value in (kind.low, kind.high):
        assert kind.layout.unpack(kind.layout.pack(value)) == (value,)
    with pytest.raises(struct.error):
        kind.layout.pack(kind.high + 1)
    with pytest.raises(struct.error):
        kind.layout.pack(kind.low - 1)
    assert (kind.clip(1 << 40), kind.clip(-1 << 40), kind.clip(1)) == (kind.high, kind.low, 1)
