"""The referee: it finds nothing in our own runs, and it finds each violation that is put into their frames."""

import struct
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import median

import pytest
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.can.canlog import CanLog
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.observe import Finding
from echelon.bridge.referee.log import judge_log
from echelon.bridge.referee.referee import KEPT, Referee
from echelon.bridge.referee_reports import FindingReport
from echelon.bridge.stations.mirror import MirrorBridge
from echelon.plan.plan import Plan
from echelon.sim.engines.in_process import Engine
from support.closed_run import Heard, run
from support.runs import plan_of

MS = 1_000_000
PROTOCOLS = ("native", "odrive", "cia402")
IDENTIFIERS = {
    "native": 9 * 3,
    # what reports on its own, torque, mode, state; nobody clears errors
    "odrive": 18 * (7 + 3),
    # NMT and SYNC, the host's heartbeat; three TPDOs, two RPDOs, SDO both ways, heartbeat
    "cia402": 3 + 18 * 8,
}
COMMAND_IDS = {"native": (0x100,), "odrive": (0x2E, 0x4E), "cia402": (0x301, 0x302)}
REPORT_IDS = {"native": (0x180,), "odrive": (0x3C, 0x5C), "cia402": (0x281, 0x282)}
"""Identifiers of the torque reports of robot 0"""
many = settings(max_examples=12, deadline=None)
each_protocol = pytest.mark.parametrize("protocol", PROTOCOLS)


def judged(plan: Plan, frames: list[Heard] | tuple[Heard, ...]) -> Referee:
    referee = Referee(plan)
    for heard in frames:
        referee.observe(*heard)
    referee.finish(max(plan.duration_ns, max(heard[0] for heard in frames)))
    return referee


@cache
def cyclic(protocol: str) -> list[int]:
    """Returns the positions of the cyclic frames in a run, without its last 0.3 s."""
    plan, frames = run(protocol)
    can_ids = {can_id for observer in Referee(plan).observers for can_id in observer.cyclic}
    return [at for at, (time_ns, _, frame) in enumerate(frames) if 0 <= time_ns < 700 * MS and frame.can_id in can_ids]


def changed(
    frames: tuple[Heard, ...], where: Callable[[int, int], bool], data: Callable[[bytes], bytes]
) -> list[Heard]:
    """Returns the frames with changed data where `where`(time, identifier) is true."""
    return [
        (time_ns, bus, frame._replace(data=data(frame.data)) if where(time_ns, frame.can_id) else frame)
        for time_ns, bus, frame in frames
    ]


def with_crc(can_id: int, body: bytes) -> bytes:
    """Returns the data of a native frame: seven bytes and their CRC by the package crccheck."""
    return body + bytes([Crc8SaeJ1850.calc(can_id.to_bytes(2, "little") + body)])


@each_protocol
def test_nothing_is_found_in_a_run(protocol: str) -> None:
    plan, frames = run(protocol)
    summary = judged(plan, frames).report()
    assert (summary.kinds, summary.findings, summary.unknown) == ({}, (), 0)
    assert summary.frames == len(frames) > 2500
    assert len(summary.identifiers) == IDENTIFIERS[protocol]
    assert sum(row.frames for row in summary.identifiers.values()) == len(frames)
    for can_id in (*COMMAND_IDS[protocol], *REPORT_IDS[protocol]):
        row = summary.identifiers[f"can0:{can_id:03X}"]
        times = [time_ns for time_ns, _, frame in frames if frame.can_id == can_id and time_ns >= 0]
        gaps = [after - before for before, after in zip(times, times[1:], strict=False)]
        assert (row.period_min, row.period_max) == pytest.approx((min(gaps) / 1e9, max(gaps) / 1e9))
        assert row.period_mean == pytest.approx((times[-1] - times[0]) / 1e9 / len(gaps), rel=1e-9)
        assert row.period_mean == pytest.approx(0.01, rel=0.01)
        spread = sum((gap - sum(gaps) / len(gaps)) ** 2 for gap in gaps) / len(gaps)
        assert row.jitter == pytest.approx(spread**0.5 / 1e9, rel=1e-6)


