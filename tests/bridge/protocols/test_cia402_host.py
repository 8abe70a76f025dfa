"""The host of CiA 402 drives, and the master of their bus."""

import struct
from dataclasses import replace
from math import nan
from random import Random
from typing import Any

import pytest

from echelon.bridge.protocols.cia402.host import Cia402Host, Master
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from support.bench_drives import MS, motor_plan
from support.cia402_rig import PERIOD_NS, Rig, plan_of


def test_bring_up_needs_few_cycles_and_gives_what_is_commanded() -> None:
    rig = Rig(plan_of())
    start_ns = rig.time_ns
    rig.bring_up()
    assert (rig.time_ns - start_ns) // PERIOD_NS < 50
    rig.cycles(3, 0.5, -0.25)
    assert rig.torques == pytest.approx((0.5, -0.25))
    assert rig.host.torque == pytest.approx((0.5, -0.25))
    assert rig.host.torque_ns == rig.time_ns - PERIOD_NS
    assert not rig.host.refused
    assert not any(drive.refused for drive in rig.drives)


def test_torque_is_the_mean_of_the_period_that_ends() -> None:
    rig = Rig(plan_of(motor=motor_plan(rated_torque=0.37))).bring_up()
    rig.cycle()
    wanted = [0.1 * step for step in range(10)]
    for step, torque in enumerate(wanted):
        rig.cycle(torque, -torque)
        if step:
            assert rig.host.torque == pytest.approx((wanted[step - 1], -wanted[step - 1]), abs=0.37e-3)


def test_what_drives_are_told() -> None:
    """The objects of the drives after bring-up do not depend on their values before."""
    rig = Rig(plan_of(watchdog_ns=50 * MS))
    right = rig.drives[0]
    right.advance(rig.time_ns)

    def write(index: int, sub: int, value: int, size: int) -> None:
        head = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        right.receive(rig.time_ns, Frame(0x605, head + value.to_bytes(size, "little") + bytes(4 - size)))

    for index, cob_id in ((0x1400, 0x333), (0x1401, 0x334), (0x1800, 0x335), (0x1801, 0x336)):
        write(index, 1, 0x80000000, 4)
        write(index + 0x200, 0, 0, 1)
        write(index, 1, cob_id, 4)
        write(index, 2, 100, 1)
    write(0x6007, 0, 0, 2)
    write(0x1017, 0, 0, 2)
    assert not right.refused
    rig.bring_up()
    for drive, node in zip(rig.drives, (5, 6), strict=True):
        od = drive._od
        assert od[0x1016, 1] == 127 << 16 | 70  # watchdog and one heartbeat
        assert od[0x1017, 0] == 20
        assert od[0x1401, 5] == 50
        assert [od[0x1400 + n, 1] for n in (0, 1)] == [0x200 + node, 0x300 + node]
        assert [od[0x1800 + n, 1] & 0x7FF for n in range(3)] == [base + node for base in (0x180, 0x280, 0x380)]
        assert [od[0x1800 + n, 2] for n in range(3)] == [1, 1, 1]
        assert [od[0x1A01, sub] for sub in range(3)] == [2, 0x60640020, 0x60770010]
        assert (od[0x6007, 0], od[0x6060, 0]) == (1, 10)
    rig.cycles(3, 0.5, 0.5)
    assert rig.torques == pytest.approx((0.5, 0.5))


@pytest.mark.parametrize("seed", range(12))
def test_bring_up_survives_lost_frames(seed: int) -> None:
    """A third of all frames are lost, heartbeats and torques included; the watchdogs are long enough to bear it."""
    random = Random(seed)
    rig = Rig(plan_of(watchdog_ns=1000 * MS))
    rig.lose = lambda frame: random.random() < 0.33
    for _ in range(1500):
        rig.cycle(0.5, 0.5)
        if rig.host.enabled:
            break
    assert rig.host.enabled
    rig.lose = lambda frame: False
    rig.cycles(4, 0.5, -0.5)
    assert rig.torques == pytest.approx((0.5, -0.5))


