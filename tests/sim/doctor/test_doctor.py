"""The doctor's checks: on this machine, and with files as they are on other machines."""

import json
import re
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from echelon.bridge.can.bus import open_bus
from echelon.bridge.can.bus_url import resolve_url
from echelon.sim.doctor import can_checks, doctor
from echelon.sim.doctor.diagnosis import Diagnosis
from echelon.sim.doctor.doctor import Measured
from support.runs import echelon, plan_of


def test_this_machine_can_run_lab_and_says_so() -> None:
    done = echelon("doctor", "lab")
    assert done.returncode == 0, done.stdout
    lines = done.stdout.splitlines()
    assert lines[-1] == "usable"
    states = {line[:7].strip() for line in lines[:-1]}
    assert states <= {"ok", "note", ""}
    for what in ("Python", "processors", "Zenoh", "vcan0", "multicast", "disk", "bus can0", "wall clock"):
        assert [line for line in lines if line[9:].startswith(what)], what


def test_a_scenario_that_does_not_fit_is_exit_code_1_with_remedies() -> None:
    done = echelon("doctor", "paper", "--json")
    assert done.returncode == 1
    found = {result["what"]: result for result in json.loads(done.stdout)}
    assert found["bus can0"]["state"] == "problem"
    assert "does not fit" in found["bus can0"]["text"]
    assert any("2 buses" in advice for advice in found["bus can0"]["advice"])
    bigger = 'can.buses={a={url="virtual:a"},b={url="virtual:b"}}'
    halves = [f'formation.groups.g{group}.robots.r{robot}.bus="b"' for group, robot in ((2, 6), (3, 7), (3, 8), (3, 9))]
    sets = [word for override in (bigger, *halves) for word in ("--set", override)]
    done = echelon("doctor", "paper", *sets)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "bus a" in done.stdout
    assert "bus b" in done.stdout


def test_no_such_scenario() -> None:
    done = echelon("doctor", "nosuch")
    assert (done.returncode, done.stdout) == (2, "")


def test_zenoh_and_waking_are_measured() -> None:
    found = {result["what"]: result for result in json.loads(echelon("doctor", "--json").stdout)}
    assert found["Zenoh"]["state"] == "ok"
    assert re.fullmatch(r"sessions over tcp/127\.\S+:\d+, [1-9]\d* µs there and back", found["Zenoh"]["text"])
    measured = Measured()
    assert doctor.check_waking(measured).state in ("ok", "note")
    assert measured.jitter_s > 0


def test_multicast_is_tried() -> None:
    try:
        open_bus(resolve_url("udp_multicast")).close()
    except OSError:
        assert can_checks.check_multicast().state == "note"
    else:
        assert can_checks.check_multicast().state == "ok"


def test_a_check_that_hangs_or_raises_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "LIMIT_S", 0.05)
    for_ever = threading.Event()
    assert doctor._limited("x", lambda: Diagnosis("x", str(for_ever.wait()), "")).text == "no answer within 0.05 s"
    for_ever.set()
    result = doctor._limited("y", lambda: Diagnosis("y", "ok", str(1 / int("0"))))
    assert (result.what, result.state, result.text) == ("y", "problem", "ZeroDivisionError: division by zero")


def test_neither_vcan_nor_multicast_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "check_vcan", lambda: Diagnosis("vcan0", "note", "not there"))
    monkeypatch.setattr(doctor, "check_multicast", lambda: Diagnosis("multicast", "note", "not there"))
    # a session in this process would disturb other tests, which fork
    monkeypatch.setattr(doctor, "check_zenoh", lambda measured: Diagnosis("Zenoh", "ok", "not tried"))
    results = doctor.examine()
    assert [result.what for result in results if result.state == "problem"] == ["CAN bus"]
    assert doctor.text(results).endswith("NOT USABLE: CAN bus")


def test_a_missing_package_is_a_problem() -> None:
    result = doctor.check_python(("numpy", "no-such-package"))
    assert result.state == "problem"
    assert result.text.endswith("not installed: no-such-package")
    assert doctor.check_python().state == "ok"


