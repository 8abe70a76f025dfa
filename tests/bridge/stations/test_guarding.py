"""On a CAN bus each identifier has one sender: who else uses those of a run is counted."""

from contextlib import closing
from pathlib import Path

import pytest

from echelon.bridge.can.bus import Bus, Received, open_bus
from echelon.bridge.can.bus_url import free_multicast_url
from echelon.bridge.can.guard import KEPT, NODE, OTHERS, Guard
from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.registry import run_identifiers
from echelon.bridge.roles.commander import Commander
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.bridge.stations.closed import ClosedBridge
from echelon.bridge.stations.guarding import check_sender, intrusions, open_guarded
from echelon.bridge.stations.lockstep_drives import LockstepDrives
from echelon.bridge.stations.mirror import MirrorBridge
from echelon.bridge.stations.waiting import AT_ONCE
from echelon.bridge.stations.wall_bridge import WallBridge
from support.runs import plan_of

PROTOCOLS = ["native", "odrive", "cia402"]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_drive_and_no_bridge_is_taken_for_an_intruder(protocol: str) -> None:
    """What the bridge sends to bring up drives, no drive sends, and the other way round, except to ask."""
    plan = plan_of("lab", f"robot.drive.protocol={protocol}", "can.path=closed", "claims=[]")
    commander, bank = Commander(plan, alone=True), DriveBank(plan)
    of_bridge, of_drives = set[int](), set[int]()

    def take(time_ns: int, answers: list[TimedFrame]) -> None:
        of_drives.update(timed.frame.can_id for timed in answers if timed.frame.data)
        for timed in answers:
            commander.receive(time_ns, timed.bus, timed.frame)

    for time_ns in range(-1_000_000_000, 1, 10_000_000):
        take(time_ns, bank.pass_time(time_ns))
        frames = [(robot.robot.drive.bus, robot.frames(time_ns, None)) for robot in commander.robots]
        for bus, made in [*frames, *commander.bus_frames(time_ns)]:
            of_bridge.update(frame.can_id for frame in made if frame.data)
            for frame in made:
                take(time_ns, bank.receive(time_ns, bus, frame))
    assert all(robot.host.enabled for robot in commander.robots)
    assert not of_bridge & of_drives
    assert of_bridge | of_drives <= run_identifiers(plan, 0)


def test_who_sends_what_only_the_run_may_is_named() -> None:
    plan = plan_of("lab", "can.path=closed", "claims=[]")
    (bus,) = open_guarded(plan, [free_multicast_url()])
    with bus, open_bus(bus.url) as stranger:
        for can_id, data, remote in [
            (0x100, b"x", False),
            (0x100, b"", True),
            (0x100, b"", False),
            (0x7F0, b"x", False),
        ]:
            stranger.send(can_id, data, remote=remote)
            received = bus.recv(5.0)
            assert received is not None
            check_sender(bus, {0x100, 0x101}, received)
        assert received.sender is not None
        (one,) = intrusions(plan, [bus])
    assert (one.bus, one.id, one.frames) == ("can0", "100", 1)
    assert one.sender == f"{received.sender[0]}:{received.sender[1]}"


def test_a_mirror_finds_an_intruder_behind_a_flood(tmp_path: Path) -> None:
    plan = plan_of("lab", "claims=[]")
    mirror = MirrorBridge(plan, [free_multicast_url()], tmp_path)
    with closing(mirror), open_bus(mirror.url) as stranger, open_bus(mirror.url) as listener:
        for _ in range(2 * AT_ONCE):
            stranger.send(0x7F0, b"x")
        stranger.send(0x100, b"x")
        stranger.send(0x7F1, b"the end")
        while (heard := listener.recv(60.0)) is not None and heard.can_id != 0x7F1:
            pass
        assert heard is not None  # so all have come
        mirror.progress()
        (one,) = mirror.report().intrusions
    assert (one.id, one.frames) == ("100", 1)


def test_a_mirror_looks_a_last_time_before_it_closes_its_buses(tmp_path: Path) -> None:
    """What others send after the last progress would stay unnoticed: a run of a third of a second shows its progress once."""
    mirror = MirrorBridge(plan_of("lab", "claims=[]"), [free_multicast_url()], tmp_path)
    with open_bus(mirror.url) as stranger, open_bus(mirror.url) as listener:
        assert mirror.progress().frames == 0
        stranger.send(0x100, b"x")
        assert listener.recv(60.0) is not None  # so it has come
        mirror.stop()
        mirror.close()
    (one,) = mirror.report().intrusions
    assert (one.id, one.frames) == ("100", 1)


