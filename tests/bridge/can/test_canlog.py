"""can.log: its lines, the tools that read them, a killed process, and a full disk."""

import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import can
import pytest

from echelon.bridge.can.canlog import FLUSH_NS, CanLog
from echelon.bridge.protocols.native.codec import NativeCodec, frame_id
from support.full_disk import fill
from support.runs import ROOT, lab_dbc

EPOCH = 1_700_000_000_000_000_000
DATA = bytes.fromhex("e80324fa010700f3")
LINE = "(1700000000.012345) vcan0 103#E80324FA010700F3\n"


def test_golden_line(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    with CanLog(path, "vcan0", EPOCH) as log:
        log.write(12_345_999, 0x103, DATA, 0)
        log.write(2_000_000_000, 0x001, b"", 0)
    log.close()
    assert path.read_text() == LINE + "(1700000002.000000) vcan0 001#\n"
    assert (log.counts.written, log.counts.lost, log.error) == (2, 0, None)


def test_lines_leave_by_time_by_number_and_by_flush(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    with CanLog(path, "vcan0", 0) as log:
        log.write(0, 1, DATA, 5)
        log.write(1, 1, DATA, 5 + FLUSH_NS - 1)
        assert path.read_text() == ""
        log.write(2, 1, DATA, 5 + FLUSH_NS)
        assert path.read_text().count("\n") == 3
        log.write(3, 1, DATA, 6 + FLUSH_NS)
        assert path.read_text().count("\n") == 3
        log.flush()
        assert path.read_text().count("\n") == 4
        for number in range(5000):
            log.write(number, 1, DATA, 6 + FLUSH_NS)
        assert path.read_text().count("\n") >= 4 + 4096


def test_a_killed_process_loses_only_what_is_younger(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    program = (
        "import os, sys; from pathlib import Path; from bridge.can.canlog import CanLog, FLUSH_NS\n"
        "log = CanLog(Path(sys.argv[1]), 'vcan0', 0)\n"
        "for number in range(1000): log.write(number, 1, bytes(8), number * FLUSH_NS // 100)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    run = subprocess.run([sys.executable, "-c", program, str(path)], cwd=ROOT, timeout=600, check=False)
    assert run.returncode == -signal.SIGKILL
    lines = path.read_text().splitlines()
    assert 900 <= len(lines) <= 1000  # 1000 frames in 1 s of wall time: at most the last 0.1 s is missing
    assert all(line.endswith("001#0000000000000000") for line in lines)


def write_some(path: Path) -> list[bytes]:
    codec = NativeCodec(0.001)
    frames = [codec.encode(1, 0.001 * number, -0.001 * number, number)[0] for number in range(300)]
    with CanLog(path, "vcan0", EPOCH) as log:
        for number, data in enumerate(frames):
            log.write(number * 10_000_000, frame_id(1), data, 0)
    return frames


def test_python_can_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    frames = write_some(path)
    with can.LogReader(path) as reader:
        messages = list(reader)
    assert [(message.arbitration_id, bytes(message.data)) for message in messages] == [(0x101, data) for data in frames]
    assert messages[299].timestamp == pytest.approx(1_700_000_002.99, abs=1e-6)


@pytest.mark.slow
def test_cantools_decodes_it(tmp_path: Path) -> None:
    path, dbc = tmp_path / "can.log", tmp_path / "torque.dbc"
    write_some(path)
    dbc.write_text(lab_dbc())
    with path.open() as log:
        command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)]
        run = subprocess.run(command, stdin=log, capture_output=True, text=True, check=True, timeout=600)
    shown = run.stdout.splitlines()
    assert len(shown) == 300
    assert "torque_g1_r2(tau_right: 0.299 Nm, tau_left: -0.299 Nm" in shown[299]


@pytest.mark.skipif(shutil.which("log2asc") is None, reason="log2asc is not installed (can-utils)")
def test_log2asc_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    frames = write_some(path)
    command = ["log2asc", "-I", str(path), "vcan0"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout
    assert [line.upper() for line in shown.splitlines() if " 101 " in line][299].split("D 8 ")[1].split() == (
        frames[299].hex(" ").upper().split()
    )


def test_full_device_is_counted_not_raised(tmp_path: Path) -> None:
    with CanLog(tmp_path / "can.log", "vcan0", 0) as log:
        fill(log._fd)
        log.write(0, 1, DATA, 0)
        log.flush()
        assert log.error is not None
        assert log.error.strerror == os.strerror(28)
        log.write(1, 1, DATA, 0)
    assert (log.counts.written, log.counts.lost) == (0, 2)


@pytest.mark.parametrize("there", ["file", "link"])
def test_what_is_there_already_is_never_written_over(there: str, tmp_path: Path) -> None:
    path, kept = tmp_path / "can.log", tmp_path / "kept"
    kept.write_text("kept")
    path.write_text("kept") if there == "file" else path.symlink_to(kept)
    with pytest.raises(FileExistsError):
        CanLog(path, "vcan0", 0)
    assert path.read_text() == kept.read_text() == "kept"


def test_file_stays_whole_when_the_disk_fills_and_goes_on_after(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    old, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with CanLog(path, "vcan0", EPOCH) as log:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (len(LINE) * 5 // 2, old[1]))
            for _ in range(4):
                log.write(12_345_999, 0x103, DATA, 0)
            log.flush()
            assert path.read_text() == LINE * 2
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, old)
            signal.signal(signal.SIGXFSZ, handler)
        log.write(12_345_999, 0x103, DATA, 0)
    assert path.read_text() == LINE * 3
    assert (log.counts.written, log.counts.lost) == (3, 2)
    assert log.error is not None


def test_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one word"):
        CanLog(tmp_path / "can.log", "two words", 0)
    with pytest.raises(OSError, match="nowhere"):
        CanLog(tmp_path / "nowhere" / "can.log", "vcan0", 0)
