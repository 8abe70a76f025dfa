"""The observer of a robot with ODrives: its findings; and the DBC of the protocol."""

import math
import struct
from dataclasses import replace
from typing import Any

import cantools.database
import pytest
from cantools.database.can import Database

from echelon.bridge.protocols.faults import LATCHING, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.observe import Finding
from echelon.bridge.protocols.odrive.config import ODriveConfig
from echelon.bridge.protocols.odrive.dbc import messages
from echelon.bridge.protocols.odrive.drive import ODriveDrive
from echelon.bridge.protocols.odrive.host import ODriveHost
from echelon.bridge.protocols.odrive.observe import ODriveObserver
from support.bench_drives import ENVELOPE, MS, drive_plan
from support.odrive_vendor import VENDOR, frame, request

PLAN = drive_plan("odrive", (1, 2), recover_ns=300 * MS)
IDLE = frame(1, "Heartbeat", Axis_State="IDLE")
CLOSED = frame(1, "Heartbeat", Axis_State="CLOSED_LOOP_CONTROL")
ASK = frame(1, "Set_Axis_State", Axis_Requested_State="CLOSED_LOOP_CONTROL")
QUIET = ODriveConfig(heartbeat_msg_rate_ms=0)


def make_observer(config: ODriveConfig | None = None) -> ODriveObserver:
    return ODriveObserver(PLAN, ENVELOPE, config)


def kinds(found: list[Finding]) -> list[str]:
    return [finding.kind for finding in found]


def observe(observer: ODriveObserver, *frames: tuple[float, Frame]) -> list[str]:
    """Gives frames to an observer; returns the kinds of all findings.  Times are in ms."""
    return [kind for time_ms, frame in frames for kind in kinds(observer.observe(round(time_ms * MS), frame))]


def reported(torque: float, axis: int = 1) -> Frame:
    return frame(axis, "Get_Torques", Torque_Estimate=torque)


def commanded(torque: float, axis: int = 1) -> Frame:
    return frame(axis, "Set_Input_Torque", Input_Torque=torque)


@pytest.mark.parametrize("fault", [None, *LATCHING, Fault.SILENT])
def test_a_whole_life_has_nothing_wrong(fault: Fault | None) -> None:
    """There are no findings in bring-up, torque, a fault, recovery, stop and start."""
    drives = [ODriveDrive(PLAN, wheel) for wheel in (0, 1)]
    host, observer = ODriveHost(PLAN), make_observer()
    found: list[Finding] = []

    def pass_on(time_ns: int, sent: Frame) -> None:
        found.extend(observer.observe(time_ns, sent))
        for drive in drives:
            if sent.can_id in drive.identifiers:
                drive.advance(time_ns)
                for answer in drive.receive(time_ns, sent):
                    found.extend(observer.observe(time_ns, answer))

    for cycle in range(-20, 300):
        time_ns = cycle * 10 * MS
        said = [frame for drive in drives for frame in drive.advance(time_ns)]
        if fault is not None and cycle == 57:
            said += drives[0].inject(time_ns, 0, fault)
        if fault is not None and cycle == 90:
            drives[0].mend(time_ns, 0, fault)
        for heard in said:
            found.extend(observer.observe(time_ns, heard))
            if heard.can_id in host.identifiers:
                host.receive(time_ns, heard)
        if cycle == 200:
            for sent in host.stop(time_ns):
                pass_on(time_ns, sent)
        if cycle == 220:
            host.start()
        for sent in host.poll(time_ns) + host.command(time_ns, 0.5, -0.25):
            pass_on(time_ns, sent)
        if cycle in (50, 190, 290):
            right, left = observer.wheels
            assert (right.commanded, right.reported, left.commanded, left.reported) == (0.5, 0.5, -0.25, -0.25)
            assert (right.state, right.fault) == ("CLOSED_LOOP_CONTROL", "")
            assert right.commanded_ns == right.reported_ns == time_ns
            assert right.speed == pytest.approx(drives[0].motor.velocity * math.tau, rel=1e-6)
    assert kinds(found) == []


