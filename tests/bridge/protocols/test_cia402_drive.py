"""The virtual CiA 402 drive, frame by frame."""

import struct
from dataclasses import replace
from typing import Any

import pytest
from canopen.profiles.p402 import State402
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.cia402.drive import Cia402Drive
from echelon.bridge.protocols.cia402.node import BOOT_NS
from echelon.bridge.protocols.cia402.sdo import Abort, SdoClient
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Frame
from support.bench_drives import MS, motor_plan
from support.cia402_rig import plan_of

NODE = 5
BOOT_MS = BOOT_NS / MS
BIT = 1e-3  # N m: the rated torque is 1 N m
PATHS = {
    "SWITCH ON DISABLED": [],
    "READY TO SWITCH ON": [6],
    "SWITCHED ON": [6, 7],
    "OPERATION ENABLED": [6, 7, 15],
    "QUICK STOP ACTIVE": [6, 7, 15, 2],
    "FAULT": [6, 7],
}
SIZES = {0x6040: 2, 0x6060: 1, 0x6071: 2, 0x6072: 2, 0x605A: 2, 0x6007: 2, 0x1005: 4, 0x1016: 4, 0x1017: 2, 0x1029: 1}


class Client:
    """A drive with its own time; frames are sent to it one by one."""

    def __init__(self, **changes: Any) -> None:
        self.drive = Cia402Drive(plan_of(**changes), 0)
        self.motor = self.drive.motor
        self.time_ns = 0
        self.heard: list[Frame] = []
        self.sdo = SdoClient()
        self.wait(0)

    def wait(self, ms: float) -> list[Frame]:
        self.time_ns += round(ms * MS)
        frames = self.drive.advance(self.time_ns)
        self.heard += frames
        return frames

    def send(self, can_id: int, data: bytes = b"") -> list[Frame]:
        frames = self.drive.receive(self.time_ns, Frame(can_id, data))
        self.heard += frames
        return frames

    def _transfer(self, request: bytes | None) -> None:
        while request is not None:
            answers = [frame.data for frame in self.send(0x605, request) if frame.can_id == 0x585]
            assert len(answers) == 1
            request = self.sdo.receive(answers[0])

    def write(self, index: int, value: int, sub: int = 0, size: int | None = None) -> int | None:
        """Writes an object; returns the abort code."""
        size = size or SIZES.get(index) or (4 if 0x1600 <= index < 0x1800 or index >= 0x1A00 or sub == 1 else 1)
        self._transfer(self.sdo.download((index, sub), value.to_bytes(size, "little", signed=value < 0)))
        return self.sdo.abort

    def read(self, index: int, sub: int = 0, signed: bool = False) -> int:
        self._transfer(self.sdo.upload((index, sub)))
        assert self.sdo.abort is None
        return int.from_bytes(self.sdo.data, "little", signed=signed)

    def start(self) -> None:
        self.send(0, bytes((1, NODE)))

    def control(self, word: int, mode: int = 10) -> None:
        self.send(0x205, struct.pack("<Hb", word, mode))

    def target(self, value: int) -> None:
        self.send(0x305, struct.pack("<h", value))

    def enable(self) -> "Client":
        self.start()
        for word in (6, 7, 15):
            self.control(word)
        return self

    def sync(self) -> dict[int, bytes]:
        return {frame.can_id: frame.data for frame in self.send(0x080)}

    @property
    def state(self) -> str:
        word = self.read(0x6041)
        return next(name for name, (mask, bits) in State402.SW_MASK.items() if word & mask == bits)

    def emergencies(self) -> list[tuple[int, int]]:
        return [struct.unpack("<HB", frame.data[:3]) for frame in self.heard if frame.can_id == 0x085]


def test_boot_up_comes_first_and_then_heartbeats() -> None:
    client = Client()
    assert client.heard == [Frame(0x705, b"\0")]
    assert client.wait(250) == [Frame(0x705, b"\x7f")] * 2
    client.start()
    assert client.wait(50) == [Frame(0x705, b"\x05")]
    client.write(0x1017, 20)
    assert client.wait(100) == [Frame(0x705, b"\x05")] * 5
    client.write(0x1017, 0)
    assert client.wait(1000) == []
    assert client.drive.due_ns > 10**18


