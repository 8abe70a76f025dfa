"""The DBC: read back, and used by the command line of cantools."""

import re
import subprocess
import sys
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Database

from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.native.codec import FaultCode, Feedback, NativeCodec, Status, encode_status, frame_id
from echelon.bridge.protocols.plan_dbc import identifiers
from support.runs import lab_dbc

ROBOTS = [f"g{1 + number // 3}_r{1 + number}" for number in range(9)]


def load(text: str) -> Database:
    database = cantools.database.load_string(text, "dbc")
    assert isinstance(database, Database)
    return database


def test_fields_units_and_ranges() -> None:
    database = load(lab_dbc())
    names = {message.frame_id: message.name for message in database.messages}
    kinds = {0x100: "torque", 0x180: "feedback", 0x200: "status"}
    assert names == {base + at: f"{kind}_{name}" for base, kind in kinds.items() for at, name in enumerate(ROBOTS)}
    assert [database.get_message_by_frame_id(base + 1).cycle_time for base in kinds] == [10, 10, 100]
    assert database.get_message_by_frame_id(0x182).senders == ["drive_g1_r3"]
    message = database.get_message_by_frame_id(frame_id(2))
    assert (message.length, message.cycle_time, message.senders) == (8, 10, ["bridge"])
    assert message.comment is not None
    assert "g1_r3" in message.comment
    for name in ("tau_right", "tau_left"):
        signal = message.get_signal_by_name(name)
        assert (signal.unit, signal.scale, signal.receivers) == ("Nm", 0.001, ["drive_g1_r3"])
        assert (signal.minimum, signal.maximum) == pytest.approx((-32.767, 32.767))


@pytest.mark.parametrize("scale", [0.001, 4.0, 1e-7, 0.0123456789012345])
def test_decodes_what_the_codec_encodes(scale: float) -> None:
    codec = NativeCodec(scale)
    data, _ = codec.encode(1, 123 * scale, -456 * scale, 9, saturated=True)
    message = load(lab_dbc(scale)).get_message_by_frame_id(0x101)
    values = message.decode(data, decode_choices=False)
    assert isinstance(values, dict)
    assert values.pop("tau_right") == pytest.approx(123 * scale, rel=1e-12)
    assert values.pop("tau_left") == pytest.approx(-456 * scale, rel=1e-12)
    flags = {"enable_right": 1, "enable_left": 1, "clear": 0, "clipped": 0, "saturated": 1, "estop": 0}
    assert values == flags | {"counter": 9, "crc": data[7]}


def test_decodes_what_drives_say() -> None:
    database = load(lab_dbc(0.01))
    states, faults = (WheelState.ENABLED, WheelState.FAULT), (FaultCode.NONE, FaultCode.BROWN_OUT)
    data = NativeCodec(0.01).encode_feedback(Feedback(2, (0.25, -1.5), states, faults, 7))
    values = database.decode_message(0x182, data)
    assert isinstance(values, dict)
    assert {name: value if isinstance(value, float) else str(value) for name, value in values.items()} == {
        "mean_tau_right": pytest.approx(0.25),
        "mean_tau_left": pytest.approx(-1.5),
        "state_right": "enabled",
        "state_left": "fault",
        "fault_right": "none",
        "fault_left": "brown_out",
        "counter": "7",
        "crc": str(data[7]),
    }
    data = encode_status(Status(0, (1.25, -300.0), 23.5, -5.0, 3))
    assert database.decode_message(0x200, data) == {
        "speed_right": pytest.approx(1.25),
        "speed_left": pytest.approx(-300.0),
        "supply": 23.5,
        "temperature": -5,
        "counter": 3,
        "crc": data[7],
    }


def test_names_are_valid_short_and_unique() -> None:
    paths = ["g1/r1", "g1_r1", "g1.r1", "a" * 40, "a" * 41, "größe/1", "7"]
    names = identifiers(paths)
    assert names[:3] == ["g1_r1", "g1_r1_2", "g1_r1_3"]
    assert len(set(names)) == len(paths)
    assert all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,31}", f"feedback_{name}") for name in names)


@pytest.mark.slow
def test_cantools_decode_shows_newton_metres(tmp_path: Path) -> None:
    dbc = tmp_path / "torque.dbc"
    dbc.write_text(lab_dbc())
    data, _ = NativeCodec(0.001).encode(2, 1.25, -0.75, 4)
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)]
    # a log file, and what candump shows
    for line in (f"(1700000000.010000) vcan0 102#{data.hex().upper()}", f"  vcan0  102   [8]  {data.hex(' ').upper()}"):
        run = subprocess.run(command, input=line + "\n", capture_output=True, text=True, check=True, timeout=600)
        assert run.stdout.startswith(line)
        assert "torque_g1_r3(tau_right: 1.25 Nm, tau_left: -0.75 Nm, enable_right: 1, enable_left: 1," in run.stdout
