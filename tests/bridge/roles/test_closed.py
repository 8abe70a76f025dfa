"""The closed torque path in one process: the plant gets exactly the torques that the drives decoded."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame, pack, unpack
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.roles.commander import NOT_COMMANDED, Commander
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.sim.engines.in_process import Engine
from echelon.sim.results.trace import TraceBuilder
from support.runs import plan_of

MS = 1_000_000
PERIOD = 10 * MS
PROTOCOLS = ("native", "odrive", "cia402")
SCALE = 0.001


def closed(*overrides: str, duration: float = 2) -> Plan:
    """Returns the lab's plan with a closed torque path."""
    return plan_of("lab", "can.path=closed", f"duration={duration}", "claims=[]", *overrides)


def ran(plan: Plan, sink: Callable[[Message], None] = lambda message: None) -> Engine:
    """Runs a plan to its end."""
    engine = Engine(plan, sink)
    engine.run()
    return engine


def stations(engine: Engine) -> tuple[Commander, DriveBank]:
    """Returns the bridge and the drives of a run."""
    bridge, drives = (engine.roles[station.index] for station in engine.plan.bus_roles)
    assert isinstance(bridge, Commander)
    assert isinstance(drives, DriveBank)
    return bridge, drives


class Heard:
    """Collects the torques that robots wanted and that their wheels got, by time: arrays (robots, 2)."""

    def __init__(self) -> None:
        self.wanted: dict[int, dict[int, Any]] = {}
        self.got: dict[int, Any] = {}
        self.frames: list[Any] = []

    def __call__(self, message: Message) -> None:
        if message.channel is Channel.TORQUE:
            self.wanted.setdefault(message.time_ns, {})[message.source] = message.values[:2].copy()
        elif message.channel is Channel.WHEELS:
            self.got[message.time_ns] = message.values.reshape(-1, 2).copy()
        elif message.channel is Channel.FRAMES:
            self.frames += [(message.source, timed) for timed in unpack(message.values)]


def errors(heard: Heard) -> Any:
    """Returns the difference between the wheels' torques of each period and those wanted at its beginning."""
    rows = []
    for time_ns, wanted in heard.wanted.items():
        got = heard.got.get(time_ns + PERIOD)
        if got is not None:
            rows.append(got - np.array([wanted[robot] for robot in range(len(wanted))]))
    return np.abs(np.array(rows))


class RoundedLimits:
    """Torque limits of a robot that also round to the resolution of a native frame: a second way to the same torques."""

    def __init__(self, limits: Any) -> None:
        self._limits = limits

    def apply(self, *arguments: float) -> tuple[float, float, bool]:
        right, left, limited = self._limits.apply(*arguments)
        return round(right / SCALE) * SCALE, round(left / SCALE) * SCALE, limited


def test_without_lag_and_delay_it_is_the_mirrored_path_with_rounded_torques_bit_for_bit() -> None:
    traces = []
    mirrored = plan_of("lab", "duration=5", "claims=[]")
    for plan in (closed("can.timing=ideal", duration=5), mirrored):
        builder = TraceBuilder(plan)
        engine = Engine(plan, builder.add)
        if plan is mirrored:
            for role in engine.roles[: len(plan.robots)]:
                role._limits = RoundedLimits(role._limits)  # type: ignore[attr-defined]
                role._constants = None  # type: ignore[attr-defined]  # the usual loop has limits of its own
        engine.run()
        traces.append(builder.build())
    for one, other in zip(traces[0].states, traces[1].states, strict=True):
        np.testing.assert_array_equal(one, other)
    assert traces[0].digest() == traces[1].digest()
    assert np.abs(traces[0].states[0][:, 10]).max() > 0.05  # there was torque


@pytest.mark.parametrize(("protocol", "step"), [("native", SCALE), ("odrive", 1e-7), ("cia402", 1.5e-3)])
def test_wheels_get_what_was_wanted_within_quantisation(protocol: str, step: float) -> None:
    heard = Heard()
    engine = ran(closed("can.timing=ideal", f"robot.drive.protocol={protocol}"), heard)
    found = errors(heard)
    assert found.shape == (200, 9, 2)
    assert found.max() <= step / 2 * (1 + 1e-9)
    assert found.max() > 0  # the frames did round
    bridge, _ = stations(engine)
    for row in bridge.reports().values():
        assert (row.enabled, row.fault, sum(row.stopped.values()), row.refused) == (True, "", 0, {})