def test_torque_needs_the_whole_sequence() -> None:
    client = Client()
    for step in (lambda: None, client.start, *(lambda word=word: client.control(word) for word in (6, 7))):
        step()
        client.target(500)
        client.write(0x6071, 500)
        assert client.motor.torque == 0.0
    client.control(15)
    assert client.state == "OPERATION ENABLED"
    assert client.motor.torque == 0.0  # the target torque from before is forgotten
    client.target(500)
    assert client.motor.torque == pytest.approx(0.5)


@pytest.mark.parametrize("start", PATHS)
@pytest.mark.parametrize("word", [0x00, 0x02, 0x06, 0x07, 0x0F, 0x80])
def test_every_command_in_every_state(start: str, word: int) -> None:
    client = Client()
    client.write(0x605A, 6)
    for step in PATHS[start]:
        client.write(0x6040, step)
    if start == "FAULT":
        client.drive.inject(0, 0, Fault.ENCODER_LOSS)
        client.drive.mend(0, 0, Fault.ENCODER_LOSS)
    assert client.state == start
    client.write(0x6040, word)
    known = {command: after for (before, after), command in State402.TRANSITIONTABLE.items() if before == start}
    if start != "FAULT":
        known.setdefault(0x80, known.get(0x00, start))  # no bit of it but that of the reset is set
    if start in ("READY TO SWITCH ON", "SWITCHED ON"):
        known[0x02] = "SWITCH ON DISABLED"
    if start == "READY TO SWITCH ON":
        known[0x0F] = "OPERATION ENABLED"
    assert client.state == known.get(word, start)


@pytest.mark.parametrize("option", range(7))
def test_quick_stop(option: int) -> None:
    client = Client().enable()
    client.write(0x605A, option)
    client.target(700)
    client.control(2)
    assert client.motor.torque == 0.0
    assert client.state == ("QUICK STOP ACTIVE" if option >= 5 else "SWITCH ON DISABLED")
    client.target(700)
    assert client.motor.torque == 0.0
    client.wait(500)
    assert client.emergencies() == []


@pytest.mark.parametrize(("mode", "follows"), [(10, True), (4, True), (0, False)])
def test_modes(mode: int, follows: bool) -> None:
    client = Client()
    client.start()
    for word in (6, 7, 15):
        client.control(word, mode)
    client.target(-400)
    assert client.motor.torque == pytest.approx(-0.4 if follows else 0.0)
    assert client.read(0x6061) == mode
    assert bool(client.read(0x6041) & 1 << 12) == (mode == 10)
    client.control(15 | 1 << 8, mode)
    assert client.motor.torque == pytest.approx(-0.4 if mode == 10 else 0.0)  # only profile torque has the bit halt
    client.control(15, 10 - mode if mode else 10)
    assert client.motor.torque == 0.0  # another mode begins at zero


def test_other_modes_are_refused() -> None:
    client = Client().enable()
    client.target(100)
    client.control(0, 8)
    assert client.drive.refused == {"value": 1}
    assert client.motor.torque == pytest.approx(0.1)
    assert client.write(0x6060, 1) == Abort.VALUE
    assert client.read(0x6060) == 10


@given(st.integers(-32768, 32767), st.integers(0, 65535))
def test_max_torque_limits(target: int, most: int) -> None:
    client = Client().enable()
    assert client.read(0x6072) == 1500
    client.write(0x6072, most)
    client.target(target)
    wanted = max(-most, min(most, target)) * BIT
    assert client.motor.torque == pytest.approx(max(-1.5, min(1.5, wanted)))
    assert bool(client.read(0x6041) & 1 << 11) == (abs(target) > most or abs(wanted) > 1.5)
    assert client.read(0x6071, signed=True) == target


def test_tpdos_on_sync() -> None:
    client = Client()
    assert client.sync() == {}
    client.enable()
    client.target(250)
    client.wait(10)
    frames = client.sync()
    assert frames.keys() == {0x185, 0x285, 0x385}
    word, mode = struct.unpack("<Hb", frames[0x185])
    assert (word & 0x6F, mode) == (0x27, 10)
    position, torque = struct.unpack("<ih", frames[0x285])
    assert torque == 250
    counts = client.motor.plan.encoder_counts
    assert position == client.motor.counts >= 0
    client.wait(20)
    assert struct.unpack("<i", client.sync()[0x385])[0] == pytest.approx(client.motor.velocity * counts, abs=1)
    client.send(0x080, b"\x01")
    client.send(0x080, b"\x01\x02")
    assert client.drive.refused == {"length": 1}


