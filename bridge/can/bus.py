"""CAN buses by URL (bridge.can.bus_url): opening, sending, receiving.

All frames are classic CAN frames with 11-bit identifiers. A bus does not receive the frames that it sent itself.

On udp_multicast, programs that use python-can hear all groups with the same port. So two buses need two ports. Only datagrams
of this host are taken, and ours do not leave it.

Only this module and bridge.can.wires use buses of python-can: those inside one process, and the format of a datagram. Its
send() and recv() take several times as long as the system call, so this module reads and writes the sockets itself.
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

from echelon.bridge.can.bus_url import parse
from echelon.bridge.can.guard import Guard
from echelon.bridge.can.wires import Datagrams, Outside, RawCan, Wire

_STAMP = struct.Struct("@ll")  # struct timespec, as SO_TIMESTAMPNS returns it
_STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)
_SO_MEMINFO = 55
_MEMINFO = struct.Struct("@9I")  # the kernel's notes about a socket (linux/sock_diag.h); the last one counts drops
_TRIES = 10
_AT_ONCE = int(socket.MSG_DONTWAIT)
_PAUSE = 0.0005  # [s]; _TRIES pauses: a full queue delays the caller by 5 ms at most
_SKEW_NS = 1_000_000
"""Time stamps may run backwards by less than this; the later frame then gets the stamp of the one before it.  Processors
stamp frames of several senders in parallel, some microseconds before the frames enter the common queue."""
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_JUNK = 1000
"""Datagrams in a row that are no frames, after which receiving gives up for once: a flood of them keeps nobody for ever"""
_LOST_MS = 100
"""How often a receiver that waits tries to come back to an interface that was removed"""


class Received(NamedTuple):
    """A frame from the bus: identifier, data, time of arrival [ns since 1970], whether it is a remote frame, and the address of
    its sender (None where frames have none)."""

    can_id: int
    data: bytes
    time_ns: int
    remote: bool
    sender: tuple[Any, ...] | None = None


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


def open_bus(url: str, own: frozenset[int] = frozenset()) -> "Bus":
    """Opens a bus.  `own` are identifiers that nobody else may send; `Bus.guard` counts who does.

    Raises ValueError for an invalid URL, and OSError if the bus cannot be opened."""
    address = parse(url)
    outside = None
    try:
        if address.interface == "virtual":
            # the bound keeps a queue that nobody reads from growing forever
            plain = can.Bus(
                interface="virtual",
                channel=address.channel,
                ignore_config=True,
                preserve_timestamps=True,
                rx_queue_size=1 << 16,
            )
            return Bus(str(address), plain)
        if address.interface == "socketcan":
            return Bus(str(address), RawCan.open(address.channel), own=own)
        wire = Datagrams(address.channel, address.port)
        try:
            outside = Outside(address.channel, address.port) if own else None
        except OSError:
            wire.close()
            raise
    except (can.CanError, OSError) as error:
        cause = error.__cause__ or error
        raise OSError(f"cannot open CAN bus {address}: {cause}") from error
    return Bus(str(address), wire, own=own, outside=outside)


class Bus:
    """An open bus. Errors on the bus do not raise: `counts` counts them, and `error` keeps the last one."""

    __slots__ = ("_last_ns", "_message", "_plain", "_sleep", "_tries", "_wire", "counts", "error", "guard", "url")

    def __init__(
        self,
        url: str,
        via: Wire | can.BusABC,
        sleep: Callable[[float], None] = time.sleep,
        own: frozenset[int] = frozenset(),
        outside: Outside | None = None,
    ) -> None:
        self.url = url  # without `auto`, so that other processes open the same bus
        self.counts = BusCounts()
        self.error: Exception | None = None
        self.guard = Guard(own, outside)
        self._sleep = sleep
        self._tries = _TRIES
        self._message = can.Message(is_extended_id=False)
        self._last_ns = 0  # the stamp of the last frame
        # either sockets, or a bus of python-can, which itself sends and receives
        self._wire = via if isinstance(via, Wire) else None
        self._plain: Any = None if isinstance(via, Wire) else via

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
            self._plain.send(message, timeout=_TRIES * _PAUSE if self._tries > 1 else 0)
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
            elif not wire.mend(error.errno):  # the frame is lost, and perhaps the interface
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
        """Returns the next frame, or None if none came within `timeout` [s] or receiving failed.  What is no frame is counted
        and passed over.

        `timeout` None waits for ever."""
        if self._wire is not None:
            return self._recv_raw(self._wire, timeout)
        while True:
            try:
                message = self._plain.recv(timeout)
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
        if wire.lost:
            wire.mend(errno.ENODEV)
        deadline_s = None  # set at the first wait, which saves the clock call if a frame is there already
        junk = 0
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
                wait_ms = None if deadline_s is None else (deadline_s - now_s) * 1e3
                if wire.lost and not wire.mend(errno.ENODEV):  # nothing wakes a socket whose interface is gone
                    wait_ms = _LOST_MS if wait_ms is None else min(wait_ms, _LOST_MS)
                poll.poll(wait_ms)
                continue
            except OSError as error:
                wire.mend(error.errno)
                self._recv_failed(error)
                return None
            try:
                frame = wire.decode(payload)
            except Exception as error:  # python-can raises all kinds of errors for a foreign datagram
                self._recv_failed(error)
                junk += 1
                if junk == _JUNK:
                    return None
                continue  # a frame may be right behind it: None would mean that there is none
            if frame is None:
                continue
            can_id, data, remote = frame
            seconds, nanoseconds = _STAMP.unpack(stamps[0][2]) if stamps else (0, time.time_ns())
            time_ns = seconds * 1_000_000_000 + nanoseconds
            if 0 < self._last_ns - time_ns < _SKEW_NS:
                time_ns = self._last_ns
            self._last_ns = time_ns
            self.counts.received += 1
            return Received(can_id, data, time_ns, remote, address)

    def _recv_failed(self, error: Exception) -> None:
        self.error = error
        self.counts.recv_failed += 1

    @property
    def missed(self) -> int:
        """Number of frames that came and were lost, since nobody read them in time.  On a multicast bus datagrams that the bus
        does not take count, too."""
        if self._wire is None:
            return 0
        notes = self._wire.into.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        drops: int = _MEMINFO.unpack(notes)[-1]
        return drops

    def fileno(self) -> int:
        """Returns the file descriptor that is readable when a frame is there. Raises OSError on a virtual bus."""
        if self._wire is None:
            raise OSError(f"{self.url} has no file descriptor")
        return self._wire.into.fileno()

    def close(self) -> None:
        """Closes the bus."""
        self.guard.close()
        if self._wire is not None:
            self._wire.close()
        else:
            self._plain.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _errno(error: BaseException) -> int | None:
    """Returns the error number of an OSError, or of the OSError that caused an error of python-can."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return cause.errno if isinstance(cause, OSError) else None
