"""The rules for every drive and host, whatever the bytes of their protocol.

A new protocol is added as an entry in `PROTOCOLS`.  The tests use only the interfaces in `bridge.protocols.frame` and
`bridge.protocols.protocol`, and never look into the bytes of a frame.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.faults import LATCHING, ON_DEMAND, Fault
from echelon.bridge.protocols.frame import Drive, Frame, Host
from echelon.bridge.protocols.motor import Motor
from echelon.bridge.protocols.protocol import DriveProtocol
from echelon.plan.can_plan import DrivePlan
from support.bench_drives import MS, drive_plan, motor_plan

WHEELS = (0, 1)
PERIOD_NS = 10 * MS
WATCHDOG_NS = 100 * MS
CYCLES = 60
"""Within this many cycles a host must enable its drives."""
NOTICE: Final = 15
"""Within this many cycles a fault must show: some drives report their state every 100 ms only"""
PROTOCOLS: dict[str, Callable[[Frame], bool]] = {
    "native": lambda frame: frame.data[4] & 32 != 0,
    "odrive": lambda frame: frame.can_id & 31 == 2,
    "cia402": lambda frame: frame.can_id & 0x780 == 0x200 and frame.data[:2] == b"\x02\x00",
    "my_drive.py:MyProtocol": lambda frame: frame.data[4] & 4 != 0,
}
"""Protocols by their name in a scenario, with a function that recognises an emergency stop in a frame of the host"""


@dataclass
class Rig:
    """A robot's drives and host on a bus without delay, with all frames that it carried."""

    plan: DrivePlan
    time_ns: int = -200 * MS
    sent: list[tuple[int, Frame]] = field(default_factory=list)
    """Frames of the drives with their times [ns]"""
    commanded: list[tuple[int, Frame]] = field(default_factory=list)
    """Frames of the host with their times [ns]"""
    deaf: bool = False
    """True: no frame of the host reaches the drives"""

    def __post_init__(self) -> None:
        self.drives = make_drives(self.plan)
        self.host = self.new_host()
        self.master = self.protocol.master(self.plan.period_ns, self.plan.watchdog_ns)

    @property
    def protocol(self) -> DriveProtocol:
        made: DriveProtocol = self.plan.protocol.made
        return made

    @property
    def resolution(self) -> float:
        """The largest difference between wanted and reported torque [N m]: half a bit of each, and rounding of floats"""
        return self.protocol.resolution(self.plan) + 1e-6

    def new_host(self) -> Host:
        return self.protocol.host(self.plan)

    def beginning(self) -> list[Frame]:
        """Returns the other frames at the beginning of a cycle, before the host's."""
        if self.master is None:
            return []
        sync = self.master.sync()
        return [*self.master.poll(self.time_ns), *([] if sync is None else [sync])]

    @property
    def motors(self) -> list[Motor]:
        """The motors of the right and the left wheel."""
        return [motor for drive in self.drives for motor in drive.motors]

    def drive_of(self, wheel: int) -> Drive:
        return self.drives[0] if len(self.drives) == 1 else self.drives[wheel]

    def refused(self) -> int:
        return sum(drive.refused.total() for drive in self.drives)

    def advance(self, time_ns: int) -> None:
        for drive in self.drives:
            self._from_drive(time_ns, drive.advance(time_ns))

    def to_drives(self, time_ns: int, frames: Sequence[Frame]) -> None:
        for frame in frames:
            self.commanded.append((time_ns, frame))
            for drive in () if self.deaf else self.drives:
                if frame.can_id in drive.identifiers:
                    self._from_drive(time_ns, drive.advance(time_ns))
                    self._from_drive(time_ns, drive.receive(time_ns, frame))

    def cycle(self, right: float = 0.0, left: float = 0.0, command: bool = True) -> None:
        """Runs one cycle at `time_ns`, and advances `time_ns` to the next."""
        self.advance(self.time_ns)
        if command:
            self.to_drives(self.time_ns, self.beginning())
            self.to_drives(self.time_ns, self.host.poll(self.time_ns))
            self.to_drives(self.time_ns, self.host.command(self.time_ns, right, left))
        self.time_ns += self.plan.period_ns

    def cycles(self, number: int, right: float = 0.0, left: float = 0.0, command: bool = True) -> None:
        for _ in range(number):
            self.cycle(right, left, command)

    def bring_up(self) -> None:
        for _ in range(CYCLES):
            self.cycle()
            if self.host.enabled:
                return
        raise AssertionError(f"not enabled: {self.host.fault!r}")

    def inject(self, wheel: int, fault: Fault) -> None:
        self._from_drive(self.time_ns, self.drive_of(wheel).inject(self.time_ns, wheel, fault))

    def mend(self, wheel: int, fault: Fault) -> None:
        self.drive_of(wheel).mend(self.time_ns, wheel, fault)

    def torques(self) -> list[float]:
        return [motor.torque for motor in self.motors]

    def _from_drive(self, time_ns: int, frames: Sequence[Frame]) -> None:
        for frame in frames:
            self.sent.append((time_ns, frame))
            if frame.can_id in self.host.identifiers:
                self.host.receive(time_ns, frame)


