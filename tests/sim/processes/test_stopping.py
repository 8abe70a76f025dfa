"""However a run ends, the wheels stop: zero torque and disabled drives, heard by a listener of its own on the bus.

The listener is python-can's, in this process.  It shares no code with what is tested.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen

import can
import pytest

from echelon.cli import main
from echelon.sim.parts.loading import parse
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.socket_folder import remove
from echelon.sim.processes.stalls import BREAK_S, RECOVER_S
from echelon.sim.processes.supervisor import Supervisor
from support.runs import (
    echelon,
    kill_session,
    pid_of,
    reasons,
    session_members,
    start_echelon,
    summary_of,
    trace_of,
    until,
)

GROUP = "239.74.163.7"
COMMAND, FEEDBACK = 0x100, 0x180
WATCHDOG_S = 1.0
SLACK_S = 3.0
"""How late processes may be on a busy machine"""
NAMED_S = 2.0
"""After so long whoever stands still on a wall clock has been named"""
SCENARIO = f"""
name = "stopped"
duration = 1000.0
robot = {{ mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }}
law = {{ epsilon = [0.5], lead = 0.5 }}
trajectory = {{ kind = "circle", radius = 3.0, rate = 0.3 }}
formation.robots = {{ solo = {{ start = [0, 1.5] }} }}
can = {{ path = "closed", watchdog = {WATCHDOG_S} }}
"""


@dataclass
class Ear:
    """Hears the frames of the robot `solo` on a bus: native frames, torques as two whole numbers."""

    port: int
    commands: list[tuple[float, bytes]] = field(default_factory=list)
    """Commands, each with the instant of `time.time` at which the kernel had it"""
    turning_s: float = 0.0
    """When a drive last reported torque"""
    torque: bool = False
    """Whether the last report was of torque"""
    reports: int = 0

    @property
    def enabled(self) -> bool:
        """Whether the last command enables the drives."""
        return bool(self.commands) and self.commands[-1][1][4] != 0

    @property
    def has_driven(self) -> bool:
        """Whether a command enabled the drives and was of torque."""
        return any(data[4] and data[:4] != bytes(4) for _, data in list(self.commands))

    @property
    def commands_torque(self) -> bool:
        """Whether the last command is of torque."""
        return bool(self.commands) and self.commands[-1][1][:4] != bytes(4)

    def hear(self, bus: can.BusABC, done: threading.Event) -> None:
        """Listens until `done`."""
        while not done.is_set():
            message = bus.recv(0.05)
            if message is None:
                continue
            if message.arbitration_id == COMMAND:
                self.commands.append((message.timestamp, bytes(message.data)))
            elif message.arbitration_id == FEEDBACK:
                self.reports += 1
                self.torque = bytes(message.data[:4]) != bytes(4)
                if self.torque:
                    self.turning_s = message.timestamp


@contextmanager
def listening() -> Iterator[Ear]:
    """A context with an ear on a bus that nobody uses yet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    ear, done = Ear(port), threading.Event()
    try:
        bus = can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False, ignore_config=True)
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast: {error}")
    thread = threading.Thread(target=ear.hear, args=(bus, done))
    thread.start()
    try:
        yield ear
    finally:
        done.set()
        thread.join()
        bus.shutdown()


@contextmanager
def running(folder: Path, *options: str, text: str = SCENARIO) -> Iterator[tuple[Popen[str], Ear]]:
    """A run in a session of its own, whose drives report torque already; what is left of it is killed afterwards."""
    scenario = folder / "stopped.toml"
    scenario.write_text(text)
    with listening() as ear:
        command = start_echelon(
            *("run", scenario, "--can", f"udp_multicast:{GROUP}:{ear.port}", "--quiet", "--out", folder / "run"),
            *(("--no-report",) if REPORT not in options else ()),
            *(option for option in options if option != REPORT),
        )
        try:
            assert until(lambda: ear.has_driven or command.poll() is not None)
            assert ear.has_driven, command.communicate()
            yield command, ear
        finally:
            kill_session(command.pid)
            command.communicate()


def ended(command: Popen[str], timeout_s: float = 600) -> tuple[int, str]:
    """Waits for the end of a run and of all its processes; returns its exit code and standard error."""
    _, err = command.communicate(timeout=timeout_s)
    assert until(lambda: not session_members(command.pid)), session_members(command.pid)
    return command.returncode, err


