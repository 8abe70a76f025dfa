"""On a wall clock can.log is what was on the wire: python-can listens on its own, and one robot is frozen meanwhile."""

import os
import signal
import threading
import time
from itertools import pairwise
from pathlib import Path
from statistics import median

import can
import pytest

from echelon.bridge.can.bus_url import resolve_url
from echelon.bridge.can.log_files import frames_in
from echelon.bridge.protocols.native.codec import BASE_ID
from echelon.sim.parts.loading import load
from echelon.sim.recording.mcap_reader import read_trace, recover
from support.runs import kill_session, pid_of, session_members, start_echelon, summary_of
from support.two_robots import two_robots

FROZEN_S = 2.5
WATCHDOG_S = 0.5
PERIOD_S = 0.01

pytestmark = pytest.mark.slow


class Listener(threading.Thread):
    """python-can alone, in a thread: what came, and when."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        group, _, port = url.partition(":")[2].rpartition(":")
        self._bus = can.Bus(group, interface="udp_multicast", port=int(port), ignore_config=True)
        self.heard: list[tuple[float, int, bytes]] = []
        self.over = threading.Event()

    def run(self) -> None:
        while (message := self._bus.recv(0.2)) is not None or not self.over.is_set():
            if message is not None:
                self.heard.append((message.timestamp, message.arbitration_id, bytes(message.data)))
        self._bus.shutdown()


def test_a_frozen_robot_holds_up_nobody_and_its_old_torques_are_not_sent(tmp_path: Path) -> None:
    url, folder, scenario = resolve_url("auto"), tmp_path / "run", tmp_path / "two.toml"
    scenario.write_text(two_robots(watchdog=WATCHDOG_S))
    if not url.startswith("udp_multicast"):
        pytest.skip("a bus on which python-can tells who sent what")
    listener = Listener(url)
    listener.start()
    words = ["--clock", "wall", "--set", "duration=8", "--quiet", "--no-report"]
    command = start_echelon("run", scenario, *words, "--can", url, "--out", folder)
    try:
        while len(listener.heard) < 200:
            assert command.poll() is None
            time.sleep(0.05)
        robot = pid_of("a/a1", session_members(command.pid))
        frozen_s = time.time()
        os.kill(robot, signal.SIGSTOP)
        time.sleep(FROZEN_S)
        os.kill(robot, signal.SIGCONT)
        thawed_s = time.time()
        command.communicate(timeout=100)
    finally:
        kill_session(command.pid)
        listener.over.set()
        listener.join()
    assert command.returncode == 1
    heard = listener.heard
    logged = [(line.time_ns / 1e9, line.frame.can_id, line.frame.data) for line in frames_in(folder / "can.log")]
    assert [what for _, *what in logged] == [what for _, *what in heard]
    offsets = [told - came for (told, *_), (came, *_) in zip(logged, heard, strict=True)]
    middle = median(offsets)
    assert sorted(abs(offset - middle) for offset in offsets)[-len(offsets) // 20] < 0.005  # 95 % within 5 ms

    def gap(robot: int) -> float:
        """The longest pause of a robot's frames [s] that touches the time in which the other one was frozen."""
        times = [at for at, can_id, _ in heard if can_id == BASE_ID + robot]
        return max(after - before for before, after in pairwise(times) if after > frozen_s and before < thawed_s)

    assert gap(0) > FROZEN_S - WATCHDOG_S
    assert gap(1) < FROZEN_S / 2
    burst = [at for at, can_id, _ in heard if can_id == BASE_ID and thawed_s <= at < thawed_s + PERIOD_S]
    assert len(burst) <= WATCHDOG_S / PERIOD_S + 2  # nothing older than the watchdog
    summary = summary_of(folder)
    assert summary["can"]["buses"][0]["lost"] > (FROZEN_S - 2 * WATCHDOG_S) / PERIOD_S
    assert summary["can"]["referee"]["source"] == "bus"
    silent = [row for row in summary["can"]["referee"]["findings"] if row["robot"] == "a/a1"]
    assert {row["kind"] for row in silent} & {"gap", "silent"}


BUSY_S = 0.5
"""What a busy machine may take away from the times between two signals"""


def test_a_recorder_behind_a_frozen_robot_loses_a_fifth_of_a_second(tmp_path: Path) -> None:
    """A robot is frozen, then the recorder is killed: the times of the robots' last states are compared."""
    folder, scenario = tmp_path / "run", tmp_path / "two.toml"
    scenario.write_text(two_robots(watchdog=WATCHDOG_S))
    words = ["--clock", "wall", "--quiet", "--no-report", "--can", "none"]
    command = start_echelon("run", scenario, *words, "--out", folder)
    try:
        while not (folder / "run.mcap").exists() or (folder / "run.mcap").stat().st_size < 100_000:
            assert command.poll() is None
            time.sleep(0.05)
        members = session_members(command.pid)
        os.kill(pid_of("a/a1", members), signal.SIGSTOP)
        frozen_s = time.monotonic()
        time.sleep(FROZEN_S)
        os.kill(pid_of("recorder", members), signal.SIGKILL)
        killed_s = time.monotonic()
    finally:
        kill_session(command.pid)
        command.communicate()
    recover(folder / "run.mcap", tmp_path / "mended.mcap")
    trace = read_trace(tmp_path / "mended.mcap", load(scenario, ())[1])
    frozen, other = (float(times[-1]) / 1e9 for times in trace.times_ns)
    assert other - frozen > killed_s - frozen_s - 0.2 - BUSY_S
