"""CAN buses that need no privileges, their URLs, and errors on a bus."""

import errno
import socket
import struct
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing
from random import Random
from typing import Any

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import interface_is_up, listen_command, resolve_url
from echelon.bridge.can.wires import _KNOWN, Datagrams, RawCan, _around_data

FRAMES = [(0x100 + number % 9, number.to_bytes(8, "little")) for number in range(500)]


@pytest.mark.parametrize(
    ("url", "full"),
    [
        ("socketcan:can1", "socketcan:can1"),
        ("udp_multicast", "udp_multicast:239.74.163.2:43113"),
        ("udp_multicast:", "udp_multicast:239.74.163.2:43113"),
        ("udp_multicast::5000", "udp_multicast:239.74.163.2:5000"),
        ("udp_multicast:239.1.2.3", "udp_multicast:239.1.2.3:43113"),
        ("udp_multicast:239.1.2.3:5000", "udp_multicast:239.1.2.3:5000"),
        ("udp_multicast:[ff15::7]:5000", "udp_multicast:[ff15::7]:5000"),
        ("virtual", "virtual:echelon"),
        ("virtual:x", "virtual:x"),
    ],
)
def test_urls(url: str, full: str) -> None:
    assert resolve_url(url) == full
    assert resolve_url(full) == full


@pytest.mark.parametrize(
    ("url", "named"),
    [
        ("", "''"),
        ("vcan0", "'vcan0'"),
        ("slcan:x", "'slcan'"),
        ("socketcan", "''"),
        ("socketcan:", "''"),
        ("socketcan:an interface", "'an interface'"),
        ("socketcan:much-too-long-a-name", "'much-too-long-a-name'"),
        ("udp_multicast:10.0.0.1", "'10.0.0.1'"),
        ("udp_multicast:239.1.2.3:x", "'239.1.2.3:x'"),
        ("udp_multicast:239.1.2.3:0", "port 0"),
        ("udp_multicast:239.1.2.3:65536", "port 65536"),
        ("udp_multicast:ff15::7", "'ff15::7'"),
        ("udp_multicast:[10.0.0.1]", "'10.0.0.1'"),
    ],
)
@pytest.mark.parametrize("function", [resolve_url, listen_command, open_bus])
def test_url_mistakes_name_the_value_and_what_is_allowed(url: str, named: str, function: Callable[[str], Any]) -> None:
    with pytest.raises(ValueError, match="allowed: socketcan:INTERFACE, udp_multicast") as caught:
        function(url)
    assert repr(url) in str(caught.value)
    assert named in str(caught.value)


def test_auto_is_a_real_interface_or_a_port_of_its_own() -> None:
    urls = {resolve_url("auto") for _ in range(5)}
    if interface_is_up("vcan0"):
        assert urls == {"socketcan:vcan0"}
    else:
        assert all(url.startswith("udp_multicast:239.74.163.2:") for url in urls)
        assert "udp_multicast:239.74.163.2:43113" not in urls


def test_how_to_listen() -> None:
    assert listen_command("socketcan:vcan3") == "candump vcan3"
    assert listen_command("udp_multicast:[ff15::7]:9") == "can_logger -i udp_multicast -c ff15::7 --bus-kwargs port=9"
    assert listen_command("virtual:x") == ""


def test_interface_is_up() -> None:
    assert interface_is_up("lo")
    assert not interface_is_up("no-such-one")


def test_interface_that_is_missing() -> None:
    with pytest.raises(OSError, match="cannot open CAN bus socketcan:nosuchcan0: "):
        open_bus("socketcan:nosuchcan0")


def own_url(kind: str) -> str:
    # a port, or a channel, that no other test uses
    return resolve_url("auto") if kind == "udp_multicast" else f"virtual:{uuid.uuid4()}"


def open_or_skip(url: str) -> Bus:
    try:
        return open_bus(url)
    except OSError as error:
        pytest.skip(f"no multicast here: {error}")