@pytest.fixture(params=PROTOCOLS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def rig(name: str) -> Rig:
    return make_rig(name)


def make_rig(name: str, **changes: Any) -> Rig:
    return Rig(drive_plan(name, **changes))


def make_drives(plan: DrivePlan) -> list[Drive]:
    return [plan.protocol.made.drive(plan, number) for number in range(len(plan.protocol.made.wheels))]


def enabled_rig(name: str, right: float = 0.5, left: float = -0.25, **changes: Any) -> Rig:
    """Returns a rig with enabled drives and these torques [N m] at the wheels."""
    rig = make_rig(name, **changes)
    rig.bring_up()
    while rig.time_ns < 0:  # the run begins
        rig.cycle()
    rig.cycles(3, right, left)
    assert rig.torques() == pytest.approx([right, left], abs=rig.resolution)
    return rig


def instants(rig: Rig, from_ns: int, to_ns: int, step_ns: int = MS) -> Iterator[int]:
    """Lets time pass in small steps without the host; yields each instant."""
    for time_ns in range(from_ns, to_ns + 1, step_ns):
        rig.advance(time_ns)
        yield time_ns


def test_bring_up_enables_without_torque(rig: Rig) -> None:
    assert not rig.host.enabled
    for _ in range(CYCLES):
        rig.cycle(0.7, -0.7)  # wanted from the first cycle on, but not before the drives are enabled
        if rig.host.enabled:
            break
        assert rig.torques() == [0.0, 0.0]
    assert rig.host.enabled
    assert rig.host.fault == ""
    assert rig.host.torque_ns is not None
    rig.cycles(5, 0.7, -0.7)
    assert rig.torques() == pytest.approx([0.7, -0.7], abs=rig.resolution)


def test_right_is_right_and_forward_is_positive(name: str) -> None:
    rig = enabled_rig(name, 1.0, -0.5)
    rig.cycles(20, 1.0, -0.5)
    assert rig.host.torque == pytest.approx((1.0, -0.5), abs=rig.resolution)
    assert rig.motors[0].counts > 0 > rig.motors[1].counts


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)), min_size=2, max_size=30))
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_reported_torques_are_the_commanded_ones(protocol: str, wanted: list[tuple[float, float]]) -> None:
    """Without lag and ramp, the torque commanded in a cycle is the mean reported in the next, to the bit."""
    rig = make_rig(protocol)
    rig.bring_up()
    heard = []
    for right, left in wanted:
        rig.cycle(right, left)
    for right, left in wanted:
        rig.cycle(right, left)
        heard.append(rig.host.torque)
    resolution = rig.resolution * 1.000001
    for before, (right, left) in zip(wanted, heard[1:], strict=False):
        assert abs(right - before[0]) <= resolution
        assert abs(left - before[1]) <= resolution
    assert rig.refused() == 0
    assert rig.host.refused.total() == 0


def test_reported_torque_is_the_mean_of_the_period(name: str) -> None:
    rig = make_rig(name, motor=motor_plan(lag=0.008, torque_slew=100.0))
    rig.bring_up()
    rig.cycles(3)
    for motor in rig.motors:
        assert motor.torque == 0.0
    means: list[float] = []
    for _ in range(6):
        start_ns = rig.time_ns
        rig.cycle(0.8, 0.8)
        if means:
            assert rig.host.torque[0] == pytest.approx(means[-1], abs=rig.resolution + 1e-4)
        step_ns = MS // 20
        torque = [rig.motors[0].torque for _ in instants(rig, start_ns, start_ns + PERIOD_NS, step_ns)]
        means.append((sum(torque) - (torque[0] + torque[-1]) / 2) * step_ns / PERIOD_NS)
    assert means == sorted(means)
    assert means[0] < 0.4 < means[-1]


