"""A native drive on a real SocketCAN interface: seen by a plain socket, by candump and by cantools."""

import re
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from echelon.bridge.can.bus import open_bus
from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import FaultCode, Feedback, NativeCodec
from echelon.bridge.protocols.native.drive import NativeDrive
from echelon.bridge.protocols.native.host import NativeHost
from support.bench_drives import MS, Bench, drive_plan
from support.runs import lab_dbc

pytestmark = pytest.mark.vcan

URL = "socketcan:vcan0"
ROBOT = 3
COMMAND, FEEDBACK = 0x103, 0x183
PLAN = drive_plan("native", watchdog_ns=2000 * MS)  # a guest may stand still for a while
CODEC = NativeCodec(PLAN.torque_scale)
ON, FAULT = WheelState.ENABLED, WheelState.FAULT


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench(URL, [NativeDrive(PLAN)]) as running:
        yield running


class Client:
    """Commands a drive through a plain socket of the kernel."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", FEEDBACK, 0x7FF))
        self.socket.bind(("vcan0",))
        self.socket.settimeout(10.0)
        self.counter = 0

    def command(self, right: float, left: float, clear: bool = False) -> None:
        self.counter += 1
        data, _ = CODEC.encode(ROBOT, right, left, self.counter, enable=(not clear, not clear), clear=clear)
        self.socket.send(struct.pack("=IB3x8s", COMMAND, 8, data))

    def heard(self) -> Feedback:
        can_id, length, data = struct.unpack("=IB3x8s", self.socket.recv(16))
        feedback = CODEC.decode_feedback(can_id, data[:length])
        assert isinstance(feedback, Feedback)
        return feedback

    def latest(self) -> Feedback:
        """Returns the newest feedback that has come; waits for one if none has."""
        feedback = self.heard()
        while select.select([self.socket], [], [], 0)[0]:
            feedback = self.heard()
        return feedback

    def hear_until(self, wanted: Callable[[Feedback], bool]) -> Feedback:
        """Hears feedback until one is `wanted`; returns that one."""
        for _ in range(500):
            if wanted(feedback := self.heard()):
                return feedback
        raise AssertionError(f"never as wanted, last {feedback}")

    def hold(self, right: float, left: float, wanted: Callable[[Feedback], bool], clear: bool = False) -> Feedback:
        """Sends the command after each feedback until one is `wanted`; returns that one."""
        for _ in range(500):
            feedback = self.heard()
            if wanted(feedback):
                return feedback
            self.command(right, left, clear)
        raise AssertionError(f"never as wanted, last {feedback}")


@pytest.fixture
def client(bench: Bench) -> Iterator[Client]:
    made = Client()
    with made.socket:
        # Feedback that the kernel still carries for an earlier bench comes first; the drive of this one begins disabled.
        made.hear_until(lambda said: said.states == (WheelState.DISABLED,) * 2)
        yield made


def test_enable_torque_and_watchdog(bench: Bench, client: Client) -> None:
    client.hold(0.0, 0.0, lambda said: said.states == (ON, ON))
    client.hold(0.5, -0.25, lambda said: said.torques == pytest.approx((0.5, -0.25)))
    with bench.lock:
        right, left = bench.drives[0].motors
        assert right.omega > 0 > left.omega
    before_ns = time.monotonic_ns()
    client.command(0.5, -0.25)
    said = client.heard()
    while said.states != (FAULT, FAULT):
        said = client.heard()
    assert time.monotonic_ns() - before_ns >= PLAN.watchdog_ns
    assert said.faults == (FaultCode.WATCHDOG, FaultCode.WATCHDOG)
    client.heard()
    assert client.heard().torques == (0.0, 0.0)
    for _ in range(5):
        client.command(0.5, 0.5)
        said = client.heard()
        assert (said.states, said.torques) == ((FAULT, FAULT), (0.0, 0.0))
    client.hold(0.0, 0.0, lambda said: FAULT not in said.states, clear=True)
    client.hold(0.0, 0.0, lambda said: said.states == (ON, ON))
    client.hold(-0.5, 0.5, lambda said: said.torques == pytest.approx((-0.5, 0.5)))


def test_a_fault_made_to_happen(bench: Bench, client: Client) -> None:
    client.hold(0.0, 0.0, lambda said: said.states == (ON, ON))
    bench.inject(0, 1, Fault.OVER_TEMPERATURE)
    said = client.hold(0.5, 0.5, lambda said: said.states == (ON, FAULT))
    assert said.faults == (FaultCode.NONE, FaultCode.OVER_TEMPERATURE)
    bench.mend(0, 1, Fault.OVER_TEMPERATURE)
    client.hold(0.0, 0.0, lambda said: FAULT not in said.states, clear=True)


def test_our_host_brings_the_drive_up(bench: Bench) -> None:
    host, last_ns = NativeHost(PLAN), 0
    with open_bus(URL) as bus:
        for _ in range(500):
            received = bus.recv(10.0)
            assert received is not None
            if received.can_id not in host.identifiers:
                continue
            now_ns = time.monotonic_ns()
            host.receive(now_ns, Frame(received.can_id, received.data))
            if host.torque == pytest.approx((1.0, -1.0)):
                break
            if host.torque_ns != last_ns:  # a cycle with each feedback
                last_ns = now_ns
                for frame in host.poll(now_ns) + host.command(now_ns, 1.0, -1.0):
                    bus.send(frame.can_id, frame.data)
        assert host.enabled
        assert host.torque == pytest.approx((1.0, -1.0))
    assert (host.refused, host.fault) == ({}, "")


def test_candump_and_cantools_show_what_the_drive_says(bench: Bench, client: Client, tmp_path: Path) -> None:
    client.hold(0.0, 0.0, lambda said: said.states == (ON, ON))
    dbc = tmp_path / "native.dbc"
    dbc.write_text(lab_dbc(PLAN.torque_scale))
    log = tmp_path / "candump.txt"
    with (
        log.open("w") as file,
        subprocess.Popen(["candump", "vcan0", "-n", "150", "-T", "60000"], stdout=file) as candump,
    ):
        while candump.poll() is None:
            client.command(0.375, -0.125, clear=FAULT in client.latest().states)
    decode = [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)]
    with log.open() as file:
        decoded = subprocess.run(decode, stdin=file, capture_output=True, text=True, timeout=600, check=True)
    shown = decoded.stdout.splitlines()
    assert len(shown) == 150
    assert {found[1] for line in shown if (found := re.search(r":: (\w+)\(", line))} == {
        f"{kind}_g2_r4" for kind in ("torque", "feedback", "status")
    }
    said = [line for line in shown if "mean_tau_right: 0.375 Nm, mean_tau_left: -0.125 Nm" in line]
    assert len(said) > 10
    assert all("state_right: enabled, state_left: enabled," in line for line in said)
