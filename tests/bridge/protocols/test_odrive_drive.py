"""The virtual ODrive axis.  Frames are made and read with the vendor's DBC."""

import math
import random
import struct
from collections.abc import Callable
from typing import Any

import pytest

from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.drive import ODriveDrive
from echelon.bridge.protocols.odrive.enums import AxisError, AxisState, ControlMode
from echelon.bridge.protocols.registry import drive_places
from echelon.bridge.protocols.registry import make_drive as make_drive_at
from support.bench_drives import MS, drive_plan, motor_plan
from support.odrive_vendor import BROADCAST, VENDOR, frame, heard, last, request
from support.runs import plan_of

WATCHDOG_NS = 100 * MS
CYCLIC_MS = {
    "Heartbeat": 100,
    "Get_Error": 100,
    "Get_Encoder_Estimates": 10,
    "Get_Iq": 100,
    "Get_Temperature": 100,
    "Get_Bus_Voltage_Current": 100,
    "Get_Torques": 10,
}


def make_drive(wheel: int = 1, config: ODriveConfig | None = None, **plan: Any) -> ODriveDrive:
    return ODriveDrive(drive_plan("odrive", (1, 2), **plan), wheel, config)


def node(drive: ODriveDrive) -> int:
    return drive.plan.node_ids[drive.wheel]


def send(drive: ODriveDrive, time_ns: int, name: str, **values: Any) -> list[Frame]:
    """Sends a frame; returns the frames that the drive sends up to this instant, and its answer."""
    return drive.advance(time_ns) + drive.receive(time_ns, frame(node(drive), name, **values))


def enable(drive: ODriveDrive, time_ns: int) -> None:
    send(drive, time_ns, "Set_Controller_Mode", Control_Mode="TORQUE_CONTROL", Input_Mode="PASSTHROUGH")
    send(drive, time_ns, "Set_Axis_State", Axis_Requested_State="CLOSED_LOOP_CONTROL")
    assert drive.state is AxisState.CLOSED_LOOP_CONTROL


def torque(drive: ODriveDrive, time_ns: int, value: float) -> list[Frame]:
    return send(drive, time_ns, "Set_Input_Torque", Input_Torque=value)


def heartbeat(drive: ODriveDrive, time_ns: int) -> tuple[str | int, str, str]:
    """Asks for a heartbeat; returns error, state and result."""
    drive.advance(time_ns)
    (answer,) = drive.receive(time_ns, request(node(drive), "Heartbeat"))
    values = heard(answer)[2]
    return values["Axis_Error"], values["Axis_State"], values["Procedure_Result"]


