"""CiA 402 on a real SocketCAN interface with the unmodified package `canopen`, as master of our drives and as slaves of our
host."""

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.profiles.p402 import State402

from echelon.bridge.can.bus import open_bus
from echelon.bridge.protocols import cia402
from echelon.bridge.protocols.cia402.drive import Cia402Drive
from echelon.bridge.protocols.cia402.host import Cia402Host, Master
from echelon.bridge.protocols.frame import Frame
from support.bench_drives import MS, Bench, drive_plan, motor_plan

pytestmark = pytest.mark.vcan

URL = "socketcan:vcan0"
EDS = str(Path(cia402.__file__).with_name("drive.eds"))
PLAN = drive_plan("cia402", (5, 6), watchdog_ns=800 * MS, recover_ns=100 * MS, motor=motor_plan(rated_torque=0.8))
HOST_NODE = 127
PATIENCE_S = 600.0


@pytest.fixture
def network() -> Iterator[Any]:
    interface, _, channel = URL.partition(":")
    logging.getLogger("canopen").setLevel(logging.ERROR)
    made = canopen.Network()
    made.connect(interface=interface, channel=channel)
    try:
        yield made
    finally:
        made.disconnect()


def until(condition: Callable[[], bool]) -> None:
    """Waits for a condition that another thread fulfils without an event."""
    limit = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.005)


def bring_up(network: Any, node_id: int) -> Any:
    """Returns a master's node in OPERATION ENABLED; SYNC, heartbeat and cyclic target torques are being sent."""
    node = network.add_node(canopen.BaseNode402(node_id, EDS))
    for what in ("RESET_FAULT", "SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{what}", PATIENCE_S)  # the library's, below a second, are too short for a busy machine
    node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    node.nmt.state = "PRE-OPERATIONAL"
    assert node.sdo["device name"].raw == "echelon virtual drive"
    assert node.sdo[0x6076].raw == 800
    node.sdo[0x1016][1].raw = HOST_NODE << 16 | 600
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"
    network.sync.start(0.02)
    node.rpdo[2][0x6071].raw = 0
    node.rpdo[2].start(0.02)
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert node.op_mode == "CYCLIC SYNCHRONOUS TORQUE"
    node.state = "OPERATION ENABLED"
    return node


def test_an_unmodified_master_finds_enables_and_moves_a_drive(network: Any) -> None:
    drives = [Cia402Drive(PLAN, wheel) for wheel in (0, 1)]
    with Bench(URL, drives) as bench:
        network.scanner.search()
        until(lambda: sorted(network.scanner.nodes) == [5, 6])
        node = bring_up(network, 5)
        network.send_message(0x600 + 6, bytes.fromhex("4008100000000000"))  # the other one answers meanwhile
        assert node.state == "OPERATION ENABLED"
        assert drives[0].motor.torque == 0.0
        node.rpdo[2][0x6071].raw = -250  # thousandths of 0.8 N m
        until(lambda: node.tpdo[2][0x6077].raw == -250)
        with bench.lock:
            assert drives[0].motor.torque == pytest.approx(-0.2)
            assert drives[1].motor.torque == 0.0
        until(lambda: node.tpdo[3][0x606C].raw < 0 and node.tpdo[2][0x6064].raw < 0)
        assert node.sdo[0x6074].raw == -250
        node.state = "SWITCHED ON"
        until(lambda: node.tpdo[2][0x6077].raw == 0)
        assert drives[0].motor.torque == 0.0
        node.sdo[0x605A].raw = 6
        node.state = "OPERATION ENABLED"
        node.state = "QUICK STOP ACTIVE"
        node.state = "OPERATION ENABLED"  # transition 16
        node.state = "SWITCH ON DISABLED"
        heard: list[int] = []
        node.nmt.add_heartbeat_callback(heard.append)
        node.nmt.state = "RESET"
        until(lambda: 0 in heard)
        node.rpdo[2].stop()
        network.sync.stop()
    assert {reason for drive in drives for reason in drive.refused} <= {"not operational"}


def test_a_lost_heartbeat_is_a_fault_that_the_master_resets(network: Any) -> None:
    drive = Cia402Drive(PLAN, 0)
    with Bench(URL, [drive]):
        node = bring_up(network, 5)
        beat = network.send_periodic(0x700 + HOST_NODE, b"\x05", 0.05)
        node.rpdo[2][0x6071].raw = 300
        until(lambda: node.tpdo[2][0x6077].raw == 300)
        beat.stop()
        emergency = node.emcy.wait(0x8130, PATIENCE_S)
        assert (emergency.code, emergency.register) == (0x8130, 0x11)
        until(lambda: bool(node.state == "FAULT"))
        assert drive.motor.torque == 0.0
        assert node.sdo[0x603F].raw == 0x8130
        beat = network.send_periodic(0x700 + HOST_NODE, b"\x05", 0.05)
        until(lambda: bool(drive.refused["first command not zero"]))
        node.rpdo[2][0x6071].raw = 0
        node.reset_from_fault()
        assert node.state == "OPERATION ENABLED"
        assert node.emcy.active == []
        assert node.sdo[0x1003][1].raw == 0x8130
        node.rpdo[2][0x6071].raw = 100
        until(lambda: node.tpdo[2][0x6077].raw == 100)
        node.rpdo[2].stop()  # its watchdog
        until(lambda: bool(node.state == "FAULT"))
        assert [said.code for said in node.emcy.log] == [0x8130, 0, 0x8250]
        beat.stop()
        network.sync.stop()