def test_reported_torque_is_the_mean_since_the_last_sync() -> None:
    client = Client().enable()
    client.sync()
    client.target(1000)
    client.wait(4)
    client.target(0)
    client.wait(6)
    assert struct.unpack("<ih", client.sync()[0x285])[1] == 400
    assert struct.unpack("<ih", client.sync()[0x285])[1] == 400  # the mean over no time is the present torque
    client.target(-1000)
    client.wait(5)
    assert client.read(0x6077, signed=True) == -1000  # SDO reads the present torque and does not end the mean
    client.target(0)
    client.wait(5)
    assert struct.unpack("<ih", client.sync()[0x285])[1] == -500


@pytest.mark.parametrize("kind", [0, 1, 2, 3, 240])
def test_synchronous_transmission_types(kind: int) -> None:
    client = Client().enable()
    client.write(0x1800, kind, 2, 1)
    sent = []
    for number in range(480):
        if number == 6:
            client.control(7)
        client.target(0)
        client.wait(1)
        sent.append(0x185 in client.sync())
    wanted = [number in (0, 6) for number in range(480)] if kind == 0 else [not (n + 1) % kind for n in range(480)]
    assert sent == wanted


def test_tpdos_by_themselves() -> None:
    client = Client()
    client.write(0x1017, 0)
    for kind, inhibit, timer, number in ((254, 0, 0, 0), (255, 0, 7, 1), (255, 50, 0, 2)):
        assert client.write(0x1800 + number, kind, 2, 1) is None
        assert client.write(0x1800 + number, inhibit, 3, 2) is None
        assert client.write(0x1800 + number, timer, 5, 2) is None
    client.write(0x1A02, 0, 0, 1)
    assert client.sdo.abort == Abort.DEVICE_STATE
    client.write(0x1802, 0x80000385, 1)
    client.write(0x1A02, 0, 0, 1)
    client.write(0x1A02, 0x60410010, 1)
    client.write(0x1A02, 1, 0, 1)
    client.write(0x1802, 0x385, 1)
    assert client.sdo.abort is None
    client.heard.clear()
    client.start()
    assert [frame.can_id for frame in client.heard] == [0x185, 0x285, 0x385]  # once at the start
    client.control(6)
    client.wait(1)
    assert [frame.can_id for frame in client.heard[3:]] == [0x185]  # the third one must wait
    client.control(7)
    assert [frame.can_id for frame in client.wait(3.99)] == []
    assert [(frame.can_id, frame.data[0] & 0x6F) for frame in client.wait(0.01)] == [(0x385, 0x23)]
    assert [frame.can_id for frame in client.wait(30)] == [0x285] * 5  # at 7, 14, 21, 28, 35 ms
    assert client.sync() == {}


def test_a_synchronous_rpdo_waits_for_sync() -> None:
    client = Client().enable()
    client.write(0x1401, 1, 2, 1)
    client.target(300)
    assert client.motor.torque == 0.0
    client.target(600)
    client.sync()
    assert client.motor.torque == pytest.approx(0.6)
    client.target(900)
    client.control(7)
    client.control(15)
    client.sync()
    assert client.motor.torque == 0.0  # enabling operation drops an RPDO that waited for SYNC