@pytest.mark.parametrize("start_ms", [-235, -200, 0, 7])
def test_cyclic_messages_come_at_multiples_of_their_periods(start_ms: int) -> None:
    drive = make_drive()
    found: dict[str, list[int]] = {name: [] for name in CYCLIC_MS}
    for time_ms in range(start_ms, start_ms + 450):
        for said in drive.advance(time_ms * MS):
            axis, name, _ = heard(said)
            assert axis == 2
            found[name].append(time_ms)
        assert drive.due_ns == (time_ms // 10 + 1) * 10 * MS
    for name, period in CYCLIC_MS.items():
        assert found[name] == [t for t in range(start_ms, start_ms + 450) if t % period == 0]


def test_a_long_time_at_once_says_the_same_in_the_same_order() -> None:
    config = ODriveConfig(iq_msg_rate_ms=7, temperature_msg_rate_ms=0, powers_msg_rate_ms=30)
    steps, leap = make_drive(config=config), make_drive(config=config)
    for drive in (steps, leap):
        enable(drive, 0)
        torque(drive, 0, 0.25)
    said = [frame for t in range(1, 400) for frame in steps.advance(t * MS)]
    leapt = leap.advance(399 * MS)
    assert [frame.can_id for frame in leapt] == [frame.can_id for frame in said]
    assert [f for f in leapt if f.can_id in (0x41, 0x5C)] == [f for f in said if f.can_id in (0x41, 0x5C)]
    names = [heard(frame)[1] for frame in said]
    assert names.count("Get_Iq") == 399 // 7
    assert names.count("Get_Powers") == 399 // 30
    assert "Get_Temperature" not in names


def test_nothing_cyclic_at_all() -> None:
    drive = make_drive(config=ODriveConfig(0, 0, 0, 0, 0, 0, 0, 0))
    assert drive.advance(0) == drive.advance(10_000 * MS) == []
    enable(drive, 10_000 * MS)
    torque(drive, 10_000 * MS, 0.5)
    assert drive.due_ns == 10_000 * MS + WATCHDOG_NS
    # without cyclic reports, a request ends the mean: 0.5 N m, then a quarter of it at zero
    drive.advance(10_030 * MS)
    torque(drive, 10_030 * MS, 0.0)
    drive.advance(10_040 * MS)
    (answer,) = drive.receive(10_040 * MS, request(2, "Get_Torques"))
    assert heard(answer)[2] == {"Torque_Target": 0.0, "Torque_Estimate": pytest.approx(0.5 * 30 / 10_040, rel=1e-6)}


def test_torque_is_zero_until_enabled_and_then_what_is_set() -> None:
    drive = make_drive()
    torque(drive, 0, 0.5)
    torque(drive, 5 * MS, 0.0)
    said = drive.advance(20 * MS)
    assert last(said, "Get_Torques") == {"Torque_Target": 0.0, "Torque_Estimate": 0.0}
    assert drive.refused == {"torque while idle": 1}
    assert heartbeat(drive, 20 * MS) == ("NONE", "IDLE", "SUCCESS")
    enable(drive, 20 * MS)
    assert heartbeat(drive, 20 * MS) == ("NONE", "CLOSED_LOOP_CONTROL", "SUCCESS")
    assert last(drive.advance(30 * MS), "Get_Torques")["Torque_Estimate"] == 0.0
    torque(drive, 34 * MS, -0.5)  # the very first may be anything
    assert last(drive.advance(40 * MS), "Get_Torques") == {
        "Torque_Target": -0.5,
        "Torque_Estimate": pytest.approx(-0.3, rel=1e-6),  # 6 of 10 ms
    }
    assert last(drive.advance(50 * MS), "Get_Torques")["Torque_Estimate"] == -0.5
    send(drive, 53 * MS, "Set_Axis_State", Axis_Requested_State="IDLE")
    said = drive.advance(60 * MS)
    assert last(said, "Get_Torques") == {"Torque_Target": 0.0, "Torque_Estimate": pytest.approx(-0.15, rel=1e-6)}
    assert last(drive.advance(70 * MS), "Get_Torques")["Torque_Estimate"] == 0.0
    assert heartbeat(drive, 70 * MS) == ("NONE", "IDLE", "SUCCESS")
    enable(drive, 70 * MS)  # the torque from before is forgotten
    assert last(drive.advance(90 * MS), "Get_Torques") == {"Torque_Target": 0.0, "Torque_Estimate": 0.0}


def test_the_reported_torque_is_the_mean_of_a_lagging_one() -> None:
    lag, period = 0.004, 0.010
    drive = make_drive(motor=motor_plan(lag=lag))
    enable(drive, 0)
    torque(drive, 0, 1.0)
    mean = 1.0 - lag / period * (1.0 - math.exp(-period / lag))
    assert last(drive.advance(10 * MS), "Get_Torques")["Torque_Estimate"] == pytest.approx(mean, rel=1e-6)


def test_four_bytes_are_enough() -> None:
    drive = make_drive()
    drive.receive(0, frame(2, "Set_Controller_Mode", Control_Mode=1, Input_Mode=1))
    drive.receive(0, Frame(0x47, struct.pack("<I", 8)))
    drive.receive(0, Frame(0x4E, struct.pack("<f", 0.25)))
    assert drive.motor.torque == 0.25
    assert not drive.refused


MODES = [(c, i) for c in range(4) for i in range(9) if (c, i) != (1, 1)]


@pytest.mark.parametrize(("control", "entry"), MODES)
def test_other_modes_cannot_be_had(control: int, entry: int) -> None:
    drive = make_drive()
    send(drive, 0, "Set_Controller_Mode", Control_Mode=control, Input_Mode=entry)
    assert heartbeat(drive, 0) == ("NONE", "IDLE", "INVALID_STATE")
    send(drive, 0, "Set_Axis_State", Axis_Requested_State=8)
    assert heartbeat(drive, 0) == ("NONE", "IDLE", "INVALID_STATE")
    assert drive.refused == {"controller mode": 1, "state without torque control": 1}
    enable(drive, 0)
    assert heartbeat(drive, 0) == ("NONE", "CLOSED_LOOP_CONTROL", "SUCCESS")
    torque(drive, 0, 0.5)
    send(drive, 0, "Set_Controller_Mode", Control_Mode=control, Input_Mode=entry)
    assert (drive.state, drive.motor.torque) == (AxisState.CLOSED_LOOP_CONTROL, 0.5)


@pytest.mark.parametrize("state", [0, *range(2, 8), *range(9, 16), 2**32 - 1])
def test_other_states_cannot_be_had(state: int) -> None:
    drive = make_drive()
    send(drive, 0, "Set_Controller_Mode", Control_Mode=1, Input_Mode=1)
    send(drive, 0, "Set_Axis_State", Axis_Requested_State=state)
    assert heartbeat(drive, 0) == ("NONE", "IDLE", "INVALID_STATE")
    assert drive.refused == {"state": 1}


def test_watchdog() -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 33 * MS, 0.5)
    drive.advance(33 * MS + WATCHDOG_NS - 1)
    assert (drive.motor.torque, drive.due_ns) == (0.5, 33 * MS + WATCHDOG_NS)
    drive.advance(33 * MS + WATCHDOG_NS)
    assert (drive.motor.torque, drive.state) == (0.0, AxisState.IDLE)
    said = drive.advance(200 * MS)
    assert last(said, "Heartbeat")["Axis_Error"] == "WATCHDOG_TIMER_EXPIRED"
    assert last(said, "Heartbeat")["Procedure_Result"] == "DISARMED"
    assert last(said, "Get_Error") == {
        "Active_Errors": "WATCHDOG_TIMER_EXPIRED",
        "Disarm_Reason": "WATCHDOG_TIMER_EXPIRED",
    }
    # the watchdog expires at its instant, although a single call covers a longer time
    late = make_drive()
    enable(late, 0)
    torque(late, 33 * MS, 0.5)
    reports = [v["Torque_Estimate"] for _, n, v in map(heard, late.advance(200 * MS)) if n == "Get_Torques"]
    expected = [0.5 * 0.7] + [0.5] * 9 + [0.5 * 0.3] + [0.0] * 6
    assert reports == pytest.approx(expected, rel=1e-6)