@pytest.mark.parametrize("timing", ["ideal", "mirror"])
@each_protocol
def test_nothing_is_found_without_bits_or_without_drives(protocol: str, timing: str, tmp_path: Path) -> None:
    if timing == "ideal":
        plan, frames = run(protocol, "can.timing=ideal")
        summary = judged(plan, frames).report()
    else:
        plan = plan_of("lab", "duration=1", "claims=[]", f"robot.drive.protocol={protocol}")
        station = MirrorBridge(plan, ["virtual:referee"], tmp_path)
        Engine(plan, lambda message: station.take([message], [])).run()
        station.close()
        summary = judge_log(tmp_path / "can.log", plan)
        assert len(summary.identifiers) == (9 if protocol == "native" else 18)
        assert summary.frames == 100 * len(summary.identifiers)
    assert (summary.kinds, summary.unknown) == ({}, 0)
    assert summary.frames >= 900


def test_two_buses() -> None:
    plan, frames = run("odrive", "can.buses={a={},b={bitrate=500000}}", 'formation.groups.g2.robot.bus="b"')
    referee = judged(plan, frames)
    assert referee.kinds == {}
    assert {bus for _, bus, _ in frames} == {0, 1}
    assert {name.partition(":")[0] for name in referee.report().identifiers} == {"a", "b"}
    wrong = judged(plan, [(time_ns, 1 - bus, frame) for time_ns, bus, frame in frames])
    assert wrong.kinds["missing"] == 3  # nodes 1 to 6 are on both, 7 to 12 are on the first alone
    assert wrong.unknown > 0


@each_protocol
@many
@given(data=st.data())
def test_a_frame_that_is_missing(protocol: str, data: st.DataObject) -> None:
    plan, frames = run(protocol)
    at = data.draw(st.sampled_from(cyclic(protocol)))
    referee = judged(plan, frames[:at] + frames[at + 1 :])
    assert referee.kinds["gap"] >= 1
    assert {row.id for row in referee.kept if row.kind == "gap"} == {f"{frames[at][2].can_id:03X}"}
    # if the largest command is missing, the torque that it caused was not commanded
    assert set(referee.kinds) <= {"gap", "counter gap", "torque not commanded"}


@pytest.mark.parametrize(
    ("tolerance_ns", "found"), [(None, {"gap"}), (30 * MS, {"gap"}), (250 * MS, set())], ids=["default", "30", "250"]
)
def test_heartbeats_that_are_late_are_judged_as_all_cyclic_frames_are(
    tolerance_ns: int | None, found: set[str]
) -> None:
    plan, frames = run("odrive")
    (heartbeat, *_) = sorted({frame.can_id for _, _, frame in frames if frame.can_id & 31 == 1})
    late = [one for one in frames if one[2].can_id != heartbeat or not 300 * MS < one[0] < 490 * MS]
    assert len(frames) - len(late) == 2
    referee = Referee(plan, tolerance_ns=tolerance_ns)
    for one in late:
        referee.observe(*one)
    assert set(referee.kinds) == found
    never = [one for one in frames if one[2].can_id != heartbeat]
    assert judged(plan, never).kinds == {"missing": 1}


@each_protocol
@many
@given(data=st.data())
def test_a_frame_that_comes_twice(protocol: str, data: st.DataObject) -> None:
    plan, frames = run(protocol)
    at = data.draw(st.sampled_from(in_time(protocol)))
    referee = judged(plan, frames[: at + 1] + frames[at:])
    zero = protocol != "native" and frames[at][2].can_id in command_ids(plan) and not any(frames[at][2].data)
    assert referee.kinds["burst"] + referee.kinds["counter repeated"] >= (0 if zero else 1)
    assert {row.id for row in referee.kept} <= {f"{frames[at][2].can_id:03X}"}