def test_mapping_of_ones_own() -> None:
    client = Client()
    assert client.write(0x1400, 0x80000205, 1) is None
    assert client.write(0x1600, 0, 0, 1) is None
    for sub, entry in enumerate((0x60710010, 0x60400010, 0x60600008), 1):
        assert client.write(0x1600, entry, sub) is None
    assert client.write(0x1600, 3, 0, 1) is None
    assert client.write(0x1400, 0x222, 1) is None
    assert {0x222, 0x205, 0x305} <= client.drive.identifiers
    client.start()
    client.send(0x205, bytes(3))
    assert client.drive.refused == {"PDO not valid": 1}
    for word in (6, 7, 15, 15):
        client.send(0x222, struct.pack("<hHb", 123, word, 10))
    assert client.motor.torque == pytest.approx(0.123)
    client.write(0x1400, 100, 5, 2)
    client.wait(99)
    client.send(0x222, struct.pack("<hHb", 123, 15, 10))
    client.wait(99)
    assert client.motor.torque == pytest.approx(0.123)


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x1400, 1, 0x222, 4, Abort.DEVICE_STATE),  # a valid PDO must be made invalid first
        (0x1400, 1, 0x80000000 | 0x585, 4, Abort.VALUE),
        (0x1402, 1, 0x80000000 | 0x800, 4, Abort.VALUE),
        (0x1402, 1, 0x000, 4, Abort.VALUE),
        (0x1800, 2, 241, 1, Abort.VALUE),
        (0x1800, 2, 253, 1, Abort.VALUE),
        (0x1600, 0, 0, 1, Abort.DEVICE_STATE),
        (0x1603, 1, 0x60410010, 4, Abort.NOT_MAPPABLE),  # the statusword is read-only
        (0x1A03, 1, 0x10000020, 4, Abort.NOT_MAPPABLE),
        (0x1A03, 1, 0x60410008, 4, Abort.NOT_MAPPABLE),
        (0x1A03, 1, 0x12345678, 4, Abort.NOT_MAPPABLE),
        (0x1A03, 0, 1, 1, Abort.NOT_MAPPABLE),  # nothing is there
        (0x1A03, 0, 9, 1, Abort.VALUE),
        (0x1016, 1, 128 << 16 | 100, 4, Abort.VALUE),
        (0x1029, 2, 1, 1, Abort.NO_SUBINDEX),
        (0x1005, 0, 0x40000080, 4, Abort.VALUE),
        (0x1003, 0, 1, 1, Abort.VALUE),
        (0x6041, 0, 1, 2, Abort.READ_ONLY),
        (0x6076, 0, 1, 4, Abort.READ_ONLY),
        (0x6071, 0, 1, 4, Abort.LENGTH),
        (0x6007, 0, 4, 2, Abort.VALUE),
        (0x605A, 0, 7, 2, Abort.VALUE),
        (0x7000, 0, 1, 1, Abort.NO_OBJECT),
    ],
)
def test_what_may_not_be_written(index: int, sub: int, value: int, size: int, code: Abort) -> None:
    client = Client()
    assert client.write(index, value, sub, size) == code
    assert client.drive.refused == {f"SDO {code.name.lower().replace('_', ' ')}": 1}


def test_a_mapping_that_is_too_long() -> None:
    client = Client()
    for sub in (1, 2, 3):
        assert client.write(0x1A03, 0x60640020, sub) is None
    assert client.write(0x1A03, 3, 0, 1) == Abort.MAPPING_TOO_LONG
    assert client.write(0x1A03, 2, 0, 1) is None
    assert client.write(0x1A03, 0x60640020, 1) == Abort.DEVICE_STATE


def test_objects_tell_what_is() -> None:
    client = Client(motor=motor_plan(rated_torque=0.8, torque_constant=0.1, torque_slew=4.0, torque_limit=1.2)).enable()
    assert client.read(0x6076) == 800
    assert client.read(0x6075) == 8000
    assert client.read(0x6072) == 1500
    assert client.read(0x6087) == 5000
    assert client.read(0x6079) == 24000
    assert client.read(0x2000) == 250
    assert client.read(0x1014) == 0x85
    client.write(0x1401, 0, 5, 2)
    client.target(1000)
    client.wait(100)
    assert client.read(0x6074, signed=True) == 500
    assert client.read(0x6077, signed=True) == client.read(0x6078, signed=True) == 500
    assert client.read(0x6071, signed=True) == 1000


# faults


def test_watchdog_to_the_nanosecond() -> None:
    client = Client().enable()
    client.wait(40)
    client.target(500)
    client.wait(99.999999)
    assert client.motor.torque == pytest.approx(0.5)
    client.wait(0.000001)
    assert client.motor.torque == 0.0
    assert client.state == "FAULT"
    assert client.emergencies() == [(0x8250, 0x11)]
    assert client.read(0x603F) == 0x8250
    assert client.read(0x1001) == 0x11


def test_watchdog_begins_when_operation_is_enabled() -> None:
    client = Client().enable()
    client.wait(99)
    assert client.state == "OPERATION ENABLED"
    client.wait(1)
    assert client.state == "FAULT"


def test_what_feeds_the_watchdog() -> None:
    client = Client().enable()
    for _ in range(10):
        client.wait(60)
        client.write(0x6071, 100)
    assert client.state == "OPERATION ENABLED"
    client.wait(60)
    client.control(15)
    client.sync()
    client.send(0x305, b"\1")  # too short
    client.wait(40)
    assert client.state == "FAULT"
    assert client.drive.refused == {"length": 1}


