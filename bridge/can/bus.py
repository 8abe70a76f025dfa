"""CAN buses by URL (bridge.can.bus_url): opening, sending, receiving.

All frames are classic CAN frames with 11-bit identifiers. A bus does not receive the frames that it sent itself.

On udp_multicast, groups with the same port on one host hear each other. So two buses need two ports. The datagrams do not
leave the host.

Only this module and bridge.can.wires use python-can. It opens the buses and defines the format of a datagram. Its send()
and recv() take several times as long as the system call, so this module reads and writes the sockets directly.
"""

import errno
import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import can
from can.interfaces.socketcan import SocketcanBus

from echelon.bridge.can.bus_url import Address, parse
from echelon.bridge.can.wires import Datagrams, RawCan, Wire, enlarge_buffers

_STAMP = struct.Struct("@ll")  # struct timespec, as SO_TIMESTAMPNS returns it
_STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)
_TRIES = 10
_AT_ONCE = int(socket.MSG_DONTWAIT)
_PAUSE = 0.0005  # [s]; _TRIES pauses: a full queue delays the caller by 5 ms at most
_SKEW_NS = 1_000_000
"""Time stamps may run backwards by less than this; the later frame then gets the stamp of the one before it.  Processors
stamp frames of several senders in parallel, some microseconds before the frames enter the common queue."""
_FULL = (errno.ENOBUFS, errno.EAGAIN)


class Received(NamedTuple):
    """A frame from the bus: identifier, data, time of arrival [ns since 1970], and whether it is a remote frame."""

    can_id: int
    data: bytes
    time_ns: int
    remote: bool


@dataclass(slots=True)
class BusCounts:
    """Counts of one bus."""

    sent: int = 0
    """Frames that the bus accepted"""
    failed: int = 0
    """Frames that the bus refused: its interface is down or gone"""
    dropped: int = 0
    """Frames given up because the queue of the bus stayed full"""
    received: int = 0
    """Frames received"""
    recv_failed: int = 0
    """Errors while receiving"""