@cache
def in_time(protocol: str) -> list[int]:
    """Returns the places of cyclic frames that did not wait for the bus.

    Two frames at the time of one that waited might be that one and the next."""
    _, frames = run(protocol)
    times_ns: dict[tuple[int, int], list[int]] = {}
    for time_ns, bus, frame in frames:
        times_ns.setdefault((bus, frame.can_id), []).append(time_ns)
    period_ns = {
        key: median(after - one for one, after in pairwise(found)) for key, found in times_ns.items() if len(found) > 2
    }
    before: dict[tuple[int, int], int] = {}
    found = set()
    for at, (time_ns, bus, frame) in enumerate(frames):
        key = bus, frame.can_id
        if key in before and time_ns - before[key] < 1.1 * period_ns.get(key, 0):
            found.add(at)
        before[key] = time_ns
    return [at for at in cyclic(protocol) if at in found]


def command_ids(plan: Plan) -> set[int]:
    return {
        can_id
        for robot in Referee(replace(plan, can=replace(plan.can, path="mirror"))).robots
        for can_id in robot.cyclic
    }


@each_protocol
@many
@given(data=st.data())
def test_frames_in_the_wrong_order(protocol: str, data: st.DataObject) -> None:
    plan, frames = run(protocol)
    at = data.draw(st.sampled_from([at for at in cyclic(protocol) if frames[at][0] < frames[at + 1][0]]))
    referee = judged(plan, (*frames[:at], frames[at + 1], frames[at], *frames[at + 2 :]))
    assert referee.kinds["time"] == 1


@many
@given(data=st.data())
def test_a_bit_that_flipped_in_a_native_frame(data: st.DataObject) -> None:
    plan, frames = run("native")
    at, bit = data.draw(st.sampled_from(cyclic("native"))), data.draw(st.integers(0, 63))
    time_ns, bus, frame = frames[at]
    broken = (int.from_bytes(frame.data, "little") ^ 1 << bit).to_bytes(8, "little")
    referee = judged(plan, (*frames[:at], (time_ns, bus, frame._replace(data=broken)), *frames[at + 1 :]))
    assert referee.kinds["crc"] == 1
    assert referee.kept[0].time == time_ns / 1e9


@pytest.mark.parametrize(("protocol", "byte", "bit"), [("odrive", 3, 6), ("cia402", 1, 6)])
@many
@given(data=st.data())
def test_a_bit_that_flipped_where_nothing_but_the_value_tells(
    protocol: str, byte: int, bit: int, data: st.DataObject
) -> None:
    """These protocols have no CRC of their own, so only a check of the values can find a flipped bit."""
    plan, frames = run(protocol)
    can_ids = COMMAND_IDS[protocol]
    at = data.draw(st.sampled_from([at for at in cyclic(protocol) if frames[at][2].can_id in can_ids]))
    time_ns, bus, frame = frames[at]
    broken = bytes(octet ^ (1 << bit if number == byte else 0) for number, octet in enumerate(frame.data))
    referee = judged(plan, (*frames[:at], (time_ns, bus, frame._replace(data=broken)), *frames[at + 1 :]))
    assert referee.kinds["torque above limit"] + referee.kinds["rise above limit"] + referee.kinds["value"] >= 1


@each_protocol
def test_torques_that_were_scaled(protocol: str) -> None:
    plan, frames = run(protocol)
    scale = {"native": scaled_native, "odrive": scaled_float, "cia402": scaled_permille}[protocol]
    command, report = COMMAND_IDS[protocol][0], REPORT_IDS[protocol][0]

    def kinds(wanted: int, factor: int) -> set[str]:
        found = changed(frames, lambda time_ns, can_id: can_id == wanted, lambda data: scale(wanted, data, factor))
        return set(judged(plan, found).kinds)

    assert "torque above limit" in kinds(command, 60)
    assert "rise above limit" in kinds(command, 60)
    assert kinds(report, 2) == {"torque not commanded"}
    assert kinds(report, -1) == {"torque not commanded"}
    assert "torque above limit" in kinds(report, 60)