def test_watchdog_of_another_length_and_none() -> None:
    client = Client(watchdog_ns=30 * MS)
    assert client.read(0x1401, 5) == 30
    client.write(0x1401, 200, 5, 2)
    client.enable()
    client.target(1)
    client.wait(199)
    assert client.state == "OPERATION ENABLED"
    client.write(0x1401, 0, 5, 2)
    client.target(1)
    client.wait(10_000)
    assert client.state == "OPERATION ENABLED"


def test_other_rpdos_are_watched_from_the_first_that_came() -> None:
    client = Client()
    client.write(0x1400, 50, 5, 2)
    client.enable()
    for _ in range(4):
        client.wait(45)
        client.target(0)
        client.control(15)
    client.wait(49)
    assert client.state == "OPERATION ENABLED"
    client.wait(1)
    assert client.emergencies() == [(0x8250, 0x11)]


@pytest.mark.parametrize(
    ("fault", "code", "register"),
    [
        (Fault.OVER_TEMPERATURE, 0x4310, 0x09),
        (Fault.ENCODER_LOSS, 0x7305, 0x21),
        (Fault.BROWN_OUT, 0x3220, 0x05),
    ],
)
def test_faults_latch_until_reset_and_begin_at_zero(fault: Fault, code: int, register: int) -> None:
    client = Client().enable()
    client.target(500)
    client.heard += client.drive.inject(client.time_ns, 0, fault)
    assert client.motor.torque == 0.0
    assert client.emergencies() == [(code, register)]
    assert client.state == "FAULT"
    for word in (0, 0x80, 0, 0x80):
        client.control(word)
        assert client.state == "FAULT"
    assert client.drive.refused == {"fault persists": 2}
    client.drive.mend(client.time_ns, 0, fault)
    client.control(0x80)
    assert client.state == "FAULT"  # there is no rising edge
    client.control(0)
    client.control(0x80)
    assert client.state == "SWITCH ON DISABLED"
    assert client.emergencies() == [(code, register), (0, 0)]
    assert (client.read(0x603F), client.read(0x1001)) == (0, 0)
    assert (client.read(0x1003), client.read(0x1003, 1), client.read(0x1003, 2)) == (1, code, 0)
    client.target(500)
    for word in (6, 7, 15):
        client.control(word)
    refused = client.drive.refused["first command not zero"]
    client.target(500)
    assert client.write(0x6071, 500) == Abort.DEVICE_STATE
    assert client.motor.torque == 0.0
    assert not client.read(0x6041) & 1 << 12
    assert client.drive.refused["first command not zero"] == refused + 2
    client.target(0)
    client.target(500)
    assert client.motor.torque == pytest.approx(0.5)
    assert client.read(0x6041) & 1 << 12
    assert client.write(0x1003, 0, size=1) is None
    assert client.read(0x1003, 1) == 0


def test_refused_torques_do_not_feed_the_watchdog() -> None:
    client = Client().enable()
    client.wait(100)
    for word in (0, 0x80, 6, 7, 15):
        client.control(word)
    for _ in range(10):
        client.target(10)
        client.wait(10)
    assert client.emergencies() == [(0x8250, 0x11), (0, 0), (0x8250, 0x11)]


def test_several_errors_at_once() -> None:
    client = Client().enable()
    for fault in (Fault.BROWN_OUT, Fault.ENCODER_LOSS, Fault.BROWN_OUT):
        client.heard += client.drive.inject(client.time_ns, 0, fault)
    assert client.emergencies() == [(0x3220, 0x05), (0x7305, 0x25)]
    assert [client.read(0x1003, sub) for sub in range(4)] == [2, 0x7305, 0x3220, 0]
    client.drive.mend(client.time_ns, 0, Fault.BROWN_OUT)
    client.control(0x80)
    assert client.state == "FAULT"


def heartbeat_lost(option: int, behaviour: int) -> Client:
    client = Client()
    client.write(0x1016, 127 << 16 | 150, 1)
    client.write(0x6007, option)
    client.write(0x1029, behaviour, 1)
    client.enable()
    client.wait(90)
    client.send(0x77F, b"\x05")
    for _ in range(4):
        client.target(400)
        client.wait(37.4)
    assert client.motor.torque == pytest.approx(0.4)
    client.target(400)
    client.wait(0.4)
    return client


