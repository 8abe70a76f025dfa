"""Logs of other programs: each form is read as the same frames, and nothing in a file ends or holds up who reads it."""

import base64
import gzip
import random
import struct
import subprocess
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from shutil import which

import can
import pytest

from echelon.bridge.can.candump import ERRORS, EXTENDED, FLEXIBLE, NOT_READ, WITHOUT_TIME, LeftOut, Logged, read_line
from echelon.bridge.can.canlog import EPOCH_NS, CanLog
from echelon.bridge.can.log_files import PATIENCE, REST, frames_in, read_log
from echelon.bridge.protocols.frame import Frame
from support.memory import memory_below

START_NS = 1_700_000_000_000_000_000
FRAMES = [(number * 10_000_000, Frame(0x100 + number % 3, bytes(range(number % 9)), False)) for number in range(30)] + [
    (300_000_000, Frame(0x123, b"", True))
]


def message(time_ns: int, frame: Frame, channel: int | str = 0) -> can.Message:
    return can.Message(
        timestamp=(START_NS + time_ns) / 1e9,
        arbitration_id=frame.can_id,
        is_extended_id=False,
        is_remote_frame=frame.remote,
        data=frame.data,
        channel=channel,
    )


def written(path: Path, messages: Iterable[can.Message] | None = None) -> Path:
    with can.Logger(path) as logger:
        for each in messages or [message(*timed) for timed in FRAMES]:
            logger.on_message_received(each)
    return path


def left_out(path: Path) -> Counter[str]:
    return Counter(entry.reason for entry in read_log(path) if isinstance(entry, LeftOut))


@pytest.mark.parametrize(
    ("line", "time_ns"),
    [
        ("(1700000000.010000) can0 101#E80324FA010700F3", 1_700_000_000_010_000_000),
        ("(1700000000.010000) can0 101#e80324fa010700f3 R", 1_700_000_000_010_000_000),
        ("(1700000000.010000001) can0 101#E80324FA010700F3", 1_700_000_000_010_000_001),
        (" (0000000000.010000)  can0  101   [8]  E8 03 24 FA 01 07 00 F3", 10_000_000),
        (" (000.010000)  can0  101   [8]  E8 03 24 FA 01 07 00 F3   '..$.....'", 10_000_000),
        (" (2023-11-14 22:13:20.010000)  can0  RX - -  101   [8]  e8 03 24 fa 01 07 00 f3", 1_700_000_000_010_000_000),
        (" (1700000000.010000)  can0  TX B E  101   [8]  E8 03 24 FA 01 07 00 F3", 1_700_000_000_010_000_000),
    ],
)
def test_each_form_of_candump_is_read(line: str, time_ns: int) -> None:
    expected = Logged(time_ns, "can0", Frame(0x101, bytes.fromhex("E80324FA010700F3"), False))
    assert read_line(f"{line}\n".encode()) == expected


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("(1.0) can0 00000101#11", EXTENDED),
        ("(1.0) can0 20000004#0000000000000000", ERRORS),
        ("(1.0) can0 101##0112233", FLEXIBLE),
        (" (1.0)  can0  101  [12]  11 22 33 44 55 66 77 88 99 AA BB CC", FLEXIBLE),
        (" (1.0)  can0  20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME", ERRORS),
        ("  can0  101   [1]  11", WITHOUT_TIME),
        ("(1.0) can0 101#1", NOT_READ),
        ("(1.0) can0 101#112233445566778899", NOT_READ),
        (" (1.0)  can0  101   [3]  11 22", NOT_READ),
        (" (2023-13-14 22:13:20.0)  can0  101   [1]  11", NOT_READ),
        ("(1e400) can0 101#11", NOT_READ),
        (f"({'9' * 400}.0) can0 101#11", NOT_READ),
        ("what is this", NOT_READ),
    ],
)
def test_what_is_no_classic_frame_is_told_apart(line: str, reason: str) -> None:
    assert read_line(line.encode()) == LeftOut(reason, reason in (NOT_READ, WITHOUT_TIME))