@each_protocol
def test_torques_that_are_too_far_apart_within_the_window(protocol: str) -> None:
    plan, frames = run(protocol)
    robot = plan.robots[0]
    observer = Referee(plan).robots[0].observer
    said = []  # the commands to the right wheel
    for time_ns, _, frame in frames:
        if frame.can_id == COMMAND_IDS[protocol][0] and time_ns > 0:
            observer.observe(time_ns, frame)
            said.append((time_ns, observer.wheels[0].commanded or 0.0))
    zeros = [at for at, (_, torque) in enumerate(said) if not torque] + [len(said)]  # where the window begins anew
    apart = max(
        abs(one - other)
        for first, last in pairwise([0, *zeros])
        for at, (time_ns, one) in enumerate(said[first:last], first)
        for other_ns, other in said[at:last]
        if other_ns - time_ns <= 230 * MS
    )
    assert apart > 0.01

    def kinds(limit: float) -> dict[str, int]:
        envelope = replace(robot.envelope, window_limit=limit)
        return judged(replace(plan, robots=(replace(robot, envelope=envelope), *plan.robots[1:])), frames).kinds

    assert kinds(apart / 2)["window above limit"] > 0
    assert kinds(apart / 2).keys() == {"window above limit"}
    generous = 3 * apart + 0.05
    assert kinds(generous) == {}


def scaled_native(can_id: int, data: bytes, factor: int) -> bytes:
    right = int.from_bytes(data[:2], "little", signed=True) * factor
    return with_crc(can_id, right.to_bytes(2, "little", signed=True) + data[2:7])


def scaled_float(can_id: int, data: bytes, factor: int) -> bytes:
    return b"".join(struct.pack("<f", value * factor) for (value,) in struct.iter_unpack("<f", data))


def scaled_permille(can_id: int, data: bytes, factor: int) -> bytes:
    at = 0 if can_id < 0x380 and len(data) == 2 else 4
    value = int.from_bytes(data[at : at + 2], "little", signed=True) * factor
    return data[:at] + value.to_bytes(2, "little", signed=True) + data[at + 2 :]


@each_protocol
@many
@given(at_ms=st.integers(10, 400))
def test_torque_that_goes_on_though_nobody_commands(protocol: str, at_ms: int) -> None:
    plan, frames = run(protocol)
    gone = COMMAND_IDS[protocol]
    referee = judged(plan, [heard for heard in frames if heard[0] < at_ms * MS or heard[2].can_id not in gone])
    assert referee.kinds["silent"] == len(gone)
    assert {"torque after silence", "torque not commanded"} <= set(referee.kinds)
    assert min(row.time for row in referee.kept if row.kind == "torque after silence") < at_ms / 1e3 + 0.2
    assert {row.robot for row in referee.kept} == {"g1/r1"}


@each_protocol
@many
@given(number=st.integers(1, 4))
def test_a_state_that_jumps(protocol: str, number: int) -> None:
    plan, frames = run(protocol)
    can_id = {"native": 0x180, "odrive": 0x21, "cia402": 0x181}[protocol]
    times = [time_ns for time_ns, _, frame in frames if frame.can_id == can_id and time_ns >= 0]

    def jump(data: bytes) -> bytes:
        if protocol == "native":
            return with_crc(can_id, data[:4] + b"\x22" + data[5:6] + b"\x11")  # both in fault
        if protocol == "odrive":
            return data[:4] + b"\x01" + data[5:]  # IDLE
        return bytes((data[0] & 0x90 | 0x08,)) + data[1:]  # FAULT

    referee = judged(plan, changed(frames, lambda time_ns, which: (time_ns, which) == (times[number], can_id), jump))
    wanted = {
        "native": "fault left without clear",
        "odrive": "enabled unasked",
        "cia402": "enabled without command",
    }[protocol]
    assert referee.kinds[wanted] >= 1


