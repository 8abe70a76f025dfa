"""What frames look like on sockets: the kernel's raw CAN frames, and python-can's multicast datagrams."""

import os
import socket
import struct
from typing import Any

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of linux/can.h
_REMOTE = 0x40000000  # CAN_RTR_FLAG
_OTHER = 0xA0000000  # CAN_EFF_FLAG, CAN_ERR_FLAG: frames with 29-bit identifiers, and news of the controller
_DATAGRAM = 4096  # bytes; one with a frame has some 160
_BUFFER = 4 << 20


class RawCan:
    """Frames as the kernel's raw CAN sockets have them."""

    size = _FRAME.size

    def __init__(self, raw: socket.socket) -> None:
        self.into = self.out = raw

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

    They are sent from a socket of our own: by its address what comes back to us is known."""

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
            self.out.connect((group, port))
        except OSError:
            self.close()
            raise
        self._own = self.out.getsockname()[:2]
        self._parts: dict[tuple[int, int, bool], tuple[bytes, bytes]] = {}

    def encode(self, can_id: int, data: bytes, remote: bool) -> bytes:
        key = can_id, len(data), remote
        parts = self._parts.get(key)
        if parts is None:
            parts = self._parts[key] = _around_data(*key)
        return parts[0] + data + parts[1]

    def decode(self, payload: bytes, address: Any) -> tuple[int, bytes, bool] | None:
        """Returns identifier, data, and whether it is a remote frame; None for what is not for us.

        Raises whatever python-can makes of a datagram that is none of its own."""
        if address[:2] == self._own:
            return None
        message = unpack_message(payload, check=True)
        if message.is_error_frame or message.is_fd or message.is_extended_id:
            return None
        remote = message.is_remote_frame
        return message.arbitration_id, b"" if remote else bytes(message.data), remote

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