@pytest.mark.parametrize("kind", ["udp_multicast", "virtual"])
def test_frames_arrive_whole_and_in_order(kind: str) -> None:
    with open_or_skip(own_url(kind)) as sender, open_bus(sender.url) as receiver:
        for number, (can_id, data) in enumerate(FRAMES):
            assert sender.send(can_id, data, number * 1_000_000)
        got = [receiver.recv(5.0) for _ in FRAMES]
        assert [frame and (frame.can_id, frame.data, frame.remote) for frame in got] == [
            (*one, False) for one in FRAMES
        ]
        assert receiver.recv(0.0) is None
        if kind == "virtual":
            assert [frame and frame.time_ns for frame in got] == [number * 1_000_000 for number in range(len(FRAMES))]
        assert (sender.counts.sent, sender.counts.failed, sender.counts.dropped) == (len(FRAMES), 0, 0)
        assert (receiver.counts.received, receiver.counts.recv_failed, sender.counts.received) == (len(FRAMES), 0, 0)


ODD = [
    msgpack.packb({"arbitration_id": can_id, "is_extended_id": False, "is_remote_frame": remote, "data": b"", "dlc": 0})
    for can_id, remote in [(5.0, False), (float("nan"), False), (True, False), (5, "x"), (5, [1]), (5, 2)]
]
"""Invalid datagrams that python-can decodes as frames"""


@pytest.fixture
def multicast() -> Iterator[tuple[Bus, can.BusABC]]:
    """A bus of this project and one of python-can, on the same group and port."""
    with open_or_skip(own_url("udp_multicast")) as bus:
        group, _, port = bus.url.partition(":")[2].rpartition(":")
        with can.Bus(
            interface="udp_multicast", channel=group, port=int(port), hop_limit=0, ignore_config=True
        ) as plain:
            yield bus, plain


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans())
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_python_can_takes_our_datagrams_and_we_take_its(
    multicast: tuple[Bus, can.BusABC], can_id: int, data: bytes, remote: bool
) -> None:
    bus, plain = multicast
    data = b"" if remote else data
    assert bus.send(can_id, data, remote=remote)
    came = plain.recv(5.0)
    assert came is not None
    assert (came.arbitration_id, bytes(came.data), came.dlc) == (can_id, data, len(data))
    assert (came.is_remote_frame, came.is_extended_id, came.is_error_frame, came.is_fd) == (remote, False, False, False)
    plain.send(can.Message(arbitration_id=can_id, data=data, is_remote_frame=remote, is_extended_id=False))
    answer = bus.recv(5.0)  # python-can's frame, not the equal frame that the bus sent itself
    assert answer is not None
    assert (answer.can_id, answer.data, answer.remote) == (can_id, data, remote)
    assert abs(answer.time_ns - time.time_ns()) < 60_000_000_000
    assert plain.recv(5.0) is not None  # python-can receives its own frames


def test_when_the_way_to_the_group_changes_the_next_frame_takes_the_new_one(
    multicast: tuple[Bus, can.BusABC],
) -> None:
    bus, plain = multicast

    def gone(payload: bytes, flags: int) -> int:
        raise OSError(errno.ENETUNREACH, "no route")

    assert bus._wire is not None
    bus._wire.send = gone
    assert [bus.send(number, b"") for number in range(3)] == [False, True, True]
    assert (bus.counts.failed, bus.counts.sent) == (1, 2)
    assert [(plain.recv(5.0) or can.Message()).arbitration_id for _ in range(2)] == [1, 2]
    assert bus.recv() is None


@pytest.mark.parametrize("group", ["ff02::e1", "ff15::e1"])
def test_groups_of_every_scope(group: str) -> None:
    port = own_url("udp_multicast").rpartition(":")[2]
    with open_or_skip(f"udp_multicast:[{group}]:{port}") as bus, open_bus(bus.url) as other:
        if not bus.send(1, b"x"):
            pytest.skip(f"no way to {group} here: {bus.error}")
        assert (other.recv(5.0) or (0,))[:2] == (1, b"x")
        assert bus.recv() is None


