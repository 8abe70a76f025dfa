"""The ODrive host with virtual axes, and its frames compared with the vendor's DBC."""

import math
import random
import struct
from typing import Any

import pytest

from echelon.bridge.protocols.faults import LATCHING, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.odrive.drive import ODriveDrive
from echelon.bridge.protocols.odrive.enums import AxisState
from echelon.bridge.protocols.odrive.host import ODriveHost
from support.bench_drives import MS, drive_plan
from support.odrive_vendor import frame, heard, request

PERIOD_NS = 10 * MS
WATCHDOG_NS = 100 * MS
PLAN = drive_plan("odrive", (1, 2))


class Robot:
    """A host with its two drives, run cycle by cycle.  Frames can be lost in both directions."""

    def __init__(self, start_ns: int = 0, **plan: Any) -> None:
        self.plan = drive_plan("odrive", (1, 2), **plan)
        self.drives = [ODriveDrive(self.plan, wheel) for wheel in (0, 1)]
        self.host = ODriveHost(self.plan)
        self.now_ns = start_ns
        self.deaf: set[int] = set()
        """Axes that do not get the host's frames"""
        self.sent: list[Frame] = []
        """Frames of the host in the last cycle"""

    def cycle(self, right: float = 0.0, left: float = 0.0) -> None:
        for drive in self.drives:
            for said in drive.advance(self.now_ns):
                self.hear(said)
        self.give(self.host.poll(self.now_ns) + self.host.command(self.now_ns, right, left))
        self.now_ns += PERIOD_NS

    def give(self, frames: list[Frame]) -> None:
        self.sent = frames
        for sent in frames:
            for drive in self.drives:
                if sent.can_id in drive.identifiers and sent.can_id >> 5 not in self.deaf:
                    drive.advance(self.now_ns)
                    for said in drive.receive(self.now_ns, sent):
                        self.hear(said)

    def hear(self, said: Frame) -> None:
        if said.can_id in self.host.identifiers:
            self.host.receive(self.now_ns, said)

    def run(self, cycles: int, right: float = 0.0, left: float = 0.0) -> None:
        for _ in range(cycles):
            self.cycle(right, left)

    def up(self) -> "Robot":
        """Runs until torque flows; the first cycle after enabling sends zeros."""
        self.run(20, 0.5, -0.25)
        assert self.host.enabled
        assert self.torques == (0.5, -0.25)
        return self

    @property
    def torques(self) -> tuple[float, float]:
        return self.drives[0].motor.torque, self.drives[1].motor.torque

    @property
    def names(self) -> list[tuple[int, str, dict[str, Any]]]:
        return [heard(frame) for frame in self.sent]


def torque_frames(right: float, left: float) -> list[tuple[int, str, dict[str, float]]]:
    return [
        (1, "Set_Input_Torque", {"Input_Torque": right}),
        (2, "Set_Input_Torque", {"Input_Torque": left}),
    ]


def prepare(axis: int, *, clear: bool = False) -> list[tuple[int, str, dict[str, Any]]]:
    return [
        (axis, "Set_Controller_Mode", {"Control_Mode": "TORQUE_CONTROL", "Input_Mode": "PASSTHROUGH"}),
        *([(axis, "Clear_Errors", {"Identify": 0})] if clear else []),
    ]


def ask(axis: int) -> tuple[int, str, dict[str, Any]]:
    return axis, "Set_Axis_State", {"Axis_Requested_State": "CLOSED_LOOP_CONTROL"}