def test_enabling_feeds_the_watchdog_once_and_so_does_asking_again() -> None:
    drive = make_drive()
    enable(drive, 0)
    drive.advance(WATCHDOG_NS - 1)
    send(drive, WATCHDOG_NS - 1, "Set_Axis_State", Axis_Requested_State=8)
    drive.advance(2 * WATCHDOG_NS - 2)
    assert drive.state is AxisState.CLOSED_LOOP_CONTROL
    drive.advance(2 * WATCHDOG_NS - 1)
    assert drive.errors is AxisError.WATCHDOG_TIMER_EXPIRED


HARMLESS: list[Frame] = [
    request(2, "Get_Iq"),
    request(2, "Heartbeat", remote=False),
    frame(2, "Set_Limits", Velocity_Limit=1.0, Current_Limit=1.0),
    frame(2, "Set_Vel_Gains", Vel_Gain=1.0),
    frame(2, "Clear_Errors"),
    frame(BROADCAST, "Clear_Errors", Identify=1),
    frame(2, "Set_Controller_Mode", Control_Mode=1, Input_Mode=1),
    frame(2, "Set_Absolute_Position", Position=1.0),
]


@pytest.mark.parametrize("harmless", HARMLESS)
def test_what_feeds_the_watchdog_beside_torques(harmless: Frame) -> None:
    for every in (False, True):
        drive = make_drive(config=ODriveConfig(every_frame_feeds=every))
        enable(drive, 0)
        drive.advance(60 * MS)
        drive.receive(60 * MS, harmless)
        assert not drive.refused
        drive.advance(WATCHDOG_NS)
        assert (drive.state is AxisState.CLOSED_LOOP_CONTROL) == every
        drive.advance(60 * MS + WATCHDOG_NS)
        assert drive.errors is AxisError.WATCHDOG_TIMER_EXPIRED


def test_watchdog_can_be_off() -> None:
    drive = make_drive(config=ODriveConfig(enable_watchdog=False))
    enable(drive, 0)
    torque(drive, 0, 0.5)
    drive.advance(60_000 * MS)
    assert drive.motor.torque == 0.5


REFUSED: list[tuple[str, Frame]] = [
    ("identifier", Frame(0x60 | 14, struct.pack("<f", 0.1))),
    ("identifier", Frame(BROADCAST << 5 | 14, struct.pack("<f", 0.1))),
    ("identifier", Frame(0x4E + (1 << 11), struct.pack("<f", 0.1))),
    ("identifier", Frame(-1)),
    ("command", Frame(0x48, bytes(8))),
    ("length", Frame(0x4E, bytes(9))),
    ("state", Frame(0x47, bytes(3))),
    ("state", Frame(0x47)),
    ("controller mode", frame(2, "Set_Controller_Mode")._replace(data=bytes(7))),
    ("not finite", frame(2, "Set_Input_Torque", Input_Torque=math.nan)),
    ("not finite", frame(2, "Set_Input_Torque", Input_Torque=math.inf)),
    ("not finite", frame(2, "Set_Limits", Velocity_Limit=-math.inf)),
    ("remote", Frame(0x4E, remote=True)),
    ("remote", Frame(0x47, remote=True)),
    ("remote", Frame(0x58, remote=True)),
    ("report", frame(2, "Heartbeat", Axis_State=8)),
    ("report", frame(2, "Get_Torques")),
    ("limit", frame(2, "Set_Limits", Velocity_Limit=1.0, Current_Limit=-1.0)),
    ("reboot action", frame(2, "Reboot", Action="erase_configuration")),
    ("setpoint of another mode", frame(2, "Set_Input_Pos", Input_Pos=1.0)),
    ("setpoint of another mode", frame(2, "Set_Input_Vel", Input_Vel=1.0)),
    ("sdo", frame(2, "RxSdo", Opcode="WRITE", Endpoint_ID=5)),
    ("sdo", Frame(0x45, remote=True)),
    ("enter dfu mode", frame(2, "Enter_DFU_Mode")),
    ("address", Frame(BROADCAST << 5 | 6, bytes([9, 2, 0, 0, 0, 0, 0xEC]))),
]


