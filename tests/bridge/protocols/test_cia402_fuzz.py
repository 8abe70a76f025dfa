"""A hundred thousand random frames: none raises, none gives torque without enabling, and every refused frame is counted."""

import struct
from random import Random

import pytest

from echelon.bridge.protocols.cia402.codec import Nmt, State
from echelon.bridge.protocols.cia402.drive import Cia402Drive
from echelon.bridge.protocols.cia402.host import Cia402Host
from echelon.bridge.protocols.faults import ON_DEMAND
from echelon.bridge.protocols.frame import Frame
from support.bench_drives import MS
from support.cia402_rig import Rig, plan_of

FRAMES = 120_000
NODE = 5


def good_frame(random: Random) -> Frame:
    """Returns a frame that a host may send."""
    match random.randrange(8):
        case 0:
            return Frame(0, bytes((random.choice((1, 1, 1, 2, 128, 129, 130)), random.choice((0, NODE)))))
        case 1:
            return Frame(0x080)
        case 2:
            return Frame(0x77F, b"\x05")
        case 3:
            index = random.choice(
                (0x1016, 0x1017, 0x1400, 0x1401, 0x1600, 0x1601, 0x1800, 0x1A00, 0x6040, 0x6071, 0x6007)
            )
            command = random.choice((0x2F, 0x2B, 0x23, 0x40, 0x21, 0x20))
            return Frame(
                0x605, struct.pack("<BHBI", command, index, random.randrange(4), random.choice((0, 1, 15, 200)))
            )
        case 4:
            return Frame(0x605, bytes((random.choice((0x00, 0x10, 0x60, 0x70, 0x01, 0x80)),)) + random.randbytes(7))
        case 5 | 6:
            word = random.choice((0, 2, 6, 7, 15, 15, 0x80))
            return Frame(0x205, struct.pack("<Hb", word, random.choice((10, 10, 4, 0))))
        case _:
            return Frame(0x305, struct.pack("<h", random.choice((0, 0, 500, -32768, 32767))))


def mutated(random: Random, frame: Frame) -> Frame:
    """Returns the frame, or one with another length, identifier or kind, or with a flipped bit."""
    can_id, data, remote = frame
    match random.randrange(8):
        case 0:
            data = random.randbytes(random.randrange(9))
        case 1 if data:
            bit = random.randrange(8 * len(data))
            data = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(len(data), "little")
        case 2:
            can_id = random.randrange(0x800)
        case 3:
            remote = True
    return Frame(can_id, data, remote)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_drive(seed: int) -> None:
    random = Random(seed)
    drive = Cia402Drive(plan_of(), 0)
    motor = drive.motor
    enabled = moved = time_ns = 0
    for number in range(FRAMES // 2):
        time_ns += random.randrange(3 * MS)
        drive.advance(time_ns)
        # enables the drive now and then, which a random sequence rarely does
        frames = [mutated(random, good_frame(random))]
        if number % 50 == 0:
            way = [Frame(0x205, struct.pack("<Hb", word, 10)) for word in (0, 0x80, 6, 7, 15)]
            ways = [Frame(0, bytes((1, NODE))), *way, Frame(0x305, b"\0\0"), Frame(0x305, b"\1\0")]
            frames = [*ways, *frames]
        for frame in frames:
            refused, booting = drive.refused.total(), drive.nmt is Nmt.BOOT_UP
            drive.receive(time_ns, frame)
            if frame.remote or frame.can_id not in drive.identifiers:
                assert drive.refused.total() >= refused
            if booting:  # it hears nothing
                assert drive.refused.total() == refused
            elif frame.remote:
                assert drive.refused.total() == refused + 1
            assert drive.state is State.OPERATION_ENABLED or motor.torque == 0.0
            enabled += drive.state is State.OPERATION_ENABLED
            moved += motor.torque != 0.0
        if number % 500 == 0:
            fault = random.choice([fault for fault in ON_DEMAND if fault != "stuck_torque"])
            drive.inject(time_ns, 0, fault)
            assert motor.torque == 0.0
            drive.mend(time_ns, 0, fault)
        if number % 5000 == 0:  # a new drive, since random writes have changed its objects
            drive = Cia402Drive(plan_of(), 0)
            motor = drive.motor
    assert enabled > 500
    assert moved > 100
    assert set(drive.refused) >= {"remote frame", "length", "identifier"}


def test_frames_that_a_drive_cannot_take_are_all_counted() -> None:
    random = Random(3)
    drive = Cia402Drive(plan_of(), 0)
    drive.advance(0)
    drive.receive(0, Frame(0, bytes((1, NODE))))
    sizes = {0x205: 3, 0x305: 2, 0x605: 8, 0x000: 2, 0x77F: 1}
    for number in range(10_000):
        can_id = random.choice(list(sizes))
        length = random.choice([length for length in range(9) if length != sizes[can_id]])
        drive.receive(0, Frame(can_id, random.randbytes(length)))
        assert drive.refused.total() == number + 1
    assert drive.motor.torque == 0.0


@pytest.mark.parametrize("recover_ns", [None, 20 * MS])
def test_a_host(recover_ns: int | None) -> None:
    random = Random(4)
    rig = Rig(plan_of(recover_ns=recover_ns)).bring_up()
    host: Cia402Host = rig.host
    identifiers = sorted(host.identifiers)
    lengths = {0x080: 8, 0x180: 3, 0x280: 6, 0x380: 4, 0x580: 8, 0x700: 1}
    states = (0x40, 0x21, 0x23, 0x27, 0x08)
    time_ns = rig.time_ns
    enabled = 0
    for number in range(FRAMES // 2):
        can_id = random.choice(identifiers) if random.random() < 0.95 else random.randrange(0x800)
        length = lengths.get(can_id & 0x780, 8) if random.random() < 0.9 else random.randrange(9)
        data = random.randbytes(length)
        if can_id & 0x780 == 0x180 and length == 3:
            data = bytes((random.choice(states), data[1], 10))
        if can_id & 0x780 == 0x700 and length:
            data = bytes((random.choice((0, 4, 5, 5, 5, 127)),)) + data[1:]
        remote = random.random() < 0.02
        refused = host.refused.total()
        host.receive(time_ns, Frame(can_id, data, remote))
        if remote or can_id not in host.identifiers or length != lengths[can_id & 0x780]:
            assert host.refused.total() == refused + 1
        if number % 4 == 0:
            time_ns += random.randrange(20 * MS)
            host.poll(time_ns)
            ready = host.enabled
            enabled += ready
            for frame in host.command(time_ns, 0.5, -0.5):
                assert ready or frame.data == b"\0\0"
        assert isinstance(host.fault, str)
    assert (enabled > 0) == (recover_ns is not None) or enabled < 5


def test_segments_in_wrong_order_write_nothing() -> None:
    random = Random(5)
    drive = Cia402Drive(plan_of(), 0)
    drive.advance(0)
    before = dict(drive._od._values)
    for _ in range(20_000):
        command = random.choice((0x00, 0x10, 0x01, 0x11, 0x0E, 0x60, 0x70, 0x80, 0x40, 0x20, 0x21, 0xA0, 0xC0, 0xE0))
        key = random.choice((0x1008, 0x1000, 0x1018))  # read-only objects
        drive.receive(0, Frame(0x605, struct.pack("<BHBI", command, key, random.randrange(3), random.randrange(20))))
    assert drive._od._values == before
    assert drive.refused.total() > 5_000
