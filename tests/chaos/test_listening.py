"""What the chaos checker sees with: its own reading of frames against the product, its listener, its look at processes."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from chaos import victims
from chaos.evidence import read_can_log, read_recording
from chaos.frames import COMMAND_ID, ENABLE, FEEDBACK_ID, Frame, command, feedback, pack, torque_frame, unpack
from chaos.listener import READY, read
from chaos.plans import ChaosPlan, Hit
from chaos.subject import GROUP, scenario
from echelon.bridge.protocols.native.codec import Feedback, NativeCodec, Torque
from echelon.bridge.protocols.native.counter import COUNTERS
from support.runs import ROOT, echelon, until

SENDER = ("192.0.2.2", 4000)


@pytest.mark.parametrize("value", [0, 1, -1, 255, 31000, -32767])
def test_its_frames_are_those_of_the_product(value: int) -> None:
    codec = NativeCodec(0.001)
    data, _ = codec.encode(2, value / 1000, -value / 1000, 21)
    assert data == torque_frame(COMMAND_ID + 2, value, -value, ENABLE, 21)
    told = command(Frame(0, SENDER, COMMAND_ID + 2, data))
    assert told is not None
    assert (told.right, told.left, told.enabled, told.moves) == (value, -value, True, value != 0)
    decoded = codec.decode(COMMAND_ID + 2, data)
    assert isinstance(decoded, Torque)
    assert decoded.counter == 21 % COUNTERS
    report = torque_frame(FEEDBACK_ID + 1, value, -value, 0x11, 3)
    assert isinstance(codec.decode_feedback(FEEDBACK_ID + 1, report), Feedback)
    assert feedback(Frame(0, SENDER, FEEDBACK_ID + 1, report)) == (value, -value)


def test_a_frame_with_a_wrong_checksum_is_no_command() -> None:
    data = torque_frame(COMMAND_ID, 5, 5, ENABLE, 0)
    assert command(Frame(0, SENDER, COMMAND_ID, data[:7] + bytes((data[7] ^ 1,)))) is None
    assert command(Frame(0, SENDER, COMMAND_ID + 1, data)) is None


def test_its_datagrams_are_those_of_python_can() -> None:
    for can_id, data in ((0x100, b"12345678"), (0x7FF, b""), (0x180, b"\x00\xff")):
        theirs = pack_message(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        assert msgpack.unpackb(pack(can_id, data)) == msgpack.unpackb(theirs)
        assert unpack(7, SENDER, theirs) == Frame(7, SENDER, can_id, data)


@pytest.mark.parametrize(
    "wrong", [b"", b"\xc1", b"\x80", pack(0x100, b"1")[:-9], pack(1 << 30, b""), pack(1, bytes(9))]
)
def test_what_is_no_frame_is_none(wrong: bytes) -> None:
    assert unpack(0, SENDER, wrong) is None


def test_the_listener_hears_all_datagrams_with_their_times(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind(("", 0))
        port = out.getsockname()[1]
        words = [
            sys.executable,
            "-m",
            "chaos.listener",
            GROUP,
            str(port + 1 if port < 65535 else 1024),
            str(tmp_path / "f"),
        ]
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == READY
                out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
                begun_ns = time.time_ns()
                for number in range(500):
                    out.sendto(pack(number, bytes((number % 256,))), (GROUP, int(words[4])))
                out.sendto(b"no frame", (GROUP, int(words[4])))
                ended_ns = time.time_ns()
                assert until(lambda: read(tmp_path / "f").other == 1)
            finally:
                process.terminate()
    assert process.returncode == 0
    heard = read(tmp_path / "f")
    assert [(frame.can_id, frame.data) for frame in heard.frames] == [(n, bytes((n % 256,))) for n in range(500)]
    assert {frame.sender[1] for frame in heard.frames} == {port}
    assert all(begun_ns <= frame.time_ns <= ended_ns for frame in heard.frames)
    assert heard.missed == 0


def test_processes_of_a_run_are_found_by_mark_and_name() -> None:
    token = f"test-{os.getpid()}"
    assert victims.marked(token) == []
    # One that hid in a session of its own, as an orphan would.
    words = ["import os, time; os.setsid(); time.sleep(60)"]
    environment = os.environ | {victims.MARK: token}
    with subprocess.Popen([sys.executable, "-c", *words], env=environment) as process:
        try:
            assert until(lambda: victims.marked(token) == [process.pid])
            name = victims.name_of(process.pid)
            assert until(lambda: victims.find(name, token) == process.pid)
            assert victims.find("somebody", token) is None
            with socket.create_server(("127.0.0.1", 0)) as server:
                assert server.getsockname() in victims.listening([os.getpid()])
        finally:
            process.send_signal(signal.SIGKILL)
    assert victims.marked(token) == []


def test_it_reads_the_files_of_a_run_and_cut_ones(tmp_path: Path) -> None:
    plan = ChaosPlan(0, "virtual", "closed", 4, 2.0, (Hit("kill", 0.0, "bridge"),))
    (tmp_path / "scenario.toml").write_text(scenario(plan))
    words = ("--engine", "inprocess", "--can", "virtual", "--quiet", "--no-report", "--out", tmp_path / "run")
    assert echelon("run", tmp_path / "scenario.toml", *words).returncode in (0, 1)
    recording = read_recording(tmp_path / "run" / "run.mcap")
    assert recording is not None
    assert (recording.whole, recording.error) == (True, "")
    states = recording.states["south/s4"]
    assert [state.sequence for state in states] == list(range(201))
    assert states[0].values[:2] == (0.0, -1.0)
    log = read_can_log(tmp_path / "run" / "can.log")
    assert log is not None
    assert any(command(Frame(0, SENDER, line.can_id, line.data)) for line in log)
    assert {(line.can_id, line.data) for line in recording.frames} <= {(line.can_id, line.data) for line in log}
    whole = (tmp_path / "run" / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    cut = read_recording(tmp_path / "cut.mcap")
    assert cut is not None
    assert (cut.whole, cut.error) == (False, "")
    assert 0 < len(cut.states["south/s4"]) < 201
    (tmp_path / "no.mcap").write_bytes(b"no recording")
    damaged = read_recording(tmp_path / "no.mcap")
    assert damaged is not None
    assert damaged.error
    assert read_recording(tmp_path / "none.mcap") is None