def test_first_torque_after_enabling_is_zero() -> None:
    rig = Rig(plan_of())
    sent: list[tuple[bool, int]] = []
    rig.listen = lambda time_ns, frame: (
        sent.append((rig.host.enabled, struct.unpack("<h", frame.data)[0])) if frame.can_id == 0x305 else None
    )
    for _ in range(60):
        rig.cycle(0.5, 0.5)
    first = [enabled for enabled, _ in sent].index(True)
    assert all(value == 0 for _, value in sent[: first + 1])
    assert all(value == 500 for _, value in sent[first + 1 :])
    assert first > 0


def test_another_rated_torque_is_not_enabled() -> None:
    rig = Rig(plan_of())
    rig.host = Cia402Host(plan_of(motor=motor_plan(rated_torque=1.1)))
    rig.cycles(100, 0.5, 0.5)
    assert not rig.host.enabled
    assert rig.host.fault == "; ".join(
        f"{wheel}: SDO 6076:00 is 1000, but 1100 in the plan" for wheel in ("right", "left")
    )


def test_a_drive_that_refuses_is_a_fault_and_tried_again_after_its_time() -> None:
    rig = Rig(plan_of(recover_ns=300 * MS))
    rig.time_ns = 0  # before the run nothing waits
    rig.cycles(3)
    asked: list[int] = []
    rig.listen = lambda time_ns, frame: asked.append(time_ns) if frame.can_id == 0x605 else None
    rig.host.receive(rig.time_ns, Frame(0x585, bytes.fromhex("8017100002000106")))
    assert not rig.host.fault  # this answers no request
    frames = rig.host.poll(rig.time_ns)
    request = next(frame.data for frame in frames if frame.can_id == 0x605)
    rig.host.receive(rig.time_ns, Frame(0x585, b"\x80" + request[1:4] + bytes.fromhex("02000106")))
    assert "refused: read only" in rig.host.fault
    failed_ns = rig.time_ns
    rig.cycles(40)
    rig.bring_up()
    assert min(asked) >= failed_ns + 300 * MS


def test_silence_before_anything_is_no_fault() -> None:
    rig = Rig(plan_of())
    rig.lose = lambda frame: True
    rig.cycles(100, 0.5, 0.5)
    assert rig.host.fault == ""
    assert not rig.host.enabled
    rig.lose = lambda frame: False
    rig.bring_up()


def test_faults_in_words() -> None:
    rig = Rig(plan_of()).bring_up()
    rig.cycles(3, 0.5, 0.5)
    rig.to_host(rig.drives[1].inject(rig.time_ns, 1, Fault.BROWN_OUT))
    assert rig.host.fault == "left: 0x3220 undervoltage"
    assert not rig.host.enabled
    rig.cycle(0.5, 0.5)
    assert rig.torques == (0.0, 0.0)
    rig.to_host(rig.drives[0].inject(rig.time_ns, 0, Fault.ENCODER_LOSS))
    assert rig.host.fault == "right: 0x7305 encoder; left: 0x3220 undervoltage"
    for wheel, fault in ((0, Fault.ENCODER_LOSS), (1, Fault.BROWN_OUT)):
        rig.drives[wheel].mend(rig.time_ns, wheel, fault)
    rig.cycles(200, 0.5, 0.5)
    assert rig.torques == (0.0, 0.0)
    assert rig.host.fault  # without a recovery time in the plan the fault stays


def test_a_fault_without_emergency_message_is_one_too() -> None:
    rig = Rig(plan_of()).bring_up()
    rig.lose = lambda frame: frame.can_id == 0x085
    rig.to_host(rig.drives[0].inject(rig.time_ns, 0, Fault.OVER_TEMPERATURE))
    assert rig.host.fault == ""
    rig.cycle(0.5, 0.5)
    assert rig.host.fault == "right: fault"
    assert rig.torques == (0.0, 0.0)


