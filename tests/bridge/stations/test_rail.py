"""The time rail: in virtual time a station uses only frames that the bus really carried, bit for bit."""

import threading
from collections.abc import Iterator
from itertools import count

import pytest

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import free_multicast_url
from echelon.bridge.frame_message import NO_BUS, TimedFrame, pack
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.stations import rail as on_bus_module
from echelon.bridge.stations.rail import BusError, Rail, on_bus
from echelon.messages import Channel, Heard, Message
from echelon.role import Stage
from echelon.runtime.turns import Turn

NUMBERS = count()
OF_BRIDGE = [TimedFrame(1000 * at, 0, 0, Frame(0x100 + at, bytes([at] * 8))) for at in range(3)]
OF_DRIVES = [TimedFrame(1000, 0, 4, Frame(0x180, b"report")), TimedFrame(2000, 0, 5, Frame(0x181, b"", True))]
EMPTIED = TimedFrame(0, NO_BUS, 4, Frame(0))


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    url = f"virtual:on-bus-{next(NUMBERS)}"
    with open_bus(url) as one, open_bus(url) as other:
        yield one, other


def message(frames: list[TimedFrame]) -> Message:
    return Message(Channel.FRAMES, 13, 0, 0, pack(frames))


def station(rail: Rail, is_bridge: bool, says: list[TimedFrame], heard: list[Heard]) -> Stage:
    """Returns a stage on a rail that keeps the messages it gets and sends the frames `says`."""

    def run(time_ns: int, messages: object) -> tuple[Message, ...]:
        heard.extend(messages)  # type: ignore[arg-type]
        return (message(says),) if says else ()

    (stage,) = on_bus([Stage(Turn.HEAR, 1, (), run)], rail, is_bridge)
    return stage


def drain(bus: Bus) -> list[Frame]:
    found = []
    while (received := bus.recv(0.0)) is not None:
        found.append(Frame(received.can_id, received.data, received.remote))
    return found


@pytest.mark.parametrize("is_bridge", [True, False])
def test_a_station_puts_its_own_frames_and_no_others(buses: tuple[Bus, Bus], is_bridge: bool) -> None:
    station(Rail(buses[:1]), is_bridge, [EMPTIED, *OF_BRIDGE, *OF_DRIVES], []).run(0, [])
    assert drain(buses[1]) == [timed.frame for timed in (OF_BRIDGE if is_bridge else OF_DRIVES)]


@pytest.mark.parametrize("is_bridge", [True, False])
def test_a_station_takes_what_the_bus_carried(buses: tuple[Bus, Bus], is_bridge: bool) -> None:
    mine, other = buses
    rail, heard = Rail([mine]), list[Heard]()
    other.send(0x7FF, b"stranger")
    for timed in OF_DRIVES if is_bridge else OF_BRIDGE:
        other.send(timed.frame.can_id, timed.frame.data, remote=timed.frame.remote)
    said = message([EMPTIED, *OF_BRIDGE, *OF_DRIVES])
    station(rail, is_bridge, [], heard).run(0, [said, None])
    assert heard == [said, None]
    assert rail.foreign == 1
    assert drain(mine) == []


def test_who_asks_for_a_frame_is_no_intruder() -> None:
    """A remote frame or an empty one is foreign, but says nothing in the run's name."""
    url = free_multicast_url()
    with open_bus(url, frozenset({OF_BRIDGE[0].frame.can_id})) as mine, open_bus(url) as other:
        rail = Rail([mine])
        for data, remote in ((b"", True), (b"", False), (b"forged", False)):
            other.send(OF_BRIDGE[0].frame.can_id, data, remote=remote)
        for timed in OF_DRIVES:
            other.send(timed.frame.can_id, timed.frame.data, remote=timed.frame.remote)
        station(rail, True, [], []).run(0, [message([*OF_BRIDGE, *OF_DRIVES]), None])
        assert rail.foreign == 3
        assert [frames for *_, frames in mine.guard.intrusions] == [1]


@pytest.mark.parametrize("spoiled", ["lost", "other data", "wrong order"])
def test_a_frame_that_did_not_come_as_it_was_sent_is_an_error_and_nothing_is_used(
    buses: tuple[Bus, Bus], monkeypatch: pytest.MonkeyPatch, spoiled: str
) -> None:
    monkeypatch.setattr(on_bus_module, "LOST_AFTER_S", 0.05)
    mine, other = buses
    frames = [timed.frame for timed in OF_BRIDGE]
    match spoiled:
        case "lost":
            del frames[1]
        case "other data":
            frames[1] = frames[1]._replace(data=b"\xff" * 8)
        case "wrong order":
            frames.reverse()
    for can_id, data, remote in frames:
        other.send(can_id, data, remote=remote)
    heard: list[Heard] = []
    with pytest.raises(BusError, match="did not come"):
        station(Rail([mine]), False, [], heard).run(0, [message(OF_BRIDGE)])
    assert heard == []


def test_it_waits_for_frames_that_are_still_on_their_way(buses: tuple[Bus, Bus]) -> None:
    mine, other = buses
    heard: list[Heard] = []
    stage = station(Rail([mine]), False, [], heard)
    thread = threading.Thread(target=stage.run, args=(0, [message(OF_BRIDGE)]), daemon=True)
    thread.start()
    for timed in OF_BRIDGE:
        assert heard == []
        other.send(timed.frame.can_id, timed.frame.data)
    thread.join(10)
    assert len(heard) == 1


def test_a_bus_that_takes_no_frames_is_waited_for_until_the_run_is_to_stop(
    buses: tuple[Bus, Bus], monkeypatch: pytest.MonkeyPatch
) -> None:
    rail = Rail(buses[:1])
    refusals = iter([False, False, True, True, False])
    tried: list[int] = []

    def send(bus: Bus, can_id: int, data: bytes, time_ns: int = 0, remote: bool = False) -> bool:
        tried.append(can_id)
        taken = next(refusals, False)
        if len(tried) > 5:
            rail.stopping.set()
        return taken

    monkeypatch.setattr(Bus, "send", send)
    assert rail.put(OF_BRIDGE) == 2
    assert tried[:4] == [0x100, 0x100, 0x100, 0x101]
    assert set(tried[4:]) == {0x102}
    assert "takes no frames" in rail.waiting