@pytest.mark.parametrize(("reason", "bad"), REFUSED)
@pytest.mark.parametrize("every", [False, True])
def test_what_is_refused_is_counted_changes_nothing_and_feeds_nothing(reason: str, bad: Frame, every: bool) -> None:
    drive = make_drive(config=ODriveConfig(every_frame_feeds=every))
    enable(drive, 0)
    torque(drive, 0, 0.5)
    drive.advance(60 * MS)
    assert drive.receive(60 * MS, bad) == []
    assert drive.refused == {reason: 1}
    assert drive.motor.torque == 0.5
    drive.advance(WATCHDOG_NS)
    assert drive.errors is AxisError.WATCHDOG_TIMER_EXPIRED


def test_missing_bytes_of_a_command_are_zero() -> None:
    drive = make_drive()
    drive.receive(0, Frame(0x4B, b"\x01\0\0\0\x01"))
    drive.receive(0, Frame(0x47, b"\x08"))
    assert drive.state is AxisState.CLOSED_LOOP_CONTROL
    torque(drive, 0, 0.5)
    drive.receive(0, Frame(0x4E, struct.pack("<f", 1.0)[:3]))  # 0.0 if the last byte is zero: 1.0 is 00 00 80 3F
    assert drive.motor.torque == pytest.approx(0.0, abs=1e-30)
    torque(drive, 0, 0.5)
    drive.receive(0, Frame(0x4E))
    assert drive.motor.torque == 0.0
    drive.receive(0, Frame(0x42))
    drive.receive(0, Frame(0x58))  # Clear_Errors without its byte
    assert (drive.errors, drive.refused) == (AxisError.NONE, {})


def test_a_mode_that_is_stored_in_the_drive_need_not_be_set() -> None:
    drive = make_drive(config=ODriveConfig(control_mode=ControlMode.TORQUE_CONTROL))
    for time_ns in (0, 2 * MS):
        drive.receive(time_ns, Frame(0x47, b"\x08"))
        assert drive.state is AxisState.CLOSED_LOOP_CONTROL
        drive.receive(time_ns + MS, frame(2, "Reboot"))  # it is stored
        assert drive.state is AxisState.IDLE
    assert drive.refused == {}
    other = make_drive()
    other.receive(0, Frame(0x47, b"\x08"))
    assert other.refused == {"state without torque control": 1}


def test_the_stored_mode_is_a_key_of_the_scenario() -> None:
    modes = []
    for parameters in ("", ", parameters={control_mode='torque'}"):
        plan = plan_of("lab", f"robot.drive.protocol={{use='odrive'{parameters}}}", "can.path=closed", "claims=[]")
        drive = make_drive_at(plan, drive_places(plan)[0])
        assert isinstance(drive, ODriveDrive)
        modes.append(drive.config.control_mode)
    assert modes == [ControlMode.POSITION_CONTROL, ControlMode.TORQUE_CONTROL]