@pytest.mark.parametrize(
    ("option", "state"),
    [(0, "OPERATION ENABLED"), (1, "FAULT"), (2, "SWITCH ON DISABLED"), (3, "SWITCH ON DISABLED")],
)
def test_a_lost_heartbeat(option: int, state: str) -> None:
    client = heartbeat_lost(option, 1)
    assert client.state == state
    assert client.emergencies() == [(0x8130, 0x11)]
    assert client.motor.torque == pytest.approx(0.4 if option == 0 else 0.0)
    client.control(0)
    client.control(0x80)
    assert client.state == ("FAULT" if option == 1 else "SWITCH ON DISABLED")  # no reset before the next heartbeat
    client.send(0x77F, b"\x05")
    client.control(0)
    client.control(0x80)
    assert client.state == "SWITCH ON DISABLED"


@pytest.mark.parametrize(("behaviour", "nmt"), [(0, 127), (1, 5), (2, 4)])
def test_what_becomes_of_the_node_without_heartbeat(behaviour: int, nmt: int) -> None:
    client = heartbeat_lost(1, behaviour)
    assert Frame(0x705, bytes((nmt,))) in client.wait(100)
    assert client.motor.torque == 0.0


def test_the_host_is_watched_from_its_first_heartbeat_on() -> None:
    client = Client()
    client.write(0x1016, 126 << 16 | 50, 1)
    client.wait(1000)
    client.send(0x77F, b"\x05")  # another node's
    client.wait(1000)
    assert client.state == "SWITCH ON DISABLED"
    assert 0x77E in client.drive.identifiers
    client.send(0x77E, b"\x05")
    client.send(0x77E, b"\x06")
    client.send(0x77E, b"")
    assert client.drive.refused == {"heartbeat": 2}
    client.wait(50)
    assert client.state == "FAULT"
    client.write(0x1016, 0, 1)
    client.write(0x6040, 0)
    client.write(0x6040, 0x80)
    assert client.state == "SWITCH ON DISABLED"


@pytest.mark.parametrize("command", [2, 128, 129, 130])
def test_a_node_that_is_told_to_rest_has_no_torque(command: int) -> None:
    client = Client().enable()
    client.target(500)
    client.heard.clear()
    client.send(0, bytes((command, 0)))
    assert client.motor.torque == 0.0
    if command > 128:
        client.wait(BOOT_MS)
    client.target(500)
    assert client.motor.torque == 0.0
    assert client.drive.refused == {"not operational": 1}
    assert client.sync() == {}
    assert (Frame(0x705, b"\0") in client.heard) == (command > 128)
    if command == 2:
        assert client.send(0x605, bytes.fromhex("4000100000000000")) == []
        assert client.drive.refused["SDO while stopped"] == 1
    else:
        assert client.state == "SWITCH ON DISABLED"
    client.start()
    client.target(500)
    assert client.motor.torque == 0.0
    client.wait(100)
    assert client.emergencies() == []


@pytest.mark.parametrize("command", [129, 130])
def test_who_has_sent_a_reset_can_begin_to_listen_for_the_boot_up(command: int) -> None:
    client = Client().enable()
    assert client.send(0, bytes((command, NODE))) == []
    assert client.wait(BOOT_MS - 0.001) == []
    client.start()  # it is not heard yet
    assert client.send(0x605, bytes.fromhex("4000100000000000")) == []
    assert client.wait(0.001) == [Frame(0x705, b"\0")]
    assert client.wait(100) == [Frame(0x705, b"\x7f")]
    assert client.drive.refused == {}


def test_resets_forget_what_they_should() -> None:
    client = Client()
    client.write(0x1017, 33)
    client.write(0x6060, 10)
    client.write(0x6072, 44)
    client.send(0, bytes((130, NODE)))
    client.wait(BOOT_MS)
    assert (client.read(0x1017), client.read(0x6060), client.read(0x6072)) == (100, 10, 44)
    client.send(0, bytes((129, NODE)))
    client.wait(BOOT_MS)
    assert (client.read(0x1017), client.read(0x6060), client.read(0x6072)) == (100, 0, 1500)
    client.send(0, bytes((129, NODE + 1)))
    client.send(0, bytes((3, NODE)))
    client.send(0, b"\x01")
    assert client.drive.refused == {"NMT command": 1, "length": 1}