@each_protocol
def test_torque_while_drives_are_brought_up(protocol: str) -> None:
    plan, frames = run(protocol)
    later = [(time_ns - 500 * MS, bus, frame) for time_ns, bus, frame in frames]
    referee = judged(plan, later)
    assert referee.kinds["torque before the run"] > 50
    assert set(referee.kinds) <= {"torque before the run", "silent"}  # and it ends too early


@each_protocol
def test_frames_of_others_are_counted_and_not_judged(protocol: str) -> None:
    plan, frames = run(protocol)
    foreign = [(time_ns, bus, Frame(0x7EE, bytes(8))) for time_ns, bus, _ in frames[::100]]
    referee = judged(plan, sorted((*frames, *foreign), key=lambda heard: heard[0]))
    assert (referee.kinds, referee.unknown) == ({}, len(foreign))
    assert referee.frames == len(frames) + len(foreign)


def native(plan: Plan, robot: int, times_ns: list[int]) -> list[Heard]:
    """Returns commands of zero torque to one robot, at these times."""
    return [
        (time_ns, 0, Frame(0x100 + robot, with_crc(0x100 + robot, bytes((0, 0, 0, 0, 3, number % 16, 0)))))
        for number, time_ns in enumerate(times_ns)
    ]


@pytest.fixture
def mirror() -> Plan:
    """A plan with a mirrored path: one robot's torques, every 10 ms at 500 kbit/s."""
    plan = plan_of("lab", "can.bitrate=500000")
    return replace(plan, robots=plan.robots[:1])


def kinds_of(plan: Plan, frames: list[Heard], tolerance_ns: int | None = None) -> dict[str, int]:
    referee = Referee(plan, tolerance_ns=tolerance_ns)
    for heard in sorted(frames, key=lambda heard: heard[0]):
        referee.observe(*heard)
    return dict(referee.kinds)


@pytest.mark.parametrize(("late_ms", "found"), [(4, {}), (6, {"gap": 1})])
def test_lateness_on_a_free_bus(mirror: Plan, late_ms: int, found: dict[str, int]) -> None:
    times = [at * 10 * MS for at in range(10)]
    times[5] += late_ms * MS
    assert kinds_of(mirror, native(mirror, 0, times)) == found
    assert kinds_of(mirror, native(mirror, 0, times), tolerance_ns=7 * MS) == {}
    assert kinds_of(mirror, native(mirror, 0, times), tolerance_ns=3 * MS) == {"gap": 1}


def test_waiting_for_a_full_bus_is_not_being_late(mirror: Plan) -> None:
    times = [at * 10 * MS for at in range(10)]
    times[5] += 8 * MS
    frames = native(mirror, 0, times)
    # frames of eight bytes take 222 to 270 µs: a busy stretch from before the frame is due until it comes
    full = [(49 * MS + 250_000 * at, 0, Frame(0x010, bytes(8))) for at in range(36)]
    assert kinds_of(mirror, frames + full) == {}
    free_again = [heard for heard in full if not 50 * MS < heard[0] < 57 * MS]
    assert kinds_of(mirror, frames + free_again) == {"gap": 1}


def test_what_is_owed_may_come_at_once(mirror: Plan) -> None:
    stalled = [0, 10, 20, 55, 56, 57, 60, 70, 80]  # 30, 40, 50 were held up
    assert kinds_of(mirror, native(mirror, 0, [at * MS for at in stalled])) == {"gap": 1}


@pytest.mark.parametrize("slower", [-0.004, 0.004])
def test_a_clock_that_is_a_little_off(mirror: Plan, slower: float) -> None:
    times = [round(at * 10 * MS * (1 + slower)) for at in range(2000)]
    assert kinds_of(mirror, native(mirror, 0, times)) == {}


