"""However a run ends, the wheels stop: zero torque and disabled drives, heard by a listener of its own on the bus.

What each process of a run does at each signal, and when it is killed or stands still, is in `test_stopping_table`.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import can
import pytest

from echelon.cli import main
from echelon.sim.parts.loading import parse
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.socket_folder import remove
from echelon.sim.processes.stalls import BREAK_S, RECOVER_S
from echelon.sim.processes.supervisor import Supervisor
from support.late import lateness
from support.runs import echelon, kill_session, reasons, session_members, start_echelon, summary_of, trace_of, until
from support.stopped import GROUP, REPORT, SCENARIO, WATCHDOG_S, ended, listening, running, whom

SLACK_S = 3.0
"""How late processes may be on a busy machine"""
WALL, VIRTUAL = ("--clock", "wall"), ("--clock", "virtual")
CLOCKS = pytest.mark.parametrize("clock", [WALL, VIRTUAL], ids=["wall", "virtual"])


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


def test_wheels_stop_before_it_is_asked_how_a_process_ended(tmp_path: Path) -> None:
    """The fork server tells it, which may take its time."""
    with lateness(tmp_path / "late") as machine, running(tmp_path, *WALL) as (command, ear):
        assert until(lambda: ear.torque and ear.commands_torque)
        lost = whom(command, "referee")
        server = int(Path(f"/proc/{lost}/stat").read_text().rpartition(")")[2].split()[1])
        os.kill(server, signal.SIGSTOP)
        try:
            at_s = time.time()
            os.kill(lost, signal.SIGKILL)
            assert until(lambda: not ear.torque and not ear.commands_torque)
            late_s = 2 * sum(machine.of(at_s, ear.turning_s))
            assert ear.turning_s - at_s < 0.5 + late_s
        finally:
            os.kill(server, signal.SIGCONT)
        code, err = ended(command)
        assert code == 3
        assert "echelon: lost referee (" in err


def test_a_leader_that_stood_still_for_a_while_is_named_and_fails_the_verdict(tmp_path: Path) -> None:
    text = SCENARIO.replace("duration = 1000.0", "duration = 6.0")
    text = text.replace("formation.robots", "formation.groups.team.robots").replace("[0.5]", "[0.5, 0.5]")
    with running(tmp_path, *WALL, text=text) as (command, ear):
        pid = whom(command, "team")
        os.kill(pid, signal.SIGSTOP)
        at_s = time.time()
        assert until(lambda: not ear.commands_torque), "its torque is used no longer than the watchdog allows"
        assert until(lambda: time.time() - at_s > 2.0, 3)
        os.kill(pid, signal.SIGCONT)
        code, err = ended(command)
        assert code == 1, err
        assert "leader team stands still, for 0." in err or "leader team stands still, for 1." in err
        assert "team goes on" in err
        (check,) = [each for each in summary_of(tmp_path / "run")["verdict"]["checks"] if each["name"] == "standstill"]
        assert check["outcome"] == "failed"
        assert check["text"].startswith("stood still: team for ")
        assert check["measured"] > 1.5
        assert not ear.enabled


SLOW = """
import time
from echelon.agents.plant import Plant, paper_step

class Slow(Plant):
    def step(self, robot, state, tau_right, tau_left, h):
        if (state.x, state.y) != robot.start:  # the trial before a run does not leave the start
            time.sleep(0.3)
        return paper_step(robot)(state, tau_right, tau_left, h)
"""


def test_a_member_that_is_slow_is_named_and_its_torques_are_not_used_when_they_are_old(tmp_path: Path) -> None:
    """It needs 0.3 s for each period of 0.1 s, so its torques are two thirds of the run's time old."""
    (tmp_path / "slow.py").write_text(SLOW)
    text = SCENARIO.replace("start = [0, 1.5]", 'start = [0, 1.5], model = "slow.py:Slow"')
    text = text.replace("duration = 1000.0", "duration = 1000.0\nperiods = { acceleration = 0.1, torque = 0.1 }")
    with lateness(tmp_path / "late") as machine, running(tmp_path, *WALL, text=text) as (command, ear):
        assert until(lambda: not ear.torque and not ear.commands_torque)
        (first_s, *_) = (at for at, data in ear.commands if data[4] and data[:4] != bytes(4))
        late_s = 2 * sum(machine.of(first_s, ear.turning_s))
        assert ear.turning_s - first_s < 1.5 * WATCHDOG_S + 0.5 + late_s
        line = command.stderr.readline() if command.stderr is not None else ""
        named = re.match(
            r"robot solo stands still, for ([0-9.]+) s from t = ([0-9.]+) s on \(process [0-9]+, [a-z]+, which", line
        )
        assert named, line
        assert float(named[1]) < 1.0 + late_s
        reports = ear.reports
        assert until(lambda: ear.reports > reports + 20)
        assert not ear.torque, "nothing newer has come"
        os.kill(command.pid, signal.SIGTERM)
        code, _ = ended(command)
        assert code == 3
        assert any(reason.startswith("stood still: solo for ") for reason in reasons(summary_of(tmp_path / "run")))


@pytest.mark.parametrize("into_the_run", [False, True])
def test_a_bring_up_that_misses_its_watchdog_is_armed_again_or_refused(into_the_run: bool, tmp_path: Path) -> None:
    """The bridge stands still in the bring-up for longer than the watchdog.  Before run time 0 that costs time only."""
    watchdog_s, still_s = (
        (0.3, 0.8) if into_the_run else (1.0, 1.3)
    )  # in the run, a bridge that is still for 1 s breaks it off
    text = SCENARIO.replace(f"watchdog = {WATCHDOG_S}", f"watchdog = {watchdog_s}, bring_up = 6.0")
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
            assert until(lambda: time.time() - stopped_s > still_s)
            os.kill(pid, signal.SIGCONT)
            code, err = ended(command)
        finally:
            kill_session(command.pid)
        assert not ear.enabled
        assert into_the_run or "s from t = -" not in err  # what is before run time 0 costs time only
        if into_the_run:
            if code == 1:  # on a busy machine it was stopped too late, after the look at the drives
                assert summary_of(folder / "run")["run"]["standstills"]["bridge"]["since"] > 0.2
                return
            assert code == 3
            assert "drives must be free of faults when a run begins" in err or "bridge stands still" in err
            assert summary_of(folder / "run")["can"]["robots"]["solo"]["came_up"] is not None
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
    with lateness(tmp_path / "late") as machine, running(tmp_path, *WALL, REPORT) as (command, ear):
        at_s = time.time()
        os.kill(command.pid, signal.SIGTERM)
        os.killpg(command.pid, signal.SIGTERM)
        code, err = ended(command)
        assert code == 3, err
        assert not ear.enabled
        assert (tmp_path / "run" / "report.html").exists()
        referee = summary_of(tmp_path / "run")["can"]["referee"]
        late = any(late_s > 0.5 for late_s in machine.of(at_s, time.time()))
        assert referee["source"] == "bus" or late  # it hears of the stop within a second
        assert referee["kinds"] == {} or late
        assert referee["frames"] > 0


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