def test_remote_frames_and_blank_lines() -> None:
    remote = Frame(0x101, b"", True)
    for line in ("(1.0) can0 101#R", "(1.0) can0 101#R8", " (1.0)  can0  101   [8]  remote request"):
        assert read_line(line.encode()) == Logged(10**9, "can0", remote)
    assert read_line(b"  \n") is None


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("suffix", "channel"), [("log", "vcan0"), ("asc", "1"), ("blf", "1"), ("trc", "1"), ("csv", "-")]
)
def test_what_python_can_writes_is_read(suffix: str, channel: str, packed: bool, tmp_path: Path) -> None:
    frames = FRAMES[:-1] if suffix == "trc" else FRAMES  # python-can writes no remote frames into TRC
    path = written(tmp_path / f"x.{suffix}", [message(*timed, "vcan0" if suffix == "log" else 0) for timed in frames])
    if packed:
        path.write_bytes(gzip.compress(path.read_bytes()))
    entries = list(read_log(path))
    assert all(isinstance(entry, Logged) for entry in entries)
    logged = [entry for entry in entries if isinstance(entry, Logged)]
    assert {entry.channel for entry in logged} == {channel}
    assert [entry.frame for entry in logged] == [frame for _, frame in frames]
    # the forms have at least a tenth of a millisecond, and python-can floats
    times = [entry.time_ns - logged[0].time_ns for entry in logged]
    assert times == pytest.approx([time_ns for time_ns, _ in frames], abs=100_000)


