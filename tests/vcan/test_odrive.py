"""Virtual ODrive axes, and their host, on a real interface with the unmodified packages odrive-can and pyodrivecan."""

import asyncio
import re
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import odrive_can
import pyodrivecan
import pytest
from can.interfaces.socketcan import SocketcanBus
from odrive_can.mock import ODriveCANMock
from odrive_can.odrive import CanMsg, DriveError, ODriveCAN

from echelon.bridge.can.bus import open_bus
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.drive import ODriveDrive
from echelon.bridge.protocols.odrive.enums import ControlMode
from echelon.bridge.protocols.odrive.host import ODriveHost
from support.bench_drives import MS, Bench, drive_plan
from support.odrive_clients import drive_by_pyodrivecan

pytestmark = pytest.mark.vcan

URL = "socketcan:vcan0"
PLAN = drive_plan("odrive", (1, 2), watchdog_ns=3000 * MS)  # the client waits for heartbeats without sending torques
DBC = Path(odrive_can.__file__).parent / "dbc" / "odrive-cansimple-0.6.10.dbc"
LIMIT_S = 600.0


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench(URL, [ODriveDrive(PLAN, wheel) for wheel in (0, 1)]) as running:
        yield running


def socketcan() -> SocketcanBus:
    return SocketcanBus(channel="vcan0")


class Client:
    """The package's driver of axis 2, with the encoder values that it reported."""

    def __init__(self) -> None:
        self.drive: Any = ODriveCAN(axis_id=2, can_bus=socketcan())
        self.speed = 0.0
        self.late = False
        """The machine was so busy that the drive's watchdog expired while torques were commanded"""
        self.drive.feedback_callback = self._feedback

    def _feedback(self, message: CanMsg, drive: ODriveCAN) -> None:
        self.speed = message.data["Vel_Estimate"]

    async def push(self, torque: float, until: Callable[[], bool]) -> None:
        """Commands a torque every 20 ms until a condition holds; brings the drive up again if its watchdog has expired.

        It may expire again before the first command, which must be zero, and an error that is cleared at once is not seen."""
        deadline_s = time.monotonic() + LIMIT_S
        while not until():
            assert time.monotonic() < deadline_s, (self.drive.axis_state, self.speed, self.late)
            fault = self._fault()
            assert not fault or "WATCHDOG_TIMER_EXPIRED" in fault
            if fault or self.drive.axis_state == "IDLE":
                self.late = True
                self.drive.clear_errors()
                await self.drive.set_axis_state("CLOSED_LOOP_CONTROL")
            if self.late:
                self.drive.set_input_torque(0.0)
            self.drive.set_input_torque(torque)
            await asyncio.sleep(0.02)

    async def ask(self, request: Callable[..., Awaitable[dict[str, Any]]], signal: str, *words: str) -> dict[str, Any]:
        """Requests until an answer has a signal.  If a cyclic message comes in between, a request has two answers, and the
        package takes the second one for the answer to the next request.  Its queue holds one answer: at the third, its reader
        would wait until the next request, and hear nothing meanwhile.  So what is left is taken out."""
        for _ in range(5):
            answer = await request(*words)
            while not self.drive._response_queue.empty():
                self.drive._response_queue.get_nowait()
                await asyncio.sleep(0)  # the reader may put in the next one
            if signal in answer:
                return answer
        raise AssertionError(f"no {signal}")

    def _fault(self) -> str:
        """Returns the text of the driver's error; empty if there is none."""
        try:
            self.drive.check_errors()
        except DriveError as error:
            return str(error)
        return ""

    async def error(self) -> str:
        """Waits without sending until the driver raises its error; returns its text."""
        deadline_s = time.monotonic() + LIMIT_S
        while not (fault := self._fault()) and time.monotonic() < deadline_s:
            await asyncio.sleep(0.02)
        return fault


def with_client(test: Callable[[Client], Awaitable[None]]) -> None:
    async def run() -> None:
        client = Client()
        await client.drive.start()
        try:
            await test(client)
        finally:
            client.drive.stop()

    asyncio.run(asyncio.wait_for(run(), 3 * LIMIT_S))