@pytest.mark.parametrize("start_ns", [-400 * MS, -30 * MS, 0])
def test_bring_up(start_ns: int) -> None:
    robot = Robot(start_ns)
    robot.cycle(0.5, -0.25)
    assert robot.names == [*prepare(1), *prepare(2), *torque_frames(0.0, 0.0)]
    for _ in range(4):  # the request must wait, since its lower identifier would overtake the mode
        robot.cycle(0.5, -0.25)
        assert robot.names == torque_frames(0.0, 0.0)
    robot.cycle(0.5, -0.25)
    assert robot.names == [ask(1), ask(2), *torque_frames(0.0, 0.0)]
    while not robot.host.enabled:
        assert robot.torques == (0.0, 0.0)
        robot.cycle(0.5, -0.25)
        assert robot.names == torque_frames(0.0, 0.0)
    # the next heartbeats show the new state, and zeros are sent in their cycle
    assert robot.now_ns - PERIOD_NS == ((start_ns + 50 * MS) // (100 * MS) + 1) * 100 * MS
    robot.cycle(0.5, -0.25)
    assert robot.names == torque_frames(0.5, -0.25)
    assert robot.torques == (0.5, -0.25)
    robot.run(100, 0.5, -0.25)
    assert (robot.host.torque, robot.host.torque_ns) == ((0.5, -0.25), robot.now_ns - PERIOD_NS)
    assert robot.host.fault == ""
    assert not robot.host.refused
    assert not any(drive.refused for drive in robot.drives)


def test_without_answers_it_asks_again_every_200_ms() -> None:
    host = ODriveHost(PLAN)
    assert (host.torque, host.torque_ns) == ((0.0, 0.0), None)
    asked = [t for t in range(0, 1000, 10) if host.poll(t * MS)]
    assert asked == [0, 50, 250, 300, 500, 550, 750, 800]
    assert not host.enabled
    assert host.fault == ""  # never heard


def test_one_axis_alone_is_not_enough() -> None:
    robot = Robot()
    robot.deaf = {2}
    robot.run(60, 0.5, 0.5)
    assert robot.drives[0].state is AxisState.CLOSED_LOOP_CONTROL
    assert not robot.host.enabled
    assert robot.torques == (0.0, 0.0)
    robot.deaf = set()
    robot.run(40, 0.5, 0.5)
    assert robot.torques == (0.5, 0.5)


def test_the_mean_torque_of_both_is_reported_when_both_have_reported() -> None:
    host = ODriveHost(PLAN)
    host.receive(5, frame(1, "Get_Torques", Torque_Target=9.0, Torque_Estimate=0.5))
    assert (host.torque, host.torque_ns) == ((0.5, 0.0), None)
    host.receive(7, frame(2, "Get_Torques", Torque_Target=9.0, Torque_Estimate=-0.25))
    assert (host.torque, host.torque_ns) == ((0.5, -0.25), 5)
    host.receive(8, frame(1, "Get_Torques"))
    assert (host.torque, host.torque_ns) == ((0.0, -0.25), 7)


def test_errors_from_before_are_cleared() -> None:
    robot = Robot()
    for drive in robot.drives:
        drive.receive(0, frame(drive.plan.node_ids[drive.wheel], "Estop"))
    robot.cycle(0.5, -0.25)
    assert robot.names == [*prepare(1, clear=True), *prepare(2, clear=True), *torque_frames(0.0, 0.0)]
    assert robot.host.fault == "right: ESTOP_REQUESTED; left: ESTOP_REQUESTED"
    robot.up()
    assert robot.host.fault == ""


def test_an_error_it_did_not_know_of_when_it_asked() -> None:
    robot = Robot(3 * MS)  # no heartbeat yet
    robot.drives[0].receive(3 * MS, frame(1, "Estop"))
    robot.cycle()
    assert robot.names == [*prepare(1), *prepare(2), *torque_frames(0.0, 0.0)]
    robot.run(10)
    assert robot.names == [*prepare(1, clear=True), *torque_frames(0.0, 0.0)]  # at the first heartbeat, not 200 ms on
    robot.run(10)
    assert robot.host.enabled


@pytest.mark.parametrize("fault", LATCHING)
@pytest.mark.parametrize("wheel", [0, 1])
def test_a_fault_stops_both_wheels_for_good(fault: Fault, wheel: int) -> None:
    robot = Robot().up()
    for said in robot.drives[wheel].inject(robot.now_ns, wheel, fault):
        robot.hear(said)
    robot.drives[wheel].mend(robot.now_ns, wheel, fault)
    robot.run(12, 0.5, -0.25)
    assert not robot.host.enabled
    assert robot.host.fault.startswith("right: " if wheel == 0 else "left: ")
    assert robot.torques == (0.0, 0.0)
    robot.run(500, 0.5, -0.25)
    assert robot.names == torque_frames(0.0, 0.0)
    assert robot.torques == (0.0, 0.0)
    robot.host.start()
    robot.run(20, 0.5, -0.25)
    assert robot.torques == (0.5, -0.25)
    assert robot.host.fault == ""


@pytest.mark.parametrize("fault", [*LATCHING, Fault.SILENT])
def test_recovery_after_its_time(fault: Fault) -> None:
    robot = Robot(recover_ns=700 * MS).up()
    at_ns = robot.now_ns
    for said in robot.drives[0].inject(at_ns, 0, fault):
        robot.hear(said)
    robot.drives[1].advance(at_ns)
    robot.run(13, 0.5, -0.25)
    assert robot.host.fault
    robot.drives[0].mend(robot.now_ns, 0, fault)
    # by the first report without torque, or a watchdog's time after the last frame
    told_ns = at_ns + (WATCHDOG_NS if fault is Fault.SILENT else PERIOD_NS)
    while robot.now_ns < told_ns + 700 * MS:
        robot.cycle(0.5, -0.25)
        assert robot.names == torque_frames(0.0, 0.0)
    robot.cycle(0.5, -0.25)
    assert robot.names == [*prepare(1, clear=fault is not Fault.SILENT), *torque_frames(0.0, 0.0)]
    robot.run(5, 0.5, -0.25)
    assert robot.names == [ask(1), *torque_frames(0.0, 0.0)]
    robot.run(12, 0.5, -0.25)
    assert robot.torques == (0.5, -0.25)
    assert robot.host.fault == ""
    assert not robot.drives[0].refused["first command not zero"]


def test_recovery_waits_for_a_cause_that_lasts() -> None:
    robot = Robot(recover_ns=0).up()
    robot.drives[1].inject(robot.now_ns, 1, Fault.ENCODER_LOSS)
    robot.run(100, 0.5, -0.25)
    assert (robot.host.fault, robot.torques) == ("left: MISSING_ESTIMATE", (0.0, 0.0))
    robot.drives[1].mend(robot.now_ns, 1, Fault.ENCODER_LOSS)
    robot.run(35, 0.5, -0.25)
    assert (robot.host.fault, robot.torques) == ("", (0.5, -0.25))


def test_silence() -> None:
    robot = Robot().up()
    last_ns = robot.now_ns - PERIOD_NS
    robot.drives[0].inject(robot.now_ns - 1, 0, Fault.SILENT)
    while robot.now_ns < last_ns + WATCHDOG_NS:
        robot.cycle(0.5, -0.25)
        assert robot.host.enabled
    robot.cycle(0.5, -0.25)
    assert (robot.host.enabled, robot.host.fault) == (False, "right: silent")
    assert robot.names == torque_frames(0.0, 0.0)
    robot.drives[0].mend(robot.now_ns, 0, Fault.SILENT)
    robot.run(100, 0.5, -0.25)
    assert (robot.host.fault, robot.torques) == ("right: silent", (0.0, 0.0))  # only `start` enables it again


def test_an_axis_that_leaves_the_state_unasked() -> None:
    robot = Robot().up()
    robot.give([frame(2, "Set_Axis_State", Axis_Requested_State="IDLE")])
    robot.run(11, 0.5, -0.25)
    assert robot.host.fault == "left: in state 1 unasked"
    assert robot.torques == (0.0, 0.0)


NOTHING = frame(1, "Get_Torques")


@pytest.mark.parametrize(
    ("cycles", "report", "fault"),
    [
        (3, NOTHING, ""),  # the first cycle's zeros and two more: a command may have been lost
        (4, NOTHING, "right: gives no torque"),
        (4, frame(1, "Get_Torques", Torque_Target=0.5), ""),
        (4, frame(1, "Get_Torques", Torque_Estimate=1e-9), ""),
    ],
)
def test_an_axis_that_gives_no_torque(cycles: int, report: Frame, fault: str) -> None:
    host = ODriveHost(PLAN)
    host.poll(-50 * MS)
    host.poll(0)
    for axis in (1, 2):
        host.receive(0, frame(axis, "Heartbeat", Axis_State="CLOSED_LOOP_CONTROL"))
    for cycle in range(cycles):
        host.command(cycle * PERIOD_NS, 0.5, 0.0)
        host.receive((cycle + 1) * PERIOD_NS, report)
        host.receive((cycle + 1) * PERIOD_NS, report._replace(can_id=0x5C))  # none was commanded there
    assert (host.fault, host.enabled) == (fault, not fault)


def test_a_report_from_before_a_pause_does_not_make_zero_reports_of_the_pause_a_fault() -> None:
    robot = Robot().up()
    host, at_ns = robot.host, robot.now_ns
    for cycle, torque in enumerate((0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5)):
        host.command(at_ns + cycle * PERIOD_NS, torque, 0.0)
    late_ns = at_ns + 7 * PERIOD_NS  # the host stood still, and reads all at once
    host.receive(late_ns, frame(1, "Get_Torques", Torque_Target=0.5, Torque_Estimate=0.5))
    for number in range(3):
        host.receive(late_ns + 10_000 * number, NOTHING)
    assert host.fault == ""
    host.receive(late_ns + PERIOD_NS, NOTHING)
    assert host.fault == "right: gives no torque"


@pytest.mark.parametrize("gives", [True, False])
def test_reports_that_come_all_at_once_after_a_standstill_are_no_fault(gives: bool) -> None:
    """Host or drive stood still: the reports are from before the command.  Later ones tell whether the axis gives torque."""
    robot = Robot().up()
    host = robot.host
    robot.cycle(0.0, 0.0)
    for cycle in range(10):
        host.command(robot.now_ns + cycle * PERIOD_NS, 0.5, 0.0)
    at_ns = robot.now_ns + 10 * PERIOD_NS
    for late_ns in range(9):
        host.receive(at_ns + 10_000 * late_ns, NOTHING)
    assert host.fault == ""
    for cycle in range(1, 3):
        report = frame(1, "Get_Torques", Torque_Target=0.5, Torque_Estimate=0.5) if gives else NOTHING
        host.receive(at_ns + cycle * PERIOD_NS, report)
        assert host.fault == ("" if gives or cycle == 1 else "right: gives no torque")


def test_the_other_wheel_stops_with_the_next_command() -> None:
    robot = Robot().up()
    robot.cycle(0.5, -0.25)
    robot.drives[0].inject(robot.now_ns - 1, 0, Fault.BROWN_OUT)
    robot.cycle(0.5, -0.25)
    robot.cycle(0.5, -0.25)
    assert robot.torques == (0.0, 0.0)
    assert robot.host.fault == "right: gives no torque"
    robot.run(10, 0.5, -0.25)
    assert robot.host.fault == "right: DC_BUS_UNDER_VOLTAGE"


@pytest.mark.parametrize("estop", [False, True])
def test_stop_and_start(estop: bool) -> None:
    robot = Robot(recover_ns=0).up()
    robot.give(robot.host.estop(robot.now_ns) if estop else robot.host.stop(robot.now_ns))
    assert robot.torques == (0.0, 0.0)
    if estop:
        assert robot.names == [(1, "Estop", {}), (2, "Estop", {})]
    else:
        idle = {"Axis_Requested_State": "IDLE"}
        assert robot.names == [*torque_frames(0.0, 0.0), (1, "Set_Axis_State", idle), (2, "Set_Axis_State", idle)]
    assert not robot.host.enabled
    for _ in range(100):
        robot.cycle(0.5, -0.25)
        assert [drive.state for drive in robot.drives] == [AxisState.IDLE] * 2
    assert robot.names == torque_frames(0.0, 0.0)
    assert ("ESTOP_REQUESTED" in robot.host.fault) == estop
    robot.host.start()
    robot.run(20, 0.5, -0.25)
    assert (robot.torques, robot.host.fault) == ((0.5, -0.25), "")


def test_a_stop_that_was_lost_is_repeated() -> None:
    robot = Robot().up()
    robot.deaf = {1}
    robot.give(robot.host.stop(robot.now_ns))
    assert robot.drives[0].state is AxisState.CLOSED_LOOP_CONTROL
    robot.deaf = set()
    robot.cycle(0.5, 0.5)
    assert [drive.state for drive in robot.drives] == [AxisState.IDLE] * 2


def test_torques_are_limited_to_the_motors() -> None:
    robot = Robot().up()
    robot.cycle(1e300, -1.6)
    assert robot.names == torque_frames(1.5, -1.5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_torque_that_is_not_finite_is_a_mistake(bad: float) -> None:
    for host in (ODriveHost(PLAN), Robot().up().host):
        for torques in ((bad, 0.0), (0.0, bad)):
            with pytest.raises(ValueError, match=f"finite.*{bad!r}"):
                host.command(0, *torques)


def test_two_wheels_are_two_nodes() -> None:
    with pytest.raises(ValueError, match=r"two nodes, not \(4, 4\)"):
        ODriveHost(drive_plan("odrive", (4, 4)))


REFUSED: list[tuple[str, Frame]] = [
    ("identifier", frame(3, "Heartbeat")),
    ("identifier", frame(1, "Set_Input_Torque")),
    ("identifier", Frame(-1)),
    ("length", frame(1, "Heartbeat")._replace(data=bytes(7))),
    ("length", frame(1, "Heartbeat")._replace(data=b"")),
    ("length", frame(1, "Get_Torques")._replace(data=bytes(9))),
    ("remote", request(1, "Get_Torques")),
    ("not finite", frame(1, "Get_Torques", Torque_Estimate=math.nan)),
    ("not finite", frame(1, "Get_Encoder_Estimates", Pos_Estimate=math.inf)),
]


@pytest.mark.parametrize(("reason", "bad"), REFUSED)
def test_what_is_refused_is_counted_and_is_no_sign_of_life(reason: str, bad: Frame) -> None:
    host = ODriveHost(PLAN)
    host.receive(0, frame(1, "Heartbeat", Axis_State=1))
    host.receive(90 * MS, bad)
    assert host.refused == {reason: 1}
    host.poll(99 * MS)
    assert host.fault == ""
    host.poll(100 * MS)
    assert host.fault == "right: silent"


@pytest.mark.slow
def test_whatever_comes_nothing_raises_and_torque_only_while_enabled() -> None:
    dice = random.Random(5)
    host = ODriveHost(drive_plan("odrive", (1, 2), recover_ns=50 * MS))
    names = ["Get_Error", "Get_Encoder_Estimates", "Get_Torques"]
    ours = {axis << 5 | command for axis in (1, 2) for command in (1, 3, 9, 28)}
    floats = {axis << 5 | command for axis in (1, 2) for command in (9, 28)}
    enabled = refused = 0
    was = False
    for step in range(100_000):
        time_ns = step * MS // 4
        axis = dice.choice((1, 2))
        noisy = step % 4000 < 400  # in between it may get well again
        said = frame(axis, "Heartbeat", Axis_State=8) if dice.random() < 0.8 else frame(axis, dice.choice(names))
        kind = dice.randrange(4 if noisy else 8)
        if kind == 0:
            said = Frame(dice.randrange(-9, 1 << 12), dice.randbytes(dice.randrange(9)), dice.random() < 0.1)
        elif kind == 1:
            said = said._replace(data=dice.randbytes(dice.randrange(10 if noisy else 8)))
        elif kind == 2 and noisy:
            bits = int.from_bytes(said.data, "little") ^ 1 << dice.randrange(64)
            said = said._replace(data=bits.to_bytes(8, "little"), remote=dice.random() < 0.1)
        before = host.refused.total()
        host.receive(time_ns, said)
        more = host.refused.total() - before
        bad = said.can_id not in ours or len(said.data) != 8 or said.remote
        bad = bad or (said.can_id in floats and not all(map(math.isfinite, struct.unpack("<ff", said.data))))
        assert more == bad, said
        refused += more
        if step % 40 == 0:
            host.poll(time_ns)
            sent = [struct.unpack("<ff", said.data)[0] for said in host.command(time_ns, 0.5, -0.25)]
            if not (was and host.enabled):
                assert sent == [0.0, 0.0]
            else:
                assert sent in ([0.5, -0.25], [0.0, 0.0])
            enabled += sent == [0.5, -0.25]
            was = host.enabled
        assert all(map(math.isfinite, host.torque))
    assert refused > 10_000
    assert enabled > 100
