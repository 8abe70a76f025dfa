"""An unmodified client from PyPI drives virtual axes on a multicast bus."""

import json
from pathlib import Path
from typing import Any

import pyodrivecan
import pytest

from echelon.bridge.can.bus_url import free_multicast_url
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.drive import ODriveDrive
from echelon.bridge.protocols.odrive.enums import ControlMode
from support.bench_drives import MS, Bench, drive_plan
from support.odrive_clients import drive_by_pyodrivecan

PLAN = drive_plan("odrive", (1, 2), watchdog_ns=3000 * MS)  # the client waits for heartbeats without sending torques


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*bustype:DeprecationWarning")
@pytest.mark.parametrize("stored", [ControlMode.POSITION_CONTROL, ControlMode.TORQUE_CONTROL])
def test_pyodrivecan_drives_an_axis(
    stored: ControlMode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    url = free_multicast_url()
    group, _, port = url.partition(":")[2].rpartition(":")
    monkeypatch.setenv("CAN_CONFIG", json.dumps({"port": int(port)}))  # python-can reads it
    monkeypatch.setattr(pyodrivecan.ODriveCAN, "can_setup_done", True)  # otherwise it sets up an interface, as root
    config = ODriveConfig(control_mode=stored)
    with Bench(url, [ODriveDrive(PLAN, wheel, config) for wheel in (0, 1)]) as bench:
        client: Any = pyodrivecan.ODriveCAN(2, group, "udp_multicast", database=str(tmp_path / "odrive.db"))
        if stored is ControlMode.POSITION_CONTROL:
            client.set_controller_mode("torque_control")
        client.initCanBus()
        while "ODrive 2 is now in state closed_loop_control" not in capsys.readouterr().out:
            client.setAxisState()  # the client looks at one heartbeat, which a busy machine may have sent before
        drive_by_pyodrivecan(client)
        with bench.lock:
            assert bench.drives[1].refused == {}  # type: ignore[attr-defined]
        client.bus_shutdown()
