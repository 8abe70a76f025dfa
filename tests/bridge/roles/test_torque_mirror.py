"""The torque mirror: one frame per robot and period, and never a torque that was not commanded."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.native.codec import NativeCodec, Torque
from echelon.bridge.protocols.native.counter import CounterCheck
from echelon.bridge.protocols.native.host import NativeHost
from echelon.bridge.protocols.registry import make_host, make_observer
from echelon.bridge.reports import WheelsReport
from echelon.bridge.roles.torque_mirror import Stop, TorqueMirror
from echelon.bridge.timing.bus_load import frame_bits
from echelon.errors import PartRunError
from echelon.plan.plan import Plan
from support.bench_drives import drive_plan
from support.runs import plan_of

MS = 1_000_000
PROTOCOLS = ("native", "odrive", "cia402")
CODEC = NativeCodec(0.001)


def make() -> TorqueMirror:
    return TorqueMirror([host(0), host(1)], 10 * MS)


def mirror_of(plan: Plan) -> TorqueMirror:
    robots = plan.robots
    hosts, periods = [make_host(robot) for robot in robots], [robot.period_ns for robot in robots]
    return TorqueMirror(hosts, periods, [robot.envelope for robot in robots])


def host(robot: int) -> NativeHost:
    return NativeHost(drive_plan("native", (robot, robot)))


def test_a_host_that_fails_at_the_end_keeps_no_other_robot_from_being_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = [host(0), host(1), host(2)]
    mirror = TorqueMirror(hosts, 10 * MS)
    for robot in range(3):
        mirror.encode(0, robot, 0.1, 0.1, False)

    def fails(*_: object) -> list[Frame]:
        raise PartRunError("mine.py: raised")

    monkeypatch.setattr(hosts[1], "mirror", fails)
    assert mirror.driven() == [[0, 1, 2]]
    frames, failure = mirror.end([0, 1, 2])
    assert [robot for robot, _ in frames] == [0, 2]
    assert str(failure) == "mine.py: raised"


def said(robot: int, right: float, left: float, enable: bool, counter: int) -> Torque:
    return Torque(robot, right, left, enable, enable, False, False, False, False, counter)


def decode(frames: list[Frame]) -> Torque:
    ((can_id, data, _),) = frames
    frame = CODEC.decode(can_id, data)
    assert isinstance(frame, Torque)
    return frame


def test_one_frame_per_robot_and_period_in_order() -> None:
    bridge = make()
    frames = [bridge.encode(step * 10 * MS, robot, 1.0 + robot, -0.5) for step in range(20) for robot in (0, 1)]
    assert [decode(one) for one in frames] == [
        said(robot, 1.0 + robot, -0.5, True, step % 16) for step in range(20) for robot in (0, 1)
    ]
    assert bridge.frames == 40
    assert sum(counts.bits.bits for counts in bridge.counts) == sum(
        frame_bits(can_id, data) for ((can_id, data, _),) in frames
    )
    assert [counts.skipped for counts in bridge.counts] == [0, 0]


@pytest.mark.parametrize("torques", [(math.nan, 1.0), (1.0, math.inf), (-math.inf, math.nan)])
def test_torque_that_is_not_finite_stops_the_drives(torques: tuple[float, float]) -> None:
    bridge = make()
    bridge.encode(0, 1, 5.0, 5.0)
    assert decode(bridge.encode(10 * MS, 1, *torques)) == said(1, 0.0, 0.0, False, 1)
    assert bridge.counts[1].stopped == {Stop.NOT_FINITE: 1}
    assert (bridge.counts[1].smallest, bridge.counts[1].largest) == ((5.0, 5.0), (5.0, 5.0))
    assert decode(bridge.encode(20 * MS, 1, 2.0, 2.0)) == said(1, 0.0, 0.0, True, 2)
    assert decode(bridge.encode(30 * MS, 1, 2.0, 2.0)) == said(1, 2.0, 2.0, True, 3)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_first_torque_after_a_stop_is_zero_and_limits_count_from_there(protocol: str) -> None:
    plan = plan_of("lab", f"robot.drive.protocol={protocol}", "robot.envelope.rise_limit=0.5")
    robot, mirror = plan.robots[0], mirror_of(plan)
    observer = make_observer(robot, False)
    heard: list[float | None] = []
    for step, torque in enumerate((0.4, 1.3, 0.4, 0.6, 0.3, math.nan, 0.8, 0.5, 0.5, 0.9)):
        for frame in mirror.encode(step * 10 * MS, 0, torque, torque):
            assert observer.observe(step * 10 * MS, frame) == []
        heard.append(observer.wheels[0].commanded)
    # 1.3 rises by too much, so 0.4 is replaced by zero, and then 0.6 rises by too much; so does 0.8
    assert heard == pytest.approx([0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.9], abs=1e-3)
    assert mirror.counts[0].stopped == {"rise limit": 3, "not finite": 1}


def test_the_first_torque_after_frames_that_no_bus_took_is_zero() -> None:
    bridge = make()
    bridge.encode(0, 0, 1.0, 1.0)
    bridge.stop(0)
    bridge.encode(10 * MS, 0, 1.0, 1.0)  # enables with zero torque, but reaches no drive
    bridge.unsent(0)
    assert decode(bridge.encode(20 * MS, 0, 1.0, 1.0)) == said(0, 0.0, 0.0, True, 3)
    assert decode(bridge.encode(30 * MS, 0, 1.0, 1.0)) == said(0, 1.0, 1.0, True, 4)


def test_old_torque_stops_the_drives_and_a_repeated_one_gives_nothing() -> None:
    bridge = make()
    bridge.encode(20 * MS, 0, 1.0, 1.0)
    assert decode(bridge.encode(10 * MS, 0, 1.0, 1.0)) == said(0, 0.0, 0.0, False, 1)
    assert bridge.encode(20 * MS, 0, 1.0, 1.0) == []
    assert decode(bridge.encode(10 * MS, 1, 1.0, 1.0)).enable_right  # each robot has its own time
    counts = bridge.counts[0]
    assert (counts.frames, counts.stopped, counts.repeated) == (2, {Stop.STALE: 1}, 1)


def test_periods_without_torque_are_counted() -> None:
    bridge = make()
    for step in (0, 1, 2, 5, 6, 10):
        bridge.encode(step * 10 * MS + (step % 2 == 0), 0, 0.0, 0.0)  # a nanosecond of jitter is no period
    assert bridge.counts[0].skipped == 2 + 3


def test_stop_on_request() -> None:
    bridge = make()
    assert not decode(bridge.stop(1)).enable_right
    assert not decode(bridge.stop(1, Stop.MISSING)).enable_right
    assert bridge.counts[1].stopped == {Stop.REQUESTED: 1, Stop.MISSING: 1}


def test_report() -> None:
    bridge = make()
    bridge.encode(0, 0, 40.0, -1.0)
    bridge.encode(10 * MS, 0, -2.0, 50.0, saturated=True)
    bridge.encode(20 * MS, 0, math.nan, 0.0)
    stopped = {"not finite": 1}
    assert bridge.report(0, "native") == WheelsReport("native", 3, stopped, 50.0, clipped=2, saturated=1)
    assert bridge.report(1, "native") == WheelsReport("native", 0, {}, 0.0)
    assert bridge.frames == 3


torques = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 1), torques, torques, st.booleans())))
def test_whatever_comes(calls: list[tuple[int, int, float, float, bool]]) -> None:
    bridge = make()
    checks, disabled = [CounterCheck(), CounterCheck()], [False, False]
    total = 0
    for time, robot, right, left, saturated in calls:
        for can_id, data, _ in bridge.encode(time * 10 * MS, robot, right, left, saturated):
            frame = CODEC.decode(can_id, data)
            assert isinstance(frame, Torque)
            assert frame.robot == robot
            assert checks[robot].step(frame.counter) == 0
            assert frame.enable_right == frame.enable_left
            assert frame.enable_right or (frame.tau_right, frame.tau_left) == (0.0, 0.0)
            assert not frame.enable_right or (math.isfinite(right) and math.isfinite(left))
            assert not (disabled[robot] and frame.enable_right) or (frame.tau_right, frame.tau_left) == (0.0, 0.0)
            disabled[robot] = not frame.enable_right
            total += 1
    assert total == bridge.frames == sum(counts.frames for counts in bridge.counts)
    assert total + sum(counts.repeated for counts in bridge.counts) == len(calls)


def test_refused() -> None:
    with pytest.raises(ValueError, match="period"):
        TorqueMirror([host(0)], 0)
    with pytest.raises(IndexError):
        make().encode(0, 2, 0.0, 0.0)