@pytest.mark.skipif(which("log2asc") is None, reason="log2asc is not installed (can-utils)")
def test_log2asc_reads_the_log_of_a_run_right(tmp_path: Path) -> None:
    """In a log that begins at 0 it gives all frames of the first second the time 0."""
    for begin_ns in (0, -700_000_000):
        path = tmp_path / f"can-{begin_ns}.log"
        with CanLog(path, "can0") as log:
            for time_ns, (can_id, data, remote) in FRAMES:
                log.write(begin_ns + 5 * time_ns, can_id, data, 0, remote=remote)
        command = ["log2asc", "-I", str(path), "can0"]
        (tmp_path / "can.asc").write_text(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        times = [logged.time_ns for logged in frames_in(tmp_path / "can.asc")]
        assert times == pytest.approx([5 * time_ns for time_ns, _ in FRAMES], abs=1000)
        assert next(frames_in(path)).time_ns == EPOCH_NS + begin_ns


@pytest.mark.parametrize("suffix", ["log", "asc", "trc", "csv"])
def test_a_damaged_line_costs_that_line(suffix: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"x.{suffix}", [message(*timed) for timed in FRAMES[:-1]])
    lines = path.read_text().splitlines(keepends=True)
    body = next(at for at in reversed(range(len(lines))) if "8899" not in lines[at] and at < len(lines) - 12)
    for at, wrong in ((body, "??? no frame\n"), (body - 3, lines[body - 3].replace("0", "z").replace("1", "z"))):
        lines[at] = wrong
    path.write_text("".join(lines))
    assert left_out(path) == {NOT_READ: 2}
    assert len(list(frames_in(path))) == len(FRAMES) - 3


@pytest.mark.parametrize("name", ["x.log", "x.blf"])
@pytest.mark.parametrize("left", [0.3, 0.6, 0.95])
def test_a_file_that_is_cut_off_is_read_up_to_there_and_it_is_said(name: str, left: float, tmp_path: Path) -> None:
    path = written(tmp_path / name, [message(*timed) for timed in FRAMES] * 200)
    data = gzip.compress(path.read_bytes()) if name == "x.log" else path.read_bytes()
    path.write_bytes(data[: int(left * len(data))])
    assert 0 < len(list(frames_in(path))) < 200 * len(FRAMES)
    assert left_out(path)[REST] == 1


@pytest.mark.parametrize("other", ["00000101#11", "101##011"])
def test_frames_of_other_kinds_do_not_make_a_log_damaged(other: str, tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    lines = ["(1.0) can0 101#11", *[f"(1.5) can1 {other}"] * (PATIENCE + 1), "(2.0) can0 101#11"]
    path.write_text("\n".join(lines) + "\n")
    assert len(list(frames_in(path))) == 2
    assert list(left_out(path).values()) == [PATIENCE + 1]


def blf(*objects: bytes, method: int = 2) -> bytes:
    """Returns a BLF file whose only container holds some objects."""
    empty = struct.pack("<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, *[0] * 8, 0, 0, 0, 0, *[0] * 16)
    content = b"".join(objects)
    packed = struct.pack("<H6xL4x", method, len(content)) + (zlib.compress(content, 9) if method else content)
    return empty.ljust(144, b"\0") + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(packed), 10) + packed


@pytest.mark.parametrize("damage", ["", "plain and cut", "half of what was packed"])
def test_a_blf_file_is_whole_or_it_is_said(damage: str, tmp_path: Path) -> None:
    """A container that is not packed may be cut; one that is packed may lack a part though its size is right."""
    data = written(tmp_path / "whole.blf", [message(*timed) for timed in FRAMES]).read_bytes()
    (header,) = struct.unpack_from("<L", data, 4)
    (size,) = struct.unpack_from("<L", data, header + 8)
    content = zlib.decompress(data[header + 32 : header + size])
    whole = blf(content, method=0)
    path, count = tmp_path / "x.blf", len(FRAMES)
    match damage:
        case "plain and cut":
            path.write_bytes(whole[: len(whole) - len(content) // 2])
        case "half of what was packed":
            half = zlib.compress(content, 0)[: len(content) // 2]  # not made smaller, so half of it holds frames
            packed = struct.pack("<H6xL4x", 2, len(content)) + half
            path.write_bytes(whole[:144] + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(packed), 10) + packed)
        case _:
            path.write_bytes(whole)
    found = len(list(frames_in(path)))
    assert (0 < found < count, left_out(path)[REST]) == ((True, 1) if damage else (False, 0))


@pytest.mark.parametrize(
    "content",
    [
        lambda: gzip.compress(b"(1.0) can0 101#11\n" + bytes(60_000_000)),
        lambda: gzip.compress(b"?\n" * 20_000_000),
        lambda: gzip.compress(b"date x\nbase hex\n" + b"7" * 40_000_000),
        lambda: gzip.compress(b";$FILEVERSION=2.1\n;$COLUMNS=" + b"N," * 20_000_000),
        lambda: blf(bytes(40_000_000)),
        lambda: blf(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 0, 7) + bytes(100)),
        lambda: blf(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16, 7) + bytes(100), method=0),
    ],
    ids=["line", "lines", "asc", "trc", "container", "size 0", "object"],
)
def test_a_bomb_is_bounded(content: Callable[[], bytes], tmp_path: Path) -> None:
    path = tmp_path / "bomb"
    path.write_bytes(content())
    begun_s = time.process_time()
    with memory_below(40_000_000):
        assert left_out(path)[REST] == 1
    assert time.process_time() - begun_s < 10


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "trc", "csv", "log.gz"])
def test_no_damage_raises_or_holds_up(suffix: str, tmp_path: Path) -> None:
    whole, rng = written(tmp_path / f"x.{suffix}").read_bytes(), random.Random(1)
    path = tmp_path / "damaged"
    for _ in range(150):
        data = bytearray(whole)
        for _ in range(rng.choice((1, 3, 30))):
            at = rng.randrange(len(data))
            match rng.randrange(4):
                case 0:
                    data[at] ^= 1 << rng.randrange(8)
                case 1:
                    data[at : at + 4] = rng.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"9999", b"\n\n\n\n"))
                case 2:
                    del data[at : at + rng.randrange(40)]
                case _:
                    data[at:at] = data[at : at + rng.randrange(40)]
            data = data or bytearray(b"x")
        path.write_bytes(data)
        begun_s = time.process_time()
        assert all(len(entry.frame.data) <= 8 for entry in frames_in(path))
        assert time.process_time() - begun_s < 5


def test_a_long_stretch_that_is_not_read_ends_the_reading(tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    path.write_text("(1.0) can0 101#11\n" + "?\n" * (PATIENCE + 5) + "(2.0) can0 101#11\n")
    assert len(list(frames_in(path))) == 1
    assert left_out(path)[REST] == 1


def test_a_csv_without_all_columns_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    data = base64.b64encode(b"\x11").decode()
    rows = ["1.0,0x101,0,0,0,1", f"2.0,0x101,0,0,0,1,{data}", f"nan,0x101,0,0,0,1,{data}", f"3.0,0x101,0,0,0,1,{data}"]
    path.write_text("timestamp,arbitration_id,extended,remote,error,dlc,data\n" + "\n".join(rows) + "\n")
    assert [entry.time_ns for entry in frames_in(path)] == [2 * 10**9, 3 * 10**9]
    assert left_out(path) == {NOT_READ: 2}