class Slave:
    """`canopen.LocalNode` as a drive: adds states by the package's own table, and PDOs on SYNC."""

    def __init__(self, network: Any, node_id: int) -> None:
        self.node = network.add_node(canopen.LocalNode(node_id, EDS))
        self.state = "SWITCH ON DISABLED"
        self.faulty = False
        self.seen: list[str] = []
        self.word = 0
        self.put(0x6076, 800)
        network.subscribe(0x000, self.manage)
        network.subscribe(0x080, self.sync)
        self.node.nmt.state = "PRE-OPERATIONAL"

    def put(self, index: int, value: int) -> None:
        entry = self.node.object_dictionary[index]
        self.node.set_data(index, 0, entry.encode_raw(value))

    def get(self, index: int) -> int:
        return int(self.node.sdo[index].raw)

    def manage(self, can_id: int, data: bytes, timestamp: float) -> None:
        if list(data) == [1, self.node.id] and not self.node.rpdo[1].enabled:
            self.node.tpdo.read()
            self.node.rpdo.read()
            self.node.rpdo[1].add_callback(self.control)
            self.node.rpdo[2].add_callback(lambda pdo: self.put(0x6071, pdo[0].raw))

    def control(self, pdo: Any) -> None:
        word, before, self.word = pdo[0x6040].raw, self.word, pdo[0x6040].raw
        self.put(0x6060, pdo[0x6060].raw)
        for (state, target), command in State402.TRANSITIONTABLE.items():
            edge = command != 0x80 or not before & 0x80
            if state == self.state and word == command and edge and not (state == "FAULT" and self.faulty):
                self.state = target
                self.seen.append(target)
                break

    def fail(self) -> None:
        self.state, self.faulty = "FAULT", True
        self.node.emcy.send(0x4310, 0x09, bytes(5))

    def sync(self, can_id: int, data: bytes, timestamp: float) -> None:
        if self.node.nmt.state != "OPERATIONAL":
            return
        torque = self.get(0x6071) if self.state == "OPERATION ENABLED" else 0
        values = {
            0x6041: State402.SW_MASK[self.state][1],
            0x6061: self.get(0x6060),
            0x6077: torque,
            0x6064: 7,
            0x606C: 9,
        }
        for number in (1, 2, 3):
            pdo = self.node.tpdo[number]
            for entry in pdo:
                entry.raw = values[entry.index]
            pdo.transmit()


def test_our_host_drives_foreign_slaves(network: Any) -> None:
    slaves = [Slave(network, node_id) for node_id in PLAN.node_ids]
    host, master = Cia402Host(PLAN), Master(PLAN.period_ns, PLAN.watchdog_ns)
    with open_bus(URL) as bus:

        def cycle(right: float, left: float) -> None:
            now_ns = time.monotonic_ns()
            end_ns = now_ns + PLAN.period_ns
            for frame in (*host.poll(now_ns), *host.command(now_ns, right, left), *master.poll(now_ns), master.sync()):
                assert bus.send(frame.can_id, frame.data)
            while (now_ns := time.monotonic_ns()) < end_ns:
                heard = bus.recv((end_ns - now_ns) * 1e-9)
                if heard is not None and heard.can_id in host.identifiers:
                    host.receive(time.monotonic_ns(), Frame(heard.can_id, heard.data, heard.remote))

        def cycle_until(condition: Callable[[], bool], right: float = 0.0, left: float = 0.0) -> None:
            limit = time.monotonic() + PATIENCE_S
            while not condition():
                assert time.monotonic() < limit, host.fault
                cycle(right, left)

        cycle_until(lambda: host.enabled)
        for slave in slaves:
            assert slave.seen == ["READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"]
            assert slave.node.sdo[0x1016][1].raw >> 16 == HOST_NODE
            assert slave.get(0x6060) == 10
        cycle_until(lambda: host.torque == pytest.approx((0.4, -0.2)), 0.4, -0.2)
        assert [slave.get(0x6071) for slave in slaves] == [500, -250]
        slaves[1].fail()
        cycle_until(lambda: bool(host.fault), 0.4, -0.2)
        assert host.fault == "left: 0x4310 over temperature"
        assert not host.enabled
        cycle_until(lambda: host.torque == (0.0, 0.0), 0.4, -0.2)
        slaves[1].faulty = False
        cycle_until(lambda: host.enabled, 0.4, -0.2)
        cycle_until(lambda: host.torque == pytest.approx((0.4, -0.2)), 0.4, -0.2)
        for frame in host.stop(time.monotonic_ns()):
            bus.send(frame.can_id, frame.data)
        cycle_until(lambda: all(slave.state == "SWITCH ON DISABLED" for slave in slaves))
        cycle_until(lambda: host.torque == (0.0, 0.0))
        assert sum(host.refused.values()) == 0
