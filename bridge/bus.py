"""CAN buses by URL. The only module that knows python-can.

    socketcan:vcan0                      an interface of the kernel
    udp_multicast:[group][:port]         several processes on one host without privileges; 239.74.163.2 and 43113 unless
                                         given, an IPv6 group in brackets
    virtual[:channel]                    inside this process
    auto                                 socketcan:vcan0 where that exists and is up, else udp_multicast on a free port

Frames are classic ones with 11-bit identifiers. On udp_multicast all groups that share a port on one host hear each
other: two buses need two ports. Its datagrams do not leave the host. What a bus sent itself it does not receive.
"""

import errno
import fcntl
import ipaddress
import os
import re
import select
import socket
import struct
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import can
from can.interfaces.socketcan import SocketcanBus

ALLOWED = "socketcan:INTERFACE, udp_multicast:[GROUP][:PORT], virtual[:CHANNEL] or auto"
DEFAULT_GROUP = "239.74.163.2"
DEFAULT_PORT = 43113
DEFAULT_INTERFACE = "vcan0"

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of linux/can.h
_REMOTE = 0x40000000  # CAN_RTR_FLAG
_OTHER = 0xA0000000  # CAN_EFF_FLAG, CAN_ERR_FLAG: frames with 29-bit identifiers, and news of the controller
_STAMP = struct.Struct("@ll")  # struct timespec, what SO_TIMESTAMPNS gives
_STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)
_BUFFER = 4 << 20
_TRIES = 10
_ECHOES = 1024  # frames sent over multicast that may still be on their way back
_PAUSE = 0.0005  # [s]; with _TRIES, one full queue holds the caller up for 5 ms at most
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_GONE = (errno.ENXIO, errno.ENODEV)


class Received(NamedTuple):
    """A frame from the bus: identifier, data, time of arrival [ns since 1970], and whether it is a remote frame."""

    can_id: int
    data: bytes
    time_ns: int
    remote: bool


@dataclass(slots=True)
class BusCounts:
    """What became of the frames: accepted by the bus; refused by it (interface down or gone); given up because its
    queue stayed full. `received` counts those that came, `recv_failed` errors while receiving."""

    sent: int = 0
    failed: int = 0
    dropped: int = 0
    received: int = 0
    recv_failed: int = 0


@dataclass(frozen=True, slots=True)
class _Address:
    interface: str
    channel: str
    port: int = 0

    def __str__(self) -> str:
        if self.interface != "udp_multicast":
            return f"{self.interface}:{self.channel}"
        group = f"[{self.channel}]" if ":" in self.channel else self.channel
        return f"{self.interface}:{group}:{self.port}"


def resolve_url(url: str, number: int = 0) -> str:
    """The URL in full, with what `auto` stands for here and now, to be handed to all processes that share the bus.

    Of several buses number 1 looks for vcan1, and so on. Raises ValueError for a URL that is none."""
    if url == "auto" and number:
        return resolve_url(
            f"socketcan:vcan{number}" if interface_is_up(f"vcan{number}") else f"udp_multicast::{_free_port()}"
        )
    return str(_parse(url))


def listen_command(url: str) -> str:
    """What to type to see the frames of a bus; empty for one that is not visible from outside. ValueError as above."""
    address = _parse(url)
    if address.interface == "socketcan":
        return f"candump {address.channel}"
    if address.interface == "udp_multicast":
        return f"can_logger -i udp_multicast -c {address.channel} --bus-kwargs port={address.port}"
    return ""


def _parse(url: str) -> _Address:
    if url == "auto":
        if interface_is_up(DEFAULT_INTERFACE):
            return _Address("socketcan", DEFAULT_INTERFACE)
        return _Address("udp_multicast", DEFAULT_GROUP, _free_port())
    interface, _, rest = url.partition(":")
    if interface == "socketcan":
        if not re.fullmatch(r"[^\s/:]{1,15}", rest):
            raise ValueError(f"CAN URL {url!r}: {rest!r} is no interface name; allowed: {ALLOWED}")
        return _Address(interface, rest)
    if interface == "virtual":
        return _Address(interface, rest or "echelon")
    if interface != "udp_multicast":
        raise ValueError(f"CAN URL {url!r}: {interface!r} is not known; allowed: {ALLOWED}")
    parts = re.fullmatch(r"(?:\[(.*)\]|([^:\[\]]*))(?::([0-9]{1,5})?)?", rest)
    if parts is None:
        raise ValueError(f"CAN URL {url!r}: {rest!r} is not [GROUP][:PORT], IPv6 in brackets; allowed: {ALLOWED}")
    group = parts[1] or parts[2] or DEFAULT_GROUP
    port = int(parts[3] or DEFAULT_PORT)
    try:
        multicast = ipaddress.ip_address(group).is_multicast
    except ValueError:
        multicast = False
    if not multicast:
        raise ValueError(f"CAN URL {url!r}: {group!r} is no multicast address; allowed: {ALLOWED}")
    if not 0 < port < 65536:
        raise ValueError(f"CAN URL {url!r}: port {port} is not 1 .. 65535; allowed: {ALLOWED}")
    return _Address(interface, group, port)