@pytest.mark.parametrize("fault", [Fault.OVER_TEMPERATURE, Fault.ENCODER_LOSS, Fault.BROWN_OUT])
def test_a_fault_takes_the_torque_and_latches(fault: Fault) -> None:
    name = {
        Fault.OVER_TEMPERATURE: "MOTOR_OVER_TEMP",
        Fault.ENCODER_LOSS: "MISSING_ESTIMATE",
        Fault.BROWN_OUT: "DC_BUS_UNDER_VOLTAGE",
    }[fault]
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 0, 0.5)
    said = drive.inject(14 * MS, 1, fault)
    assert [heard(frame)[1] for frame in said] == ["Get_Encoder_Estimates", "Get_Torques"]
    assert drive.motor.torque == 0.0
    assert heartbeat(drive, 14 * MS) == (name, "IDLE", "DISARMED")
    (answer,) = drive.receive(14 * MS, request(2, "Get_Error"))
    assert heard(answer)[2] == {"Active_Errors": name, "Disarm_Reason": name}

    def try_to_enable(time_ns: int) -> tuple[str | int, str, str]:
        send(drive, time_ns, "Set_Controller_Mode", Control_Mode=1, Input_Mode=1)
        send(drive, time_ns, "Set_Axis_State", Axis_Requested_State=8)
        torque(drive, time_ns, 0.5)
        assert drive.motor.torque == 0.0
        return heartbeat(drive, time_ns)

    assert try_to_enable(20 * MS) == (name, "IDLE", "DISARMED")
    send(drive, 30 * MS, "Clear_Errors")
    assert try_to_enable(30 * MS) == (name, "IDLE", "DISARMED")  # the cause is still there
    drive.mend(45 * MS, 1, fault)
    assert [heard(frame)[1] for frame in drive.advance(45 * MS)] == ["Get_Encoder_Estimates", "Get_Torques"]
    assert try_to_enable(50 * MS) == (name, "IDLE", "DISARMED")  # not cleared
    send(drive, 60 * MS, "Clear_Errors")
    assert heartbeat(drive, 60 * MS) == ("NONE", "IDLE", "SUCCESS")
    drive.refused.clear()
    assert try_to_enable(60 * MS) == ("NONE", "CLOSED_LOOP_CONTROL", "SUCCESS")
    assert drive.refused == {"first command not zero": 1}
    torque(drive, 60 * MS, 0.0)
    torque(drive, 60 * MS, 0.5)
    assert drive.motor.torque == 0.5


def test_two_errors_at_once_are_both_told() -> None:
    drive = make_drive()
    enable(drive, 0)
    drive.inject(0, 1, Fault.BROWN_OUT)
    drive.receive(0, frame(2, "Estop"))
    assert heartbeat(drive, 0)[0] == 0x2000200  # the DBC has names for single bits only
    drive.receive(0, frame(2, "Clear_Errors"))
    assert heartbeat(drive, 0)[0] == "DC_BUS_UNDER_VOLTAGE"


ESTOPS = [
    frame(2, "Estop"),
    frame(2, "Estop")._replace(remote=True),
    frame(2, "Estop")._replace(data=bytes(8)),
    frame(BROADCAST, "Estop"),
]


@pytest.mark.parametrize("estop", ESTOPS)
def test_estop(estop: Frame) -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 0, 0.5)
    assert drive.receive(0, estop) == []
    assert drive.motor.torque == 0.0
    assert heartbeat(drive, 0) == ("ESTOP_REQUESTED", "IDLE", "DISARMED")
    drive.receive(0, frame(2, "Clear_Errors"))
    enable(drive, 0)
    torque(drive, 0, 0.5)
    assert (drive.motor.torque, drive.refused) == (0.0, {"first command not zero": 1})


@pytest.mark.parametrize("first", [2e-6, -2e-6, 0.5])
@pytest.mark.parametrize("again", ["Clear_Errors", "Reboot"])
def test_the_first_torque_after_a_fault_must_be_zero(first: float, again: str) -> None:
    drive = make_drive()
    drive.receive(0, frame(2, "Estop"))
    drive.receive(0, frame(2, again))
    enable(drive, 0)
    torque(drive, 60 * MS, first)
    assert (drive.motor.torque, drive.refused) == (0.0, {"first command not zero": 1})
    drive.advance(WATCHDOG_NS - 1)
    torque(drive, WATCHDOG_NS - 1, 5e-7)
    torque(drive, WATCHDOG_NS - 1, first)
    assert drive.motor.torque == pytest.approx(first)


def test_stuck_torque_stays_whatever_is_commanded() -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 0, 0.5)
    drive.inject(10 * MS, 1, Fault.STUCK_TORQUE)
    torque(drive, 10 * MS, 0.1)
    assert last(drive.advance(20 * MS), "Get_Torques") == {
        "Torque_Target": pytest.approx(0.1),
        "Torque_Estimate": 0.5,
    }
    drive.receive(20 * MS, frame(2, "Estop"))
    assert heartbeat(drive, 20 * MS)[0] == "ESTOP_REQUESTED"
    assert last(drive.advance(30 * MS), "Get_Torques")["Torque_Estimate"] == 0.5
    drive.mend(30 * MS, 1, Fault.STUCK_TORQUE)
    assert last(drive.advance(40 * MS), "Get_Torques")["Torque_Estimate"] == 0.0


