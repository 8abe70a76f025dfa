"""Nobody on another host can speak on a multicast bus.  Attacks come over a cable from a network namespace beside this one."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from chaos.frames import COMMAND_ID, ENABLE, FEEDBACK_ID, is_whole, torque_frame
from echelon.bridge.protocols.cyclic import WheelState
from support.namespaces import HERE, THERE, Hosts, NamespaceError, two_hosts
from support.notice import say_not_tested
from support.runs import ROOT
from support.two_robots import two_robots

PORT = 43999
GROUPS = ["239.74.163.2", "ff15::7"]


@pytest.fixture
def hosts(request: pytest.FixtureRequest) -> Iterator[Hosts]:
    """Two hosts with a cable between them; the test is skipped, loudly, where they cannot be made."""
    try:
        with two_hosts() as made:
            yield made
    except NamespaceError as error:
        say_not_tested(request.config, "attacks from other hosts", f"no network namespaces can be made here: {error}")
        pytest.skip(str(error))


def start(inside: list[str], script: str, *words: str | int) -> "subprocess.Popen[str]":
    """Starts a Python script on a host."""
    command = [*inside, sys.executable, "-c", script, *map(str, words)]
    return subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(running: "subprocess.Popen[str]") -> str:
    out, err = running.communicate(timeout=60)
    assert running.returncode == 0, err
    return out


LISTEN = """
import json, sys, time
from echelon.bridge.can.bus import open_bus
url, own = sys.argv[1], frozenset(json.loads(sys.argv[2]))
with open_bus(url, own) as bus:
    print("open", flush=True)
    heard = []
    while (frame := bus.recv(30.0)) is not None and frame.can_id != 0x7FF:
        heard.append([frame.can_id, frame.sender[0]])
    bus.guard.look_outside()
    print(json.dumps([heard, [list(one) for one in bus.guard.intrusions], bus.counts.recv_failed]))
"""
ATTACK = """
import socket, struct, sys, can
from can.interfaces.udp_multicast.utils import pack_message
group, port, victims = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
def frame(can_id):
    return pack_message(can.Message(arbitration_id=can_id, data=bytes(8), is_extended_id=False))
family = socket.AF_INET6 if ":" in group else socket.AF_INET
with socket.socket(family, socket.SOCK_DGRAM) as plain:
    plain.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 4)
    plain.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 4) if family == socket.AF_INET6 else None
    for _ in range(5):
        for can_id in (0x100, 0x200, 0x7FF):
            for address in [group, *victims]:
                plain.sendto(frame(can_id), (address, port))
if family == socket.AF_INET:  # pretending to be the victim itself
    with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW) as raw:
        for source in [*victims, "127.0.0.1", "0.0.0.0"]:
            for target in [group, *victims]:
                payload = frame(0x100)
                udp = struct.pack("!HHHH", port, port, 8 + len(payload), 0) + payload
                ip = struct.pack("!BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 1, 0, 4, 17, 0,
                                 socket.inet_aton(source), socket.inet_aton(target))
                raw.sendto(ip + udp, (target, 0))
"""
FRIEND = """
import sys, can
with can.Bus(sys.argv[1], interface="udp_multicast", port=int(sys.argv[2]), ignore_config=True) as bus:
    for can_id in (0x101, 0x7FF):
        bus.send(can.Message(arbitration_id=can_id, is_extended_id=False))
