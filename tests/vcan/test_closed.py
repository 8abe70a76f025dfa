"""Closed torque paths over a real interface: the same run as in one process, also when the interface goes down."""

import json
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import cantools
import pytest

from echelon.bridge.protocols.native.codec import FEEDBACK_ID, FaultCode, Feedback, NativeCodec, Torque
from echelon.sim.out_folder import OutFolder
from echelon.sim.parts.loading import load
from echelon.sim.run import execute
from echelon.sim.view.live import Display
from vcan.test_vcan import ip, listener, next_frame, somebody_listens

pytestmark = pytest.mark.vcan

ROOT = Path(__file__).parents[2]
LAB = ROOT / "deploy" / "scenarios" / "lab.toml"
CLOSED = ("can.path=closed", "claims=[]")
PROTOCOLS = {
    "native": ("duration=1",),
    "odrive": ("duration=0.4", "can.bring_up=0.4", 'robot.drive.protocol="odrive"', "can.bitrate=1000000"),
    "cia402": ("duration=0.3", "can.bring_up=0.5", 'robot.drive.protocol="cia402"', "can.bitrate=1000000"),
}
OWN = "vcan2"
TRIO = """
name = "trio"
duration = 1.0
periods = { acceleration = 0.05, torque = 0.05 }
can = { path = "closed", bring_up = 0.5, watchdog = 0.7 }
trajectory = { kind = "line", velocity = [0.2, 0.0] }
law = { epsilon = [0.5] }

[robot]
mass = 4.0
inertia = 0.12
wheel_radius = 0.05
arm = 0.15
offset = 0.1
torque_limit = 1.5

[formation]
shape = { kind = "triangle", side = 1.2 }
robots = { r1 = { start = [0.0, -0.7] }, r2 = { start = [0.9, 0.1] }, r3 = { start = [0.0, 0.9] } }
"""


def in_one_process(scenario: Path, overrides: Sequence[str], folder: Path) -> str:
    """Runs a scenario without a bus; returns the digest of its trace."""
    folder.mkdir()
    loaded, plan = load(scenario, overrides)
    display = Display(plan, quiet=True)
    out = OutFolder(folder, loaded.name, ())
    summary, _ = execute(loaded, plan, out, engine="inprocess", clock="virtual", can_urls=(), display=display)
    assert summary.run.failure is None
    return str(summary.trace_digest)


def as_processes(
    scenario: Path, overrides: Sequence[str], folder: Path, interface: str, *more: str
) -> subprocess.Popen[str]:
    """Starts a run as processes with its frames on an interface."""
    settings = [word for override in overrides for word in ("--set", override)]
    command = [sys.executable, "-m", "echelon", "run", str(scenario), *settings, *more]
    command += ["--can", f"socketcan:{interface}", "--no-report", "--quiet", "--out", str(folder)]
    return subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finished(run: subprocess.Popen[str], folder: Path, code: int = 0) -> dict[str, Any]:
    """Waits for the end of a run; returns its summary."""
    _, said = run.communicate(timeout=600)
    assert run.returncode == code, said
    assert "Traceback" not in said
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary


def frames(path: Path) -> list[str]:
    """Returns identifiers and data from a log."""
    return [line.split()[2] for line in path.read_text().splitlines()]


def by_identifier(logged: Iterable[str]) -> dict[str, list[str]]:
    """Returns frames by identifier, in their order."""
    in_order = sorted(logged, key=lambda frame: frame[:3])
    return {can_id: list(same) for can_id, same in groupby(in_order, lambda frame: frame[:3])}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_processes_on_the_bus_give_the_run_of_one_process(protocol: str, tmp_path: Path) -> None:
    """Candump hears every frame in the log: the bridge's frames in their order, those of drives by identifier."""
    overrides = (*CLOSED, *PROTOCOLS[protocol])
    digest = in_one_process(LAB, overrides, tmp_path / "one")
    out = tmp_path / "candump.log"
    with out.open("w") as file, subprocess.Popen(["candump", "-L", "vcan0"], stdout=file) as candump:
        limit_s = time.monotonic() + 600
        while not somebody_listens() and time.monotonic() < limit_s:
            assert candump.poll() is None
        summary = finished(as_processes(LAB, overrides, tmp_path / "run", "vcan0"), tmp_path / "run")
        candump.terminate()
    assert summary["trace_digest"] == digest
    assert (tmp_path / "run" / "can.log").read_bytes() == (tmp_path / "one" / "can.log").read_bytes()
    logged, heard = frames(tmp_path / "run" / "can.log"), frames(out)
    assert (summary["can"]["frames"], summary["can"]["foreign"]) == (len(logged), 0)
    assert not Counter(logged) - Counter(heard)
    # Not logged: drives' frames that a real bus would not have carried yet, and what drives say for two watchdogs (0.2 s) after
    # the end.  The log is of 0.8 s at least.
    assert len(heard) - len(logged) < 0.3 * len(logged)
    database = cantools.database.can.Database()
    database.add_dbc_file(tmp_path / "run" / "torque.dbc")
    of_bridge = {f"{message.frame_id:03X}" for message in database.messages if message.senders == ["bridge"]}
    assert [frame for frame in heard if frame[:3] in of_bridge] == [frame for frame in logged if frame[:3] in of_bridge]
    heard_of = by_identifier(heard)
    for can_id, said in by_identifier(logged).items():
        assert heard_of[can_id][: len(said)] == said