def test_silent() -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 0, 0.5)
    drive.inject(10 * MS, 1, Fault.SILENT)
    assert (drive.motor.torque, drive.state) == (0.0, AxisState.UNDEFINED)
    assert drive.receive(10 * MS, request(2, "Heartbeat")) == []
    drive.receive(10 * MS, frame(3, "Estop"))
    assert drive.advance(500 * MS) == []
    assert drive.refused == {}  # a silent drive receives nothing
    drive.mend(505 * MS, 1, Fault.SILENT)
    said = drive.advance(510 * MS)
    assert last(said, "Get_Torques") == {"Torque_Target": 0.0, "Torque_Estimate": 0.0}
    assert heartbeat(drive, 510 * MS) == ("NONE", "IDLE", "SUCCESS")
    send(drive, 510 * MS, "Set_Axis_State", Axis_Requested_State=8)
    assert drive.state is AxisState.IDLE  # the mode is that of power-on
    enable(drive, 510 * MS)
    torque(drive, 510 * MS, 0.5)
    assert drive.motor.torque == 0.0
    torque(drive, 510 * MS, 0.0)
    torque(drive, 510 * MS, 0.5)
    assert drive.motor.torque == 0.5


def test_a_cause_that_came_in_silence_is_found_afterwards() -> None:
    drive = make_drive()
    drive.inject(0, 1, Fault.SILENT)
    drive.inject(0, 1, Fault.ENCODER_LOSS)
    drive.mend(0, 1, Fault.SILENT)
    assert heartbeat(drive, 0) == ("MISSING_ESTIMATE", "IDLE", "SUCCESS")


HOT = motor_plan(thermal_time=1.0, temperature_limit=60.0, derating_from=60.0)


def test_a_motor_that_gets_too_hot_is_an_error_until_it_is_cool_again() -> None:
    drive = make_drive(motor=HOT, watchdog_ns=60_000 * MS)
    enable(drive, 0)
    torque(drive, 0, 1.0)  # 8 A, 16 W: 32 K warmer in the end; never too hot
    drive.advance(5_000 * MS)
    torque(drive, 5_000 * MS, 1.5)  # 12 A, 36 W: 72 K
    t = 5_000
    while drive.state is AxisState.CLOSED_LOOP_CONTROL:
        t += 1
        drive.advance(t * MS)
    # T - ambient = 72 - 40 e^-t until 35 K (5 s were enough for 32 K but for e^-5)
    expected = 5_000 + 1_000 * math.log((72 - 32 * (1 - math.exp(-5))) / (72 - 35))
    assert t == pytest.approx(expected, abs=11)
    assert heartbeat(drive, t * MS)[0] == "MOTOR_OVER_TEMP"
    send(drive, t * MS, "Clear_Errors")
    assert heartbeat(drive, t * MS)[0] == "MOTOR_OVER_TEMP"
    send(drive, (t + 100) * MS, "Clear_Errors")
    assert heartbeat(drive, (t + 100) * MS)[0] == "NONE"


def test_a_bus_voltage_that_breaks_down_is_an_error() -> None:
    # 12 A through 0.25 Ω at a standing wheel: 36 W, so 18 V behind 3 Ω and 15.3 V behind 3.7 Ω; at least 16 V
    drive = make_drive(motor=motor_plan(supply_resistance=3.0, inertia=1e6))
    enable(drive, 0)
    torque(drive, 0, 1.5)
    drive.advance(50 * MS)
    assert heartbeat(drive, 50 * MS) == ("NONE", "CLOSED_LOOP_CONTROL", "SUCCESS")
    drive = make_drive(motor=motor_plan(supply_resistance=3.7, inertia=1e6))
    enable(drive, 0)
    torque(drive, 0, 1.5)
    drive.advance(50 * MS)
    assert heartbeat(drive, 50 * MS) == ("DC_BUS_UNDER_VOLTAGE", "IDLE", "DISARMED")


def values_now(drive: ODriveDrive, time_ns: int, name: str, remote: bool = True) -> dict[str, Any]:
    drive.advance(time_ns)
    asked = request(node(drive), name, remote)
    (answer,) = drive.receive(time_ns, asked)
    assert answer.can_id == asked.can_id
    assert not drive.refused
    return heard(answer)[2]


