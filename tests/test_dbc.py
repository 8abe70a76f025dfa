"""The DBC: read back, and used by cantools as a user would."""

import re
import subprocess
import sys
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Database

from bridge.dbc import identifiers, torque_dbc
from bridge.native.codec import NativeCodec, frame_id

ROBOTS = ["g1/r1", "g1/r2", "g2/r1"]


def load(text: str) -> Database:
    database = cantools.database.load_string(text, "dbc")
    assert isinstance(database, Database)
    return database


def test_fields_units_and_ranges() -> None:
    database = load(torque_dbc(ROBOTS, 0.001, 10_000_000))
    assert [message.name for message in database.messages] == ["torque_g1_r1", "torque_g1_r2", "torque_g2_r1"]
    assert [message.frame_id for message in database.messages] == [frame_id(robot) for robot in range(3)]
    message = database.messages[2]
    assert (message.length, message.cycle_time, message.senders) == (8, 10, ["bridge"])
    assert message.comment is not None
    assert "g2/r1" in message.comment
    for name in ("tau_right", "tau_left"):
        signal = message.get_signal_by_name(name)
        assert (signal.unit, signal.scale, signal.receivers) == ("Nm", 0.001, ["drive_g2_r1"])
        assert (signal.minimum, signal.maximum) == pytest.approx((-32.767, 32.767))


@pytest.mark.parametrize("scale", [0.001, 4.0, 1e-7, 0.0123456789012345])
def test_decodes_what_the_codec_encodes(scale: float) -> None:
    codec = NativeCodec(scale)
    data, _ = codec.encode(1, 123 * scale, -456 * scale, 9, saturated=True)
    message = load(torque_dbc(ROBOTS, scale)).get_message_by_frame_id(0x101)
    values = message.decode(data, decode_choices=False)
    assert isinstance(values, dict)
    assert values.pop("tau_right") == pytest.approx(123 * scale, rel=1e-12)
    assert values.pop("tau_left") == pytest.approx(-456 * scale, rel=1e-12)
    assert values == {"enable": 1, "clipped": 0, "saturated": 1, "counter": 9, "crc": data[7]}


def test_names_are_valid_short_and_unique() -> None:
    paths = ["g1/r1", "g1_r1", "g1.r1", "a" * 40, "a" * 41, "größe/1", "7"]
    names = identifiers(paths)
    assert names[:3] == ["g1_r1", "g1_r1_2", "g1_r1_3"]
    assert len(set(names)) == len(paths)
    assert all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,31}", f"torque_{name}") for name in names)
    assert len(load(torque_dbc(paths, 0.001)).messages) == len(paths)


def test_refused() -> None:
    with pytest.raises(ValueError, match="127 robots"):
        torque_dbc(["r"] * 128, 0.001)
    with pytest.raises(ValueError, match="torque scale"):
        torque_dbc(ROBOTS, 0.0)


def test_cantools_decode_shows_newton_metres(tmp_path: Path) -> None:
    dbc = tmp_path / "torque.dbc"
    dbc.write_text(torque_dbc(ROBOTS, 0.001))
    data, _ = NativeCodec(0.001).encode(2, 1.25, -0.75, 4)
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)]
    # a log file, and what candump shows
    for line in (f"(1700000000.010000) vcan0 102#{data.hex().upper()}", f"  vcan0  102   [8]  {data.hex(' ').upper()}"):
        run = subprocess.run(command, input=line + "\n", capture_output=True, text=True, check=True, timeout=60)
        assert run.stdout.startswith(line)
        assert "torque_g2_r1(tau_right: 1.25 Nm, tau_left: -0.75 Nm, enable: 1," in run.stdout
