"""The referee and the live table on a real SocketCAN interface, with kernel stamps."""

import json
import threading
from pathlib import Path

import pytest

from echelon.bridge.can.bus import open_bus
from echelon.cli import main
from support.live_robot import TORQUES, LiveRobot, one_robot

pytestmark = pytest.mark.vcan

URL = "socketcan:vcan0"
LATE = ("--tolerance", "5")  # a guest may stand still for a while


@pytest.mark.parametrize("protocol", ["native", "odrive", "cia402"])
def test_nothing_is_found_where_all_keep_the_contract(
    protocol: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, plan = one_robot(tmp_path, protocol, watchdog=5.0)
    with LiveRobot(plan, URL) as robot:
        assert robot.enabled.wait(60.0)
        code = main(["referee", str(path), "--seconds", "2", "--json", *LATE])  # vcan0 is what `auto` takes
        summary = json.loads(capsys.readouterr().out)
        assert (code, summary["findings"]) == (0, [])
        assert main(["can", str(path), "--can", URL, "--seconds", "2.5", "--json"]) == 0
        shot = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert robot.fault == ""
    assert (summary["kinds"], summary["unknown"]) == ({}, 0)
    assert summary["frames"] > 50
    assert [wheel["commanded"] for wheel in shot["robots"][0]["wheels"]] == pytest.approx(TORQUES, abs=0.002)
    assert [wheel["reported"] for wheel in shot["robots"][0]["wheels"]] == pytest.approx(TORQUES, abs=0.002)


def test_a_stranger_who_speaks_for_a_robot_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, plan = one_robot(tmp_path, "native", watchdog=5.0)
    end = threading.Event()

    def disturb() -> None:
        with open_bus(URL) as bus:
            while not end.wait(0.1):
                bus.send(0x100, bytes(8))  # no valid CRC
                bus.send(0x7E0, bytes(8))  # an identifier that no robot uses

    stranger = threading.Thread(target=disturb)
    with LiveRobot(plan, URL) as robot:
        assert robot.enabled.wait(60.0)
        stranger.start()
        code = main(["referee", str(path), "--can", URL, "--seconds", "2", "--json", *LATE])
        end.set()
        stranger.join()
    summary = json.loads(capsys.readouterr().out)
    assert code == 1
    assert set(summary["kinds"]) == {"crc"}
    assert summary["unknown"] >= 1
    assert {row["robot"] for row in summary["findings"]} == {"r0"}