def whom(command: Popen[str], who: str) -> int:
    """Returns the process with a role."""
    return command.pid if who == "supervisor" else pid_of(who, session_members(command.pid))


WALL, VIRTUAL = ("--clock", "wall"), ("--clock", "virtual")
REPORT = "--report"
CLOCKS = pytest.mark.parametrize("clock", [WALL, VIRTUAL], ids=["wall", "virtual"])


@CLOCKS
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP], ids=lambda number: number.name)
@pytest.mark.parametrize("to", ["supervisor", "group", "group twice", "bridge", "solo"])
def test_a_signal_ends_the_run_in_order_and_the_last_command_disables(
    to: str, number: signal.Signals, clock: tuple[str, str], tmp_path: Path
) -> None:
    with running(tmp_path, *clock) as (command, ear):
        at_s = time.time()
        if to.startswith("group"):
            os.killpg(command.pid, number)
            if to == "group twice":
                os.kill(command.pid, number)
        else:
            os.kill(whom(command, to), number)
        assert until(lambda: not ear.enabled)
        disabled_s = next(at for at, data in reversed(ear.commands) if data[4] == 0)
        code, err = ended(command)
        assert code == 3, err
        assert not ear.enabled
        assert not ear.commands_torque
        assert disabled_s - at_s < SLACK_S + WATCHDOG_S
        assert not ear.torque
        assert ("interrupted" in err) if to not in ("bridge", "solo") else (f"{to} was asked to end" in err)
        assert "Traceback" not in err
        assert summary_of(tmp_path / "run")["instants"] > 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP], ids=lambda number: number.name)
def test_a_signal_at_any_time_of_the_start_leaves_nothing_behind(number: signal.Signals, tmp_path: Path) -> None:
    """The start begins with the folder of the fork server, and a signal comes so much later."""
    scenario = tmp_path / "stopped.toml"
    scenario.write_text(SCENARIO)
    for after_s in (0.0, 0.05, 0.1, 0.2, 0.4):
        options = ("--quiet", "--no-report", "--out", tmp_path / f"run-{after_s}")
        with tempfile.TemporaryDirectory() as temporary:
            command = start_echelon("run", scenario, *options, env=os.environ | {"TMPDIR": temporary})
            try:
                while not os.listdir(temporary) and command.poll() is None:
                    time.sleep(0.001)
                time.sleep(after_s)
                os.killpg(command.pid, number)
                code, err = ended(command)
            finally:
                kill_session(command.pid)
            assert (code, err) == (3, "echelon: interrupted\n")
            assert os.listdir(temporary) == []


@pytest.mark.parametrize("clock", [WALL, VIRTUAL], ids=["wall", "virtual"])
def test_a_supervisor_that_is_killed_leaves_no_temporary_folder(clock: tuple[str, ...], tmp_path: Path) -> None:
    scenario = tmp_path / "stopped.toml"
    scenario.write_text(SCENARIO)
    with tempfile.TemporaryDirectory() as temporary:  # pytest's folders are too deep for a socket
        command = start_echelon(
            "run", scenario, *clock, "--out", tmp_path / "run", env=os.environ | {"TMPDIR": temporary}
        )
        try:
            assert until(lambda: command.poll() is not None or len(session_members(command.pid)) > 3)
            assert command.poll() is None, command.communicate()
            assert os.listdir(temporary)
            os.kill(command.pid, signal.SIGKILL)
            command.communicate(timeout=600)
            assert until(lambda: not session_members(command.pid))
            assert until(lambda: os.listdir(temporary) == []), os.listdir(temporary)
        finally:
            kill_session(command.pid)


def test_a_supervisor_that_is_dying_counts_as_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed process closes its files before its children get another parent."""
    with subprocess.Popen(["sleep", "1000"]) as supervisor:
        monkeypatch.setattr(os, "getppid", lambda: supervisor.pid)
        remove(supervisor.pid, tmp_path)
        assert tmp_path.is_dir()
        supervisor.kill()
        os.waitid(
            os.P_PID, supervisor.pid, os.WEXITED | os.WNOWAIT
        )  # not waited for, it stays in the table of processes
        remove(supervisor.pid, tmp_path)
        assert not tmp_path.exists()


def test_what_others_have_put_beside_the_socket_stays(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("mine")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "listener"))
        remove(os.getppid(), tmp_path)  # the supervisor is there
        assert (tmp_path / "listener").is_socket()
        remove(os.getpid(), tmp_path)
    assert list(tmp_path.iterdir()) == [other]


def test_signals_to_a_group_reach_neither_the_fork_server_nor_the_resource_tracker() -> None:
    words = """
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from echelon.sim.parts.loading import load
from echelon.shipped import shipped
from echelon.sim.processes.children import warm_up
warm_up(load(shipped()["lab"])[1])
for pid in (resource_tracker._resource_tracker._pid, forkserver._forkserver._forkserver_pid):
    print(next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("SigBlk")))