def test_watchdog_trips_exactly_when_it_says(name: str) -> None:
    rig = enabled_rig(name)
    fed_ns = rig.commanded[-1][0]
    before = rig.torques()
    assert all(before)
    rig.advance(fed_ns + WATCHDOG_NS - 1)
    assert rig.torques() == before
    rig.advance(fed_ns + WATCHDOG_NS)
    assert rig.torques() == [0.0, 0.0]
    rig.time_ns = fed_ns + WATCHDOG_NS + PERIOD_NS
    rig.cycles(CYCLES, 0.5, -0.25)
    assert rig.torques() == [0.0, 0.0]
    assert not rig.host.enabled
    assert rig.host.fault


def test_watchdog_trips_at_its_time_even_if_time_is_asked_later(name: str) -> None:
    """Of two rigs only one is advanced every millisecond.  The wheels of both turn by the same angle."""
    one, other = (enabled_rig(name, watchdog_ns=73_456_789) for _ in range(2))
    end_ns = one.time_ns + 2 * WATCHDOG_NS
    for _ in instants(one, one.time_ns, end_ns):
        pass
    other.advance(end_ns)
    assert one.torques() == other.torques() == [0.0, 0.0]
    assert [motor.counts for motor in one.motors] == [motor.counts for motor in other.motors]
    assert one.motors[0].omega == pytest.approx(other.motors[0].omega, rel=1e-9)


def test_a_disabled_drive_needs_no_commands(rig: Rig) -> None:
    rig.cycles(3 * CYCLES, command=False)
    rig.host = rig.new_host()
    rig.bring_up()
    assert rig.host.fault == ""


@pytest.mark.parametrize("fault", LATCHING)
@pytest.mark.parametrize("wheel", WHEELS)
def test_a_fault_takes_the_torque_at_once_and_stays(name: str, fault: Fault, wheel: int) -> None:
    rig = enabled_rig(name)
    rig.inject(wheel, fault)
    assert rig.torques()[wheel] == 0.0
    for _ in range(NOTICE):
        rig.cycle(0.5, -0.25)
        assert rig.torques()[wheel] == 0.0
    assert rig.host.fault
    assert not rig.host.enabled
    assert rig.torques() == [0.0, 0.0]  # the host takes it from the other wheel too
    rig.mend(wheel, fault)
    rig.cycles(CYCLES, 0.5, -0.25)
    assert rig.torques() == [0.0, 0.0]
    assert rig.host.fault
    assert not rig.host.enabled


@pytest.mark.parametrize("fault", LATCHING)
def test_recovery_after_its_time_and_first_with_zero(name: str, fault: Fault) -> None:
    recover_ns = 300 * MS
    rig = enabled_rig(name, recover_ns=recover_ns)
    end_ns = rig.time_ns + recover_ns
    rig.inject(0, fault)
    for _ in range(NOTICE):
        rig.cycle(0.5, -0.25)
        assert rig.torques()[0] == 0.0
    rig.mend(0, fault)
    refused = rig.refused()
    while rig.time_ns < end_ns:
        rig.cycle(0.5, -0.25)
        assert rig.torques() == [0.0, 0.0]
        assert not rig.host.enabled
    rig.cycles(CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)
    assert rig.refused() == refused  # no torque was refused: the first one was zero


def test_a_fault_whose_cause_persists_cannot_be_cleared(name: str) -> None:
    rig = enabled_rig(name, recover_ns=50 * MS)
    rig.inject(1, Fault.OVER_TEMPERATURE)
    for _ in range(2 * CYCLES):
        rig.cycle(0.5, -0.25)
        assert rig.torques()[1] == 0.0
    assert rig.host.fault
    rig.mend(1, Fault.OVER_TEMPERATURE)
    rig.cycles(2 * CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)


def test_of_two_causes_both_must_go(name: str) -> None:
    rig = enabled_rig(name, recover_ns=50 * MS)
    rig.inject(0, Fault.ENCODER_LOSS)
    rig.cycle()
    rig.inject(0, Fault.BROWN_OUT)
    rig.mend(0, Fault.ENCODER_LOSS)
    rig.cycles(CYCLES, 0.5, 0.5)
    assert rig.torques()[0] == 0.0
    assert not rig.host.enabled
    rig.mend(0, Fault.BROWN_OUT)
    rig.cycles(CYCLES, 0.5, 0.5)
    assert rig.host.enabled


