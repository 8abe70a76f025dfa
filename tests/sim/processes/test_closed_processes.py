"""The closed torque path as processes over Zenoh and a real bus: the same results as in one process, and stopping of wheels."""

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from subprocess import Popen
from typing import Any

import pytest

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import resolve_url
from echelon.bridge.can.canlog import EPOCH_NS
from echelon.bridge.can.log_files import frames_in
from echelon.bridge.frame_message import BRIDGE_NODE
from echelon.bridge.protocols.native.codec import BASE_ID, FEEDBACK_ID, NativeCodec
from echelon.bridge.timing.bus_load import frame_bits
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.supervisor import Supervisor
from support.runs import (
    echelon,
    kill_session,
    pid_of,
    plan_of,
    reasons,
    session_members,
    start_echelon,
    summary_of,
    until,
)

SHORT = ("--set", "duration=0.5", "--set", "claims=[]", "--no-report", "--quiet")
ROBOTS = 9
SCALE = 0.001
STILL = 50
"""Reports in a row without torque after which a wheel counts as stopped: five times the watchdog of 100 ms"""


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


def test_drives_may_be_brought_up_for_longer_than_members_may_be_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("echelon.sim.processes.supervisor.WALL_OVERTIME_S", 5.0)
    plan = plan_of("lab", "can.path=closed", "duration=0.2", "can.bring_up=7.0", "can.watchdog=2.0")
    outcome = Supervisor(
        plan, tmp_path, run=f"test-{os.getpid()}", virtual=False, can_urls=(resolve_url("auto"),)
    ).run()
    assert outcome.failure is None


def DIGEST_OF_ONE_PROCESS() -> str:  # noqa: N802
    from support.runs import trace_of

    return trace_of(plan_of("lab", "can.path=closed", "duration=0.3")).digest()


class Listener:
    """Listens to the native frames of a run on a bus; notes when each robot's drive reported, with and without torque."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._codec = NativeCodec(SCALE)
        self.moving_ns = [0] * ROBOTS
        """When a robot's drive last reported torque"""
        self.heard_ns = [0] * ROBOTS
        """When a robot's drive last reported"""
        self.moving = [0] * ROBOTS
        """How often a robot's drive reported torque"""
        self.still = [0] * ROBOTS
        """How often in a row a robot's drive reported zero torque"""
        self.commands = 0
        """Number of torque frames of the first robot"""

    def listen(self, until_ns: int) -> None:
        """Listens until an instant of the monotonic clock."""
        while (left_ns := until_ns - time.monotonic_ns()) > 0:
            self._take(left_ns * 1e-9)

    def catch_up(self) -> None:
        """Takes all frames that have come."""
        while self._take(0.0):
            pass

    def _take(self, timeout_s: float) -> bool:
        received = self._bus.recv(timeout_s)
        now_ns = time.monotonic_ns()
        self.commands += received is not None and received.can_id == BASE_ID
        if received is not None and FEEDBACK_ID <= received.can_id < FEEDBACK_ID + ROBOTS:
            robot = received.can_id - FEEDBACK_ID
            right, left = (int.from_bytes(received.data[at : at + 2], "little", signed=True) for at in (0, 2))
            self.heard_ns[robot] = now_ns
            self.still[robot] += 1
            if right or left:
                self.moving_ns[robot] = now_ns
                self.moving[robot] += 1
                self.still[robot] = 0
        return received is not None

    def await_still(self, robots: Iterable[int]) -> None:
        """Listens until the drives have reported zero torque `STILL` times in a row."""
        limit_s = time.monotonic() + 600
        while min(self.still[robot] for robot in robots) < STILL:
            assert time.monotonic() < limit_s, self.still
            self.listen(time.monotonic_ns() + 20_000_000)


@pytest.fixture
def wall_run(tmp_path: Path) -> Iterator[tuple[Popen[str], Listener, Path]]:
    """A closed run in real time whose drives give torque; remaining processes are killed afterwards."""
    url = resolve_url("auto")
    folder = tmp_path / "run"
    # with recovery, drives go on after a busy machine has delayed their commands
    arguments = ["--clock", "wall", "--set", "can.path=closed", "--set", "robot.drive.recover_after=0.5"]
    arguments += ["--set", "claims=[]", "--can", url, "--quiet", "--no-report"]
    with open_bus(url) as bus:
        command = start_echelon("run", "lab", *arguments, "--out", folder)
        try:
            listener = Listener(bus)
            limit_ns = time.monotonic_ns() + 600_000_000_000
            while not all(listener.moving_ns):
                assert command.poll() is None, command.communicate()
                assert time.monotonic_ns() < limit_ns, listener.moving
                listener.listen(time.monotonic_ns() + 100_000_000)
            yield command, listener, folder
        finally:
            kill_session(command.pid)
            command.communicate()


HALF_A_SECOND = 500_000_000
"""Five times the watchdog: additional time that a busy machine may need"""