def test_a_reset_does_not_forget_that_there_was_a_fault() -> None:
    client = Client().enable()
    client.drive.inject(client.time_ns, 0, Fault.ENCODER_LOSS)
    client.heard.clear()
    client.send(0, bytes((129, NODE)))
    client.wait(BOOT_MS)
    assert client.state == "FAULT"  # its cause is still there
    assert client.emergencies() == [(0x7305, 0x21)]
    client.drive.mend(client.time_ns, 0, Fault.ENCODER_LOSS)
    client.send(0, bytes((129, NODE)))
    client.wait(BOOT_MS)
    assert client.state == "SWITCH ON DISABLED"
    client.enable()
    client.target(500)
    assert client.motor.torque == 0.0
    client.target(0)
    client.target(500)
    assert client.motor.torque == pytest.approx(0.5)


def test_silence() -> None:
    client = Client().enable()
    client.target(500)
    assert client.drive.inject(client.time_ns, 0, Fault.SILENT) == []
    assert client.motor.torque == 0.0
    client.heard.clear()
    for _ in range(20):
        client.wait(30)
        client.enable()
        client.target(500)
        assert client.sync() == {}
    assert client.heard == []
    client.drive.mend(client.time_ns, 0, Fault.SILENT)
    assert client.wait(BOOT_MS) == [Frame(0x705, b"\0")]
    assert client.state == "SWITCH ON DISABLED"
    assert client.read(0x6060) == 0


def test_physics_can_be_a_fault() -> None:
    hot = motor_plan(thermal_time=1.0, thermal_resistance=10.0, derating_from=50.0, temperature_limit=50.0)
    client = Client(motor=hot).enable()
    while not client.emergencies():
        client.target(1500)
        client.wait(10)
        assert client.time_ns < 10_000 * MS
    assert client.emergencies() == [(0x4310, 0x09)]
    assert client.motor.temperature >= 50.0
    assert client.read(0x2000) == round(client.motor.temperature * 10)
    assert client.motor.torque == 0.0


def test_callers_mistakes() -> None:
    with pytest.raises(ValueError, match="wheel must be 0"):
        Cia402Drive(plan_of(), 2)
    with pytest.raises(ValueError, match="node id"):
        Cia402Drive(replace(plan_of(), node_ids=(0, 1)), 0)
    drive = Cia402Drive(plan_of(), 1)
    assert 0x606 in drive.identifiers
    with pytest.raises(ValueError, match="wheel 1"):
        drive.inject(0, 0, Fault.SILENT)
    with pytest.raises(ValueError, match="watchdog"):
        drive.mend(0, 1, Fault.WATCHDOG)


def test_frames_that_are_not_its_own() -> None:
    client = Client()
    client.send(0x206, bytes(3))
    client.drive.receive(0, Frame(0x705, b"", True))
    client.send(0x405, bytes(3))
    client.send(0x605, bytes(7))
    assert client.drive.refused == {"identifier": 1, "remote frame": 1, "PDO not valid": 1, "length": 1}


def test_sync_with_another_identifier() -> None:
    client = Client().enable()
    client.write(0x1005, 0x0F0)
    assert client.sync() == {}
    assert {frame.can_id for frame in client.send(0x0F0)} == {0x185, 0x285, 0x385}
    assert 0x0F0 in client.drive.identifiers
    assert not client.drive.refused


@settings(max_examples=50)
@given(st.lists(st.floats(0.1, 40), min_size=1, max_size=20))
def test_events_come_in_the_order_of_their_times(steps: list[float]) -> None:
    """A drive sends the same frames whether time passes in steps or at once."""
    one, other = Client(), Client()
    for client in (one, other):
        client.write(0x1017, 7)
        client.write(0x1016, 127 << 16 | 90, 1)
        client.write(0x1801, 254, 2, 1)
        client.write(0x1801, 11, 5, 2)
        client.enable()
        client.send(0x77F, b"\x05")
    for step in steps:
        one.wait(step)
    other.wait((one.time_ns - other.time_ns) / MS)
    assert other.time_ns == one.time_ns
    assert [frame for frame in one.heard if frame.can_id != 0x285] == [f for f in other.heard if f.can_id != 0x285]
    assert len(one.heard) == len(other.heard)
