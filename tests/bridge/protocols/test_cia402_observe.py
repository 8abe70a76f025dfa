"""The observer of CiA 402 frames, and their DBC."""

import struct
from collections import Counter
from math import inf, tau
from typing import Any

import cantools
import pytest
from cantools.database import Database
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.cia402.dbc import messages, shared_messages
from echelon.bridge.protocols.cia402.observe import Cia402Observer
from echelon.bridge.protocols.faults import LATCHING, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.observe import Finding
from support.bench_drives import ENVELOPE, MS, motor_plan
from support.cia402_rig import PERIOD_NS, Rig, plan_of


class Heard:
    """An observer that listens to a rig."""

    def __init__(self, **changes: Any) -> None:
        self.rig = Rig(plan_of(**changes))
        self.observer = Cia402Observer(self.rig.plan, ENVELOPE)
        self.findings: list[Finding] = []
        self.rig.listen = self.listen

    def listen(self, time_ns: int, frame: Frame) -> None:
        self.findings += self.observer.observe(time_ns, frame)

    def kinds(self, *frames: Frame) -> list[str]:
        """Returns the kinds of the findings in these frames, all sent now."""
        self.findings.clear()
        for frame in frames:
            self.listen(self.rig.time_ns, frame)
        return [finding.kind for finding in self.findings]


START = Frame(0, b"\x01\x05")


def status(word: int, node: int = 5) -> Frame:
    return Frame(0x180 + node, struct.pack("<Hb", word, 10))


def control(word: int) -> Frame:
    return Frame(0x205, struct.pack("<Hb", word, 10))


def torque(value: int) -> Frame:
    return Frame(0x285, struct.pack("<ih", 0, value))


@settings(max_examples=15)
@given(
    st.lists(
        st.sampled_from([*LATCHING, Fault.SILENT, "stop", "start", "deaf", "reset", "none"]), min_size=1, max_size=8
    ),
    st.integers(0, 1),
)
def test_nothing_is_found_where_all_do_what_they_should(events: list[Any], wheel: int) -> None:
    heard = Heard(recover_ns=50 * MS, motor=motor_plan(lag=0.005, torque_slew=50.0))
    rig = heard.rig
    rig.bring_up()
    for event in events:
        rig.cycles(7, 0.9, -0.4)
        if isinstance(event, Fault):
            rig.to_host(rig.drives[wheel].inject(rig.time_ns, wheel, event))
            rig.cycles(15, 0.9, -0.4)
            rig.drives[wheel].mend(rig.time_ns, wheel, event)
        elif event == "stop":
            rig.to_drives(rig.host.stop(rig.time_ns))
        elif event == "start":
            rig.host.start()
        elif event == "reset":
            rig.to_drives([Frame(0, bytes((129, 5 + wheel)))])
        elif event == "deaf":
            for _ in range(15):  # the host is gone
                rig.time_ns += PERIOD_NS
                for drive in rig.drives:
                    rig.to_host(drive.advance(rig.time_ns))
        rig.cycles(60, 0.9, -0.4)
    assert heard.findings == []


def test_readings() -> None:
    heard = Heard()
    heard.rig.bring_up()
    heard.rig.cycles(20, 0.5, -0.25)
    right, left = heard.observer.wheels
    assert (right.commanded, left.commanded) == pytest.approx((0.5, -0.25))
    assert (right.reported, left.reported) == pytest.approx((0.5, -0.25))
    assert right.commanded_ns == right.reported_ns == heard.rig.time_ns - PERIOD_NS
    motor = heard.rig.drives[0].motor
    assert right.speed == pytest.approx(motor.velocity * tau, abs=0.1)
    assert right.speed is not None
    assert right.speed > 0
    assert (right.state, right.fault) == ("OPERATION ENABLED", "")
    heard.rig.to_host(heard.rig.drives[0].inject(heard.rig.time_ns, 0, Fault.BROWN_OUT))
    assert right.fault == "0x3220 undervoltage"
    heard.rig.cycle()
    assert (right.state, right.fault) == ("FAULT", "0x3220 undervoltage")
    assert heard.findings == []


def test_cyclic_frames_come_as_often_as_it_says() -> None:
    heard = Heard()
    heard.rig.bring_up()
    count: Counter[int] = Counter()
    heard.rig.listen = lambda time_ns, frame: count.update([frame.can_id])
    heard.rig.cycles(100)
    assert heard.observer.cyclic.keys() <= heard.observer.identifiers
    for can_id, period_ns in heard.observer.cyclic.items():
        assert count[can_id] == pytest.approx(100 * PERIOD_NS / period_ns, abs=1)