def interface_is_up(name: str) -> bool:
    """Whether a network interface of this name exists and is up."""
    request = struct.pack("16sH14x", name.encode()[:15], 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            answer = fcntl.ioctl(any_socket, 0x8913, request)  # SIOCGIFFLAGS
        except OSError:
            return False
    return bool(struct.unpack("16xH14x", answer)[0] & 1)  # IFF_UP


def _free_port() -> int:
    port = DEFAULT_PORT  # which is for those who ask for it
    while port == DEFAULT_PORT:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            port = probe.getsockname()[1]
    return port


def open_bus(url: str) -> "Bus":
    """Opens a bus. Raises ValueError for a URL that is none, and OSError where the bus cannot be had."""
    address = _parse(url)
    options: dict[str, dict[str, Any]] = {
        "socketcan": {"ignore_rx_error_frames": True},
        "udp_multicast": {"port": address.port, "hop_limit": 0, "fd": False},
        # a queue that nobody reads must not grow without end
        "virtual": {"preserve_timestamps": True, "rx_queue_size": 1 << 16},
    }
    try:
        bus = can.Bus(
            interface=address.interface,
            channel=address.channel,
            ignore_config=True,
            can_filters=[{"can_id": 0, "can_mask": 0, "extended": False}],
            **options[address.interface],
        )
    except (can.CanError, OSError) as error:
        cause = error.__cause__ or error
        raise OSError(f"cannot open CAN bus {address}: {cause}") from error
    return Bus(bus, str(address))


class Bus:
    """A bus to send frames on. Trouble on it is survived and counted in `counts`, the last error kept in `error`."""

    __slots__ = ("_bus", "_echoes", "_message", "_sleep", "_socket", "_tries", "counts", "error", "url")

    def __init__(self, bus: can.BusABC, url: str, sleep: Callable[[float], None] = time.sleep) -> None:
        self.url = url  # in full, as other processes need it
        self.counts = BusCounts()
        self.error: Exception | None = None
        self._bus = bus
        self._sleep = sleep
        self._tries = _TRIES
        self._echoes: OrderedDict[tuple[int, bytes, bool], int] | None = None
        if url.startswith("udp_multicast"):
            self._echoes = OrderedDict()
        self._message = can.Message(is_extended_id=False)
        # python-can's send() and recv() cost several times the system call; on a raw socket a frame is 16 bytes
        self._socket: socket.socket | None = bus.socket if isinstance(bus, SocketcanBus) else None
        _enlarge_buffers(bus)

    @property
    def channel(self) -> str:
        """The word that names the bus in a log: the interface, or the kind of bus where there is none."""
        kind, _, rest = self.url.partition(":")
        return rest if kind == "socketcan" else kind

    def send(self, can_id: int, data: bytes, time_ns: int = 0, remote: bool = False) -> bool:
        """Sends a frame, a remote one if `remote`; false if it was not accepted, which is counted. Blocks for 5 ms at most.

        `time_ns` is the time stamp that receivers on a virtual bus see; other buses put their own.
        Raises ValueError for an identifier of more than 11 bits or more than 8 bytes."""
        if can_id >> 11 or len(data) > 8:
            raise ValueError(f"no classic CAN frame with an 11-bit identifier: {can_id:#x}, {len(data)} bytes")
        if self._socket is not None:
            return self._send_raw(self._socket, _FRAME.pack(can_id | _REMOTE if remote else can_id, len(data), data))
        message = self._message
        message.arbitration_id, message.dlc, message.data = can_id, len(data), bytearray(data)
        message.is_remote_frame = remote
        message.timestamp = time_ns * 1e-9
        if self._echoes is not None:
            self._expect_echo(self._echoes, (can_id, bytes(data), remote))
        try:
            self._bus.send(message, timeout=_TRIES * _PAUSE if self._tries > 1 else 0)
        except (can.CanError, OSError) as error:
            self.error = error
            if isinstance(error, can.CanTimeoutError) or _errno(error) in _FULL:
                return self._drop()
            self._tries = 1
            self.counts.failed += 1
            return False
        return self._accepted()

    def _send_raw(self, raw: socket.socket, frame: bytes) -> bool:
        for _ in range(self._tries):
            try:
                raw.send(frame, socket.MSG_DONTWAIT)
            except OSError as error:
                self.error = error
                if error.errno in _FULL:
                    self._sleep(_PAUSE)
                elif not (error.errno in _GONE and self._rebind(raw)):
                    self.counts.failed += 1
                    return False
            else:
                return self._accepted()
        return self._drop()

    def _rebind(self, raw: socket.socket) -> bool:
        """A socket whose interface was removed stays without one, even if it comes back under the same name."""
        try:
            raw.bind((self.url.partition(":")[2],))
        except OSError:
            return False
        return True

    def _accepted(self) -> bool:
        self._tries = _TRIES
        self.counts.sent += 1
        return True

    def _drop(self) -> bool:
        # a queue that stays full, as on a bus that is off, must not hold up every frame
        self._tries = 1
        self.counts.dropped += 1
        return False

    def recv(self, timeout: float | None = 0.0) -> Received | None:
        """The next frame, or None if there is none within `timeout` [s] (None: wait for ever) or receiving failed."""
        if self._socket is not None:
            return self._recv_raw(self._socket, timeout)
        while True:
            try:
                message = self._bus.recv(timeout)
            except Exception as error:  # whatever python-can makes of a datagram that is none of its own
                self.error = error
                self.counts.recv_failed += 1
                return None
            if message is None:
                return None
            if message.is_error_frame or message.is_fd or message.is_extended_id:
                continue
            data = b"" if message.is_remote_frame else bytes(message.data)
            key = message.arbitration_id, data, message.is_remote_frame
            if self._echoes and (count := self._echoes.get(key)):
                if count == 1:
                    del self._echoes[key]
                else:
                    self._echoes[key] = count - 1
                continue
            self.counts.received += 1
            return Received(message.arbitration_id, data, round(message.timestamp * 1e9), message.is_remote_frame)

    def _recv_raw(self, raw: socket.socket, timeout: float | None) -> Received | None:
        deadline_s = None  # known once there is something to wait for
        while True:
            try:
                frame, stamps, _, _ = raw.recvmsg(_FRAME.size, _STAMP_SPACE, socket.MSG_DONTWAIT)
            except BlockingIOError:
                if timeout is not None:
                    now_s = time.monotonic()
                    deadline_s = now_s + timeout if deadline_s is None else deadline_s
                    if now_s >= deadline_s:
                        return None
                poll = select.poll()
                poll.register(raw, select.POLLIN)
                poll.poll(None if deadline_s is None else (deadline_s - now_s) * 1e3)
                continue
            except OSError as error:
                self.error = error
                self.counts.recv_failed += 1
                return None
            can_id, length, data = _FRAME.unpack(frame)
            remote = can_id & _REMOTE != 0
            if can_id & _OTHER or length > 8:
                continue
            seconds, nanoseconds = _STAMP.unpack(stamps[0][2]) if stamps else (0, time.time_ns())
            data = b"" if remote else data[:length]
            self.counts.received += 1
            return Received(can_id & 0x7FF, data, seconds * 1_000_000_000 + nanoseconds, remote)

    @staticmethod
    def _expect_echo(echoes: "OrderedDict[tuple[int, bytes, bool], int]", key: tuple[int, bytes, bool]) -> None:
        echoes[key] = echoes.get(key, 0) + 1
        if len(echoes) > _ECHOES:  # some did not come back
            echoes.popitem(last=False)

    def fileno(self) -> int:
        """The file descriptor that is readable when there is something to receive. OSError on a virtual bus."""
        try:
            return self._bus.fileno()
        except NotImplementedError as error:
            raise OSError(f"{self.url} has no file descriptor") from error

    def close(self) -> None:
        """Closes the bus."""
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _errno(error: BaseException) -> int | None:
    """The error number of an OSError, or of the one that python-can made its own error from."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return cause.errno if isinstance(cause, OSError) else None


def _enlarge_buffers(bus: can.BusABC) -> None:
    """Asks for buffers that hold a burst while a process waits for its turn; the kernel grants what it allows."""
    try:
        number = os.dup(bus.fileno())
    except (NotImplementedError, OSError):
        return  # not a socket
    with socket.socket(fileno=number) as same:
        for option, force in ((socket.SO_SNDBUF, 32), (socket.SO_RCVBUF, 33)):  # SO_SNDBUFFORCE, SO_RCVBUFFORCE
            try:
                same.setsockopt(socket.SOL_SOCKET, force, _BUFFER)
            except OSError:
                same.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