def test_what_is_no_frame_for_us_is_counted_or_passed_over(multicast: tuple[Bus, can.BusABC]) -> None:
    bus, plain = multicast
    for other in ({"is_extended_id": True}, {"is_error_frame": True, "is_extended_id": False}):
        plain.send(can.Message(arbitration_id=5, **other))
    group, _, port = bus.url.partition(":")[2].rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for junk in (b"", b"junk", bytes(3000), b"\x80", b"\x81\xaearbitration_id\xa3abc", *ODD):
            stranger.sendto(junk, (group, int(port)))
    plain.send(can.Message(arbitration_id=7, is_extended_id=False))
    got = bus.recv(5.0)  # what came before is passed over: None would mean that there is no frame
    assert got is not None
    assert got.can_id == 7
    assert bus.counts.recv_failed >= 4 + len(ODD)
    assert bus.counts.received == 1


def test_a_flood_of_what_is_no_frame_keeps_nobody_for_ever(
    multicast: tuple[Bus, can.BusABC], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("echelon.bridge.can.bus._JUNK", 100)  # fewer than the smallest buffer of the kernel holds
    bus, _ = multicast
    group, _, port = bus.url.partition(":")[2].rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for _ in range(150):
            stranger.sendto(b"junk", (group, int(port)))
        assert bus.recv(None) is None  # though it would wait for ever
        assert bus.counts.recv_failed < 150


def test_a_receiver_keeps_earlier_frames_when_later_ones_are_sent() -> None:
    with open_bus(own_url("virtual")) as sender, open_bus(sender.url) as receiver:
        sender.send(1, b"first")
        sender.send(2, b"second")
        first, second = receiver.recv(), receiver.recv()
        assert first is not None
        assert second is not None
        assert (first.data, second.data) == (b"first", b"second")


def test_a_bus_nobody_reads_drops_without_blocking() -> None:
    with open_bus(own_url("virtual")) as sender, open_bus(sender.url):
        sent = [sender.send(1, b"") for _ in range((1 << 16) + 10)]
        assert (sum(sent), sender.counts.failed + sender.counts.dropped) == (1 << 16, 10)


def test_a_remote_frame_has_no_data() -> None:
    with open_bus(own_url("virtual")) as bus, pytest.raises(ValueError, match="remote frame"):
        bus.send(1, b"x", remote=True)


@pytest.mark.parametrize(("can_id", "data"), [(0x800, b""), (-1, b""), (1, bytes(9))])
def test_no_classic_frame(can_id: int, data: bytes) -> None:
    with open_bus(own_url("virtual")) as bus, pytest.raises(ValueError, match="classic"):
        bus.send(can_id, data)


class Socket:
    """Stands for a raw CAN socket.  Each send fails with the next errno of `answers`; 0 is success."""

    def __init__(self, answers: list[int], bind: int = 0) -> None:
        self.answers = answers
        self.bind_answer = bind
        self.sent: list[bytes] = []
        self.filters: list[bytes] = []

    def send(self, frame: bytes, flags: int) -> int:
        answer = self.answers.pop(0)
        if answer:
            raise OSError(answer, "refused")
        self.sent.append(frame)
        return len(frame)

    def setsockopt(self, level: int, option: int, value: bytes) -> None:
        assert (level, option) == (socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER)
        self.filters.append(value)

    def bind(self, address: tuple[str]) -> None:
        assert address == ("vcan0",)
        if self.bind_answer:
            raise OSError(self.bind_answer, "refused")

    def close(self) -> None:
        pass


def raw_bus(answers: list[int], bind: int = 0) -> tuple[Bus, Socket, list[float]]:
    raw, pauses = Socket(answers, bind), list[float]()
    bus = Bus("socketcan:vcan0", RawCan(raw, "vcan0"), pauses.append)  # type: ignore[arg-type]
    return bus, raw, pauses


def test_bytes_on_a_raw_socket() -> None:
    bus, raw, _ = raw_bus([0, 0])
    assert bus.send(0x17E, b"\x01\x02")
    assert bus.send(1, bytes(range(8)))
    assert [frame.hex() for frame in raw.sent] == [
        "7e010000020000000102000000000000",
        "01000000080000000001020304050607",
    ]
    bus.close()


def kernel_frame(can_id: int, data: bytes) -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data)