def test_the_reading_is_what_the_bus_said() -> None:
    observer = make_observer()
    assert observer.wheels[1].state == ""
    observer.observe(5, frame(2, "Heartbeat", Axis_State=1, Axis_Error=0x2000200))
    observer.observe(6, frame(2, "Get_Encoder_Estimates", Vel_Estimate=-0.5))
    observer.observe(7, commanded(0.25, 2))
    observer.observe(8, reported(0.0, 2))
    left = observer.wheels[1]
    assert (left.state, left.fault) == ("IDLE", "DC_BUS_UNDER_VOLTAGE|ESTOP_REQUESTED")
    assert (left.commanded, left.commanded_ns, left.reported, left.reported_ns) == (0.25, 7, 0.0, 8)
    assert left.speed == pytest.approx(-math.pi)
    observer.observe(9, frame(2, "Get_Error", Active_Errors="WATCHDOG_TIMER_EXPIRED"))
    assert left.fault == "WATCHDOG_TIMER_EXPIRED"
    assert observer.wheels[0] == make_observer().wheels[0]


def test_what_belongs_to_others_is_not_looked_at() -> None:
    observer = make_observer()
    assert observer.identifiers == set(range(0x20, 0x60))
    assert observer.observe(0, Frame(0x6E, b"")) == []


def test_what_must_come_regularly() -> None:
    ten = {0x20 | command for command in (0x09, 0x0E, 0x1C)} | {0x40 | command for command in (0x09, 0x0E, 0x1C)}
    hundred = {axis | command for axis in (0x20, 0x40) for command in (0x01, 0x03, 0x14, 0x15, 0x17)}
    assert make_observer().cyclic == dict.fromkeys(ten, 10 * MS) | dict.fromkeys(hundred, 100 * MS)
    assert 0x21 not in make_observer(QUIET).cyclic


BAD: list[tuple[str, Frame]] = [
    ("length", Frame(0x2E, bytes(9))),
    ("length", Frame(0x21, bytes(7))),
    ("length", Frame(0x3C, bytes(4))),
    ("not finite", commanded(math.nan)),
    ("not finite", reported(math.inf)),
    ("command", Frame(0x28, bytes(8))),
    ("state", Frame(0x21, bytes([0, 0, 0, 0, 99, 0, 0, 0]))),
    ("torque above limit", commanded(1.50001)),
    ("torque above limit", commanded(-1e9)),
]


@pytest.mark.parametrize(("kind", "bad"), BAD)
def test_a_bad_frame(kind: str, bad: Frame) -> None:
    (finding,) = make_observer().observe(123, bad)
    assert (finding.time_ns, finding.can_id, finding.kind) == (123, bad.can_id, kind)
    assert finding.text


GOOD = [
    Frame(0x2E, struct.pack("<f", 0.5)),
    commanded(1.5),
    commanded(-1.5),
    request(1, "Get_Torques"),
    request(1, "Heartbeat", remote=False),
    request(1, "Address"),
    frame(1, "Estop"),
    frame(1, "Clear_Errors"),
    frame(1, "Set_Limits"),
]


@pytest.mark.parametrize("good", GOOD)
def test_a_good_frame(good: Frame) -> None:
    assert make_observer().observe(123, good) == []


def test_a_limit_that_no_float_is() -> None:
    observer = ODriveObserver(PLAN, replace(ENVELOPE, torque_limit=1.1))
    rounded = struct.unpack("<f", struct.pack("<f", 1.1))[0]
    assert rounded > 1.1
    assert observer.observe(0, commanded(1.1)) == []


LIVES: list[tuple[list[tuple[float, Frame]], list[str]]] = [
    ([(0, CLOSED)], ["enabled unasked"]),
    ([(0, IDLE), (100, CLOSED), (200, CLOSED)], ["enabled unasked"]),
    ([(0, ASK), (0, IDLE), (100, CLOSED), (200, CLOSED)], []),
    ([(0, ASK), (100, CLOSED), (200, IDLE), (300, CLOSED)], ["enabled unasked"]),
    ([(0, ASK), (100, CLOSED), (150, ASK), (200, IDLE), (300, CLOSED)], []),
    ([(0, ASK), (10, frame(1, "Estop")), (100, CLOSED)], ["enabled unasked"]),
    ([(0, ASK), (10, frame(1, "Reboot")), (100, CLOSED)], ["enabled unasked"]),
    ([(0, ASK), (10, frame(1, "Set_Axis_State", Axis_Requested_State=1)), (100, CLOSED)], ["enabled unasked"]),
    ([(0, ASK), (1, frame(1, "Heartbeat", Axis_State=8, Axis_Error=8))], ["error while enabled"]),
    ([(0, frame(1, "Heartbeat", Axis_State=1, Axis_Error=8))], []),
]