def test_vcan_that_is_missing_or_not_up() -> None:
    result = can_checks.check_vcan("nosuch0")
    assert (result.what, result.state) == ("nosuch0", "note")
    assert "ip link add nosuch0 type vcan" in result.advice[0] or "vcan.sh" in result.advice[-1]
    assert can_checks.check_vcan("lo").state == "ok"


@pytest.mark.parametrize(("most", "state"), [(212_992, "note"), (4 << 20, "ok")])
def test_small_socket_buffers(most: int, state: str, tmp_path: Path) -> None:
    (tmp_path / "rmem_max").write_text(f"{most}\n")
    (tmp_path / "rmem_default").write_text("212992\n")
    result = doctor.check_buffers(tmp_path)
    assert result.state == state
    assert f"{most // 1024} KiB for receiving; candump uses 208 KiB" in result.text
    assert doctor.check_buffers(tmp_path / "nowhere").state == "note"


def test_little_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert doctor.check_disk(tmp_path).state == ("ok" if shutil.disk_usage(tmp_path).free >= 1 << 30 else "note")
    monkeypatch.setattr(doctor, "SPACE", 1 << 80)
    assert doctor.check_disk(tmp_path).state == "note"


def test_which_interfaces_are_can(tmp_path: Path) -> None:
    for name, kind, queue in (("can7", "280", "10"), ("eth0", "1", "1000"), ("vcan7", "280", "1000")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "tx_queue_len").write_text(f"{queue}\n")
    results = can_checks.check_interfaces(tmp_path)
    assert [result.what for result in results] == ["can7", "vcan7"]
    assert "queue of 10 frames" in results[0].text
    assert results[0].advice[-1].endswith("ip link set can7 txqueuelen 1000")


def can(state: str, up: bool = True, bitrate: int | None = 500_000) -> dict[str, Any]:
    """Returns a part of the output of `ip -details -json link show`."""
    data: dict[str, Any] = {"state": state, "restart_ms": 0}
    if bitrate:
        data["bittiming"] = {"bitrate": bitrate, "sample_point": "0.875", "tq": 125}
    flags = ["NOARP", "UP", "LOWER_UP", "ECHO"] if up else ["NOARP", "ECHO"]
    return {"ifname": "can0", "flags": flags, "txqlen": 10, "linkinfo": {"info_kind": "can", "info_data": data}}


@pytest.mark.parametrize(
    ("link", "queue", "text", "advice"),
    [
        (can("ERROR-ACTIVE"), 1000, "can, 500 kbit/s, error-active, queue of 1000 frames", []),
        (can("ERROR-ACTIVE"), 10, "can, 500 kbit/s, error-active, queue of 10 frames", ["txqueuelen 1000"]),
        (can("BUS-OFF"), 1000, "can, 500 kbit/s, bus-off, queue of 1000 frames", ["restart-ms 100"]),
        (can("ERROR-PASSIVE"), 1000, "can, 500 kbit/s, error-passive, queue of 1000 frames", ["termination"]),
        (
            can("STOPPED", up=False, bitrate=None),
            10,
            "can, stopped, down, queue of 10 frames",
            ["sudo ip link set can0 up type can bitrate 500000", "txqueuelen 1000"],
        ),
    ],
)
def test_what_an_interface_needs(link: dict[str, Any], queue: int, text: str, advice: list[str]) -> None:
    result = can_checks._interface("can0", queue, link)
    assert (result.text, result.state) == (text, "note" if advice else "ok")
    assert len(result.advice) == len(advice)
    for one, wanted in zip(result.advice, advice, strict=True):
        assert wanted in one


def test_whether_a_period_is_realistic() -> None:
    plan = plan_of("lab")
    assert doctor.check_wall_clock(plan, Measured(0.0001, 0.00003)).state == "ok"
    slow = doctor.check_wall_clock(plan, Measured(0.0001, 0.1))
    assert (slow.state, len(slow.advice)) == ("note", 1)
    assert "--clock virtual" in slow.advice[0]
    jittery = doctor.check_wall_clock(plan, Measured(0.02, 0.00003))
    assert jittery.advice == ("processes wake up to 20 ms late: use periods over 40 ms",)