@pytest.mark.parametrize("frozen", ["g1/r1", "g1", "coordinator", "bridge"])
def test_who_is_frozen_lets_nobody_drive_on(wall_run: tuple[Popen[str], Listener, Path], frozen: str) -> None:
    """A frozen process does not end, so only watchdogs and the ages of messages can notice it."""
    command, listener, _ = wall_run
    os.kill(pid_of(frozen, session_members(command.pid)), signal.SIGSTOP)
    listener.catch_up()
    before = list(listener.moving)
    hit = range(3) if frozen.startswith("g1") else range(ROBOTS)
    listener.await_still(hit)
    for robot in hit:  # drives report every 10 ms of their own clock, so a busy machine does not count here
        assert listener.moving[robot] - before[robot] < STILL
    stopped = list(listener.moving)
    listener.listen(time.monotonic_ns() + HALF_A_SECOND)
    assert [listener.moving[robot] for robot in hit] == [stopped[robot] for robot in hit]


def test_a_bridge_that_stood_still_makes_up_for_nothing(wall_run: tuple[Popen[str], Listener, Path]) -> None:
    command, listener, _ = wall_run
    bridge = pid_of("bridge", session_members(command.pid))
    os.kill(bridge, signal.SIGSTOP)
    listener.listen(time.monotonic_ns() + 2 * HALF_A_SECOND)
    stopped_ns, before = time.monotonic_ns(), listener.commands
    os.kill(bridge, signal.SIGCONT)
    listener.listen(stopped_ns + HALF_A_SECOND)
    assert listener.commands - before < 75  # fifty periods; a hundred were missed
    limit_ns = stopped_ns + 600_000_000_000
    while listener.commands - before <= 10:  # it goes on
        assert time.monotonic_ns() < limit_ns
        listener.listen(time.monotonic_ns() + HALF_A_SECOND)
    while min(listener.moving_ns) <= stopped_ns + HALF_A_SECOND:  # and the drives recover
        assert time.monotonic_ns() < limit_ns, listener.moving_ns
        listener.listen(time.monotonic_ns() + HALF_A_SECOND)


@pytest.mark.parametrize("killed", ["g2/r5", "bridge"])  # all of them: test_stopping_table.py
def test_who_is_killed_ends_the_run_without_torque(wall_run: tuple[Popen[str], Listener, Path], killed: str) -> None:
    command, listener, folder = wall_run
    os.kill(pid_of(killed, session_members(command.pid)), signal.SIGKILL)
    listener.catch_up()
    before = list(listener.moving)
    limit_s = time.monotonic() + 600
    while command.poll() is None:
        assert time.monotonic() < limit_s
        listener.listen(time.monotonic_ns() + 20_000_000)
    listener.catch_up()
    assert command.returncode == 3
    for moved, until_then in zip(listener.moving, before, strict=True):  # reports every 10 ms of the drives' clock
        assert moved - until_then < STILL
    assert any(killed in reason for reason in reasons(summary_of(folder)))
    frames = [logged.frame for logged in frames_in(folder / "can.log")]
    if killed != "bridge":  # otherwise the bridge disables all drives at the end
        codec = NativeCodec(SCALE)
        for robot in range(ROBOTS):
            last = [frame for frame in frames if frame.can_id == BASE_ID + robot][-1]
            torque = codec.decode(last.can_id, last.data)
            assert (torque.enable_right, torque.enable_left) == (False, False)  # type: ignore[union-attr]
    assert until(lambda: not session_members(command.pid))


TRIES = 10


def paced_run(folder: Path, wanted: Callable[[dict[str, Any]], bool], *more: str) -> dict[str, Any]:
    """Runs the lab on a wall clock on a paced bus; returns the part `can` of the summary.

    A busy machine may hold up the bridge or the drives until the start is refused, or send too few frames for what is
    `wanted`: then it is tried again.  The last of `TRIES` is returned as it is."""
    sets = ["can.path=closed", "can.timing=bits", "duration=2.5", "claims=[]", *more]
    arguments = [word for value in sets for word in ("--set", value)]
    tries = 0
    while True:
        done = echelon("run", "lab", "--clock", "wall", "--quiet", "--no-report", "--out", folder, *arguments)
        if done.returncode == 3:
            assert "must be free of faults" in done.stderr or "stands still" in done.stderr, done.stderr
            continue
        can: dict[str, Any] = summary_of(folder)["can"]
        tries += 1
        if tries == TRIES or wanted(can):
            return can


def test_on_a_wall_clock_an_overloaded_bus_is_late_and_loses(tmp_path: Path) -> None:
    bitrate = 125_000
    options = f"can.bitrate={bitrate}", "can.queue=64", "can.bring_up=0.1"

    def rows(can: dict[str, Any], first: int) -> list[dict[str, Any]]:
        return [can["buses"][0]["identifiers"][f"{first + robot:03X}"] for robot in range(ROBOTS)]

    def wanted(can: dict[str, Any]) -> bool:
        """A bridge that was held up has more commands at once than its queue takes."""
        return can["buses"][0]["load"] > 0.7 and not any(row["lost"] for row in rows(can, BASE_ID))

    can = paced_run(tmp_path / "run", wanted, *options)
    (bus,) = can["buses"]
    assert bus["lost"] > 100
    assert 0.7 < bus["load"] < 1.01
    frames = [(frame.time_ns, frame_bits(*frame.frame)) for frame in frames_in(tmp_path / "run" / "can.log")]
    taken_ns = sum(bits for _, bits in frames[1:]) * 1_000_000_000 // bitrate
    assert 0.7 < taken_ns / (frames[-1][0] - frames[0][0]) < 1.1  # frames that a process delayed go out slightly denser
    # commands have lower identifiers than feedback: commands wait for each other only, feedback waits for all of them
    commands, feedback = rows(can, BASE_ID), rows(can, FEEDBACK_ID)
    assert sum(row["lost"] for row in commands) == 0
    assert sum(row["lost"] for row in feedback) > 0
    assert max(row["latency_max"] for row in feedback) > 2 * max(row["latency_mean"] for row in commands)