"""


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_only_this_host_is_heard_and_others_are_named(hosts: Hosts, group: str) -> None:
    victims = [HERE] if "." in group else []
    url = f"udp_multicast:{group if '.' in group else f'[{group}]'}:{PORT}"
    if ":" in group:
        for inside in (hosts.here, hosts.there):  # no waiting until an address is known to be nobody else's
            number = 0 if inside is hosts.here else 1
            script = (
                f"ip addr add fd77::{1 + number}/64 dev cable{number} nodad; ip -6 route add default dev cable{number}"
            )
            subprocess.run([*inside, "sh", "-c", script], check=True, timeout=20)
    listener = start(hosts.here, LISTEN, url, json.dumps([0x100, 0x101]))
    assert listener.stdout is not None
    assert listener.stdout.readline() == "open\n"
    ended(start(hosts.there, ATTACK, group, PORT, *victims))
    ended(start(hosts.here, FRIEND, group, PORT))
    heard, intrusions, failed = json.loads(ended(listener))
    assert [can_id for can_id, _ in heard] == [0x101]  # from python-can on this host
    assert failed == 0
    (one,) = intrusions
    assert one[1] == 0x100
    assert one[0] == (THERE if "." in group else "fd77::2")
    assert one[2] >= 5  # multicast, and perhaps unicast


FORGE = """
import sys, can
from can.interfaces.udp_multicast.utils import pack_message
import socket, time
import json
group, port, here = sys.argv[1], int(sys.argv[2]), sys.argv[3]
frames = [(can_id, bytes.fromhex(data)) for can_id, data in json.loads(sys.argv[4])]
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plain:
    plain.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 4)
    print("forging", flush=True)
    while True:
        for can_id, data in frames:
            datagram = pack_message(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
            for address in (group, here):
                plain.sendto(datagram, (address, port))
            time.sleep(0.001)
"""


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["wall", "virtual"])
def test_forged_torque_and_feedback_move_no_wheel_and_fail_the_verdict(
    hosts: Hosts, tmp_path: Path, clock: str
) -> None:
    # commands of the host, and feedback of the drive, that their receivers would take: with counters that go on
    forged = [
        (can_id, torque_frame(can_id, 8000, -8000, byte_4, counter))
        for counter in range(16)
        for can_id, byte_4 in ((COMMAND_ID, ENABLE), (FEEDBACK_ID, WheelState.ENABLED * 0x11))
    ]
    assert all(is_whole(can_id, data) for can_id, data in forged)
    scenario = tmp_path / "two.toml"
    scenario.write_text(two_robots(watchdog=2.0))
    run = ["run", str(scenario), "--clock", clock, "--set", "can.path=closed", "--set", "duration=1.5"]
    run += ["--can", f"udp_multicast:239.74.163.2:{PORT}", "--quiet", "--no-report"]
    attacker = start(
        hosts.there, FORGE, "239.74.163.2", PORT, HERE, json.dumps([(can_id, data.hex()) for can_id, data in forged])
    )
    try:
        assert attacker.stdout is not None
        assert attacker.stdout.readline() == "forging\n"
        done = subprocess.run(
            [*hosts.here, sys.executable, "-m", "echelon", *run, "--out", str(tmp_path / "run")],
            cwd=ROOT, capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip
    finally:
        attacker.kill()
        attacker.communicate()
    assert done.returncode == 1, done.stderr
    # the most frequent first: which one that is, is a matter of where in the attacker's round the run ended
    assert re.search(rf"came from elsewhere: {re.escape(THERE)} sent (100|180) on can0, \d+ times", done.stdout), (
        done.stdout
    )
    log = (tmp_path / "run" / "can.log").read_text()
    assert not any(f"{can_id:03X}#{data.hex().upper()}" in log for can_id, data in forged)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    found: dict[str, Any] = {row["id"]: row for row in summary["can"]["intrusions"]}
    assert set(found) == {"100", "180"}
    assert all(row["sender"] == THERE and row["frames"] > 50 for row in found.values())
    assert summary["can"]["foreign"] == summary["can"]["drives"]["foreign"] == 0
    assert not any(row["refused"] for row in summary["can"]["drives"]["robots"].values())
    if clock == "virtual":  # nobody forges: the same motion, and no intrusions
        calm = subprocess.run(
            [*hosts.here, sys.executable, "-m", "echelon", *run, "--out", str(tmp_path / "calm")],
            cwd=ROOT, capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip
        before = json.loads((tmp_path / "calm" / "summary.json").read_text())
        assert calm.returncode == 0, calm.stdout
        assert summary["trace_digest"] == before["trace_digest"]
        assert before["can"]["intrusions"] == []