def test_odrive_can_turns_the_wheel_and_sees_the_watchdog(bench: Bench) -> None:
    async def test(client: Client) -> None:
        drive = client.drive
        drive.check_alive()
        drive.check_errors()
        assert drive.axis_state == "IDLE"
        drive.set_controller_mode("TORQUE_CONTROL", "PASSTHROUGH")
        await drive.set_axis_state("CLOSED_LOOP_CONTROL")
        await client.push(0.25, lambda: client.speed > 0.5)
        # by remote frames, or the cyclic ones that come in between; 0.125 N m/A
        assert await client.ask(drive.get_iq, "Iq_Setpoint") == {"Iq_Setpoint": 2.0, "Iq_Measured": 2.0}
        supply = await client.ask(drive.get_bus_voltage_current, "Bus_Voltage")
        drive.set_input_torque(0.25)
        assert 23.0 < supply["Bus_Voltage"] < 24.0
        assert 0.0 < supply["Bus_Current"] < 1.0
        assert (await client.ask(drive.get_encoder_estimates, "Vel_Estimate"))["Vel_Estimate"] > 0.5
        torques = await client.ask(drive._request, "Torque_Estimate", "Get_Torques")
        assert torques["Torque_Estimate"] == 0.25
        version = await client.ask(drive._request, "Fw_Version_Minor", "Get_Version")
        assert version["Fw_Version_Minor"] == 6
        await client.push(-0.25, lambda: client.speed < -0.5)

        assert "WATCHDOG_TIMER_EXPIRED" in await client.error()
        assert drive.axis_state == "IDLE"
        with bench.lock:
            assert bench.drives[1].motors[0].torque == 0.0
        drive.clear_errors()
        await drive.set_axis_state("CLOSED_LOOP_CONTROL")
        drive.check_errors()
        drive.set_input_torque(0.25)  # refused: the first after a fault must be zero
        drive.set_input_torque(0.0)
        await client.push(0.25, lambda: client.speed > 0.5)
        with bench.lock:
            refused = bench.drives[1].refused
            assert refused["first command not zero"] == 1
            assert len(refused) == 1 or client.late

    with_client(test)
    with bench.lock:
        assert bench.drives[0].refused == {}


def test_odrive_can_sees_faults_and_emergency_stop(bench: Bench) -> None:
    async def test(client: Client) -> None:
        drive = client.drive
        drive.set_controller_mode("TORQUE_CONTROL", "PASSTHROUGH")
        await drive.set_axis_state("CLOSED_LOOP_CONTROL")
        await client.push(0.25, lambda: client.speed > 0.1)
        bench.inject(1, 1, Fault.ENCODER_LOSS)
        assert "MISSING_ESTIMATE" in await client.error()
        drive.clear_errors()  # in vain
        drive._send_message("Estop")
        deadline_s = time.monotonic() + LIMIT_S
        while "33554440" not in await client.error():  # two bits: the DBC has no name for them
            assert time.monotonic() < deadline_s
            await asyncio.sleep(0.02)
        bench.mend(1, 1, Fault.ENCODER_LOSS)
        drive.clear_errors()
        await drive.wait_for_heartbeat()
        await drive.wait_for_heartbeat()
        drive.check_errors()
        await drive.set_axis_state("CLOSED_LOOP_CONTROL")
        drive.set_input_torque(0.0)
        await client.push(0.25, lambda: client.speed > 0.2)

    with_client(test)