def test_silence_is_told_once_while_it_lasts(mirror: Plan) -> None:
    plan = plan_of("lab", "can.bitrate=500000")
    times = [at * 10 * MS for at in range(100)]
    hole = [at for at in times if not 300 * MS < at < 600 * MS]
    frames = [heard for robot in range(9) for heard in native(plan, robot, hole if robot == 4 else times)]
    referee = Referee(plan)
    told = [found for heard in sorted(frames, key=lambda heard: heard[:1]) for found in referee.observe(*heard)]
    assert [(found.kind, found.can_id) for found in told] == [("silent", 0x104)]
    assert 400 * MS < told[0].time_ns < 500 * MS
    assert referee.finish(995 * MS) == []
    assert {found.kind for found in referee.finish(1200 * MS)} == {"silent"}


def test_where_a_run_is_cut_off_only_a_long_silence_is_told(mirror: Plan) -> None:
    def told(last_ms: int) -> list[Finding]:
        referee = Referee(mirror)
        for heard in native(mirror, 0, [at * 10 * MS for at in range(100)]):
            referee.observe(*heard)
        return referee.finish(last_ms * MS, cut=True)

    assert told(1090) == []  # 990 ms + watchdog
    assert [(found.kind, found.can_id) for found in told(1120)] == [("silent", 0x100)]


def test_robots_of_which_nothing_came(mirror: Plan) -> None:
    plan = plan_of("lab")
    referee = Referee(plan)
    assert [(found.kind, found.can_id) for found in referee.finish(10 * MS)] == [
        ("missing", 0x100 + robot) for robot in range(9)
    ]
    assert [row.robot for row in referee.kept] == [robot.path for robot in plan.robots]


def test_planned_faults() -> None:
    stuck = 'events=[{kind="drive_fault",at=0.3,duration=0.5,fault="stuck_torque",robot="g1/r1"}]'
    for protocol in PROTOCOLS:
        referee = judged(*run(protocol, stuck))
        assert set(referee.kinds) == {"torque not commanded"}, protocol
        assert {row.robot for row in referee.kept} == {"g1/r1"}
    estop = 'events=[{kind="estop",at=0.3}]'
    assert judged(*run("native", estop)).kinds == {}
    disturbed = 'events=[{kind="error_frames",at=0.2,duration=0.6,rate=0.05}]'
    assert judged(*run("native", disturbed)).kinds == {}


def test_the_log_of_a_run(tmp_path: Path) -> None:
    plan, frames = run("native")
    path = tmp_path / "can.log"
    with CanLog(path, "can0") as log:
        for time_ns, _, (can_id, data, remote) in frames:
            log.write(time_ns, can_id, data, 0, "", remote)
    summary = judge_log(path, plan)
    assert (summary.kinds, summary.frames, len(summary.identifiers)) == ({}, len(frames), 27)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[: len(lines) // 2]))
    assert judge_log(path, plan).kinds == {"silent": 27}
    assert judge_log(path, plan, whole=False).kinds == {}  # the run was cut off there
    path.write_text("")
    assert judge_log(path, plan).kinds == {"missing": 9}
    assert judge_log(path, plan, whole=False).kinds == {}
    with pytest.raises(OSError, match="No such file"):
        judge_log(tmp_path / "none.log", plan)


def test_findings_are_counted_and_the_first_kept() -> None:
    plan = plan_of("lab")
    referee = Referee(plan)
    for at in range(3 * KEPT):
        referee.observe(at * 10 * MS, 0, Frame(0x100, bytes(8)))
    assert referee.kinds["crc"] == 3 * KEPT
    assert len(referee.report().findings) == KEPT
    first = referee.report().findings[0]
    assert replace(first, text="") == FindingReport(0.0, "can0", "100", "crc", "", "g1/r1")


def test_callers_mistakes() -> None:
    plan = plan_of("lab")
    with pytest.raises(ValueError, match="tolerance must be 0 ns or more, not -1"):
        Referee(plan, tolerance_ns=-1)
    with pytest.raises(ValueError, match=r"bus must be 0 \.\. 0, not 1"):
        Referee(plan).observe(0, 1, Frame(0x100))