def test_frames_without_an_address_come_from_another_node() -> None:
    guard = Guard(frozenset({1}))
    guard.count(("vcan0",), 1)
    guard.count(Received(1, b"", 0, False).sender, 1)
    assert list(guard.intrusions) == [(NODE, 1, 2)]


def test_a_flood_of_senders_takes_no_room() -> None:
    guard = Guard(frozenset({1}))
    for port in range(10_000):
        guard.count(("10.0.0.7", port), 1)
    found = list(guard.intrusions)
    assert len(found) == KEPT + 1
    assert found[0] == (OTHERS, 1, 10_000 - KEPT)


BUSES = pytest.mark.parametrize("kind", ["udp_multicast", "virtual"])
"""A bus whose frames have the addresses of their senders, and one whose frames have none, as on SocketCAN"""


def url_of(kind: str, name: str) -> str:
    """Returns the URL of a bus that nobody uses yet."""
    return free_multicast_url() if kind == "udp_multicast" else f"virtual:{name}"


def heard_last(listener: Bus) -> None:
    """Waits for the frame with the data `x`, the last one: then all frames have come."""
    while (heard := listener.recv(60.0)) is not None and heard.data != b"x":
        pass
    assert heard is not None


@BUSES
def test_drives_in_lockstep_name_who_spoke_for_them_while_they_stopped(kind: str) -> None:
    """What the bridge sends then is no intrusion, nor is what it had sent before and they have not taken yet."""
    plan = plan_of("lab", "can.path=closed", "claims=[]")
    drives = LockstepDrives(plan, [url_of(kind, "drives-stop")])
    url = drives._buses[0].url
    with open_bus(url) as stranger, open_bus(url) as listener:
        drives.stages[0].run(drives.stages[0].first_ns, ())
        sent = []
        while (heard := listener.recv(0.0)) is not None:
            sent.append(heard.can_id)
        for _ in range(2 * AT_ONCE):
            stranger.send(0x100, bytes(8))
        stranger.send(sent[0], b"x")
        heard_last(listener)
        drives.stop()
        drives.close()
    (one,) = drives.report().intrusions
    assert (one.id, one.frames) == (f"{sent[0]:03X}", 1)
    assert (one.sender == NODE) is (kind == "virtual")


@BUSES
@pytest.mark.parametrize("paired", [True, False])
def test_a_bridge_in_virtual_time_looks_a_last_time_before_it_closes_its_buses(
    kind: str, paired: bool, tmp_path: Path
) -> None:
    """What drives have still sent is no intrusion."""
    plan = plan_of("lab", "can.path=closed", "claims=[]")
    bridge = ClosedBridge(plan, [url_of(kind, f"bridge-{paired}")], tmp_path, paired=paired)
    with open_bus(bridge.url) as stranger, open_bus(bridge.url) as listener:
        bridge.rail.put([TimedFrame(0, 0, BRIDGE_NODE, Frame(0x100, bytes(8)))])
        stranger.send(0x180, bytes(8))
        stranger.send(0x100, b"x")
        heard_last(listener)
        bridge.stop()
        bridge.close()
    (one,) = bridge.report().intrusions
    assert (one.id, one.frames) == ("100", 1)
    assert (one.sender == NODE) is (kind == "virtual")


def test_a_bridge_on_a_wall_clock_looks_a_last_time_before_it_closes_its_buses(tmp_path: Path) -> None:
    plan = plan_of("lab", "can.path=closed", "claims=[]")
    bridge = WallBridge(plan, [free_multicast_url()], tmp_path, lambda payload: None, None)
    with open_bus(bridge.url) as stranger, open_bus(bridge.url) as listener:
        while (heard := listener.recv(0.0)) is None:
            bridge.serve()
        bridge.stop()
        stranger.send(heard.can_id, b"x")
        heard_last(listener)
        bridge.close()
    (one,) = bridge.report().intrusions
    assert (one.id, one.frames) == (f"{heard.can_id:03X}", 1)