def test_the_bus_takes_time_and_the_wheels_see_it() -> None:
    """At 500 kbit/s a command arrives after the frames before it, so the mean of a period contains the old torque."""
    heard = Heard()
    ran(closed(), heard)
    late = errors(heard)
    assert late.max() > 2 * SCALE
    # frame k of nine ends after k + 1 frame times of 0.24 to 0.25 ms; at the first the bus may have been busy
    for robot in range(9):
        for time_ns in range(10 * PERIOD, 100 * PERIOD, PERIOD):
            share = (robot + 1.5) * 0.26e6 / PERIOD
            step = np.abs(heard.wanted[time_ns][robot] - heard.wanted[time_ns - PERIOD][robot])
            error = np.abs(heard.got[time_ns + PERIOD][robot] - heard.wanted[time_ns][robot])
            assert (error <= share * step + 1.01 * SCALE).all()


def test_bring_up_is_over_before_the_run_and_without_torque() -> None:
    for protocol in PROTOCOLS:
        heard = Heard()
        engine = ran(closed(f"robot.drive.protocol={protocol}", "can.bitrate=1000000", duration=0.1), heard)
        early = [timed for source, timed in heard.frames if source == engine.plan.bridge.index and timed.time_ns < 0]
        assert any(timed.node == BRIDGE_NODE for timed in early)
        assert any(timed.node != BRIDGE_NODE for timed in early)
        assert all(robot.host.enabled for robot in stations(engine)[0].robots)
        assert not heard.got[0].any()


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("dead", ["g1/r1", "g2", "coordinator", "bridge"])
def test_whoever_dies_wheel_torque_is_zero_within_the_watchdog_time_plus_one_frame(protocol: str, dead: str) -> None:
    plan = closed(f"robot.drive.protocol={protocol}", "can.timing=ideal")
    index = next(one.index for one in plan.all_roles if one.name == dead)
    heard = Heard()
    engine = Engine(plan, heard)
    dies_ns = 1000 * MS
    bridge, drives = stations(engine)

    def torque_of(robot: int) -> float:
        return max(
            abs(motor.torque) for each in drives.drives if each.place.robot == robot for motor in each.drive.motors
        )

    hit = {"g1/r1": [0, 1, 2], "g2": [3, 4, 5]}.get(dead, list(range(9)))
    for time_ns in engine.instants():
        if time_ns == dies_ns:
            assert all(torque_of(robot) > 0 for robot in range(9))
            for channel in Channel:
                engine._receivers.pop((index, channel), None)
        if time_ns > dies_ns + plan.can.watchdog_ns + PERIOD:
            assert all(torque_of(robot) == 0 for robot in hit)
    # the torque was held until then
    assert np.abs(heard.got[dies_ns + plan.can.watchdog_ns // 2][hit]).max() > 0
    if dead != "bridge":
        assert all(bridge.robots[robot].stopped[NOT_COMMANDED] > 0 for robot in hit)


def test_a_robot_that_is_not_heard_gets_no_torque() -> None:
    heard = Heard()
    rule = 'links=[{source="g1/r1", receiver="bridge", channel="torque", loss=1.0}]'
    engine = ran(closed(rule), heard)
    got = np.array([row for time_ns, row in heard.got.items() if time_ns > 100 * MS])
    assert not got[:, 0].any()
    assert np.abs(got[:, 1:]).max(axis=(0, 2)).min() > 0.01
    assert stations(engine)[0].reports()["g1/r1"].largest == 0.0


def test_a_torque_older_than_the_watchdog_is_not_sent() -> None:
    heard = Heard()
    engine = ran(closed('links=[{source="g1/*", receiver="bridge", channel="torque", delay=0.15}]'), heard)
    assert not np.array(list(heard.got.values()))[:, :3].any()
    rows = stations(engine)[0].reports()
    assert rows["g1/r1"].stopped[NOT_COMMANDED] > 150
    assert not rows["g2/r4"].stopped.get(NOT_COMMANDED)


FAULTS = ("over_temperature", "encoder_loss", "brown_out")


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_drive_with_a_fault_gives_no_torque_until_it_is_cleared_and_enabled(protocol: str, fault: str) -> None:
    event = f'events=[{{kind="drive_fault", robot="g1/r1", fault="{fault}", at=0.5, duration=0.3}}]'
    for recover in (False, True):
        heard = Heard()
        more = ["robot.drive.recover_after=0.2"] if recover else []
        engine = ran(closed(f"robot.drive.protocol={protocol}", "can.bitrate=1000000", event, *more), heard)
        first = {time_ns: np.abs(row[0]).max() for time_ns, row in heard.got.items()}
        assert first[500 * MS] > 0
        # the period that begins at the fault may still contain torque from before the next command
        assert all(tau == 0 for time_ns, tau in first.items() if 530 * MS <= time_ns <= 800 * MS)
        later = [tau for time_ns, tau in first.items() if time_ns > 1500 * MS]
        assert bool(max(later) > 0) is recover
        assert max(np.abs(row[1:]).max() for time_ns, row in heard.got.items() if time_ns > 600 * MS) > 0
        assert bool(stations(engine)[0].robots[0].host.fault) is not recover


def test_stuck_torque_stays_and_a_silent_drive_gives_none() -> None:
    heard = Heard()
    ran(
        closed(
            'events=[{kind="drive_fault", robot="g1/r1", wheel="right", fault="stuck_torque", at=0.5, duration=0.5},'
            ' {kind="drive_fault", robot="g2/r4", fault="silent", at=0.5}]'
        ),
        heard,
    )
    right = [heard.got[time_ns][0, 0] for time_ns in range(530 * MS, 1000 * MS, PERIOD)]
    assert len(set(right)) == 1
    assert right[0] != 0
    assert not any(row[3].any() for time_ns, row in heard.got.items() if time_ns > 620 * MS)


ESTOPS = {
    "native": [(0x100 + robot, lambda data: data[4] & 32) for robot in range(3)],
    "odrive": [(node << 5 | 2, lambda data: True) for node in range(1, 7)],
    "cia402": [(0x200 + node, lambda data: data[:2] == b"\x02\x00") for node in range(1, 7)],
}
"""By protocol: the identifiers of the e-stops of g1, and a function that recognises one"""


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_an_estop_stops_its_robots_for_as_long_as_it_lasts(protocol: str) -> None:
    heard = Heard()
    drive, event = f"robot.drive.protocol={protocol}", 'events=[{kind="estop", robot="g1/*", at=0.5, duration=0.5}]'
    ran(closed(event, drive, "can.bitrate=1000000"), heard)
    said = [timed for _, timed in heard.frames if timed.node == BRIDGE_NODE]
    for can_id, is_estop in ESTOPS[protocol]:
        times = [one.time_ns for one in said if one.frame.can_id == can_id and is_estop(one.frame.data)]
        assert 500 * MS < times[0] < 510 * MS  # lower identifiers go first
        assert times[-1] < 1000 * MS
    got = {time_ns: np.abs(row) for time_ns, row in heard.got.items()}
    assert not any(row[:3].any() for time_ns, row in got.items() if 520 * MS < time_ns < 1000 * MS)
    assert any(row[:3].any() for time_ns, row in got.items() if time_ns > 1200 * MS)
    assert all(row[3:].any() for time_ns, row in got.items() if 520 * MS < time_ns < 1000 * MS)


@pytest.mark.parametrize(
    ("events", "stopped"),
    [
        ("{at=0.5}, {at=0.7, duration=0.2}", (500, 2000)),  # the end of one is not the end of the other
        ("{at=0.5, duration=1.0}, {at=0.6, duration=0.1, robot='**/r1'}", (500, 1500)),
        ("{at=0.501, duration=0.008}", (510, 520)),  # between two instants
    ],
)
def test_estops_that_overlap_and_short_ones(events: str, stopped: tuple[int, int]) -> None:
    heard = Heard()
    ran(closed(f"events=[{events}]".replace("{at", "{kind='estop', at")), heard)
    from_ms, until_ms = stopped
    first = {time_ns // MS: np.abs(row[0]).max() for time_ns, row in heard.got.items()}
    assert not any(tau for at, tau in first.items() if from_ms + 20 < at <= until_ms)
    assert any(tau for at, tau in first.items() if from_ms - 200 < at <= from_ms)
    if until_ms < 2000:
        assert any(tau for at, tau in first.items() if at > until_ms + 50)
    if until_ms == 520:
        assert first[530] == 0  # the fault did happen


def test_a_fault_that_two_events_cause_stays_until_both_are_over() -> None:
    heard = Heard()
    fault = 'kind="drive_fault", robot="g1/r1", fault="encoder_loss"'
    events = f"events=[{{{fault}, at=0.3, duration=0.9}}, {{{fault}, at=0.5, duration=0.1}}]"
    ran(closed(events, "robot.drive.recover_after=0.05"), heard)
    first = {time_ns // MS: np.abs(row[0]).max() for time_ns, row in heard.got.items()}
    assert not any(tau for at, tau in first.items() if 330 < at <= 1200)
    assert any(tau for at, tau in first.items() if at > 1300)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_limits_of_the_envelope_count_from_the_zero_that_comes_first_after_a_fault(protocol: str) -> None:
    """A robot that wants more than `rise_limit` when its drives recover must not get it in one step."""
    heard = Heard()
    engine = ran(
        closed(
            f"robot.drive.protocol={protocol}",
            "can.timing=ideal",
            "robot.envelope.rise_limit=0.004",
            "robot.drive.recover_after=0.1",
            "robot.torque_rate_limit=0.3",  # robots begin gently by themselves
            'events=[{kind="drive_fault", robot="g1/r1", fault="encoder_loss", at=0.6, duration=0.01}]',
        ),
        heard,
    )
    got = np.array([heard.got[time_ns] for time_ns in sorted(heard.got)])
    rises = np.diff(np.abs(got), axis=0)
    assert rises.max() <= 0.004 + 1.6e-3  # and the rounding of a frame
    assert np.abs(got[:60, 0]).max() > 0.02
    assert stations(engine)[0].robots[0].stopped["rise limit"] > 0


def test_messages_that_cannot_be_are_counted_and_nothing_else() -> None:
    plan = closed("can.timing=ideal", duration=0.1)
    engine = ran(plan)
    bridge, drives = stations(engine)
    serve = drives.stages[1]
    time_ns = plan.duration_ns + PERIOD

    def message(source: int, channel: Channel, values: Any) -> Message:
        return Message(channel, source, 0, time_ns, values)

    wrong = [
        TimedFrame(2**62, 0, 0, Frame(0x100)),
        TimedFrame(-1, 0, 0, Frame(0x100)),
        TimedFrame(time_ns, 0, 999, Frame(1)),
    ]
    wrong.append(TimedFrame(time_ns, 255, 999, Frame(0)))
    silly = [message(0, Channel.TORQUE, np.array([0, 0, 1, 0, speed, speed])) for speed in (np.nan, np.inf, 1e308)]
    for torque in silly:
        serve.run(time_ns, [message(drives.index, Channel.FRAMES, pack(wrong)), torque, *[None] * 8])
    assert drives.refused == {"frame of no bus": 3 * len(wrong), "speed": 6}
    bridge.stages[0].run(time_ns, [message(drives.index, Channel.FRAMES, pack([*wrong[:2], wrong[3]]))])
    assert bridge.refused == {"frame of no drive": 3}
    drives.stages[0].run(time_ns, [])


def test_an_overloaded_bus_loses_frames_and_says_so() -> None:
    engine = ran(closed("can.bitrate=125000", "can.queue=8"))
    bridge, drives = stations(engine)
    bus = bridge.buses[0]
    assert bus.load > 0.98
    assert sum(row.lost for row in bus.traffic.values()) + sum(placed.lost.total() for placed in drives.drives) > 100
    for row in bus.traffic.values():
        assert row.sent == row.delivered + row.lost + row.pending


def test_disturbed_frames_are_sent_again_and_a_controller_that_is_off_comes_back() -> None:
    heard = Heard()
    engine = ran(
        closed(
            'events=[{kind="error_frames", at=0.2, duration=0.3, rate=0.2}, {kind="bus_off", at=1.0}]',
            "robot.drive.recover_after=0.05",
        ),
        heard,
    )
    bridge, _ = stations(engine)
    bus = bridge.buses[0]
    assert sum(row.retransmitted for row in bus.traffic.values()) > 50
    kinds = [event.kind.value for event in bus.events if event.node == BRIDGE_NODE and event.time_ns >= 1000 * MS]
    assert kinds[:2] == ["bus-off", "recovered"]
    from_bridge = sorted(timed.time_ns for source, timed in heard.frames if timed.node == BRIDGE_NODE)
    gap = np.diff(from_bridge).max()
    assert 100 * MS < gap < 125 * MS  # can.restart, 128 times 11 idle bits, and the way to the next period
    # frames that waited meanwhile are lost and do not come late
    assert all(bus.traffic[0x100 + robot].latency_max_ns < 2 * PERIOD for robot in range(9))
    assert bus.traffic[0x100].lost > 8
    assert heard.got[1900 * MS].any(axis=1).all()  # all were enabled again


@pytest.mark.parametrize("kind", ["error_frames", "bus_off"])
def test_one_disturbance_does_not_swing_on(kind: str) -> None:
    """A late SYNC must not make all later ones late."""
    more = ", rate=0.5, duration=0.02" if kind == "error_frames" else ""
    engine = ran(
        closed(
            f'events=[{{kind="{kind}", at=0.5{more}}}]',
            "robot.drive.protocol=cia402",
            "can.bitrate=1000000",
            "robot.drive.recover_after=0.1",
            duration=3,
        ),
        heard := Heard(),
    )
    for node in range(1, 19):
        came = [timed.time_ns for source, timed in heard.frames if timed.frame.can_id == 0x280 + node and source == 13]
        assert np.diff([time_ns for time_ns in came if time_ns > 2000 * MS]).max() < 1.5 * PERIOD
    assert all(row.enabled for row in stations(engine)[0].reports().values())


def test_a_drive_that_is_off_the_bus_comes_back_with_news_only() -> None:
    heard = Heard()
    engine = ran(closed('events=[{kind="bus_off", at=0.5, robot="g1/r1"}]', "robot.drive.recover_after=0.1"), heard)
    bridge, drives = stations(engine)
    assert bridge.buses[0].traffic[0x180].latency_max_ns < 2 * PERIOD
    assert 0 <= drives.drives[0].waiting <= 2
    assert bridge.robots[0].host.enabled


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_drives_come_up_at_once_where_the_lower_identifier_goes_first(protocol: str) -> None:
    """No frame is refused, and all drives are enabled long before the run: no request overtakes the frame before it."""
    plan = closed(f"robot.drive.protocol={protocol}", "can.bitrate=1000000", "can.bring_up=0.5", duration=0.1)
    engine = Engine(plan)
    bridge, drives = stations(engine)
    enabled_ns = next(at for at in engine.instants() if all(robot.host.enabled for robot in bridge.robots))
    assert enabled_ns < 0
    assert not sum(placed.drive.refused.total() for placed in drives.drives)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_drive_that_is_off_the_bus_hears_nothing_and_is_not_heard(protocol: str) -> None:
    """A drive that is bus-off takes the torque away after its watchdog; the bridge gets nothing from it until it is back."""
    event = 'events=[{kind="bus_off", at=0.505, robot="g1/r1"}]'
    bitrate = "can.bitrate=1000000"  # it goes off at the next torque period: 0.51 s
    heard = Heard()
    engine = Engine(closed(event, "can.restart=0.3", bitrate, f"robot.drive.protocol={protocol}", duration=0.9), heard)
    bridge, drives = stations(engine)
    mine = [motor for placed in drives.drives if placed.place.robot == 0 for motor in placed.drive.motors]
    torques = {time_ns: max(abs(motor.torque) for motor in mine) for time_ns in engine.instants()}
    assert all(torques[at * MS] > 0 for at in range(450, 600, 10))  # goes on with what it heard last
    assert all(torques[at * MS] == 0 for at in range(630, 810, 10))
    assert all(robot.host.enabled for robot in bridge.robots[1:])
    from_drive = [
        timed.time_ns for source, timed in heard.frames if timed.node == 1 and timed.bus == 0 and source == 13
    ]
    assert not [time_ns for time_ns in from_drive if 512 * MS < time_ns < 810 * MS]
    assert [time_ns for time_ns in from_drive if time_ns > 815 * MS]
    silent = [heard.got[at * MS][0] for at in range(620, 810, 10)]
    assert not np.any(silent)


def test_one_seed_one_run() -> None:
    def outcome(*overrides: str) -> tuple[str, bytes]:
        plan = closed(*overrides)
        builder, frames = TraceBuilder(plan), bytearray()

        def keep(message: Message) -> None:
            nonlocal frames
            builder.add(message)
            if message.channel is Channel.FRAMES:
                frames += message.values.tobytes()

        ran(plan, keep)
        return builder.build().digest(), bytes(frames)

    noisy: Sequence[str] = ['events=[{kind="error_frames", at=0, rate=0.05}]', 'links=[{channel="torque", loss=0.2}]']
    assert outcome(*noisy) == outcome(*noisy)
    assert outcome(*noisy) != outcome(*noisy, "seed=2")


@pytest.mark.parametrize("mirror_fails", [False, True])
def test_one_protocol_that_fails_at_stopping_does_not_keep_others_turning(
    mirror_fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bridge, _ = stations(ran(closed(duration=0.1)))

    def fail(*arguments: object) -> list[Frame]:
        raise KeyError("a fault of the protocol")

    monkeypatch.setattr(bridge.robots[1].host, "stop", fail)
    if mirror_fails:
        monkeypatch.setattr(bridge.robots[1].host, "mirror", fail)
    (robots,) = bridge.in_order_of_stopping()
    frames, failure = bridge.stop(100 * MS, robots)
    stopped = {timed.frame.can_id - 0x100 for timed in frames if timed.frame.data[:5] == bytes(5)}
    assert stopped == set(range(9)) - ({1} if mirror_fails else set())
    assert "a fault of the protocol" in str(failure)