def test_after_a_fault_the_first_torque_must_be_zero(name: str) -> None:
    """A drive whose fault was cleared refuses torques of a host that does not know of the fault."""
    rig = enabled_rig(name)
    rig.cycle(0.5, -0.25)
    torque_frames = [frame for time_ns, frame in rig.commanded if time_ns == rig.time_ns - PERIOD_NS]
    rig.inject(0, Fault.BROWN_OUT)
    rig.mend(0, Fault.BROWN_OUT)
    refused = rig.refused()
    for _ in range(3):
        rig.to_drives(rig.time_ns, torque_frames)
        rig.advance(rig.time_ns)
        assert rig.torques()[0] == 0.0
        rig.time_ns += PERIOD_NS
    assert rig.refused() > refused


def test_before_the_run_drives_are_brought_up_from_whatever_fault_they_are_in(name: str) -> None:
    """Faults may be left over from an earlier run or happen during the bring-up; both are cleared."""
    rig = make_rig(name, recover_ns=None)
    rig.time_ns = -4 * CYCLES * PERIOD_NS
    rig.bring_up()
    rig.deaf = True
    rig.cycles(WATCHDOG_NS // PERIOD_NS + NOTICE)
    assert rig.host.fault
    rig.deaf = False
    while rig.time_ns < 0:
        rig.cycle()
        assert rig.torques() == [0.0, 0.0]
    assert (rig.host.enabled, rig.host.fault) == (True, "")


def test_watchdog_fault_recovers_too(name: str) -> None:
    rig = enabled_rig(name, recover_ns=100 * MS)
    rig.deaf = True
    rig.cycles(WATCHDOG_NS // PERIOD_NS + NOTICE, 0.5, -0.25)
    assert rig.torques() == [0.0, 0.0]
    assert rig.host.fault
    rig.deaf = False
    rig.cycles(CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.host.fault == ""
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)


@pytest.mark.parametrize("wheel", WHEELS)
def test_a_silent_drive(name: str, wheel: int) -> None:
    rig = enabled_rig(name, recover_ns=100 * MS)
    rig.inject(wheel, Fault.SILENT)
    drive = rig.drive_of(wheel)
    assert [motor.torque for motor in drive.motors] == [0.0] * len(drive.motors)
    for _ in range(CYCLES):
        frames = drive.advance(rig.time_ns)
        for frame in rig.host.poll(rig.time_ns) + rig.host.command(rig.time_ns, 0.5, 0.5):
            if frame.can_id in drive.identifiers:
                frames += drive.receive(rig.time_ns, frame)
        assert frames == []
        assert [motor.torque for motor in drive.motors] == [0.0] * len(drive.motors)
        rig.time_ns += PERIOD_NS
    rig.mend(wheel, Fault.SILENT)
    assert [motor.torque for motor in drive.motors] == [0.0] * len(drive.motors)
    rig.cycles(2 * CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)


def test_the_host_notices_silence_in_the_watchdogs_time(name: str) -> None:
    rig = enabled_rig(name)
    rig.cycle(0.5, -0.25)
    last_ns = rig.time_ns - PERIOD_NS
    rig.inject(0, Fault.SILENT)
    while not rig.host.fault:
        rig.cycle(0.5, -0.25)
        assert rig.time_ns < last_ns + 2 * WATCHDOG_NS
    assert last_ns + WATCHDOG_NS <= rig.time_ns - PERIOD_NS <= last_ns + WATCHDOG_NS + PERIOD_NS
    assert "silent" in rig.host.fault
    rig.mend(0, Fault.SILENT)
    rig.cycles(CYCLES, 0.5, -0.25)
    assert not rig.host.enabled  # it stays stopped without recovery
    assert rig.torques() == [0.0, 0.0]


def test_a_cause_survives_power_on(name: str) -> None:
    rig = enabled_rig(name, recover_ns=50 * MS)
    rig.inject(0, Fault.ENCODER_LOSS)
    rig.inject(0, Fault.SILENT)
    rig.cycles(CYCLES)
    rig.mend(0, Fault.SILENT)
    for _ in range(CYCLES):
        rig.cycle(0.5, 0.5)
        assert rig.torques()[0] == 0.0
    assert not rig.host.enabled
    rig.mend(0, Fault.ENCODER_LOSS)
    rig.cycles(CYCLES, 0.5, 0.5)
    assert rig.host.enabled


def test_stuck_torque_stays_whatever_is_commanded(name: str) -> None:
    rig = enabled_rig(name)
    rig.inject(0, Fault.STUCK_TORQUE)
    stuck = rig.torques()[0]
    rig.cycles(5, -1.0, -1.0)
    assert rig.torques()[0] == stuck
    assert rig.host.torque == pytest.approx((0.5, -1.0), abs=rig.resolution)
    rig.to_drives(rig.time_ns, rig.host.stop(rig.time_ns))
    rig.cycles(5, -1.0, -1.0)
    assert rig.torques() == [stuck, 0.0]
    rig.mend(0, Fault.STUCK_TORQUE)
    assert rig.torques() == [0.0, 0.0]


@pytest.mark.parametrize("how", ["stop", "estop"])
@pytest.mark.parametrize("faulty", [False, True])
def test_stop_takes_the_torque_and_start_gives_it_back(name: str, how: str, faulty: bool) -> None:
    """`start` also clears an old fault, although faults are never cleared automatically in this test."""
    rig = enabled_rig(name)
    if faulty:
        rig.inject(0, Fault.ENCODER_LOSS)
        rig.cycles(5, 0.5, -0.25)
        rig.mend(0, Fault.ENCODER_LOSS)
        rig.cycles(CYCLES, 0.5, -0.25)
        assert rig.host.fault != ""
    rig.to_drives(rig.time_ns, rig.host.stop(rig.time_ns) if how == "stop" else rig.host.estop(rig.time_ns))
    assert rig.torques() == [0.0, 0.0]
    assert not rig.host.enabled
    for _ in range(CYCLES):
        rig.cycle(0.5, -0.25)
        assert rig.torques() == [0.0, 0.0]
        assert not rig.host.enabled
    if not faulty and how == "stop":
        assert rig.host.fault == ""
    rig.host.start()
    refused = rig.refused()
    for _ in range(2 * CYCLES):
        rig.cycle(0.5, -0.25)
    assert rig.host.enabled
    assert rig.host.fault == ""
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)
    assert rig.refused() == refused
    rig.inject(1, Fault.ENCODER_LOSS)
    rig.cycle(0.5, -0.25)
    rig.mend(1, Fault.ENCODER_LOSS)
    rig.cycles(2 * CYCLES, 0.5, -0.25)
    assert rig.host.fault != ""  # what goes wrong later stays
    assert not rig.host.enabled


def test_an_estop_that_was_lost_is_repeated(name: str) -> None:
    """The emergency stop itself is repeated: no other frame of the host gets through in this test."""
    rig = enabled_rig(name)
    estops = {frame[:2] for frame in rig.host.estop(rig.time_ns)}
    repeated = []
    for _ in range(CYCLES):
        rig.advance(rig.time_ns)
        rig.to_drives(rig.time_ns, rig.beginning())
        frames = [*rig.host.poll(rig.time_ns), *rig.host.command(rig.time_ns, 0.5, 0.5)]
        repeated += [frame for frame in frames if PROTOCOLS[name](frame)]
        rig.to_drives(rig.time_ns, [frame for frame in frames if PROTOCOLS[name](frame)])
        rig.time_ns += rig.plan.period_ns
    assert estops
    assert repeated
    assert rig.torques() == [0.0, 0.0]


def test_a_quick_stop_is_left_to_the_drive() -> None:
    """The host sends no other controlword while the drive makes its configured quick stop."""
    rig = enabled_rig("cia402")
    rig.to_drives(rig.time_ns, rig.host.estop(rig.time_ns))
    rig.deaf = True  # and the drives are slow to say that they stopped
    rig.commanded.clear()
    rig.cycles(CYCLES, 0.5, 0.5)
    words = [frame.data[:2] for _, frame in rig.commanded if frame.can_id & 0x780 == 0x200]
    assert set(words) <= {b"\x02\x00", b"\x00\x00"}
    assert b"\x00\x00" not in words[:2]


@pytest.mark.parametrize("cycles", [0, 1, 2, 3])
def test_an_estop_that_is_over_at_once(name: str, cycles: int) -> None:
    """The host learns of the fault by the emergency stop only after `start`."""
    rig = enabled_rig(name)
    rig.to_drives(rig.time_ns, rig.host.estop(rig.time_ns))
    assert rig.torques() == [0.0, 0.0]
    rig.cycles(cycles, 0.5, -0.25)
    rig.host.start()
    rig.cycles(2 * CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)


def test_a_host_that_begins_anew(name: str) -> None:
    """The drives were enabled, and their watchdog has stopped them since the old host was gone."""
    rig = enabled_rig(name, recover_ns=100 * MS)
    rig.cycles(20, command=False)
    assert rig.torques() == [0.0, 0.0]
    rig.host = rig.new_host()
    rig.cycles(2 * CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)


def test_a_host_that_begins_anew_while_drives_are_enabled(name: str) -> None:
    """The new host gets both wheels enabled, with or without a fault in between, and never a torque that it did not command."""
    rig = enabled_rig(name, recover_ns=100 * MS)
    rig.host = rig.new_host()
    rig.cycle()
    rig.cycle()
    assert rig.torques() == [0.0, 0.0]
    rig.cycles(2 * CYCLES, 0.5, -0.25)
    assert rig.host.enabled
    assert rig.torques() == pytest.approx([0.5, -0.25], abs=rig.resolution)


@pytest.mark.parametrize("bad", [float("nan"), inf, -inf])
def test_torque_that_is_not_finite_is_the_callers_mistake(name: str, bad: float) -> None:
    rig = make_rig(name)
    with pytest.raises(ValueError, match="finite"):
        rig.host.command(0, bad, 0.0)
    rig.bring_up()
    with pytest.raises(ValueError, match="finite"):
        rig.host.command(rig.time_ns, 0.0, bad)


@pytest.mark.parametrize("fault", [Fault.WATCHDOG, Fault.ESTOP])
def test_faults_that_nobody_can_make_happen(rig: Rig, fault: Fault) -> None:
    with pytest.raises(ValueError, match=fault):
        rig.inject(0, fault)
    with pytest.raises(ValueError, match="wheel"):
        rig.drives[0].inject(0, 2, Fault.SILENT)


def test_torque_is_limited_to_the_motors(name: str) -> None:
    rig = make_rig(name, motor=motor_plan(torque_limit=0.75))
    rig.bring_up()
    rig.cycles(3, 1.4, -1.4)
    assert rig.torques() == pytest.approx([0.75, -0.75], abs=rig.resolution)


def test_heat_is_a_fault_of_its_own(name: str) -> None:
    hot = motor_plan(thermal_time=1.0, thermal_resistance=10.0, derating_from=60.0, temperature_limit=60.0)
    rig = enabled_rig(name, 1.0, 0.0, motor=hot)
    for _ in range(200):
        rig.cycle(1.0, 0.0)
        if rig.host.fault:
            break
    assert rig.host.fault
    assert rig.torques()[0] == 0.0
    assert rig.motors[0].temperature == pytest.approx(60.0, abs=2.0)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 45_000), min_size=1, max_size=30))
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_what_is_sent_does_not_depend_on_when_time_is_asked(protocol: str, steps_us: list[int]) -> None:
    """A drive sends the same frames in the same order, at their times, whether time passes in steps or at once."""
    plan = drive_plan(protocol)
    one, other = make_drives(plan)[0], make_drives(plan)[0]
    time_ns = -77 * MS
    frames = one.advance(time_ns)
    others = other.advance(time_ns)
    for step_us in steps_us:
        due_ns = one.due_ns
        time_ns += step_us * 1000
        found = one.advance(time_ns)
        assert not found or due_ns <= time_ns
        frames += found
    others += other.advance(time_ns)
    assert frames == others
    assert one.due_ns == other.due_ns > time_ns


@pytest.mark.parametrize("fault", ON_DEMAND)
def test_faults_may_come_and_go_before_time_is_asked(name: str, fault: Fault) -> None:
    """Frames that were due before are not lost, and time does not run backwards in the drive."""
    rig = enabled_rig(name)
    later_ns = rig.time_ns + 2 * WATCHDOG_NS + 3 * MS
    drive = rig.drives[0]
    seen = len(rig.sent)
    rig._from_drive(later_ns, drive.inject(later_ns, 0, fault))
    drive.mend(later_ns + 4 * PERIOD_NS, 0, fault)
    rig._from_drive(later_ns + 4 * PERIOD_NS, drive.advance(later_ns + 4 * PERIOD_NS))
    assert len(rig.sent) > seen
    assert rig.torques()[0] == 0.0


def test_time_must_not_run_backwards(rig: Rig) -> None:
    rig.bring_up()
    with pytest.raises(ValueError, match="backwards"):
        rig.drives[0].advance(rig.time_ns - 2 * PERIOD_NS)