@pytest.mark.parametrize("base", [0x080, 0x180, 0x280, 0x380, 0x200, 0x300, 0x580, 0x600])
def test_lengths(base: int) -> None:
    heard = Heard()
    right = {0x180: 3, 0x280: 6, 0x380: 4, 0x200: 3, 0x300: 2}.get(base, 8)
    for length in range(9):
        found = heard.kinds(Frame(base + 6, bytes(length)))
        assert (found == ["length"]) == (length != right)
    assert heard.kinds(Frame(base + 6, b"", True)) == ["remote"]
    assert heard.kinds(Frame(base + 7, b"")) == []


def test_what_says_nothing() -> None:
    heard = Heard()
    assert heard.kinds(Frame(0x705, b"\x06"), Frame(0x705, b""), Frame(0, b"\x01")) == [
        "heartbeat",
        "heartbeat",
        "length",
    ]
    assert heard.kinds(status(0x01)) == ["statusword"]


def test_transitions() -> None:
    heard = Heard()
    assert heard.kinds(Frame(0x705, b"\0"), START, status(0x40)) == []
    assert heard.kinds(status(0x21)) == ["transition"]
    assert heard.kinds(control(6), status(0x23)) == ["transition"]
    assert heard.kinds(status(0x40)) == ["transition"]
    assert heard.kinds(control(6), status(0x21), control(7), status(0x23)) == []
    assert heard.kinds(status(0x27)) == ["enabled without command"]
    assert heard.kinds(status(0x08), status(0x40)) == [
        "transition"
    ]  # a fault may begin at any time, but not end by itself
    assert heard.kinds(status(0x08), control(0), control(0x80), status(0x40)) == []
    assert heard.kinds(control(6), control(7), control(15), status(0x27)) == []
    assert heard.kinds(control(2), status(0x07), status(0x40)) == []


def test_a_drive_that_boots_enabled_is_noticed_and_one_that_was_there_before_is_not() -> None:
    assert Heard().kinds(status(0x27)) == []
    assert Heard().kinds(Frame(0x705, b"\0"), START, status(0x27)) == ["enabled without command"]


def test_a_controlword_may_overtake_the_statusword_that_does_not_know_of_it() -> None:
    heard = Heard()
    assert heard.kinds(status(0x40), control(6), status(0x40), status(0x21)) == []
    assert heard.kinds(control(7), control(15), status(0x21), status(0x27)) == []


def test_controlwords_by_sdo_count() -> None:
    heard = Heard()
    word = Frame(0x605, bytes.fromhex("2b40600006000000"))
    assert heard.kinds(status(0x40), word, status(0x21)) == []
    assert heard.kinds(Frame(0x605, bytes.fromhex("2b71600018fc0000"))) == []
    assert heard.observer.wheels[0].commanded == pytest.approx(-1.0)
    assert heard.kinds(Frame(0x605, bytes.fromhex("2b716000b80b0000"))) == ["torque above limit"]


def test_torque_of_a_drive_that_is_not_enabled() -> None:
    heard = Heard()
    command = Frame(0x305, b"\0\0")
    assert heard.kinds(command, status(0x40), torque(1)) == ["torque while disabled"]
    assert heard.kinds(control(6), control(15), status(0x27), torque(500)) == []
    assert heard.kinds(status(0x08), torque(500)) == []  # the mean of a period in which it was enabled
    assert heard.kinds(status(0x08), torque(500)) == ["torque while disabled"]
    assert heard.kinds(control(0x80), control(6), control(15), status(0x08), torque(3)) == []


def test_torque_after_silence() -> None:
    heard = Heard()
    assert heard.kinds(torque(1)) == ["torque after silence"]
    heard.kinds(Frame(0x305, b"\0\0"), status(0x27))
    heard.rig.time_ns += 110 * MS
    assert heard.kinds(torque(1), torque(0)) == []
    heard.rig.time_ns += 1
    assert heard.kinds(torque(0), torque(1)) == ["torque after silence"]
    heard = Heard()  # with SYNC, the reported time is known
    assert heard.kinds(Frame(0x080), Frame(0x305, b"\0\0"), status(0x27)) == []
    heard.rig.time_ns += 500 * MS
    assert heard.kinds(Frame(0x080), torque(1)) == []
    assert heard.kinds(Frame(0x080), torque(1)) == ["torque after silence"]


