"""The output of `echelon can` and `echelon referee` for finished runs and for live buses."""

import io
import json
import signal
import socket
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from echelon.bridge.can.bus import open_bus
from echelon.bridge.can.canlog import EPOCH_NS
from echelon.bridge.can.log_files import frames_in
from echelon.bridge.protocols.cyclic import WheelState
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import FaultCode, Feedback, NativeCodec, Status, encode_status
from echelon.bridge.referee.referee import Referee
from echelon.bridge.timing.bus_load import worst_case_bits
from echelon.cli import main
from echelon.cli.showing import show_live
from echelon.sim.view.wheel_table import HALF, CanTable, Rate, bar
from support.live_robot import TORQUES, LiveRobot, one_robot
from support.runs import echelon, plan_of, start_echelon, until

MS = 1_000_000
ON, FAULT = WheelState.ENABLED, WheelState.FAULT


def free_url() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"udp_multicast:239.74.163.2:{probe.getsockname()[1]}"


@pytest.fixture
def table() -> CanTable:
    """A table of the lab: one robot drives, one is in a fault, and no frames came from the others."""
    plan = plan_of("lab", "can.path=closed", "claims=[]")
    codec = NativeCodec(plan.can.torque_scale)
    made = CanTable(plan, Referee(plan), ("socketcan:vcan0",))
    heard = []
    for at in range(100):
        for robot, torque in ((0, 0.75), (1, 0.0)):
            right = min(at, 1) * torque
            states = (ON, ON) if robot == 0 else (ON, FAULT)
            faults = (FaultCode.NONE, FaultCode.NONE if robot == 0 else FaultCode.BROWN_OUT)
            said = codec.encode_feedback(Feedback(robot, (right, -right), states, faults, at))
            command, _ = codec.encode(robot, right, -right, at)
            heard += [(at * 10 * MS, 0x100 + robot, command), (at * 10 * MS + MS, 0x180 + robot, said)]
            if at % 10 == 0:
                status = encode_status(Status(robot, (3.5, -3.5), 24.0, 30.0, at // 10))
                heard.append((at * 10 * MS + 2 * MS, 0x200 + robot, status))
    for time_ns, can_id, data in sorted(heard):
        made.take(time_ns, 0, Frame(can_id, data))
    return made


def shown(table: CanTable, time_ns: int, width: int = 130, styles: bool = False) -> str:
    console = Console(record=True, width=width, file=io.StringIO(), force_terminal=True, color_system="standard")
    console.print(table.render(time_ns, width))
    return console.export_text(styles=styles)


@pytest.mark.parametrize(
    ("value", "cells"),
    [
        (0.0, " " * HALF + "│" + " " * HALF),
        (1.5, " " * HALF + "│" + "█" * 8),
        (0.75, " " * HALF + "│" + "████    "),
        (-1.5, "████████│" + " " * HALF),
        (-0.75, "    ████│" + " " * HALF),
        (0.75 + 1.5 / 16, " " * HALF + "│" + "████▌   "),
        (9.0, " " * HALF + "│" + "█" * 8),
        (-9.0, "████████│" + " " * HALF),
        (None, " " * (2 * HALF + 1)),
        (float("nan"), " " * (2 * HALF + 1)),
    ],
)
def test_bars(value: float | None, cells: str) -> None:
    assert bar(value, 1.5).plain == cells
    beyond = value is not None and abs(value) > 1.5
    assert any("red" in str(span.style) for span in bar(value, 1.5).spans) is beyond


def test_bars_without_a_limit_to_speak_of() -> None:
    assert bar(0.5, 0.0).plain == " " * HALF + "│" + "█" * 8
    assert bar(0.0, 0.0).plain == bar(1.0, float("inf")).plain == " " * HALF + "│" + " " * HALF


def test_rates() -> None:
    rate = Rate()
    assert rate.per_second(0) == 0.0
    for at in range(300):
        rate.add(at * 10 * MS, 2)
    assert rate.per_second(2999 * MS) == pytest.approx(200, rel=0.02)
    assert 80 < rate.per_second(3500 * MS) < 120
    assert rate.per_second(4500 * MS) == 0.0
    young = Rate()
    for at in range(30):
        young.add(at * 10 * MS)
    assert young.per_second(300 * MS) == pytest.approx(100, rel=0.01)


def test_the_data(table: CanTable) -> None:
    data = json.loads(json.dumps(table.data(1000 * MS), allow_nan=False))
    (bus,) = data["buses"]
    assert (bus["name"], bus["url"]) == ("can0", "socketcan:vcan0")
    assert bus["frames_per_second"] == pytest.approx(420, rel=0.03)
    assert 0.8 < bus["load"] / (420 * worst_case_bits(8) / 500_000) < 1.0
    first, second, *others = data["robots"]
    assert (first["robot"], second["robot"], len(others)) == ("g1/r1", "g1/r2", 7)
    assert first["frames_per_second"] == pytest.approx(210, rel=0.03)
    right, left = first["wheels"]
    assert right == {
        "wheel": "right",
        "commanded": 0.75,
        "reported": 0.75,
        "speed": 3.5,
        "state": "enabled",
        "fault": "",
        "age": pytest.approx(0.009),
    }
    assert (left["commanded"], left["reported"], left["speed"]) == (-0.75, -0.75, -3.5)
    assert (second["wheels"][1]["state"], second["wheels"][1]["fault"]) == ("fault", "brown out")
    assert all(wheel["age"] is wheel["commanded"] is None for robot in others for wheel in robot["wheels"])
    assert (data["frames"], data["unknown"], data["kinds"]) == (420, 0, {})


def test_the_table(table: CanTable) -> None:
    text = shown(table, 1000 * MS)
    rows = {row.split()[0]: row for row in text.splitlines() if row.split()}
    assert "0.750          │████" in rows["g1/r1"]
    assert "enabled" in rows["g1/r1"]
    assert "socketcan:vcan0" in text
    assert "brown out" in text
    assert "no findings" in text
    assert all(robot.name in rows for robot in table.plan.robots)
    assert rows["g3/r9"].split()[1:] == ["right", "–", "–", "–", "–", "–", "0"]
    narrow = shown(table, 1000 * MS, width=80)
    assert "│" not in narrow
    assert "0.750" in narrow
    assert max(map(len, narrow.splitlines())) <= 80


def test_what_is_wrong_is_red(table: CanTable) -> None:
    assert "\x1b[1;31mbrown out" in shown(table, 1000 * MS, styles=True)
    assert "\x1b[1;31m9\x1b" not in shown(table, 1000 * MS, styles=True)
    assert "\x1b[1;31m509\x1b" in shown(table, 1500 * MS, styles=True)
    table.take(1000 * MS, 0, Frame(0x100, bytes(8)))
    text = shown(table, 1000 * MS, styles=True)
    assert "\x1b[1;31m1 findings: crc 1" in text
    assert "1.000000 s  100  crc: 0000000000000000 is no valid frame" in text


def test_the_line(table: CanTable) -> None:
    line = table.line(1000 * MS)
    assert line.startswith("t 1.0 s  can0 42")
    assert "2 of 9 robots heard  faults: g1/r2 left brown out  findings: none" in line
    table.take(1000 * MS, 0, Frame(0x100, bytes(8)))
    assert table.line(1000 * MS).endswith("findings: crc 1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a closed torque path."""
    path = tmp_path_factory.mktemp("runs") / "one"
    closed = ["can.path=closed", "can.bring_up=0.2", "duration=1", "claims=[]"]
    options = [word for key in closed for word in ("--set", key)]
    done = echelon("run", "lab", *options, "--engine=inprocess", "--no-report", "--quiet", "--out", path)
    assert done.returncode in (0, 1), done.stderr
    return path


def test_a_run_that_has_been(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = len(list(frames_in(folder / "can.log")))
    assert main(["referee", str(folder)]) == 0
    assert capsys.readouterr().out == f"{frames} frames of 27 identifiers: no findings\n"
    assert main(["referee", str(folder), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["frames"], summary["kinds"], len(summary["identifiers"])) == (frames, {}, 27)
    assert main(["can", str(folder), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert {wheel["state"] for robot in data["robots"] for wheel in robot["wheels"]} == {"enabled"}
    assert data["frames"] == frames
    assert main(["can", str(folder)]) == 0
    assert "g3/r9" in capsys.readouterr().out


def test_a_log_that_was_tampered_with(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scenario.toml").write_text((folder / "scenario.toml").read_text())
    lines = (folder / "can.log").read_text().splitlines(keepends=True)
    at = next(at for at in range(len(lines) // 2, len(lines)) if " 104#" in lines[at])
    (tmp_path / "can.log").write_text("".join(lines[:at] + lines[at + 1 :]))
    assert main(["referee", str(tmp_path)]) == 1
    first, second, verdict = capsys.readouterr().out.splitlines()
    assert "104  g2/r5 gap: " in first + second
    assert "104  g2/r5 counter gap: 1 frames missing" in first + second
    assert verdict.endswith("2 findings: counter gap 1, gap 1")


@pytest.mark.parametrize(
    "facts", [{"run": {"failure": "x"}, "can": {"referee": {"until": 0.5}}}, {"run": {"clock": "wall"}, "can": None}]
)
def test_what_a_run_sends_at_its_end_is_shown_and_not_judged(
    facts: dict[str, Any], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run broke off at 0.5 s, or it ends there; after that nothing is heard for 0.3 s."""
    scenario = (folder / "scenario.toml").read_text()
    (tmp_path / "scenario.toml").write_text(scenario.replace("duration = 1.0", "duration = 0.5", 1))
    (tmp_path / "summary.json").write_text(json.dumps(facts))
    lines = [
        (float(line.partition(")")[0][1:]) - EPOCH_NS / 1e9, line)
        for line in (folder / "can.log").read_text().splitlines(keepends=True)
    ]
    lines = [(at_s, line) for at_s, line in lines if at_s < 0.501 or at_s > 0.8]
    (tmp_path / "can.log").write_text("".join(line for _, line in lines))
    assert main(["can", str(tmp_path), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["kinds"], data["frames"]) == ({}, len(lines))
    assert main(["referee", str(tmp_path), "--json"]) == 0
    judged = json.loads(capsys.readouterr().out)
    assert (judged["kinds"], judged["frames"]) == ({}, sum(at_s <= 0.5 for at_s, _ in lines))


def test_a_replay(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["can", str(folder), "--speed", "0.5", "--json"]) == 0
    shots = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(shots) >= 2  # 1.2 s at half speed, one each second
    assert [shot["frames"] for shot in shots] == sorted(shot["frames"] for shot in shots)
    assert shots[0]["time"] < shots[-1]["time"] <= 1.1
    assert main(["can", str(folder), "--speed", "0.1", "--seconds", "0.1"]) == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["can", "lab", "--can", "virtual:x"], "virtual:x: is a bus inside one process, where nobody else can listen"),
        (["can", "lab", "--can", "socketcan:none0"], "there is no network interface none0 that is up"),
        (["can", "lab", "--can", "nonsense"], "'nonsense' is not known"),
        (
            ["can", "lab", "--can", "udp_multicast:,udp_multicast:"],
            "must have a URL for each bus of the scenario (can0), with",
        ),
        (["referee", "lab", "--can", "udp_multicast:", "--tolerance", "-1"], "--tolerance -1: must be 0 s or more"),
        (["can", "none"], "none: no such file, and no shipped scenario"),
        (["can", "lab", "--can", "udp_multicast:", "--speed", "2"], "--speed: is for a run's folder"),
        (["can", "{folder}", "--speed", "0"], "--speed 0: must be more than 0"),
        (["can", "{folder}", "--set", "a=1"], "--set a=1: is for a scenario"),
        (["referee", "{empty}"], "scenario.toml: No such file or directory"),
        (["referee", "{unlogged}"], "can.log: No such file or directory"),
        (["can", "{unlogged}"], "can.log: No such file or directory"),
    ],
)
def test_mistakes(
    arguments: list[str], said: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("empty", "unlogged"):
        (tmp_path / name).mkdir()
    (tmp_path / "unlogged" / "scenario.toml").write_text((folder / "scenario.toml").read_text())
    places = {"folder": folder, "empty": tmp_path / "empty", "unlogged": tmp_path / "unlogged"}
    assert main([word.format(**places) for word in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("protocol", ["native", "odrive", "cia402"])
def test_a_bus_that_is_alive(protocol: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, plan = one_robot(tmp_path, protocol)
    url = free_url()
    with LiveRobot(plan, url) as robot:
        assert robot.enabled.wait(20.0)
        assert main(["can", str(path), "--can", url, "--seconds", "2.2", "--json"]) == 0
        shots = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        # a busy machine delays processes, hence the tolerance
        code = main(["referee", str(path), "--can", url, "--seconds", "1", "--json", "--tolerance", "2"])
        summary = json.loads(capsys.readouterr().out)
    assert len(shots) >= 2
    wheels = shots[-1]["robots"][0]["wheels"]
    assert [wheel["commanded"] for wheel in wheels] == pytest.approx(TORQUES, abs=0.002)
    assert [wheel["reported"] for wheel in wheels] == pytest.approx(TORQUES, abs=0.002)
    assert shots[-1]["buses"][0]["url"] == url
    assert shots[-1]["buses"][0]["frames_per_second"] > 50
    assert (code, summary["kinds"], summary["unknown"]) == (0, {}, 0)
    assert summary["frames"] > 50


def test_a_table_in_a_terminal(tmp_path: Path) -> None:
    _, plan = one_robot(tmp_path)
    url = free_url()
    console = Console(file=io.StringIO(), record=True, force_terminal=True, width=120, color_system="standard")
    with LiveRobot(plan, url) as robot:
        assert robot.enabled.wait(20.0)
        show_live(plan, url, 1.0, as_json=False, console=console)
    text = console.export_text()
    assert "enabled" in text
    assert "-0.500" in text
    assert "▐" in text or "██│" in text


def test_control_c_ends_it_well(tmp_path: Path) -> None:
    path, _ = one_robot(tmp_path)
    process = start_echelon("referee", path, "--can", free_url())
    assert process.stderr is not None
    assert process.stdout is not None
    with process:
        assert "listening on udp_multicast:" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=600)
    assert (process.returncode, err) == (1, "")
    first, verdict = out.splitlines()
    assert "100  missing: nothing came" in first
    assert verdict == "0 frames of 0 identifiers: 1 findings: missing 1"


def test_frames_that_break_the_contract_are_told_at_once(tmp_path: Path) -> None:
    path, _ = one_robot(tmp_path)
    url = free_url()
    process = start_echelon("referee", path, "--can", url)
    assert process.stderr is not None
    assert process.stdout is not None
    with process, open_bus(url) as bus:
        process.stderr.readline()
        assert until(lambda: bus.send(0x100, bytes(8)))
        assert "100  crc: 0000000000000000 is no valid frame" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=600)
    assert process.returncode == 1
    assert "crc 1" in out.splitlines()[-1]