def test_recovery_after_its_time() -> None:
    rig = Rig(plan_of(recover_ns=200 * MS)).bring_up()
    rig.cycles(3, 0.5, 0.5)
    rig.to_host(rig.drives[0].inject(rig.time_ns, 0, Fault.ENCODER_LOSS))
    failed_ns = rig.time_ns
    rig.drives[0].mend(rig.time_ns, 0, Fault.ENCODER_LOSS)
    while not rig.host.enabled:
        assert rig.torques == (0.0, 0.0) or rig.time_ns == failed_ns
        rig.cycle(0.5, 0.5)
    assert failed_ns + 200 * MS < rig.time_ns < failed_ns + 300 * MS
    rig.cycles(3, 0.5, 0.5)
    assert rig.torques == pytest.approx((0.5, 0.5))
    assert not rig.drives[0].refused


def test_a_drive_that_restarts_is_brought_up_anew() -> None:
    rig = Rig(plan_of(recover_ns=50 * MS)).bring_up()
    rig.to_drives([Frame(0, b"\x81\x05")])
    rig.cycles(2)
    assert rig.host.fault == "right: restarted"
    rig.cycles(60, 0.5, 0.5)
    assert rig.host.enabled
    assert rig.torques == pytest.approx((0.5, 0.5))
    rig = Rig(plan_of()).bring_up()
    rig.to_drives([Frame(0, b"\x81\x05")])
    rig.cycles(100, 0.5, 0.5)
    assert rig.torques == (0.0, 0.0)


def test_a_drive_that_somebody_else_disables_is_a_fault() -> None:
    rig = Rig(plan_of()).bring_up()
    rig.to_drives([Frame(0x206, struct.pack("<Hb", 6, 10))])
    rig.cycles(2, 0.5, 0.5)
    assert rig.host.fault == "left: left OPERATION ENABLED for READY TO SWITCH ON"


def test_a_drive_that_somebody_else_makes_rest() -> None:
    rig = Rig(plan_of()).bring_up()
    rig.to_drives([Frame(0, b"\x80\x06")])
    while rig.host.enabled:
        rig.cycle(0.5, 0.5)  # until its next heartbeat
    assert rig.torques[1] == 0.0
    rig.cycles(3, 0.5, 0.5)
    assert rig.host.fault == "left: left OPERATION ENABLED for SWITCH ON DISABLED"
    assert rig.torques == (0.0, 0.0)


def test_a_controlword_that_was_lost_is_sent_again() -> None:
    rig = Rig(plan_of())
    lost: list[Frame] = []

    def lose(frame: Frame) -> bool:
        if frame.can_id == 0x205 and len(lost) < 3:
            lost.append(frame)
            return True
        return False

    rig.lose = lose
    rig.cycles(80)
    assert rig.host.enabled
    assert len(lost) == 3


def test_no_drive_is_enabled_in_another_mode() -> None:
    rig = Rig(plan_of())
    words: list[int] = []
    rig.listen = lambda time_ns, frame: words.append(frame.data[0]) if frame.can_id == 0x205 else None
    rig.lose = lambda frame: frame.can_id in (0x185, 0x205)  # the test sends the right drive's frames itself
    rig.cycles(42)
    for word, mode, cycles in ((0x40, 4, 1), (0x21, 4, 1), (0x23, 4, 20), (0x23, 10, 1)):
        rig.host.receive(rig.time_ns, Frame(0x185, struct.pack("<Hb", word, mode)))
        rig.cycles(cycles)
    assert words == [6, 7, *[7] * 4, 15]  # again after each five periods
    rig.host.receive(rig.time_ns, Frame(0x185, struct.pack("<Hb", 0x27, 4)))
    assert not rig.host.enabled
    rig.host.receive(rig.time_ns, Frame(0x185, struct.pack("<Hb", 0x27, 10)))
    assert rig.host.enabled


