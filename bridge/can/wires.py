"""Frames as bytes on sockets: the kernel's raw CAN frames, and python-can's multicast datagrams."""

import ctypes
import errno
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Final

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of linux/can.h
_REMOTE = 0x40000000  # CAN_RTR_FLAG
_OTHER = 0xA0000000  # CAN_EFF_FLAG | CAN_ERR_FLAG: frames with 29-bit identifiers, and messages of the controller
_STANDARD = struct.pack("=II", 0, 0x80000000)  # struct can_filter: all frames with 11-bit identifiers
_DATAGRAM = 4096  # largest datagram that is read [bytes]; one with a frame has about 160
_HEAD = 48  # bytes at the beginning of a datagram, with the identifier among them
_KNOWN = 1024  # kinds of frames on a bus, at most
_BUFFER = 4 << 20
_GONE = (errno.ENXIO, errno.ENODEV)
_SO_ATTACH_FILTER = 26
_SO_TIMESTAMPNS = 35


class RawCan:
    """Frames on a raw CAN socket of the kernel."""

    size = _FRAME.size

    def __init__(self, raw: socket.socket, interface: str) -> None:
        self.into = self.out = raw
        self.send = raw.send
        self.lost = False
        """True: the interface was removed; the socket hears nothing until `mend` has bound it again"""
        self._interface = interface

    @classmethod
    def open(cls, interface: str) -> "RawCan":
        """Opens a socket on an interface of the kernel.  Raises OSError if there is none."""
        raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            raw.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            enlarge_buffers(raw)
            wire = cls(raw, interface)
            wire._bind()
        except OSError:
            raw.close()
            raise
        return wire

    def _bind(self) -> None:
        self.into.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, _STANDARD)
        self.into.bind((self._interface,))
        self.lost = False

    def mend(self, number: int | None) -> bool:
        """Tries to repair the socket after an error with this number; returns true if a new attempt may work.

        If its interface is removed, the kernel takes the socket off it and deletes its filters.  Even when an interface of the
        same name comes back, the socket is bound to none and hears nothing; so it gets its filters and is bound anew."""
        if number not in _GONE:
            return False
        self.lost = True
        try:
            self._bind()
        except OSError:
            return False
        return True

    @staticmethod
    def encode(can_id: int, data: bytes, remote: bool) -> bytes:
        return _FRAME.pack(can_id | _REMOTE if remote else can_id, len(data), data)

    @staticmethod
    def decode(payload: bytes) -> tuple[int, bytes, bool] | None:
        """Returns identifier, data, and whether it is a remote frame; None for a frame that is not a classic 11-bit one."""
        can_id, length, data = _FRAME.unpack(payload)
        if can_id & _OTHER or length > 8:
            return None
        remote = can_id & _REMOTE != 0
        return can_id & 0x7FF, b"" if remote else data[:length], remote

    def close(self) -> None:
        self.into.close()


class Datagrams:
    """Frames as datagrams of python-can's multicast bus, on this host only.

    `into` is a member of the group.  It is bound to the group's address, so no unicast datagram reaches it.  In the kernel a
    filter drops what did not come from this host, and what `out` itself sent.  Frames are sent from `out`, whose port is unique
    on this host.  They do not leave the host."""

    size = _DATAGRAM
    lost = False

    def __init__(self, group: str, port: int) -> None:
        """Raises OSError if the group cannot be joined."""
        self._family = socket.AF_INET6 if ":" in group else socket.AF_INET
        self._target = group, port
        self.out = socket.socket(self._family, socket.SOCK_DGRAM)
        self.into = socket.socket(self._family, socket.SOCK_DGRAM)
        try:
            if self._family == socket.AF_INET:
                self.out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            else:
                self.out.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 0)
            self.out.bind(("", 0))
            attach(self.into, from_this_host(self.out.getsockname()[1]))
            self.into.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            for one in (self.into, self.out):
                enlarge_buffers(one)
            self.into.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # other programs are on the same port
            self._join()
        except OSError:
            self.close()
            raise
        self.send: Callable[[bytes, int], int] = self._send_to
        self.mend(None)
        self._heard: dict[tuple[bytes, int], tuple[bytes, bytes, int, bool]] = {}
        """By the first bytes and the size of a datagram that has come: the bytes around its data, the identifier, and whether
        it is a remote frame.  Only datagrams as `encode` makes them are here; no more than `_KNOWN`"""

    def _join(self) -> None:
        group, port = self._target
        packed = socket.inet_pton(self._family, group)
        if self._family == socket.AF_INET:
            self.into.bind((group, port))
            self.into.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, packed + struct.pack("@I", 0))
            return
        try:
            self.into.bind((group, port))
        except OSError:  # a group of one link has a different address on each link
            self.into.bind(("", port))
        self.into.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, packed + struct.pack("@I", 0))

    def _send_to(self, payload: bytes, flags: int) -> int:
        return self.out.sendto(payload, flags, self._target)

    def mend(self, number: int | None) -> bool:
        """Connects the socket anew after an error, since the host's addresses may have changed; returns false.

        The frame that failed is lost. A connected socket saves a look-up of the route for each frame. Some groups cannot be
        connected to; their frames are sent with the address."""
        try:
            self.out.connect(self._target)
            self.send = self.out.send
        except OSError:
            self.send = self._send_to
        return False

    @staticmethod
    def encode(can_id: int, data: bytes, remote: bool) -> bytes:
        before, after = _around_data(can_id, len(data), remote)
        return before + data + after

    def decode(self, payload: bytes) -> tuple[int, bytes, bool] | None:
        """Returns what `unpack` does.  A datagram that differs from an earlier one in its data alone is not unpacked again."""
        heard = self._heard.get((payload[:_HEAD], len(payload)))
        if heard is not None:
            before, after, can_id, remote = heard
            if payload.startswith(before) and payload.endswith(after):
                return can_id, payload[len(before) : len(payload) - len(after)], remote
        frame = self.unpack(payload)
        if frame is not None and len(self._heard) < _KNOWN:
            can_id, data, remote = frame
            before, after = _around_data(can_id, len(data), remote)
            if payload == before + data + after:
                self._heard[payload[:_HEAD], len(payload)] = before, after, can_id, remote
        return frame

    @staticmethod
    def unpack(payload: bytes) -> tuple[int, bytes, bool] | None:
        """Returns identifier, data, and whether it is a remote frame; None for a frame that is not a classic 11-bit one.

        A foreign datagram may make python-can raise any exception."""
        message = unpack_message(payload, check=True)
        if message.is_error_frame or message.is_fd or message.is_extended_id:
            return None
        can_id, remote = message.arbitration_id, message.is_remote_frame
        if type(can_id) is not int or type(remote) is not bool:  # python-can accepts 5.0 as an identifier
            raise TypeError(f"identifier must be an int and remote a bool, not {can_id!r} and {remote!r}")
        return can_id, b"" if remote else bytes(message.data), remote

    def close(self) -> None:
        self.into.close()
        self.out.close()


