"""Frames on a real SocketCAN interface, received by foreign programs."""

import fcntl
import re
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bench.can import bus_rates
from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import interface_is_up, listen_command, resolve_url
from echelon.bridge.protocols.native.codec import NativeCodec, Torque
from echelon.bridge.protocols.native.host import NativeHost
from echelon.bridge.roles.torque_mirror import TorqueMirror
from echelon.sim.doctor.can_checks import check_interfaces, check_vcan
from support.bench_drives import drive_plan
from support.runs import lab_dbc, until

pytestmark = pytest.mark.vcan

ROBOTS = [f"g{1 + number // 3}/r{1 + number}" for number in range(9)]
STEPS = 250
ROOM = 32_000
"""Half of what a pipe holds [bytes]"""
SCALE = 0.001


@pytest.fixture
def bus() -> Iterator[Bus]:
    with open_bus("socketcan:vcan0") as opened:
        yield opened


def listener(interface: str = "vcan0") -> socket.socket:
    """Returns a plain socket of the kernel with room for all frames of a test."""
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    raw.bind((interface,))
    raw.settimeout(10.0)
    return raw


def next_frame(raw: socket.socket) -> tuple[int, bytes]:
    can_id, length, data = struct.unpack("=IB3x8s", raw.recv(16))
    return can_id, data[:length]


def torques(step: int, robot: int) -> tuple[float, float]:
    return 0.0123 * step - robot, 0.00045678 * step * robot


def run(bus: Bus, waiting: Callable[[], int] = int) -> list[tuple[int, bytes]]:
    """Sends STEPS periods of all robots through a bridge, each when few bytes wait for who reads what comes of them."""
    plans = [drive_plan("native", (robot, robot), torque_scale=SCALE) for robot in range(len(ROBOTS))]
    bridge = TorqueMirror([NativeHost(plan) for plan in plans], 10_000_000)
    sent = []
    for step in range(STEPS):
        while waiting() > ROOM:
            time.sleep(0.001)
        for robot in range(len(ROBOTS)):
            for frame in bridge.encode(step * 10_000_000, robot, *torques(step, robot)):
                bus.send(frame.can_id, frame.data, step * 10_000_000)
                sent.append((frame.can_id, frame.data))
    assert len(sent) == bridge.frames == STEPS * len(ROBOTS) >= 2000
    return sent


def test_an_independent_socket_gets_every_frame(bus: Bus) -> None:
    with listener() as raw:
        sent = run(bus)
        assert [next_frame(raw) for _ in sent] == sent
        raw.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            raw.recv(16)
    assert (bus.counts.sent, bus.counts.failed, bus.counts.dropped) == (len(sent), 0, 0)
    codec = NativeCodec(SCALE)
    for number, (can_id, data) in enumerate(sent):
        step, robot = divmod(number, len(ROBOTS))
        frame, (right, left) = codec.decode(can_id, data), torques(step, robot)
        assert isinstance(frame, Torque)
        assert (frame.robot, frame.counter) == (robot, step % 16)
        assert abs(frame.tau_right - right) <= SCALE * 0.500001
        assert abs(frame.tau_left - left) <= SCALE * 0.500001


def somebody_listens() -> bool:
    """Returns whether a socket without a filter is bound to vcan0; the buses of this project have filters."""
    return re.search(r"^ +vcan0 +0", Path("/proc/net/can/rcvlist_all").read_text(), re.MULTILINE) is not None


def test_candump_and_cantools_show_newton_metres(bus: Bus, tmp_path: Path) -> None:
    dbc = tmp_path / "torque.dbc"
    dbc.write_text(lab_dbc(SCALE))
    total = STEPS * len(ROBOTS)
    # as a user types it, but it ends after all frames, or after ten seconds of silence
    with (
        subprocess.Popen(
            [*listen_command(bus.url).split(), "-n", str(total), "-T", "10000"], stdout=subprocess.PIPE
        ) as one,
        subprocess.Popen(
            [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)],
            stdin=one.stdout,
            stdout=subprocess.PIPE,
            text=True,
        ) as two,
    ):
        limit = time.monotonic() + 600
        while not somebody_listens() and time.monotonic() < limit:
            assert one.poll() is None
        assert one.stdout is not None
        assert two.stdout is not None
        pipe, shown = one.stdout.fileno(), list[str]()
        reader = threading.Thread(target=shown.extend, args=(two.stdout,))
        reader.start()
        # candump waits when the pipe is full, and the kernel drops what it then does not read
        run(bus, lambda: int.from_bytes(fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)), sys.byteorder))
        one.stdout.close()
        reader.join(600)
    assert len(shown) == total
    number = r"(-?[0-9.e-]+)"
    for index, line in enumerate(shown):
        step, robot = divmod(index, len(ROBOTS))
        found = re.search(
            rf":: (\w+)\(tau_right: {number} Nm, tau_left: {number} Nm, enable_right: 1, enable_left: 1, clear: 0, clipped: 0,",
            line,
        )
        assert found is not None, line
        assert found[1] == f"torque_{ROBOTS[robot].replace('/', '_')}"
        right, left = torques(step, robot)
        assert abs(float(found[2]) - right) <= SCALE * 0.500001
        assert abs(float(found[3]) - left) <= SCALE * 0.500001


