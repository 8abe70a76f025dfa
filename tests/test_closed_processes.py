"""The closed torque path as processes, over Zenoh and a real bus: the same as in one process; and who stops whom."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen

import pytest

from bridge.bus import Bus, open_bus, resolve_url
from bridge.canlog import read_log
from bridge.native.codec import BASE_ID, FEEDBACK_ID, NativeCodec
from sim.joining import ProcessSpec
from sim.supervisor import Supervisor
from tests.runs import echelon, kill_session, pid_of, plan_of, session_members, start_echelon, summary_of, until

SHORT = ("--set", "duration=0.5", "--set", "claims=[]", "--no-report", "--quiet")
ROBOTS = 9
SCALE = 0.001


def test_three_protocols_on_three_buses_as_processes_are_what_one_process_computes(tmp_path: Path) -> None:
    urls = ",".join(resolve_url("auto", number) for number in range(3))
    many = echelon("run", "drives", *SHORT, "--can", urls, "--out", tmp_path / "many")
    one = echelon("run", "drives", *SHORT, "--engine", "inprocess", "--out", tmp_path / "one")
    assert (many.returncode, one.returncode) == (0, 0), many.stderr + one.stderr
    several, single = summary_of(tmp_path / "many"), summary_of(tmp_path / "one")
    assert several["trace_digest"] == single["trace_digest"]
    assert (tmp_path / "many" / "can.log").read_bytes() == (tmp_path / "one" / "can.log").read_bytes()
    assert (tmp_path / "many" / "can.log").stat().st_size > 100_000
    assert several["can"]["foreign"] == several["can"]["drives"]["foreign"] == 0
    for row in several["can"]["robots"].values():
        assert (row["enabled"], row["fault"], sum(row["stopped"].values())) == (True, "", 0)
    assert sorted(path.name for path in (tmp_path / "many").glob("*.dbc")) == [
        "torque-can0.dbc",
        "torque-can1.dbc",
        "torque-can2.dbc",
    ]


@pytest.mark.parametrize("backwards", [False, True])
def test_in_any_order_of_start(tmp_path: Path, backwards: bool) -> None:
    plan = plan_of("lab", "can.path=closed", "duration=0.3")

    def order(specs: list[ProcessSpec]) -> list[ProcessSpec]:
        return specs[::-1] if backwards else sorted(specs, key=lambda spec: spec.name)

    outcome = Supervisor(
        plan,
        tmp_path,
        run=f"test-{os.getpid()}-{backwards}",
        virtual=True,
        can_urls=(resolve_url("auto"),),
        order=order,
    ).run()
    assert outcome.failure is None
    assert outcome.trace.digest() == DIGEST_OF_ONE_PROCESS()


def DIGEST_OF_ONE_PROCESS() -> str:  # noqa: N802
    from tests.runs import trace_of

    return trace_of(plan_of("lab", "can.path=closed", "duration=0.3")).digest()


class Listener:
    """Hears the native frames of a run on a bus: for each robot the last torques commanded and reported, with their times."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._codec = NativeCodec(SCALE)
        self.moving_ns = [0] * ROBOTS
        """When a robot's drive last reported torque"""
        self.heard_ns = [0] * ROBOTS
        """When a robot's drive last reported"""
        self.commands = 0
        """Torque frames of the first robot"""

    def listen(self, until_ns: int) -> None:
        """Listens until an instant of the monotonic clock."""
        while (left_ns := until_ns - time.monotonic_ns()) > 0:
            received = self._bus.recv(left_ns * 1e-9)
            now_ns = time.monotonic_ns()
            self.commands += received is not None and received.can_id == BASE_ID
            if received is None or not FEEDBACK_ID <= received.can_id < FEEDBACK_ID + ROBOTS:
                continue
            robot = received.can_id - FEEDBACK_ID
            right, left = (int.from_bytes(received.data[at : at + 2], "little", signed=True) for at in (0, 2))
            self.heard_ns[robot] = now_ns
            if right or left:
                self.moving_ns[robot] = now_ns