@pytest.mark.parametrize(("frames", "expected"), LIVES)
def test_states(frames: list[tuple[float, Frame]], expected: list[str]) -> None:
    assert observe(make_observer(), *frames) == expected


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([(0, IDLE), (9.9, reported(0.5))], []),  # part of the mean may be from before
        ([(0, IDLE), (10, reported(0.5))], ["torque while idle"]),
        ([(0, IDLE), (10, reported(-2e-6))], ["torque while idle"]),
        ([(0, IDLE), (10, reported(5e-7))], []),
        ([(0, IDLE), (5, ASK), (20, reported(0.5))], []),  # the axis may be enabled by now
        ([(0, ASK), (1, CLOSED), (50, IDLE), (70, reported(0.5))], ["torque while idle"]),
        ([(0, IDLE), (10, reported(0.5, axis=2))], []),
    ],
)
def test_torque_while_idle(frames: list[tuple[float, Frame]], expected: list[str]) -> None:
    assert observe(make_observer(), *frames) == expected


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([(0, commanded(0.5)), (110, reported(0.5))], []),  # watchdog and a period
        ([(0, commanded(0.5)), (110.1, reported(0.5))], ["torque after silence"]),
        ([(0, commanded(0.5)), (110.1, reported(0.0))], []),
        (
            [(0, commanded(0.5)), (90, commanded(math.nan)), (120, reported(0.5))],
            ["not finite", "torque after silence"],
        ),
        ([(0, commanded(0.5)), (90, commanded(0.5)), (200, reported(0.5))], []),
        ([(0, commanded(0.5)), (90, ASK), (200, reported(0.5))], []),
        ([(0, request(1, "Get_Iq")), (111, reported(0.5))], ["torque after silence"]),  # there was never a command
    ],
)
def test_torque_after_silence(frames: list[tuple[float, Frame]], expected: list[str]) -> None:
    assert observe(make_observer(QUIET), *frames) == expected


def dbc(config: ODriveConfig | None = None) -> Database:
    """Returns the DBC, written as text and read back."""
    found = cantools.database.load_string(Database(messages(PLAN, "g1/r3", config)).as_dbc_string(), "dbc")
    assert isinstance(found, Database)
    return found


def test_the_dbc_decodes_as_the_vendors_does() -> None:
    ours = dbc()
    assert len(ours.messages) == 2 * 28
    for wheel, axis in (("right", 1), ("left", 2)):
        for message in ours.messages:
            if message.frame_id >> 5 != axis:
                continue
            theirs = VENDOR.get_message_by_frame_id(message.frame_id)
            assert message.name == f"g1_r3_{wheel}_" + theirs.name.removeprefix(f"Axis{axis}_")
            assert (message.length, message.is_extended_frame) == (theirs.length, False)
            assert units(message) == units(theirs)
            for data in (bytes(theirs.length), bytes(range(1, 9))[: theirs.length], b"\xf0\x3f" * (theirs.length // 2)):
                if theirs.signals and len(data) == theirs.length:
                    for choices in (False, True):
                        assert plain(message.decode(data, choices)) == plain(theirs.decode(data, choices))


def units(message: Any) -> dict[str, str]:
    return {signal.name: (signal.unit or "").split(" (default)")[0] for signal in message.signals}


def plain(values: Any) -> dict[str, str]:
    return {name: str(value) for name, value in values.items()}


def test_the_dbc_says_who_sends_and_how_often() -> None:
    ours = dbc(ODriveConfig(iq_msg_rate_ms=20, error_msg_rate_ms=0))
    cycles = {message.name.removeprefix("g1_r3_left_"): message.cycle_time for message in ours.messages}
    expected = {"Heartbeat": 100, "Get_Encoder_Estimates": 10, "Get_Iq": 20, "Get_Torques": 10, "Get_Temperature": 100}
    expected |= {"Get_Bus_Voltage_Current": 100, "Set_Input_Torque": 10}
    assert {name: cycle for name, cycle in cycles.items() if cycle and "right" not in name} == expected
    assert ours.get_message_by_name("g1_r3_left_Get_Torques").senders == ["drive_g1_r3_left"]
    assert ours.get_message_by_name("g1_r3_left_Set_Input_Torque").senders == ["bridge"]
    assert ours.get_message_by_name("g1_r3_left_Set_Input_Torque").receivers == {"drive_g1_r3_left"}