"""
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, timeout=600, check=True)
    tracker, server = (int(line.split()[1], 16) for line in done.stdout.splitlines())
    assert tracker >> (signal.SIGHUP - 1) & 1  # it ignores SIGINT and SIGTERM by itself
    assert all(server >> (number - 1) & 1 for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM))


def test_a_library_that_makes_another_error_of_an_interrupt_does_not_hide_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(options: object) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise ValueError("KeyboardInterrupt") from None
        return 0

    monkeypatch.setattr("echelon.cli.run._run", work)
    assert main(["run", "lab"]) == 3
    assert capsys.readouterr().err == "echelon: interrupted\n"


def test_a_folder_that_is_too_deep_for_sockets_is_one_line(tmp_path: Path) -> None:
    deep = tmp_path / ("x" * 120)
    deep.mkdir()
    done = echelon("run", "lab", "--out", tmp_path / "run", env=os.environ | {"TMPDIR": str(deep)})
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert str(deep) in done.stderr
    assert "TMPDIR" in done.stderr


@CLOCKS
@pytest.mark.parametrize("who", ["supervisor", "solo", "coordinator", "bridge", "drives", "recorder"])
def test_whatever_is_killed_the_wheels_stop(who: str, clock: tuple[str, str], tmp_path: Path) -> None:
    with running(tmp_path, *clock) as (command, ear):
        at_s = time.time()
        os.kill(whom(command, who), signal.SIGKILL)
        code, err = ended(command)
        if who == "supervisor":
            assert code == -signal.SIGKILL
        else:
            assert code == 3
            assert f"lost {'robot ' if who == 'solo' else ''}{who}" in err
        if who != "bridge":
            assert not ear.enabled
            assert not ear.commands_torque
        if who != "drives":
            assert not ear.torque
        assert ear.turning_s - at_s < WATCHDOG_S + SLACK_S


@pytest.mark.slow
@CLOCKS
@pytest.mark.parametrize(
    ("who", "seconds"),
    [
        pytest.param(who, seconds, id=f"{who}-{'for_ever' if seconds is None else f'{seconds:g}s'}")
        for who in ("supervisor", "solo", "coordinator", "bridge", "drives", "recorder")
        for seconds in (0.2, 2.0, 20.0, None)
        if seconds != 20.0 or who in ("solo", "bridge")  # the others are in `make chaos`
    ],
)
def test_whoever_stands_still_the_wheels_have_no_torque_without_reason(
    who: str, seconds: float | None, clock: tuple[str, str], tmp_path: Path
) -> None:
    """A bridge or drives that stand still on a wall clock end the run, others their part in it.  In virtual time all wait."""
    with running(tmp_path, *clock, "--stall-timeout", "6") as (command, ear):
        pid = whom(command, who)
        os.kill(pid, signal.SIGSTOP)
        at_s = time.time()
        long = seconds is None or seconds > 1.0
        breaks = long and who in ("bridge", "drives") if clock == WALL else seconds is None and who != "supervisor"
        breaks |= clock == VIRTUAL and seconds == 20.0 and who != "supervisor"  # longer than the stall timeout
        if clock == WALL and long and who in ("solo", "coordinator", "bridge"):
            assert until(lambda: not ear.torque or time.time() - at_s > (seconds or 20.0))
            assert ear.turning_s - at_s < WATCHDOG_S + SLACK_S
        if not breaks:
            if seconds is None and clock == WALL:
                assert until(lambda: time.time() - at_s > NAMED_S)
            if seconds is not None:
                assert until(lambda: time.time() - at_s > seconds, seconds + 5)
                os.kill(pid, signal.SIGCONT)
                commands = len(ear.commands)
                assert until(lambda: len(ear.commands) > commands), "the run goes on"
            if seconds is None and who == "supervisor":
                os.killpg(command.pid, signal.SIGTERM)
                assert until(lambda: not ear.enabled)  # the bridge needs nobody for that
                os.kill(pid, signal.SIGKILL)
            else:
                os.kill(command.pid, signal.SIGTERM)
        code, err = ended(command, 90)
        assert code in (3, -signal.SIGKILL), err
        if breaks:
            assert f"{who} stands still" in err if clock == WALL else f"everyone waits for {who}" in err
        elif who != "supervisor":
            assert "interrupted" in err
        if clock == WALL and long and who not in ("supervisor", "recorder"):
            assert f"{who} stands still" in err
        if who != "bridge" or not breaks:
            assert not ear.enabled
            assert not ear.commands_torque
        if who != "drives" or not breaks:
            assert not ear.torque


def test_a_bridge_that_stands_still_on_a_wall_clock_is_blamed_at_once(tmp_path: Path) -> None:
    with running(tmp_path, *WALL) as (command, ear):
        pid = whom(command, "bridge")
        os.kill(pid, signal.SIGSTOP)
        at_s = time.time()
        assert until(lambda: not ear.torque)
        assert ear.turning_s - at_s < WATCHDOG_S + SLACK_S
        code, err = ended(command, 90)
        assert code == 3
        (line,) = [line for line in err.splitlines() if line.startswith("echelon: ")]
        still = re.match(r"echelon: bridge stands still, for ([0-9.]+) s from t = ", line)
        assert still, line
        assert BREAK_S <= float(still[1]) < RECOVER_S
        assert f"(process {pid}, stopped)" in line
        assert "solo" not in line
        assert "drives stand" not in line
        failed = [
            each["text"] for each in summary_of(tmp_path / "run")["verdict"]["checks"] if each["outcome"] == "failed"
        ]
        assert any("stood still: bridge for" in text for text in failed)


@pytest.mark.parametrize("who", ["solo", "coordinator", "team"])
def test_a_member_that_stood_still_for_a_while_is_named_and_fails_the_verdict(who: str, tmp_path: Path) -> None:
    text = SCENARIO.replace("duration = 1000.0", "duration = 8.0")
    if who == "team":  # a leader between coordinator and robot
        text = text.replace("formation.robots", "formation.groups.team.robots").replace("[0.5]", "[0.5, 0.5]")
    with running(tmp_path, *WALL, text=text) as (command, ear):
        pid = whom(command, who)
        os.kill(pid, signal.SIGSTOP)
        at_s = time.time()
        assert until(lambda: not ear.commands_torque), "its torque is used no longer than the watchdog allows"
        assert until(lambda: time.time() - at_s > 2.0, 3)
        os.kill(pid, signal.SIGCONT)
        code, err = ended(command)
        assert code == 1, err
        named = {"solo": "robot solo", "team": "leader team"}.get(who, who)
        assert f"{named} stands still, for 0." in err or f"{named} stands still, for 1." in err
        assert f"{who} goes on" in err
        (check,) = [each for each in summary_of(tmp_path / "run")["verdict"]["checks"] if each["name"] == "standstill"]
        assert check["outcome"] == "failed"
        assert check["text"].startswith(f"stood still: {who} for ")
        assert check["measured"] > 1.5
        assert not ear.enabled


@pytest.mark.parametrize("into_the_run", [False, True])
def test_a_bring_up_that_misses_its_watchdog_is_armed_again_or_refused(into_the_run: bool, tmp_path: Path) -> None:
    """The bridge stands still in the bring-up for longer than the watchdog.  Before run time 0 that costs time only."""
    text = SCENARIO.replace(f"watchdog = {WATCHDOG_S}", "watchdog = 0.3, bring_up = 6.0")
    text = text.replace("duration = 1000.0", "duration = 3.0")
    folder = tmp_path
    (folder / "stopped.toml").write_text(text)
    with listening() as ear:
        urls = f"udp_multicast:{GROUP}:{ear.port}"
        options = ("--clock", "wall", "--can", urls, "--quiet", "--no-report", "--out", folder / "run")
        command = start_echelon("run", folder / "stopped.toml", *options)
        try:
            assert until(lambda: ear.enabled), command.communicate(timeout=5)
            begun_s = ear.commands[0][0]
            assert until(lambda: time.time() - begun_s > (5.6 if into_the_run else 2.0))
            pid = whom(command, "bridge")
            os.kill(pid, signal.SIGSTOP)
            stopped_s = time.time()
            assert until(lambda: time.time() - stopped_s > (0.8 if into_the_run else 0.5))
            os.kill(pid, signal.SIGCONT)
            code, err = ended(command)
        finally:
            kill_session(command.pid)
        assert not ear.enabled
        assert into_the_run or "s from t = -" not in err  # what is before run time 0 costs time only
        if into_the_run:
            assert code == 3
            assert "drives must be free of faults when a run begins" in err or "bridge stands still" in err
        elif "bridge stands still" not in err:  # on a busy machine it may stand still later, too
            summary = summary_of(folder / "run")
            solo = summary["can"]["robots"]["solo"]
            assert solo["came_up"] is not None
            stood_still = any(reason.startswith("stood still") for reason in reasons(summary))
            assert solo["fault"] == "" or stood_still  # in the run: a fault that is left over would have refused it


def test_when_the_supervisor_stands_still_the_wheels_stop_at_the_end_of_the_run(tmp_path: Path) -> None:
    text = SCENARIO.replace("duration = 1000.0", "duration = 5.0")
    with running(tmp_path, *WALL, text=text) as (command, ear):
        os.kill(command.pid, signal.SIGSTOP)
        assert until(lambda: not ear.enabled)
        assert not ear.commands_torque
        os.kill(command.pid, signal.SIGCONT)
        code, err = ended(command)
        assert code in (0, 1), err


def test_timeout_and_systemd_end_a_run_with_its_report(tmp_path: Path) -> None:
    """They send SIGTERM to the process and to all of its group."""
    with running(tmp_path, *WALL, REPORT) as (command, ear):
        os.kill(command.pid, signal.SIGTERM)
        os.killpg(command.pid, signal.SIGTERM)
        code, err = ended(command)
        assert code == 3, err
        assert not ear.enabled
        assert (tmp_path / "run" / "report.html").exists()


def test_a_mirrored_run_ends_with_zero_and_disable(tmp_path: Path) -> None:
    mirrored = SCENARIO.replace('path = "closed", ', "")
    with running(tmp_path, *WALL, text=mirrored) as (command, ear):
        os.killpg(command.pid, signal.SIGTERM)
        code, err = ended(command)
        assert code == 3
        assert "interrupted" in err
        assert not ear.enabled
        assert not ear.commands_torque


def test_a_mirrored_run_that_comes_to_its_end_disables_too(tmp_path: Path) -> None:
    mirrored = SCENARIO.replace('path = "closed", ', "").replace("duration = 1000.0", "duration = 2.0")
    with running(tmp_path, *VIRTUAL, text=mirrored) as (command, ear):
        code, err = ended(command)
        assert code in (0, 1), err
        assert until(lambda: not ear.enabled)
        assert not ear.commands_torque


@CLOCKS
def test_an_error_in_the_supervisor_stops_the_wheels_first(clock: tuple[str, str], tmp_path: Path) -> None:
    def show(progress: Progress) -> None:
        if ear.enabled and ear.commands_torque:
            raise RuntimeError("a fault of the display")

    with listening() as ear:
        urls = (f"udp_multicast:{GROUP}:{ear.port}",)
        plan = parse(SCENARIO, "stopped.toml")[1]
        supervisor = Supervisor(
            plan, tmp_path, run=f"error-{os.getpid()}", virtual=clock == VIRTUAL, can_urls=urls, show=show
        )
        with pytest.raises(RuntimeError, match="a fault of the display"):
            supervisor.run()
        assert until(lambda: not ear.enabled)
        assert not ear.commands_torque
        assert until(lambda: not ear.torque)


def test_a_listener_that_stands_still_holds_up_no_lockstep(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    plan = parse(SCENARIO.replace("duration = 1000.0", "duration = 10.0"), "stopped.toml")[1]
    try:
        bus = can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False, ignore_config=True)
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast: {error}")
    with bus:  # it never reads
        urls = (f"udp_multicast:{GROUP}:{port}",)
        outcome = Supervisor(plan, tmp_path, run=f"still-{os.getpid()}", virtual=True, can_urls=urls).run()
    assert outcome.failure is None
    assert outcome.trace.digest() == trace_of(plan).digest()
    assert outcome.can is not None
    assert outcome.can.frames > 2000