@pytest.mark.parametrize("remote", [True, False])
def test_requests_are_answered_with_what_the_motor_does(remote: bool) -> None:
    motor = motor_plan(friction=0.0, inertia=0.5, supply_resistance=0.1, resistance=0.5)
    drive = make_drive(motor=motor)
    enable(drive, 0)
    for t in range(0, 1000, 10):
        torque(drive, t * MS, 1.25)

    def values(name: str) -> dict[str, Any]:
        return values_now(drive, 1000 * MS, name, remote)

    # τ = 1.25 N m on 0.5 kg m² for a second, 10 A, 50 W of heat and τ ω
    omega, amperes = 2.5, 10.0
    watts = 0.5 * amperes**2 + 1.25 * omega
    volts = 12 + math.sqrt(144 - 0.1 * watts)
    count = 1 / 8192
    assert values("Get_Torques") == {"Torque_Target": 1.25, "Torque_Estimate": pytest.approx(1.25, rel=1e-6)}
    assert values("Get_Iq") == {"Iq_Setpoint": amperes, "Iq_Measured": amperes}
    estimates = values("Get_Encoder_Estimates")
    assert estimates["Vel_Estimate"] == pytest.approx(omega / math.tau, abs=0.006 + 100 * count)
    assert estimates["Pos_Estimate"] == pytest.approx(omega / 2 / math.tau, abs=count)
    assert values("Get_Powers") == pytest.approx(
        {"Electrical_Power": watts, "Mechanical_Power": 1.25 * omega}, rel=1e-6
    )
    supply = values("Get_Bus_Voltage_Current")
    assert supply["Bus_Voltage"] == pytest.approx(volts, rel=1e-3)
    assert supply["Bus_Current"] == pytest.approx(watts / volts, rel=1e-3)
    temperature = values("Get_Temperature")
    assert temperature["FET_Temperature"] == 25.0
    assert temperature["Motor_Temperature"] == pytest.approx(25 + 100 * (1 - math.exp(-1 / 60)), rel=1e-3)
    assert values("Get_Version")["Fw_Version_Minor"] == 6
    assert values("Get_Error") == {"Active_Errors": "NONE", "Disarm_Reason": "NONE"}
    assert values("Heartbeat")["Axis_State"] == "CLOSED_LOOP_CONTROL"
    assert values("Address") == {"Node_ID": 2, "Serial_Number": drive.serial_number}


def test_a_request_leaves_the_periodic_mean_alone() -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 5 * MS, 1.0)
    assert values_now(drive, 8 * MS, "Get_Torques")["Torque_Estimate"] == 0.0
    assert last(drive.advance(10 * MS), "Get_Torques")["Torque_Estimate"] == pytest.approx(0.5)
    assert values_now(drive, 12 * MS, "Get_Torques")["Torque_Estimate"] == pytest.approx(0.5)


def test_discovery() -> None:
    drives = [make_drive(wheel) for wheel in (0, 1)]
    answers = [drive.receive(0, Frame(0x7E6, remote=True)) for drive in drives]
    said = [heard(frame) for (frame,) in answers]
    assert [(axis, name, values["Node_ID"]) for axis, name, values in said] == [(1, "Address", 1), (2, "Address", 2)]
    assert said[0][2]["Serial_Number"] != said[1][2]["Serial_Number"]


def test_current_limit() -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 0, 1.0)
    send(drive, 0, "Set_Limits", Velocity_Limit=10.0, Current_Limit=2.0)  # 0.125 N m/A
    assert drive.motor.torque == 0.25
    torque(drive, 0, -1.0)
    assert drive.motor.torque == -0.25
    assert last(drive.advance(10 * MS), "Get_Torques")["Torque_Target"] == -0.25
    send(drive, 10 * MS, "Set_Limits", Velocity_Limit=10.0, Current_Limit=1000.0)
    torque(drive, 10 * MS, 3e38)
    assert drive.motor.torque == 1.5  # the motor's own limit


def test_position_can_be_set() -> None:
    drive = make_drive()
    send(drive, 0, "Set_Absolute_Position", Position=-7.5)
    assert values_now(drive, 0, "Get_Encoder_Estimates")["Pos_Estimate"] == -7.5
    enable(drive, 0)
    torque(drive, 0, 1.0)
    drive.advance(50 * MS)
    turned = values_now(drive, 50 * MS, "Get_Encoder_Estimates")["Pos_Estimate"] + 7.5
    # ω = (τ/f)(1 - e^(-f t/J)) with f 0.02 and J 0.01, integrated
    exact = 50.0 * (0.05 - (1 - math.exp(-0.1)) / 2) / math.tau
    assert turned == pytest.approx(exact, abs=1.1 / 8192)


