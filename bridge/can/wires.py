"""Frames as bytes on sockets: the kernel's raw CAN frames, and python-can's multicast datagrams."""

import errno
import os
import socket
import struct
from collections.abc import Callable
from typing import Any

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of linux/can.h
_REMOTE = 0x40000000  # CAN_RTR_FLAG
_OTHER = 0xA0000000  # CAN_EFF_FLAG | CAN_ERR_FLAG: frames with 29-bit identifiers, and messages of the controller
_DATAGRAM = 4096  # largest datagram that is read [bytes]; one with a frame has about 160
_BUFFER = 4 << 20
_GONE = (errno.ENXIO, errno.ENODEV)


class RawCan:
    """Frames on a raw CAN socket of the kernel."""

    size = _FRAME.size

    def __init__(self, raw: socket.socket, interface: str) -> None:
        self.into = self.out = raw
        self.send = raw.send
        self._interface = interface

    def mend(self, number: int | None) -> bool:
        """Tries to repair the socket after sending failed with error `number`; returns true if a new attempt may work.

        A socket whose interface was removed must be bound again, even if an interface of the same name comes back."""
        if number not in _GONE:
            return False
        try:
            self.out.bind((self._interface,))
        except OSError:
            return False
        return True

    @staticmethod
    def encode(can_id: int, data: bytes, remote: bool) -> bytes:
        return _FRAME.pack(can_id | _REMOTE if remote else can_id, len(data), data)

    @staticmethod
    def decode(payload: bytes, address: object) -> tuple[int, bytes, bool] | None:
        """Returns identifier, data, and whether it is a remote frame; None for a frame that is not a classic 11-bit one."""
        can_id, length, data = _FRAME.unpack(payload)
        if can_id & _OTHER or length > 8:
            return None
        remote = can_id & _REMOTE != 0
        return can_id & 0x7FF, b"" if remote else data[:length], remote

    def close(self) -> None:
        pass  # the socket is python-can's, which closes it


class Datagrams:
    """Frames as datagrams of python-can's multicast bus.

    They are sent from a second socket. Its port is unique on this host, so datagrams of our own that come back are known by
    it and ignored."""

    size = _DATAGRAM

    def __init__(self, fileno: int, group: str, port: int) -> None:
        """`fileno` is python-can's socket, a member of the group.  Raises OSError if the group cannot be reached."""
        self.into = socket.socket(fileno=os.dup(fileno))
        self.out = socket.socket(self.into.family, socket.SOCK_DGRAM)
        try:
            if self.out.family == socket.AF_INET:
                self.out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            else:
                self.out.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 0)
            self.out.bind(("", 0))
        except OSError:
            self.close()
            raise
        self._port = self.out.getsockname()[1]
        self._target = group, port
        self.send: Callable[[bytes, int], int] = self._send_to
        self.mend(None)
        self._parts: dict[tuple[int, int, bool], tuple[bytes, bytes]] = {}

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

    def encode(self, can_id: int, data: bytes, remote: bool) -> bytes:
        key = can_id, len(data), remote
        parts = self._parts.get(key)
        if parts is None:
            parts = self._parts[key] = _around_data(*key)
        return parts[0] + data + parts[1]

    def decode(self, payload: bytes, address: Any) -> tuple[int, bytes, bool] | None:
        """Returns identifier, data, and whether it is a remote frame.

        Returns None for a datagram of our own and for a frame that is not a classic 11-bit one. A foreign datagram may make
        python-can raise any exception."""
        if address[1] == self._port:
            return None
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


def enlarge_buffers(one: socket.socket) -> None:
    """Asks the kernel for large buffers, so that a burst is not lost while the process waits for a processor."""
    for option, force in ((socket.SO_SNDBUF, 32), (socket.SO_RCVBUF, 33)):  # SO_SNDBUFFORCE, SO_RCVBUFFORCE
        try:
            one.setsockopt(socket.SOL_SOCKET, force, _BUFFER)
        except OSError:
            one.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