@pytest.mark.parametrize("whose", ["bridge", "drive"])
def test_on_a_wall_clock_errors_come_on_schedule_and_a_controller_that_is_off_comes_back(
    tmp_path: Path, whose: str
) -> None:
    robot = ', robot="g1/r1"' if whose == "drive" else ""
    events = f'events=[{{kind="error_frames", at=0.2, duration=0.3, rate=0.1}}, {{kind="bus_off", at=1.0{robot}}}]'
    node, can_id = (BRIDGE_NODE, BASE_ID) if whose == "bridge" else (1, FEEDBACK_ID)
    errors = 20  # more than this: on a machine that is not busy there are about sixty

    def switches_s(can: dict[str, Any]) -> list[float]:
        """When the controller went off, and when it came back."""
        return [one["time"] for one in can["buses"][0]["events"] if one["node"] == node and one["time"] >= 1.0]

    def sent_s() -> list[float]:
        frames = [each for each in frames_in(tmp_path / "run" / "can.log") if each.frame.can_id == can_id]
        return [(each.time_ns - EPOCH_NS) / 1e9 for each in frames]

    def wanted(can: dict[str, Any]) -> bool:
        """A process that is held up may come back only when the run is over."""
        switches = switches_s(can)
        late = len(switches) < 2 or max(sent_s(), default=0.0) <= switches[1]
        return can["buses"][0]["destroyed"] > errors and not late

    can = paced_run(tmp_path / "run", wanted, events, "robot.drive.recover_after=0.05", "can.restart=0.5")
    (bus,) = can["buses"]
    assert bus["destroyed"] > errors
    off_s, back_s = switches_s(can)
    assert 1.0 <= off_s < 1.5
    assert 0.5 < back_s - off_s < 0.8
    times_s = sent_s()
    assert not [at for at in times_s if off_s + 0.25 < at < back_s - 0.01]
    assert [at for at in times_s if at > back_s]
    assert can["referee"]["kinds"]  # the referee found missing frames


@pytest.mark.parametrize("protocol", ["native", "odrive", "cia402"])
def test_where_no_drive_answers_the_bridge_says_so_and_goes_on(tmp_path: Path, protocol: str) -> None:
    sets = [
        "can.path=closed",
        "can.virtual_drives=false",
        f"robot.drive.protocol={protocol}",
        "duration=0.5",
        "claims=[]",
    ]
    arguments = [word for value in sets for word in ("--set", value)]
    done = echelon("run", "lab", "--clock", "wall", "--quiet", "--no-report", "--out", tmp_path / "run", *arguments)
    assert done.returncode == 1
    assert "lost bridge" not in done.stdout + done.stderr
    robots = summary_of(tmp_path / "run")["can"]["robots"]
    assert not any(row["enabled"] for row in robots.values())
    assert "not enabled at the end: g1/r1, " in done.stdout


@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_frames_that_drives_had_no_room_for_stand_with_their_identifiers(tmp_path: Path, engine: str) -> None:
    sets = ["can.path=closed", "can.bitrate=125000", "can.queue=8", "duration=0.5", "claims=[]"]
    arguments = [word for value in sets for word in ("--set", value)]
    echelon("run", "lab", "--engine", engine, "--quiet", "--no-report", "--out", tmp_path / "run", *arguments)
    can = summary_of(tmp_path / "run")["can"]
    (bus,) = can["buses"]
    in_drives = sum(row["lost"] for row in can["drives"]["robots"].values())
    assert in_drives > 100
    assert bus["lost"] >= in_drives
    assert bus["lost"] == sum(row["lost"] for row in bus["identifiers"].values())
    assert all(bus["identifiers"][f"{0x200 + robot:03X}"]["lost"] for robot in range(ROBOTS))


@pytest.mark.parametrize("command", ["run", "drives"])
@pytest.mark.parametrize("event", ['kind="error_frames", rate=0.1', 'kind="bus_off", robot="g1/r1"'])
def test_disturbances_need_a_bus_that_is_a_model(command: str, event: str) -> None:
    clock = ["--clock", "wall"] if command == "run" else ["--seconds", "1"]
    events = f"events=[{{{event}, at=0.1}}]"
    done = echelon(command, "lab", *clock, "--set", "can.path=closed", "--set", events)
    assert (done.returncode, done.stdout) == (2, "")
    assert "takes its own time" in done.stderr