def test_stop_and_start() -> None:
    rig = Rig(plan_of()).bring_up()
    rig.cycles(3, 0.5, 0.5)
    words: list[int] = []
    rig.listen = lambda time_ns, frame: words.append(frame.data[0]) if frame.can_id == 0x205 else None
    rig.to_drives(rig.host.stop(rig.time_ns))
    assert rig.torques == (0.0, 0.0)
    rig.cycles(50, 0.5, 0.5)
    assert rig.host.fault == ""
    assert not rig.host.enabled
    assert words == [0]  # once is enough, since the drive says it heard it
    rig.host.start()
    rig.bring_up()
    assert words == [0, 6, 7, 15]
    rig.lose = lambda frame: frame.can_id == 0x205
    rig.to_drives(rig.host.stop(rig.time_ns))
    rig.cycles(3)
    rig.lose = lambda frame: False
    rig.cycles(10)
    assert {drive.state.words for drive in rig.drives} == {"SWITCH ON DISABLED"}


def test_stop_before_bring_up() -> None:
    rig = Rig(plan_of())
    assert rig.host.stop(rig.time_ns) == []
    rig.cycles(100, 0.5, 0.5)
    assert {drive.state.words for drive in rig.drives} == {"SWITCH ON DISABLED"}
    rig.host.start()
    rig.bring_up()


def test_frames_that_are_none() -> None:
    rig = Rig(plan_of()).bring_up()
    bad = {
        "identifier": [Frame(0x187, bytes(3))],
        "remote frame": [Frame(0x185, b"", True)],
        "length": [Frame(base + 5, bytes(2)) for base in (0x080, 0x180, 0x280, 0x380)],
        "heartbeat": [Frame(0x705, b"\x03"), Frame(0x705), Frame(0x705, b"\x05\x05")],
        "statusword": [Frame(0x185, b"\x01\0\x0a")],
        "SDO answer": [Frame(0x585, bytes(8)), Frame(0x585, b"")],
    }
    before = rig.host.torque, rig.host.torque_ns
    for frames in bad.values():
        for frame in frames:
            rig.host.receive(rig.time_ns, frame)
    assert rig.host.refused == {reason: len(frames) for reason, frames in bad.items()}
    assert rig.host.enabled
    assert (rig.host.torque, rig.host.torque_ns) == before


def test_callers_mistakes() -> None:
    with pytest.raises(ValueError, match="twice 5"):
        Cia402Host(replace(plan_of(), node_ids=(5, 5)))
    with pytest.raises(ValueError, match="node id"):
        Cia402Host(replace(plan_of(), node_ids=(5, 127)))
    with pytest.raises(ValueError, match="finite"):
        Cia402Host(plan_of()).command(0, nan, 0.0)
    for bad in ((0, 1), (1, 0)):
        with pytest.raises(ValueError, match="positive"):
            Master(*bad)


@pytest.mark.parametrize(
    ("period_ms", "watchdog_ms", "every_ms"), [(10, 100, 40), (10, 50, 20), (10, 20, 10), (1, 100, 40), (30, 100, 30)]
)
def test_heartbeats_of_the_master(period_ms: int, watchdog_ms: int, every_ms: int) -> None:
    master = Master(period_ms * MS, watchdog_ms * MS)
    beats = [time_ms for time_ms in range(-90, 3000, period_ms) if master.poll(time_ms * MS) == [Frame(0x77F, b"\x05")]]
    assert beats == list(range(-90, 3000, every_ms))[: len(beats)]
    assert beats[-1] > 3000 - 2 * every_ms
    assert master.sync() == Frame(0x080)


def test_a_lost_host_is_noticed_by_its_torques_first_and_by_its_heartbeat_too() -> None:
    rig = Rig(plan_of()).bring_up()
    rig.cycles(3, 0.5, 0.5)
    last_ns = rig.time_ns - PERIOD_NS
    said: list[Any] = []
    for time_ns in range(last_ns, last_ns + 300 * MS, MS):
        said += [
            (time_ns - last_ns, frame.data[:2]) for frame in rig.drives[0].advance(time_ns) if frame.can_id == 0x085
        ]
    assert said[0] == (100 * MS, b"\x50\x82")
    assert said[1][1] == b"\x30\x81"
    assert 100 * MS <= said[1][0] <= 140 * MS
