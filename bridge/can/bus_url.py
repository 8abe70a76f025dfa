"""URLs of CAN buses: parsing, and what `auto` means on this machine.

URL                                  bus
socketcan:vcan0                      an interface of the kernel
udp_multicast:[group][:port]         several processes on one host, without privileges; the defaults are 239.74.163.2 and
                                     43113; an IPv6 group is in brackets
virtual[:channel]                    inside this process
auto                                 socketcan:vcan0 if it exists and is up, else udp_multicast on a free port
"""

import fcntl
import ipaddress
import re
import socket
import struct
from dataclasses import dataclass

ALLOWED = "socketcan:INTERFACE, udp_multicast:[GROUP][:PORT], virtual[:CHANNEL] or auto"
DEFAULT_GROUP = "239.74.163.2"
DEFAULT_PORT = 43113
DEFAULT_INTERFACE = "vcan0"


@dataclass(frozen=True, slots=True)
class Address:
    """A parsed URL."""

    interface: str
    """python-can's name of the kind of bus: `socketcan`, `udp_multicast` or `virtual`"""
    channel: str
    """Name of the interface, or the multicast group"""
    port: int = 0
    """Port of a multicast group"""

    def __str__(self) -> str:
        if self.interface != "udp_multicast":
            return f"{self.interface}:{self.channel}"
        group = f"[{self.channel}]" if ":" in self.channel else self.channel
        return f"{self.interface}:{group}:{self.port}"


def resolve_url(url: str, number: int = 0) -> str:
    """Returns the complete URL, in which `auto` is replaced by the bus that it means on this machine now.

    All processes that share the bus get this URL. `number` is the number of the bus in the plan: for bus 1, `auto` tries vcan1
    instead of vcan0, and so on. Raises ValueError for an invalid URL."""
    if url == "auto" and number:
        return f"socketcan:vcan{number}" if interface_is_up(f"vcan{number}") else free_multicast_url()
    return str(parse(url))


def free_multicast_url() -> str:
    """Returns the URL of a multicast bus on a port that nobody uses."""
    return str(parse(f"udp_multicast::{_free_port()}"))


def why_no_multicast(group: str = DEFAULT_GROUP) -> str | None:
    """Returns why this machine cannot join an IPv4 multicast group, for example because no network is up; None if it can."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.setsockopt(
                socket.IPPROTO_IP,
                socket.IP_ADD_MEMBERSHIP,
                socket.inet_aton(group) + struct.pack("@I", socket.INADDR_ANY),
            )
        except OSError as error:
            return error.strerror
    return None


def listen_command(url: str) -> str:
    """Returns the command that shows the frames of a bus, or "" for a bus inside one process.

    Raises ValueError for an invalid URL."""
    address = parse(url)
    if address.interface == "socketcan":
        return f"candump {address.channel}"
    if address.interface == "udp_multicast":
        return f"can_logger -i udp_multicast -c {address.channel} --bus-kwargs port={address.port}"
    return ""


def parse(url: str) -> Address:
    """Returns the address that a URL stands for.  Raises ValueError for an invalid URL."""
    if url == "auto":
        if interface_is_up(DEFAULT_INTERFACE):
            return Address("socketcan", DEFAULT_INTERFACE)
        return Address("udp_multicast", DEFAULT_GROUP, _free_port())
    interface, _, rest = url.partition(":")
    if interface == "socketcan":
        if not re.fullmatch(r"[^\s/:]{1,15}", rest):
            raise ValueError(f"CAN URL {url!r}: {rest!r} is no interface name; allowed: {ALLOWED}")
        return Address(interface, rest)
    if interface == "virtual":
        return Address(interface, rest or "echelon")
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
    return Address(interface, group, port)


def interface_is_up(name: str) -> bool:
    """Returns whether a network interface of this name exists and is up."""
    request = struct.pack("16sH14x", name.encode()[:15], 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            answer = fcntl.ioctl(any_socket, 0x8913, request)  # SIOCGIFFLAGS
        except OSError:
            return False
    return bool(struct.unpack("16xH14x", answer)[0] & 1)  # IFF_UP


def _free_port() -> int:
    port = DEFAULT_PORT  # never returned: it belongs to users who name no port
    while port == DEFAULT_PORT:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            port = probe.getsockname()[1]
    return port
