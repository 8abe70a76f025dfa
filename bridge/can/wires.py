"""What frames look like on sockets: the kernel's raw CAN frames, and python-can's multicast datagrams."""

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
_OTHER = 0xA0000000  # CAN_EFF_FLAG, CAN_ERR_FLAG: frames with 29-bit identifiers, and news of the controller
_DATAGRAM = 4096  # bytes; one with a frame has some 160
_BUFFER = 4 << 20
_GONE = (errno.ENXIO, errno.ENODEV)


class RawCan:
    """Frames as the kernel's raw CAN sockets have them."""

    size = _FRAME.size

    def __init__(self, raw: socket.socket, interface: str) -> None:
        self.into = self.out = raw
        self.send = raw.send
        self._interface = interface

    def mend(self, number: int | None) -> bool:
        """After an error while sending: true if it may work now.

        A socket whose interface was removed stays without one, even if it comes back under the same name."""
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
        """Returns identifier, data, and whether it is a remote frame; None for what is not for us."""
        can_id, length, data = _FRAME.unpack(payload)
        if can_id & _OTHER or length > 8:
            return None
        remote = can_id & _REMOTE != 0
        return can_id & 0x7FF, b"" if remote else data[:length], remote

    def close(self) -> None:
        pass  # python-can closes it


class Datagrams:
    """Frames as python-can's multicast buses have them.

    They are sent from a socket of our own: by its port, which nobody else on this host has, what comes back is known."""

    size = _DATAGRAM

    def __init__(self, fileno: int, group: str, port: int) -> None:
        """`fileno` is of python-can's socket, which is in the group.  Raises OSError if nothing can be sent there."""
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
        """After an error while sending: false, for this frame is lost; but with the next the host's addresses may be others.

        A socket that is connected saves the way to be looked up for each frame; some groups can do without only."""
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
        """Returns identifier, data, and whether it is a remote frame; None for what is not for us.

        Raises whatever python-can makes of a datagram that is none of its own."""
        if address[1] == self._port:
            return None
        message = unpack_message(payload, check=True)
        if message.is_error_frame or message.is_fd or message.is_extended_id:
            return None
        can_id, remote = message.arbitration_id, message.is_remote_frame
        if type(can_id) is not int or type(remote) is not bool:  # python-can takes 5.0 for a 5
            raise TypeError(f"no identifier, or not known whether remote: {can_id!r}, {remote!r}")
        return can_id, b"" if remote else bytes(message.data), remote

    def close(self) -> None:
        self.into.close()
        self.out.close()


def _around_data(can_id: int, length: int, remote: bool) -> tuple[bytes, bytes]:
    """What python-can's datagram has before and after the data of a frame."""
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
    """Asks for buffers that hold a burst while a process waits for its turn; the kernel grants what it allows."""
    for option, force in ((socket.SO_SNDBUF, 32), (socket.SO_RCVBUF, 33)):  # SO_SNDBUFFORCE, SO_RCVBUFFORCE
        try:
            one.setsockopt(socket.SOL_SOCKET, force, _BUFFER)
        except OSError:
            one.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
