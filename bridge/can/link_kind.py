"""What kind of network interface carries a CAN bus: a virtual one of the kernel, or hardware.

The kernel is asked through rtnetlink for the kind of the link, as `ip -details link` does.  Folders in /sys do not tell:
an adapter on a serial line (slcan) looks there as vcan does.
"""

import socket
import struct
from typing import Final

VIRTUAL: Final = ("vcan", "vxcan")
"""Kinds of links whose frames stay within this machine"""
_GET_LINK: Final = 18
_NEW_LINK: Final = 16
_NAME: Final = 3
_INFO: Final = 18
_KIND: Final = 1
_HEADER: Final = struct.Struct("=IHHII")
_LINK: Final = struct.Struct("=BxHiII")
_ATTRIBUTE: Final = struct.Struct("=HH")
_TIMEOUT_S: Final = 1.0


def is_hardware(url: str) -> bool:
    """Returns whether frames on the bus with this full URL leave the machine: it is a network interface, and not a virtual
    one.

    An interface of which the kernel tells nothing counts as hardware."""
    interface, _, name = url.partition(":")
    return interface == "socketcan" and link_kind(name) not in VIRTUAL


def link_kind(name: str) -> str | None:
    """Returns the kind of a network interface, for example `vcan`, `can`, `veth`; None if it has none or cannot be asked."""
    attribute = name.encode() + b"\0"
    body = _LINK.pack(0, 0, 0, 0, 0) + _ATTRIBUTE.pack(_ATTRIBUTE.size + len(attribute), _NAME) + attribute
    body += bytes(-len(body) % 4)
    request = _HEADER.pack(_HEADER.size + len(body), _GET_LINK, 1, 1, 0) + body
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
            kernel.settimeout(_TIMEOUT_S)
            kernel.sendto(request, (0, 0))
            answer = kernel.recv(1 << 16)
        length, kind, *_ = _HEADER.unpack_from(answer)
    except (OSError, struct.error):
        return None
    if kind != _NEW_LINK:
        return None
    info = _attributes(answer[_HEADER.size + _LINK.size : length]).get(_INFO, b"")
    return _attributes(info).get(_KIND, b"").rstrip(b"\0").decode(errors="replace") or None


def _attributes(data: bytes) -> dict[int, bytes]:
    """Returns the attributes in a part of a message of rtnetlink, by their types."""
    found, at = dict[int, bytes](), 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size:
            break
        found[kind & 0x3FFF] = data[at + _ATTRIBUTE.size : at + length]
        at += length + -length % 4
    return found