def ip(*words: str) -> None:
    done = subprocess.run(["ip", "link", *words], capture_output=True, text=True, timeout=10, check=False)
    if "not permitted" in done.stderr:
        pytest.skip("no right to change interfaces")
    assert done.returncode == 0, done.stderr


def test_an_interface_going_down_and_away_is_survived() -> None:
    data = bytes(range(8))
    ip("add", "vcan1", "type", "vcan")
    try:
        ip("set", "vcan1", "up")
        with open_bus("socketcan:vcan1") as bus:
            assert bus.send(1, data)
            ip("set", "vcan1", "down")
            assert [bus.send(2, data) for _ in range(3)] == [False] * 3
            ip("set", "vcan1", "up")
            with listener("vcan1") as raw:
                assert bus.send(3, data)
                assert next_frame(raw) == (3, data)
            ip("del", "vcan1")
            assert [bus.send(4, data) for _ in range(3)] == [False] * 3
            ip("add", "vcan1", "type", "vcan")
            ip("set", "vcan1", "up")
            with listener("vcan1") as raw:
                assert bus.send(5, data)
                assert next_frame(raw) == (5, data)
            assert (bus.counts.sent, bus.counts.failed, bus.counts.dropped) == (3, 6, 0)
    finally:
        ip("del", "vcan1")


def test_an_interface_that_was_away_is_heard_again_by_those_who_only_listen() -> None:
    ip("add", "vcan1", "type", "vcan")
    try:
        ip("set", "vcan1", "up")
        with open_bus("socketcan:vcan1") as bus, open_bus("socketcan:vcan1") as waiting:
            ip("del", "vcan1")
            assert [bus.recv(0.0) for _ in range(3)] == [None] * 3
            assert isinstance(bus.error, OSError)
            threading.Timer(0.2, lambda: (ip("add", "vcan1", "type", "vcan"), ip("set", "vcan1", "up"))).start()
            while waiting.recv(0.05) is None and not interface_is_up("vcan1"):
                pass
            assert bus.recv(0.0) is waiting.recv(0.0) is None
            with listener("vcan1") as other:
                other.send(struct.pack("=IB3x8s", 0x80000123, 8, b"01234567"))  # the filters are there, too
                other.send(struct.pack("=IB3x8s", 0x101, 8, b"01234567"))
            for one in (bus, waiting):
                frame = one.recv(10.0)
                assert frame is not None
                assert (frame.can_id, frame.data) == (0x101, b"01234567")
    finally:
        ip("del", "vcan1")


@pytest.mark.parametrize("command", ["drives", "referee", "can"])
def test_a_command_hears_an_interface_again_that_was_away(command: str, tmp_path: Path) -> None:
    ip("add", "vcan1", "type", "vcan")
    words = [sys.executable, "-m", "echelon", command, "lab", "--can", "socketcan:vcan1", "--seconds", "900", "--json"]
    try:
        ip("set", "vcan1", "up")
        said = tmp_path / "said"
        with said.open("w") as out, subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT) as running:
            try:
                assert until(lambda: somebody_is_on("vcan1") or running.poll() is not None)
                assert running.poll() is None, said.read_text()
                before = said.read_text()
                ip("del", "vcan1")
                if command == "drives":
                    time.sleep(1.0)  # drives do not say that it is gone
                else:
                    assert "socketcan:vcan1: " not in before
                    assert until(lambda: "socketcan:vcan1: " in said.read_text())
                ip("add", "vcan1", "type", "vcan")
                ip("set", "vcan1", "up")
                assert until(lambda: somebody_is_on("vcan1") or running.poll() is not None), said.read_text()
                assert running.poll() is None, said.read_text()
            finally:
                running.kill()
    finally:
        ip("del", "vcan1")


