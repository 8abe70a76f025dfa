"""The independent listener: `python -m chaos.listener GROUP PORT FILE` notes every datagram of a multicast bus.

It starts before the run and ends at SIGTERM.  Times are the kernel's, of the arrival of a datagram, so a busy machine does not
shift them.  Lines of FILE:

    <time [ns since 1970]> <address> <port> <bytes, hexadecimal>     a datagram
    <time> missed <number>                                           datagrams that its buffer could not hold
    <time> late <ns>                                                 by how much a process that slept for 1 ms was late then
"""

import os
import select
import signal
import socket
import struct
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from chaos.frames import Frame, unpack

READY: Final = "listens\n"
_STAMP: Final = struct.Struct("@ll")
_STAMPED: Final = 35  # SO_TIMESTAMPNS
_OVERFLOW: Final = 40  # SO_RXQ_OVFL: how many datagrams the socket has dropped so far
_FORCE: Final = 33  # SO_RCVBUFFORCE
_BUFFER: Final = 16 << 20
_AT_ONCE: Final = 4096
"""Datagrams that are taken before their lines are written"""
_NOTED_NS: Final = 2_000_000
"""Lateness that is worth a line [ns]"""


@dataclass(slots=True)
class Heard:
    """What a listener has noted."""

    frames: list[Frame] = field(default_factory=list)
    other: int = 0
    """Datagrams that hold no classic frame"""
    missed: int = 0
    """Datagrams that the listener could not take"""
    late: list[tuple[int, int]] = field(default_factory=list)
    """(instant [ns since 1970], by how much a process was late then [ns])"""

    def add(self, line: str) -> None:
        """Takes a line of the listener's file."""
        words = line.split()
        if words[1] == "missed":
            self.missed += int(words[2])
        elif words[1] == "late":
            self.late.append((int(words[0]), int(words[2])))
        elif frame := unpack(
            int(words[0]), (words[1], int(words[2])), bytes.fromhex(words[3] if len(words) > 3 else "")
        ):
            self.frames.append(frame)
        else:
            self.other += 1

    def lateness_ns(self, begin_ns: int, end_ns: int) -> int:
        """Returns by how much a process was late at most between two instants [ns]."""
        return max((late for time_ns, late in self.late if begin_ns <= time_ns <= end_ns + late), default=0)


def read(path: Path) -> Heard:
    """Reads a listener's file, which may still grow."""
    heard = Heard()
    *lines, _ = path.read_text(encoding="ascii").split("\n")
    for line in lines:
        heard.add(line)
    return heard


def _open(group: str, port: int) -> socket.socket:
    """Returns a socket that hears a multicast group."""
    bus = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bus.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    bus.setsockopt(socket.SOL_SOCKET, _STAMPED, 1)
    bus.setsockopt(socket.SOL_SOCKET, _OVERFLOW, 1)
    try:
        bus.setsockopt(socket.SOL_SOCKET, _FORCE, _BUFFER)
    except PermissionError:
        bus.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    bus.bind(("", port))
    bus.setsockopt(
        socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, struct.pack("4sI", socket.inet_aton(group), socket.INADDR_ANY)
    )
    return bus


def _waiting(bus: socket.socket, missed_before: int) -> tuple[list[str], int]:
    """Returns the lines of the datagrams that wait in a socket, and how many it has missed so far."""
    lines: list[str] = []
    space = socket.CMSG_SPACE(_STAMP.size) + socket.CMSG_SPACE(4)
    while len(lines) < _AT_ONCE:
        try:
            payload, ancillary, _, (address, port) = bus.recvmsg(65536, space, socket.MSG_DONTWAIT)
        except BlockingIOError:
            break
        time_ns = time.time_ns()
        for _, kind, content in ancillary:
            if kind == _STAMPED:
                seconds, nanoseconds = _STAMP.unpack(content)
                time_ns = seconds * 1_000_000_000 + nanoseconds
            elif kind == _OVERFLOW and (missed := int.from_bytes(content, sys.byteorder)) != missed_before:
                lines.append(f"{time_ns} missed {missed - missed_before & 0xFFFFFFFF}\n")
                missed_before = missed
        lines.append(f"{time_ns} {address} {port} {payload.hex()}\n")
    return lines, missed_before


def _beat(file: int) -> None:
    """Sleeps for 1 ms again and again, and notes when that took longer; ends with its parent."""
    parent = os.getppid()
    while os.getppid() == parent:
        begun_ns = time.monotonic_ns()
        time.sleep(0.001)
        late_ns = time.monotonic_ns() - begun_ns - 1_000_000
        if late_ns > _NOTED_NS:
            os.write(file, f"{time.time_ns()} late {late_ns}\n".encode())


def main(group: str, port: str, path: str) -> None:
    """Listens until SIGTERM."""
    over, missed = False, 0
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)  # each write is whole lines
    if os.fork() == 0:
        _beat(file)
        os._exit(0)

    def end(number: int, frame: object) -> None:
        nonlocal over
        over = True

    signal.signal(signal.SIGTERM, end)
    with _open(group, int(port)) as bus:
        sys.stdout.write(READY)
        sys.stdout.flush()
        while not over:
            select.select([bus], [], [], 0.05)
            lines, missed = _waiting(bus, missed)
            os.write(file, "".join(lines).encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
