"""`echelon drives`: virtual drives alone on a bus, what the command prints, and that a host can command them."""

import json
import signal
import time
from pathlib import Path
from subprocess import Popen

import pytest

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import resolve_url
from echelon.bridge.protocols.frame import Frame, Host
from echelon.bridge.protocols.registry import make_host
from echelon.cli.drive_bench import bench_facts, bench_lines
from support.runs import echelon, kill_session, plan_of, start_echelon

PATIENCE_S = 600.0


def own_bus() -> Bus:
    """A bus with a URL that no other process uses."""
    try:
        return open_bus(resolve_url("auto") if not Path("/sys/class/net/vcan0").exists() else "udp_multicast::47131")
    except OSError as error:
        pytest.skip(f"no multicast here: {error}")


def turn_wheels(bus: Bus, host: Host, period_ns: int) -> None:
    """Brings a robot's drives up and commands torques until they report them."""
    limit_s = time.monotonic() + PATIENCE_S
    next_ns = time.monotonic_ns()
    while host.torque != pytest.approx((0.5, -0.25)):
        assert time.monotonic() < limit_s, (host.enabled, host.fault)
        now_ns = time.monotonic_ns()
        if now_ns >= next_ns:
            next_ns = now_ns + period_ns
            for can_id, data, remote in [*host.poll(now_ns), *host.command(now_ns, 0.5, -0.25)]:
                assert bus.send(can_id, data, remote=remote)
        heard = bus.recv(max(0, next_ns - time.monotonic_ns()) * 1e-9)
        if heard is not None and heard.can_id in host.identifiers:
            host.receive(time.monotonic_ns(), Frame(heard.can_id, heard.data, heard.remote))


def lines_until(command: Popen[str], wanted: str) -> list[str]:
    """Returns the lines that a command prints, up to the first that contains `wanted`."""
    assert command.stdout is not None
    lines = []
    for line in command.stdout:
        lines.append(line.rstrip("\n"))
        if wanted in line:
            return lines
    raise AssertionError(f"{command.communicate()}: {lines}")


@pytest.mark.parametrize("protocol", ["native", "odrive"])
def test_a_host_turns_wheels_and_ctrl_c_ends_it(protocol: str) -> None:
    overrides = [f'robot.drive.protocol="{protocol}"', "can.watchdog=1.0", "can.bitrate=1000000"]
    plan = plan_of("lab", "can.path=closed", *overrides)
    robot = plan.robots[4]
    host = make_host(robot)
    with own_bus() as bus:
        sets = [word for override in overrides for word in ("--set", override)]
        command = start_echelon("drives", "lab", *sets, "--can", bus.url)
        try:
            said = lines_until(command, "they report every 10 ms, and stop after 1000 ms")
            assert bus.url in said[0]
            assert len(said) == 1 + 9 + 1
            turn_wheels(bus, host, robot.drive.period_ns)
            (line,) = lines_until(command, "N m")[-1:]
            assert f"{robot.name} 0.5 -0.25 N m" in line
            command.send_signal(signal.SIGINT)
            out, err = command.communicate(timeout=PATIENCE_S)
            assert (command.returncode, err) == (0, "")
            assert "frames in" in out
        finally:
            kill_session(command.pid)
            command.communicate()


def test_it_ends_by_itself() -> None:
    with own_bus() as bus:
        done = echelon("drives", "multi", "--can", bus.url, "--seconds", "0.2")
    assert (done.returncode, done.stderr) == (0, "")
    last = done.stdout.splitlines()[-1]
    assert " 0 frames in, " in last
    assert "N m" not in last


@pytest.mark.parametrize("url", ["none", "virtual:x", "nonsense"])
def test_drives_that_nobody_could_hear(url: str) -> None:
    done = echelon("drives", "lab", "--can", url)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "udp_multicast" in done.stderr


def test_scripts_get_an_object_of_what_is_there_and_one_each_second() -> None:
    with own_bus() as bus:
        done = echelon("drives", "lab", "--can", bus.url, "--seconds", "1.3", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    bench, *states = map(json.loads, done.stdout.splitlines())
    assert [robot["name"] for robot in bench["robots"]][:2] == ["g1/r1", "g1/r2"]
    assert bench["robots"][1]["identifiers"] == {"command": 0x101, "feedback": 0x181, "status": 0x201}
    assert (bench["buses"][0]["url"], bench["period"], bench["watchdog"]) == (bus.url, 0.01, 0.1)
    assert len(states) == 2
    assert states[-1]["sent"] > states[0]["sent"] > 0
    assert (states[-1]["received"], states[-1]["wheels"], states[-1]["refused"]) == (0, [], {})


def test_what_there_is_to_command() -> None:
    lines = bench_lines(bench_facts(plan_of("lab", "can.path=closed"), ["socketcan:can3"]))
    assert lines[0] == "bus can0: socketcan:can3; to listen: candump can3"
    assert lines[2] == "  g1/r2  native on can0, command 0x101, feedback 0x181, status 0x201"
    assert lines[-1] == "they report every 10 ms, and stop after 100 ms without a command"
    other = plan_of("lab", "can.path=closed", 'robot.drive.protocol="cia402"')
    lines = bench_lines(bench_facts(other, ["socketcan:can3"]))
    assert lines[2] == "  g1/r2  cia402 on can0, nodes 3 right, 4 left"