def test_receiving_on_a_raw_socket() -> None:
    bus, _, _ = raw_bus([])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        bus._wire = RawCan(ours, "vcan0")
        assert bus.recv(0.0) is None
        for can_id in (0x80000123, 0x20000004, 0x40000105, 0x7FF):  # extended, error, remote, plain
            theirs.send(kernel_frame(can_id, b"0123"))
        before_ns = time.time_ns()
        got = [bus.recv(0.0), bus.recv(None), bus.recv(0.0)]
        assert [frame and (frame.can_id, frame.data, frame.remote) for frame in got] == [
            (0x105, b"", True),
            (0x7FF, b"0123", False),
            None,
        ]
        assert got[0] is not None
        assert before_ns <= got[0].time_ns <= time.time_ns()
        assert (bus.counts.received, bus.counts.recv_failed) == (2, 0)
    bus.close()


class Stamped:
    """Stands for a raw CAN socket whose frames have these time stamps [ns]."""

    def __init__(self, stamps: list[int]) -> None:
        self.stamps = stamps

    def recvmsg(self, size: int, space: int, flags: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        stamp = struct.pack("@ll", *divmod(self.stamps.pop(0), 1_000_000_000))
        return kernel_frame(1, b""), [(0, 0, stamp)], 0, None

    def send(self, frame: bytes, flags: int) -> int:
        return len(frame)

    def close(self) -> None:
        pass


def test_stamps_of_frames_do_not_run_backwards_but_with_the_clock() -> None:
    """Stamps of two processors may be out of order by microseconds, which is corrected; a clock set back by seconds is not."""
    bus, _, _ = raw_bus([])
    at, back = 1_700_000_000_000_000_000, 5_000_000_000
    bus._wire = RawCan(Stamped([at, at - 2_000, at + 1, at - back, at - back + 7]), "vcan0")  # type: ignore[arg-type]
    got = [bus.recv(0.0) for _ in range(5)]
    assert [frame and frame.time_ns - at for frame in got] == [0, 0, 1, -back, 7 - back]
    bus.close()


def test_waiting_on_a_raw_socket_ends_with_a_frame_or_with_the_time() -> None:
    bus, _, _ = raw_bus([])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        bus._wire = RawCan(ours, "vcan0")
        begun_s = time.monotonic()
        assert bus.recv(0.05) is None
        assert time.monotonic() - begun_s >= 0.05
        only_others = threading.Timer(0.05, lambda: theirs.send(kernel_frame(0x80000001, b"")))
        only_others.start()
        assert bus.recv(0.2) is None
        frame = threading.Timer(0.05, lambda: theirs.send(kernel_frame(1, b"")))
        frame.start()
        received = bus.recv(None)
        assert received is not None
        assert received.can_id == 1
        for timer in (only_others, frame):
            timer.join()
    bus.close()


def test_trouble_while_receiving_on_a_raw_socket_is_counted() -> None:
    bus, _, _ = raw_bus([])
    closed = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    closed.close()
    bus._wire = RawCan(closed, "vcan0")
    assert bus.recv(None) is None
    assert bus.counts.recv_failed == 1
    assert isinstance(bus.error, OSError)
    bus.close()


def test_a_full_queue_is_retried_then_dropped_and_holds_up_only_once() -> None:
    full = errno.ENOBUFS
    bus, raw, pauses = raw_bus([full, errno.EAGAIN, 0] + [full] * 10 + [full] + [0] + [full, 0])
    assert bus.send(1, b"")
    assert len(pauses) == 2
    assert not bus.send(2, b"")
    assert len(pauses) == 12
    assert not bus.send(3, b"")  # the queue is still full: one attempt only
    assert len(pauses) == 13
    assert bus.send(4, b"")
    assert bus.send(5, b"")  # after a success there are several attempts again
    assert raw.answers == []
    assert (bus.counts.sent, bus.counts.dropped, bus.counts.failed) == (3, 2, 0)
    assert sum(pauses[2:12]) <= 0.005 + 1e-9
    bus.close()


class Grumbler:
    """Stands for python-can's bus.  Each send raises the next error of `answers`; None is success."""

    def __init__(self, answers: list[Exception | None]) -> None:
        self.answers = answers
        self.patience: list[float] = []

    def send(self, message: can.Message, timeout: float) -> None:
        self.patience.append(timeout)
        if answer := self.answers.pop(0):
            raise answer

    def recv(self, timeout: float | None) -> None:
        raise can.CanOperationError("not a frame")

    def shutdown(self) -> None:
        pass


def test_trouble_on_other_buses_is_counted_and_holds_up_only_once() -> None:
    with open_bus(own_url("virtual")) as bus:
        bus._plain.shutdown()
        full = can.CanOperationError("failed to send")
        full.__cause__ = BlockingIOError(errno.EAGAIN, "full")
        fake = Grumbler(
            [can.CanTimeoutError(), full, None, can.CanOperationError("no route"), OSError("odd"), None, None]
        )
        bus._plain = fake
        assert [bus.send(1, b"") for _ in range(7)] == [False, False, True, False, False, True, True]
        assert [timeout > 0 for timeout in fake.patience] == [True, False, False, True, False, False, True]
        assert (bus.counts.sent, bus.counts.dropped, bus.counts.failed) == (3, 2, 2)
        assert bus.recv() is None
        assert bus.counts.recv_failed == 1


def test_an_interface_that_goes_down_or_away_is_survived() -> None:
    bus, raw, pauses = raw_bus([errno.ENETDOWN, 0, errno.ENXIO, 0], bind=0)
    assert [bus.send(1, b"") for _ in range(3)] == [False, True, True]
    assert (bus.counts.sent, bus.counts.failed, pauses) == (2, 1, [])
    assert raw.filters == [struct.pack("=II", 0, socket.CAN_EFF_FLAG)]  # the kernel deleted them with the interface
    raw.answers, raw.bind_answer = [errno.ENODEV, errno.ENXIO], errno.ENODEV
    assert [bus.send(1, b"") for _ in range(2)] == [False, False]
    assert bus.counts.failed == 3
    assert isinstance(bus.error, OSError)
    bus.close()


def said_of(take: Callable[[bytes], object], payload: bytes) -> object:
    """Returns what is read from a datagram, or that it is none."""
    try:
        return take(payload)
    except Exception:
        return "no frame"


@pytest.mark.parametrize(
    "frame",
    [(1, b"", False), (0x7F, b"", True), (0x80, b"abc", False), (0x103, b"\xc4\x08" * 4, False), (0x7FF, b"", True)],
)
def test_a_datagram_is_read_as_python_can_does_whatever_came_before(frame: tuple[int, bytes, bool]) -> None:
    random, (can_id, data, remote) = Random(1), frame
    with closing(Datagrams("239.74.163.2", 43119)) as wire:
        payload = wire.encode(can_id, data, remote)
        assert wire.decode(payload) == Datagrams.unpack(payload) == frame
        assert wire.decode(payload) == frame
        for at in range(len(payload)):
            for value in {0, 1, 0x7F, 0xC2, 0xC3, 0xFF, random.randrange(256)}:
                changed = payload[:at] + bytes([value]) + payload[at + 1 :]
                assert said_of(wire.decode, changed) == said_of(Datagrams.unpack, changed)
            for changed in (payload[:at], payload[:at] + payload[at + 1 :], payload[:at] + b"\0" + payload[at:]):
                assert said_of(wire.decode, changed) == said_of(Datagrams.unpack, changed)
        assert wire.decode(payload) == frame


def test_datagrams_of_others_cost_no_packing_each() -> None:
    """Those with a time stamp are not as this project sends them, and are unpacked each time."""
    with closing(Datagrams("239.74.163.2", 43119)) as wire:
        before = _around_data.cache_info().misses
        for number in range(100):
            sent = can.Message(timestamp=number / 7, arbitration_id=0x3A7, data=[number] * 5, is_extended_id=False)
            assert wire.decode(pack_message(sent)) == (0x3A7, bytes([number] * 5), False)
        assert _around_data.cache_info().misses <= before + 1
        assert len(wire._heard) == 1  # of number 0, whose time stamp is 0


def test_what_is_known_of_datagrams_is_bounded() -> None:
    with closing(Datagrams("239.74.163.2", 43119)) as wire:
        for can_id in range(0x7FF):
            for length in range(9):
                frame = can_id, bytes([can_id & 0xFF] * length), False
                assert wire.decode(wire.encode(*frame)) == frame
        assert len(wire._heard) == _KNOWN