@pytest.fixture
def wall_run(tmp_path: Path) -> Iterator[tuple[Popen[str], Listener, Path]]:
    """A closed run in real time whose drives give torque; whatever is left of it is killed afterwards."""
    url = resolve_url("auto")
    folder = tmp_path / "run"
    # Drives that a busy machine starved come back.
    arguments = ["--clock", "wall", "--set", "can.path=closed", "--set", "robot.drive.recover_after=0.5"]
    arguments += ["--set", "claims=[]", "--can", url, "--quiet", "--no-report"]
    with open_bus(url) as bus:
        command = start_echelon("run", "lab", *arguments, "--out", folder)
        try:
            listener = Listener(bus)
            limit_ns = time.monotonic_ns() + 30_000_000_000
            while not all(listener.moving_ns):
                assert time.monotonic_ns() < limit_ns, command.poll()
                listener.listen(time.monotonic_ns() + 100_000_000)
            yield command, listener, folder
        finally:
            kill_session(command.pid)
            command.communicate()


HALF_A_SECOND = 500_000_000
"""Five times the watchdog: what a busy machine may need on top of it"""


@pytest.mark.parametrize("frozen", ["g1/r1", "g1", "coordinator", "bridge"])
def test_who_is_frozen_lets_nobody_drive_on(wall_run: tuple[Popen[str], Listener, Path], frozen: str) -> None:
    """Frozen and not killed: nobody sees it end, so watchdogs and ages of messages alone can tell."""
    command, listener, _ = wall_run
    frozen_ns = time.monotonic_ns()
    os.kill(pid_of(frozen, session_members(command.pid)), signal.SIGSTOP)
    listener.listen(frozen_ns + 4 * HALF_A_SECOND)
    hit = range(3) if frozen.startswith("g1") else range(ROBOTS)
    for robot in hit:
        assert listener.moving_ns[robot] < frozen_ns + HALF_A_SECOND
        assert listener.heard_ns[robot] > frozen_ns + 3 * HALF_A_SECOND  # it still says that there is none


def test_a_bridge_that_stood_still_makes_up_for_nothing(wall_run: tuple[Popen[str], Listener, Path]) -> None:
    command, listener, _ = wall_run
    bridge = pid_of("bridge", session_members(command.pid))
    os.kill(bridge, signal.SIGSTOP)
    listener.listen(time.monotonic_ns() + 2 * HALF_A_SECOND)
    stopped_ns, before = time.monotonic_ns(), listener.commands
    os.kill(bridge, signal.SIGCONT)
    listener.listen(stopped_ns + HALF_A_SECOND)
    assert 10 < listener.commands - before < 75  # fifty periods; a hundred were missed
    listener.listen(stopped_ns + 4 * HALF_A_SECOND)
    assert min(listener.moving_ns) > stopped_ns + HALF_A_SECOND  # and the drives recovered


@pytest.mark.parametrize("killed", ["g2/r5", "g3", "coordinator", "bridge", "drives"])
def test_who_is_killed_ends_the_run_without_torque(wall_run: tuple[Popen[str], Listener, Path], killed: str) -> None:
    command, listener, folder = wall_run
    killed_ns = time.monotonic_ns()
    os.kill(pid_of(killed, session_members(command.pid)), signal.SIGKILL)
    listener.listen(killed_ns + 2 * HALF_A_SECOND)
    assert max(listener.moving_ns) < killed_ns + HALF_A_SECOND
    assert command.wait(30) == 3
    assert killed in summary_of(folder)["verdict"]["reasons"][0]
    frames = [logged.frame for logged in read_log(folder / "can.log")]
    if killed != "bridge":  # whose last word is to disable all drives
        codec = NativeCodec(SCALE)
        for robot in range(ROBOTS):
            last = [frame for frame in frames if frame.can_id == BASE_ID + robot][-1]
            torque = codec.decode(last.can_id, last.data)
            assert (torque.enable_right, torque.enable_left) == (False, False)  # type: ignore[union-attr]
    assert until(lambda: not session_members(command.pid))