def test_torque_above_the_envelope() -> None:
    heard = Heard()
    assert heard.kinds(Frame(0x305, struct.pack("<h", 1500)), Frame(0x306, struct.pack("<h", -1500))) == []
    assert heard.kinds(Frame(0x305, struct.pack("<h", -1501))) == ["torque above limit"]


def test_pdos_of_a_node_that_is_not_operational() -> None:
    heard = Heard()
    assert heard.kinds(Frame(0x705, b"\x7f"), status(0x40), Frame(0x305, b"\0\0")) == ["not operational"] * 2
    assert heard.kinds(Frame(0, b"\x01\0"), status(0x40)) == []
    assert heard.kinds(Frame(0x705, b"\x7f"), status(0x40)) == []  # this heartbeat is older than the NMT start
    heard.rig.time_ns += PERIOD_NS
    assert heard.kinds(Frame(0x705, b"\x05"), status(0x40)) == []
    assert heard.kinds(Frame(0x705, b"\x04"), torque(0)) == ["not operational"]
    assert heard.kinds(status(0x40, 6)) == []


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans()), max_size=200))
def test_arbitrary_frames_never_raise(frames: list[tuple[int, bytes, bool]]) -> None:
    observer = Cia402Observer(plan_of(), ENVELOPE)
    known = sorted(observer.identifiers)
    for time_ns, (can_id, data, remote) in enumerate(frames):
        observer.observe(time_ns, Frame(known[can_id % len(known)], data, remote))
        assert observer.observe(time_ns, Frame(0x7FF, data, remote)) == []


def test_the_dbc_says_what_the_frames_say() -> None:
    plan = plan_of(motor=motor_plan(rated_torque=0.8, lag=0.002, torque_slew=inf))
    shared = shared_messages(plan.period_ns, plan.watchdog_ns)
    text = Database([*messages(plan, "g1/r2"), *shared]).as_dbc_string()
    dbc = cantools.database.load_string(text, "dbc")
    assert isinstance(dbc, Database)
    rig = Rig(plan)
    seen: dict[str, dict[str, Any]] = {}

    def listen(time_ns: int, frame: Frame) -> None:
        message = dbc.get_message_by_frame_id(frame.can_id)  # there is one for each frame
        assert message.length == len(frame.data)
        decoded = message.decode(frame.data)
        assert isinstance(decoded, dict)
        seen[message.name] = decoded

    rig.listen = listen
    rig.bring_up()
    rig.cycles(30, 0.6, -0.3)
    rig.time_ns -= PERIOD_NS
    motor = rig.drives[1].motor
    assert seen["g1_r2_right_RPDO2"] == {"target_torque": pytest.approx(0.6, abs=4e-4)}
    said = seen["g1_r2_left_TPDO2"]
    assert said == {"position": pytest.approx(motor.position, abs=1e-6), "torque": pytest.approx(-0.3, abs=4e-4)}
    assert seen["g1_r2_left_TPDO3"] == {"velocity": pytest.approx(motor.velocity, abs=1e-3)}
    bits = {name for name, value in seen["g1_r2_left_TPDO1"].items() if value == 1}
    assert bits >= {"ready_to_switch_on", "switched_on", "operation_enabled", "quick_stop_off", "remote"}
    assert not bits & {"fault", "switch_on_disabled"}
    assert str(seen["g1_r2_left_TPDO1"]["mode"]) == "cyclic synchronous torque"
    control = {name for name, value in seen["g1_r2_left_RPDO1"].items() if value == 1}
    assert control == {"switch_on", "enable_voltage", "quick_stop_off", "enable_operation"}
    rig.to_host(rig.drives[1].inject(rig.time_ns, 1, Fault.BROWN_OUT))
    assert {name: str(value) for name, value in seen["g1_r2_left_EMCY"].items()} == {
        "error_code": "undervoltage",
        "error_register": "5",
    }
    assert str(seen["g1_r2_left_heartbeat"]["state"]) == "operational"
    assert {str(seen["NMT"]["command"]), seen["NMT"]["node"]} == {"start", 6}
    assert seen["g1_r2_right_SDO_answer"]["command"] == 0x60  # a download was taken
    assert str(seen["bridge_heartbeat"]["state"]) == "operational"
    assert {message.name for message in dbc.messages} - seen.keys() == {"g1_r2_right_EMCY"}
    cycles = {message.name.rpartition("_")[2]: message.cycle_time for message in dbc.messages if message.cycle_time}
    assert cycles == {"RPDO2": 10, "TPDO1": 10, "TPDO2": 10, "TPDO3": 10, "heartbeat": 40, "SYNC": 10}