@pytest.mark.parametrize("axis", [2, BROADCAST])
def test_reboot_is_as_power_on_but_for_causes(axis: int) -> None:
    drive = make_drive()
    enable(drive, 0)
    torque(drive, 0, 0.5)
    drive.inject(0, 1, Fault.BROWN_OUT)
    drive.receive(0, frame(2, "Estop"))
    drive.receive(0, frame(axis, "Reboot", Action="reboot"))
    assert heartbeat(drive, 0) == ("DC_BUS_UNDER_VOLTAGE", "IDLE", "SUCCESS")
    drive.mend(0, 1, Fault.BROWN_OUT)
    drive.receive(0, frame(axis, "Reboot", Action="reboot"))
    assert heartbeat(drive, 0) == ("NONE", "IDLE", "SUCCESS")
    send(drive, 0, "Set_Axis_State", Axis_Requested_State=8)
    assert heartbeat(drive, 0) == ("NONE", "IDLE", "INVALID_STATE")
    running = make_drive()
    enable(running, 0)
    torque(running, 0, 0.5)
    running.receive(0, frame(axis, "Reboot"))
    assert (running.motor.torque, running.state) == (0.0, AxisState.IDLE)


def test_callers_mistakes() -> None:
    plan = drive_plan("odrive", (62, 63))
    assert ODriveDrive(plan, 0).identifiers >= set(range(62 << 5, 63 << 5))
    with pytest.raises(ValueError, match="63"):
        ODriveDrive(plan, 1)
    with pytest.raises(ValueError, match=r"wheel must be 0 .* 2"):
        ODriveDrive(plan, 2)
    with pytest.raises(ValueError, match=r"GET_IQ.*-1"):
        make_drive(config=ODriveConfig(iq_msg_rate_ms=-1))
    drive = make_drive()
    calls: list[Callable[..., Any]] = [drive.inject, drive.mend]
    for call in calls:
        with pytest.raises(ValueError, match="wheel 1, not 0"):
            call(0, 0, Fault.SILENT)
        with pytest.raises(ValueError, match=r"over_temperature.*watchdog"):
            call(0, 1, Fault.WATCHDOG)


def must_be_refused(sent: Frame) -> bool:
    """Returns whether axis 2 must refuse a frame, by the DBC alone."""
    axis, command = divmod(sent.can_id, 32)
    if axis == BROADCAST and command in (2, 6, 22, 24):
        axis = 2
    if axis != 2 or command in (4, 5, 8, 10, 16, 30, 31):
        return True
    if command == 2:
        return False
    message = VENDOR.get_message_by_frame_id(sent.can_id & 31 | 2 << 5)
    reports = message.senders != ["Master"]
    if reports and (sent.remote or not sent.data):
        return False
    needed = max(signal.start + signal.length for signal in message.signals)
    if sent.remote or reports or command == 6 or len(sent.data) > 8:
        return True
    # bytes that are missing are zero
    values = message.decode(sent.data.ljust(-(-needed // 8), b"\0"), allow_truncated=True, decode_choices=False)
    assert isinstance(values, dict)
    return not all(math.isfinite(float(str(value))) for value in values.values())


def test_whatever_comes_nothing_raises_and_no_torque_without_closed_loop() -> None:
    dice = random.Random(4)
    drive = make_drive()
    good = [frame(2, "Set_Controller_Mode", Control_Mode=1, Input_Mode=1), frame(2, "Clear_Errors")]
    good += [frame(2, "Set_Axis_State", Axis_Requested_State=8), frame(2, "Set_Input_Torque")]
    good += [frame(2, "Set_Input_Torque", Input_Torque=dice.uniform(-2, 2)) for _ in range(4)]
    good += [frame(2, "Estop"), frame(2, "Reboot"), frame(2, "Set_Limits", Current_Limit=9.0), *HARMLESS]
    refused = closed = 0
    for step in range(100_000):
        time_ns = step * MS // 8
        sent = dice.choice(good[:8] if dice.random() < 0.7 else good)
        kind = dice.randrange(5)
        if kind == 0:
            sent = Frame(dice.randrange(-9, 1 << 12), dice.randbytes(dice.randrange(9)), dice.random() < 0.1)
        elif kind == 1:
            sent = sent._replace(can_id=2 << 5 | dice.randrange(32), data=dice.randbytes(dice.randrange(10)))
        elif kind == 2 and sent.data:
            bits = int.from_bytes(sent.data, "little") ^ 1 << dice.randrange(8 * len(sent.data))
            sent = sent._replace(data=bits.to_bytes(len(sent.data), "little"), remote=dice.random() < 0.1)
        said = drive.advance(time_ns)
        before = drive.refused.total()
        answers = drive.receive(time_ns, sent)
        more = drive.refused.total() - before
        assert more in (0, 1)
        if must_be_refused(sent):
            assert (more, answers) == (1, []), sent
        refused += more
        closed += drive.state is AxisState.CLOSED_LOOP_CONTROL
        if drive.state is not AxisState.CLOSED_LOOP_CONTROL or drive.errors:
            assert drive.motor.torque == 0.0
        assert abs(drive.motor.torque) <= 1.5
        for report in said + answers:
            heard(report)
    assert refused > 30_000
    assert closed > 10_000