def open_bus(url: str) -> "Bus":
    """Opens a bus. Raises ValueError for an invalid URL, and OSError if the bus cannot be opened."""
    address = parse(url)
    options: dict[str, dict[str, Any]] = {
        "socketcan": {"ignore_rx_error_frames": True},
        "udp_multicast": {"port": address.port, "hop_limit": 0, "fd": False},
        # the bound keeps a queue that nobody reads from growing forever
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
        try:
            wire = _wire(bus, address)
        except OSError:
            bus.shutdown()
            raise
    except (can.CanError, OSError) as error:
        cause = error.__cause__ or error
        raise OSError(f"cannot open CAN bus {address}: {cause}") from error
    return Bus(bus, str(address), wire)


def _wire(bus: can.BusABC, address: Address) -> Wire | None:
    if isinstance(bus, SocketcanBus):
        wire: Wire = RawCan(bus.socket, address.channel)
    elif address.interface == "udp_multicast":
        wire = Datagrams(bus.fileno(), address.channel, address.port)
    else:
        return None
    for one in {wire.into, wire.out}:
        enlarge_buffers(one)
    return wire


class Bus:
    """An open bus. Errors on the bus do not raise: `counts` counts them, and `error` keeps the last one."""

    __slots__ = ("_bus", "_last_ns", "_message", "_sleep", "_tries", "_wire", "counts", "error", "url")

    def __init__(
        self,
        bus: can.BusABC,
        url: str,
        wire: Wire | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.url = url  # without `auto`, so that other processes open the same bus
        self.counts = BusCounts()
        self.error: Exception | None = None
        self._bus = bus
        self._sleep = sleep
        self._tries = _TRIES
        self._message = can.Message(is_extended_id=False)
        self._last_ns = 0  # the stamp of the last frame
        self._wire = wire  # None: python-can itself sends and receives

    @property
    def channel(self) -> str:
        """The word that names the bus in a log: the interface of a SocketCAN bus, otherwise the kind of bus."""
        kind, _, rest = self.url.partition(":")
        return rest if kind == "socketcan" else kind

    def send(self, can_id: int, data: bytes, time_ns: int = 0, remote: bool = False) -> bool:
        """Sends a data frame, or a remote frame if `remote`. Returns true if the bus accepted it.

        A frame that is not accepted is counted. The call blocks for 5 ms at most. `time_ns` is the time stamp that receivers
        on a virtual bus see; other buses make their own. Raises ValueError for an identifier of more than 11 bits, more than
        8 bytes, or a remote frame with data."""
        if can_id >> 11 or len(data) > 8 or (remote and data):
            what = "remote frame" if remote else "frame"
            raise ValueError(f"not a classic CAN {what} with an 11-bit identifier: {can_id:#x}, {len(data)} bytes")
        if self._wire is not None:
            return self._send_raw(self._wire, self._wire.encode(can_id, data, remote))
        message = self._message
        message.arbitration_id, message.dlc, message.data = can_id, len(data), bytearray(data)
        message.is_remote_frame = remote
        message.timestamp = time_ns * 1e-9
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

    def _send_raw(self, wire: Wire, frame: bytes) -> bool:
        try:
            wire.send(frame, _AT_ONCE)
        except OSError as error:
            return self._send_again(wire, frame, error)
        self._tries = _TRIES
        self.counts.sent += 1
        return True

    def _send_again(self, wire: Wire, frame: bytes, error: OSError) -> bool:
        for left in reversed(range(self._tries)):
            self.error = error
            if error.errno in _FULL:
                self._sleep(_PAUSE)
            elif not wire.mend(error.errno):
                self.counts.failed += 1
                return False
            if left:
                try:
                    wire.send(frame, _AT_ONCE)
                except OSError as another:
                    error = another
                else:
                    return self._accepted()
        return self._drop()

    def _accepted(self) -> bool:
        self._tries = _TRIES
        self.counts.sent += 1
        return True

    def _drop(self) -> bool:
        self._tries = 1  # a queue that stays full (bus-off) would delay each further frame by 5 ms
        self.counts.dropped += 1
        return False

    def recv(self, timeout: float | None = 0.0) -> Received | None:
        """Returns the next frame, or None if none came within `timeout` [s] or receiving failed.

        `timeout` None waits for ever."""
        if self._wire is not None:
            return self._recv_raw(self._wire, timeout)
        while True:
            try:
                message = self._bus.recv(timeout)
            except (can.CanError, OSError) as error:
                self.error = error
                self.counts.recv_failed += 1
                return None
            if message is None:
                return None
            if message.is_error_frame or message.is_fd or message.is_extended_id:
                continue
            data = b"" if message.is_remote_frame else bytes(message.data)
            self.counts.received += 1
            return Received(message.arbitration_id, data, round(message.timestamp * 1e9), message.is_remote_frame)

    def _recv_raw(self, wire: Wire, timeout: float | None) -> Received | None:
        deadline_s = None  # set at the first wait, which saves the clock call if a frame is there already
        while True:
            try:
                payload, stamps, _, address = wire.into.recvmsg(wire.size, _STAMP_SPACE, _AT_ONCE)
            except BlockingIOError:
                if timeout is not None:
                    now_s = time.monotonic()
                    deadline_s = now_s + timeout if deadline_s is None else deadline_s
                    if now_s >= deadline_s:
                        return None
                poll = select.poll()
                poll.register(wire.into, select.POLLIN)
                poll.poll(None if deadline_s is None else (deadline_s - now_s) * 1e3)
                continue
            except OSError as error:
                self._recv_failed(error)
                return None
            try:
                frame = wire.decode(payload, address)
            except Exception as error:  # python-can raises all kinds of errors for a foreign datagram
                self._recv_failed(error)
                return None
            if frame is None:
                continue
            can_id, data, remote = frame
            seconds, nanoseconds = _STAMP.unpack(stamps[0][2]) if stamps else (0, time.time_ns())
            time_ns = seconds * 1_000_000_000 + nanoseconds
            if 0 < self._last_ns - time_ns < _SKEW_NS:
                time_ns = self._last_ns
            self._last_ns = time_ns
            self.counts.received += 1
            return Received(can_id, data, time_ns, remote)

    def _recv_failed(self, error: Exception) -> None:
        self.error = error
        self.counts.recv_failed += 1

    def fileno(self) -> int:
        """Returns the file descriptor that is readable when a frame is there. Raises OSError on a virtual bus."""
        try:
            return self._bus.fileno()
        except NotImplementedError as error:
            raise OSError(f"{self.url} has no file descriptor") from error

    def close(self) -> None:
        """Closes the bus."""
        if self._wire is not None:
            self._wire.close()
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _errno(error: BaseException) -> int | None:
    """Returns the error number of an OSError, or of the OSError that caused an error of python-can."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return cause.errno if isinstance(cause, OSError) else None