def somebody_is_on(interface: str) -> bool:
    """Returns whether a socket with filters is bound to an interface, as the buses of this project are."""
    lists = [path.read_text() for path in Path("/proc/net/can").glob("rcvlist_*")]
    return any(re.search(rf"^ +{interface} +[0-9a-f]", text, re.MULTILINE) for text in lists)


def test_receiving_from_others(bus: Bus) -> None:
    before_ns = time.time_ns()
    with listener() as other:
        for can_id in (0x80000123, 0x20000004, 0x40000105, 0x101):  # extended, error, remote, plain
            other.send(struct.pack("=IB3x8s", can_id, 8, b"01234567"))
    got = [bus.recv(10.0), bus.recv(10.0)]
    assert [frame and (frame.can_id, frame.remote) for frame in got] == [(0x105, True), (0x101, False)]
    assert got[1] is not None
    assert got[1].data == b"01234567"
    assert before_ns <= got[1].time_ns <= time.time_ns()
    assert bus.recv(0.0) is None


def test_a_receiver_holds_a_burst(bus: Bus) -> None:
    with open_bus("socketcan:vcan0") as receiver:
        sent = run(bus)
        got = [receiver.recv(10.0) for _ in sent]
    assert [frame and (frame.can_id, frame.data) for frame in got] == sent
    assert bus.recv(0.0) is None  # a bus does not receive its own frames


def test_the_way_to_the_bus_costs_no_more_than_twice_python_can() -> None:
    rates = bus_rates("socketcan:vcan0", 100)
    assert rates["bridge"] > rates["plain send"] / 2
    assert rates["recv"] > rates["plain recv"] / 2


def test_the_doctor_sees_interfaces() -> None:
    ip("add", "vcan3", "type", "vcan")
    try:
        assert check_vcan().state == "ok"
        assert check_vcan("vcan3").advice == ("sudo ip link set vcan3 up",)
        found = {finding.what: finding for finding in check_interfaces()}
        assert set(found) == {"vcan0", "vcan3"}
        assert found["vcan0"].state == "ok"
        assert found["vcan0"].text.startswith("vcan, queue of ")
        assert found["vcan3"].text.startswith("vcan, down, queue of ")
        assert found["vcan3"].advice == ("sudo ip link set vcan3 up",)
    finally:
        ip("del", "vcan3")


def test_auto_is_this_interface() -> None:
    assert resolve_url("auto") == "socketcan:vcan0"


def test_multicast_beside_it() -> None:
    with open_bus("udp_multicast::47113") as sender, open_bus(sender.url) as receiver:
        assert sender.send(0x101, b"torque")
        frame = receiver.recv(10.0)
        assert frame is not None
        assert (frame.can_id, frame.data) == (0x101, b"torque")


def test_a_whole_run_as_processes_is_on_the_bus(tmp_path: Path) -> None:
    """Candump hears every torque of thirteen members with recorder and bridge, and cantools decodes it in N m."""
    folder = tmp_path / "run"
    run_command = [sys.executable, "-m", "echelon", "run", "lab", "--set", "duration=1", "--set", "claims=[]"]
    run_command += ["--can", "socketcan:vcan0", "--no-report", "--quiet", "--out", str(folder)]
    listen = ["candump", "-L", "vcan0", "-n", "909", "-T", "60000"]
    with subprocess.Popen(listen, stdout=subprocess.PIPE, text=True) as candump:
        limit = time.monotonic() + 600
        while not somebody_listens() and time.monotonic() < limit:
            assert candump.poll() is None
        done = subprocess.run(run_command, capture_output=True, text=True, timeout=600, check=False)
        assert done.returncode == 0, done.stderr
        heard = candump.communicate(timeout=600)[0].splitlines()
    logged = [line.split()[2] for line in (folder / "can.log").read_text().splitlines()]
    assert len(logged) == 9 * 100 + 9  # the last nine take the torque away
    assert [line.split()[2] for line in heard] == logged
    decode = [sys.executable, "-m", "cantools", "decode", "--single-line", str(folder / "torque.dbc")]
    decoded = subprocess.run(
        decode, input="\n".join(heard) + "\n", capture_output=True, text=True, timeout=600, check=True
    ).stdout.splitlines()
    codec = NativeCodec(SCALE)
    for line, frame in zip(decoded, logged, strict=True):
        can_id, data = frame.split("#")
        torque = codec.decode(int(can_id, 16), bytes.fromhex(data))
        assert isinstance(torque, Torque)
        found = re.search(r"tau_right: (\S+) Nm, tau_left: (\S+) Nm,", line)
        assert found, line
        assert [float(text) for text in found.groups()] == pytest.approx([torque.tau_right, torque.tau_left])