@lru_cache(maxsize=4 * _KNOWN)
def _around_data(can_id: int, length: int, remote: bool) -> tuple[bytes, bytes]:
    """Returns the bytes of python-can's datagram before and after the data of a frame."""
    packed = [
        pack_message(
            can.Message(
                arbitration_id=can_id,
                data=None if remote else bytes([fill] * length),
                dlc=length,
                is_remote_frame=remote,
                is_extended_id=False,
            )
        )
        for fill in (0x00, 0xFF)
    ]
    at = next((at for at, (zero, one) in enumerate(zip(*packed, strict=True)) if zero != one), len(packed[0]))
    return packed[0][:at], packed[0][at + length :]


Wire = RawCan | Datagrams


class Outside:
    """The datagrams for a multicast bus that do not come from this host.  No bus takes them; this only tells of them.

    Unicast datagrams are among them, unless another program on the same port gets them instead.  Raises OSError if the port
    cannot be used."""

    AT_ONCE: Final = 4096
    """Largest number of datagrams that `heard` reads; of a flood, the kernel keeps as many as its buffer holds"""

    def __init__(self, group: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in group else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            attach(self._socket, from_elsewhere())
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind(("", port))
        except OSError:
            self._socket.close()
            raise
        enlarge_buffers(self._socket)

    def heard(self) -> Iterator[tuple[str, int]]:
        """Yields address of the sender and identifier of each frame that has come since the last call."""
        for _ in range(self.AT_ONCE):
            try:
                payload, address = self._socket.recvfrom(_DATAGRAM, int(socket.MSG_DONTWAIT))
            except OSError:
                return
            try:
                frame = Datagrams.unpack(payload)
            except Exception:
                continue
            if frame is not None:
                yield str(address[0]), frame[0]

    def close(self) -> None:
        self._socket.close()


# Filters of the kernel (classic BPF, linux/filter.h): operation, jump if true, jump if false, operand.  A filter of a UDP
# socket sees the datagram from the UDP header on, and the kernel's notes about it.
_Filter = Sequence[tuple[int, int, int, int]]
_LOAD_PORT = (0x28, 0, 0, 0)  # the port of the sender
_LOAD_KIND = (0x20, 0, 0, 0xFFFFF004)  # SKF_AD_PKTTYPE
_LOAD_INTERFACE = (0x20, 0, 0, 0xFFFFF008)  # SKF_AD_IFINDEX
_TAKE, _DROP = (0x06, 0, 0, 0xFFFFFFFF), (0x06, 0, 0, 0)
_LOOPED = 5  # PACKET_LOOPBACK: the kernel's own copy of a multicast datagram that this host sent
_LOOPBACK = 1  # index of `lo` in every network namespace


def _equal(operand: int, if_true: int, if_false: int) -> tuple[int, int, int, int]:
    return 0x15, if_true, if_false, operand


def from_this_host(own_port: int) -> _Filter:
    """Returns the filter that takes datagrams of this host, except those from `own_port`.

    The kernel knows where a datagram comes from by the way that it came, whatever its sender's address says."""
    return (
        _LOAD_PORT,
        _equal(own_port, 5, 0),
        _LOAD_KIND,
        _equal(_LOOPED, 2, 0),
        _LOAD_INTERFACE,
        _equal(_LOOPBACK, 0, 1),
        _TAKE,
        _DROP,
    )


def from_elsewhere() -> _Filter:
    """Returns the filter that takes only datagrams that do not come from this host."""
    return (_LOAD_KIND, _equal(_LOOPED, 3, 0), _LOAD_INTERFACE, _equal(_LOOPBACK, 1, 0), _TAKE, _DROP)


def attach(one: socket.socket, rules: _Filter) -> None:
    """Gives a socket a filter.  Raises OSError if the kernel does not take it."""
    program = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *rule) for rule in rules))
    one.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(rules), ctypes.addressof(program)))


def enlarge_buffers(one: socket.socket) -> None:
    """Asks the kernel for large buffers, so that a burst is not lost while the process waits for a processor."""
    for option, force in ((socket.SO_SNDBUF, 32), (socket.SO_RCVBUF, 33)):  # SO_SNDBUFFORCE, SO_RCVBUFFORCE
        try:
            one.setsockopt(socket.SOL_SOCKET, force, _BUFFER)
        except OSError:
            one.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
