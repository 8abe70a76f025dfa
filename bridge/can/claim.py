"""One run on each bus: a run claims its buses while it goes on, and whoever comes second is told.

A claim is a socket with a name in the abstract namespace of this host, which the kernel gives to one process only and takes
back when that process ends, however it ends.  Other users' claims count, too.
"""

import errno
import socket
import struct
from types import TracebackType
from typing import Final, Self

from echelon.bridge.can.bus_url import parse

HOST: Final = "host"
"""The side of a bus that commands drives"""
DRIVES: Final = "drives"
"""The side of a bus on which virtual drives answer"""
_CREDENTIALS: Final = struct.Struct("@3i")  # struct ucred: process, user, group
_WAIT_S: Final = 0.5


class BusTakenError(Exception):
    """Another run holds this side of the bus; the text says which process."""


class Claim:
    """A side of a bus, held until `close`.

    Interfaces are told apart by their names, multicast buses by their ports, since groups on one port hear each other.  A bus
    inside one process needs no claim.  Raises ValueError for an invalid URL and BusTakenError if another run holds it."""

    def __init__(self, url: str, side: str) -> None:
        name = _name(url, side)
        self._socket: socket.socket | None = None
        if name is None:
            return
        one = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            one.bind(name)
            one.listen()  # so that others can ask who holds it
        except OSError as error:
            one.close()
            if error.errno != errno.EADDRINUSE:
                raise
            raise BusTakenError(f"another run is on this bus{_holder(name)}") from None
        self._socket = one

    def close(self) -> None:
        """Gives the side of the bus back."""
        if self._socket is not None:
            self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def is_claimed(url: str, side: str) -> bool:
    """Returns whether a run holds a side of a bus now.  Raises ValueError for an invalid URL."""
    try:
        Claim(url, side).close()
    except BusTakenError:
        return True
    return False


def _name(url: str, side: str) -> str | None:
    address = parse(url)
    if address.interface == "virtual":
        return None
    return f"\0echelon/can/{side}/{address.interface}:{address.port or address.channel}"


def _holder(name: str) -> str:
    """Returns the process that holds a claim, to be appended to a sentence; empty if it does not answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.settimeout(_WAIT_S)
        try:
            asking.connect(name)
            credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        except OSError:
            return ""
    process: int = _CREDENTIALS.unpack(credentials)[0]
    return f", process {process}" if process else ""  # 0: it is in another container