@pytest.fixture
def interface() -> Iterator[str]:
    """An interface of this test alone, which may go down."""
    ip("add", OWN, "type", "vcan")
    try:
        ip("set", OWN, "up")
        yield OWN
    finally:
        ip("del", OWN)


@pytest.fixture
def trio(tmp_path: Path) -> Path:
    path = tmp_path / "trio.toml"
    path.write_text(TRIO)
    return path


def carried(interface: str) -> int:
    """Returns how many frames an interface has carried."""
    return int(Path(f"/sys/class/net/{interface}/statistics/tx_packets").read_text())


def await_torque(raw: socket.socket) -> None:
    """Waits until a torque is sent to a robot."""
    codec = NativeCodec(0.001)
    limit_s = time.monotonic() + 600
    while time.monotonic() < limit_s:
        can_id, data = next_frame(raw)
        torque = codec.decode(can_id, data) if can_id < FEEDBACK_ID else None
        if isinstance(torque, Torque) and torque.tau_right:
            return
    raise AssertionError("no torque")


def down_for(seconds: float, run: subprocess.Popen[str], interface: str) -> None:
    """Takes an interface down for some seconds during a run, and checks that it carries no frames meanwhile."""
    ip("set", interface, "down")
    before = carried(interface)
    with pytest.raises(subprocess.TimeoutExpired):
        run.wait(seconds)
    assert carried(interface) == before
    ip("set", interface, "up")


def test_in_virtual_time_a_run_stands_still_with_its_interface(interface: str, trio: Path, tmp_path: Path) -> None:
    overrides = ("duration=10",)
    digest = in_one_process(trio, overrides, tmp_path / "one")
    run = as_processes(trio, overrides, tmp_path / "run", interface)
    with run:
        with listener(interface) as raw:
            raw.settimeout(60)
            await_torque(raw)
        down_for(1.0, run, interface)
        summary = finished(run, tmp_path / "run")
    assert summary["trace_digest"] == digest
    assert (tmp_path / "run" / "can.log").read_bytes() == (tmp_path / "one" / "can.log").read_bytes()
    assert carried(interface) >= summary["can"]["frames"]


def test_on_a_wall_clock_watchdogs_stop_the_wheels(interface: str, trio: Path, tmp_path: Path) -> None:
    # A watchdog that a guest with one busy processor meets, as long as its interface is up.
    overrides = ("duration=12", "can.bring_up=2", "can.watchdog=2")
    run = as_processes(trio, overrides, tmp_path / "run", interface, "--clock", "wall")
    with run:
        with listener(interface) as raw:
            raw.settimeout(60)
            await_torque(raw)
        down_for(4.0, run, interface)
        with listener(interface) as raw:
            said: dict[int, Feedback] = {}
            limit_s = time.monotonic() + 600
            while len(said) < 3 or any(FaultCode.NONE in feedback.faults for feedback in said.values()):
                assert time.monotonic() < limit_s, said
                can_id, data = next_frame(raw)
                feedback = NativeCodec(0.001).decode_feedback(can_id, data)
                if isinstance(feedback, Feedback) and can_id >= FEEDBACK_ID:
                    said[can_id] = feedback
        summary = finished(run, tmp_path / "run", 1)
    for feedback in said.values():
        assert feedback.faults == (FaultCode.WATCHDOG, FaultCode.WATCHDOG)
        assert feedback.torques == (0.0, 0.0)
    can = summary["can"]
    late = {found["robot"] for found in can["referee"]["findings"] if found["kind"] in ("gap", "silent")}
    assert late == {"r1", "r2", "r3"}
    assert summary["verdict"]["word"] == "FAILS"
    assert can["failed"] > 0
    for robot in can["robots"].values():
        assert not robot["enabled"]
        assert robot["fault"]