def test_our_host_brings_up_the_packages_mock() -> None:
    """The mock has no torques; a listener with the vendor's DBC checks that they are sent to it."""
    plan = drive_plan("odrive", (1, 2), period_ns=20 * MS, watchdog_ns=1000 * MS)  # its fastest report: 100 ms
    told: dict[str, Any] = {}

    async def run() -> None:
        mocks: list[Any] = [ODriveCANMock(axis, socketcan()) for axis in plan.node_ids]
        host = ODriveHost(plan)
        with open_bus(URL) as bus, open_bus(URL) as listener:

            async def cycles(right: float, left: float, until: Callable[[], bool]) -> None:
                deadline_s = time.monotonic() + LIMIT_S
                while not until():
                    assert time.monotonic() < deadline_s, host.fault
                    while heard := bus.recv(0.0):
                        host.receive(time.monotonic_ns(), Frame(heard.can_id, heard.data, heard.remote))
                    now_ns = time.monotonic_ns()
                    for sent in host.poll(now_ns) + host.command(now_ns, right, left):
                        bus.send(sent.can_id, sent.data)
                    while heard := listener.recv(0.0):
                        message = mocks[0].dbc.get_message_by_frame_id(heard.can_id)
                        told[message.name] = message.decode(heard.data)
                    await asyncio.sleep(plan.period_ns * 1e-9)

            served = asyncio.gather(*(mock.main() for mock in mocks))
            try:
                await cycles(0.5, -0.25, lambda: host.enabled)
                assert [str(mock.odrive.axis_state) for mock in mocks] == ["CLOSED_LOOP_CONTROL"] * 2
                assert [str(mock.odrive.control_mode) for mock in mocks] == ["TORQUE_CONTROL"] * 2
                assert [str(mock.odrive.input_mode) for mock in mocks] == ["PASSTHROUGH"] * 2
                await cycles(0.5, -0.25, lambda: told["Axis1_Set_Input_Torque"]["Input_Torque"] == 0.5)
                await cycles(0.5, -0.25, lambda: told["Axis2_Set_Input_Torque"]["Input_Torque"] == -0.25)
                assert host.fault == ""
                for sent in host.stop(time.monotonic_ns()):
                    bus.send(sent.can_id, sent.data)
                await cycles(0.5, -0.25, lambda: all(str(mock.odrive.axis_state) == "IDLE" for mock in mocks))
                assert not host.refused
            finally:
                served.cancel()
                for mock in mocks:
                    mock.notifier.stop()
                    mock.bus.shutdown()

    asyncio.run(run())
    assert told["Axis1_Set_Input_Torque"]["Input_Torque"] == 0.0


def test_candump_and_cantools_decode_with_the_vendors_dbc(bench: Bench) -> None:
    listen = ["candump", "vcan0", "-n", "100", "-T", "10000"]
    with (
        subprocess.Popen(listen, stdout=subprocess.PIPE) as one,
        subprocess.Popen(
            [sys.executable, "-m", "cantools", "decode", "--single-line", str(DBC)],
            stdin=one.stdout,
            stdout=subprocess.PIPE,
            text=True,
        ) as two,
    ):
        assert one.stdout is not None
        one.stdout.close()
        shown = two.communicate(timeout=600)[0].splitlines()
    assert len(shown) == 100
    names = [re.sub(r".*:: (\w+)\(.*", r"\1", line) for line in shown]
    reports = {"Heartbeat", "Get_Error", "Get_Encoder_Estimates", "Get_Iq", "Get_Temperature"}
    reports |= {"Get_Bus_Voltage_Current", "Get_Torques"}
    assert set(names) == {f"Axis{axis}_{name}" for axis in (1, 2) for name in reports}
    beat = next(line for line in shown if "Axis2_Heartbeat" in line)
    assert "Axis_Error: NONE, Axis_State: IDLE, Procedure_Result: SUCCESS" in ", ".join(
        sorted(re.findall(r"\w+: \w+", beat))
    )


def test_pyodrivecan_turns_the_wheel(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It asks for a state with one byte, and expects its mode to be stored in the drive."""
    stored = ODriveConfig(control_mode=ControlMode.TORQUE_CONTROL)
    with Bench(URL, [ODriveDrive(PLAN, wheel, stored) for wheel in (0, 1)]) as bench:
        client: Any = pyodrivecan.ODriveCAN(2, canBusID="vcan0", database=str(tmp_path / "odrive.db"))
        assert "CAN interface is operational" in capsys.readouterr().out
        client.initCanBus()
        assert "ODrive 2 is now in state closed_loop_control" in capsys.readouterr().out
        drive_by_pyodrivecan(client)
        with bench.lock:
            assert bench.drives[1].refused == {}
        client.bus_shutdown()
