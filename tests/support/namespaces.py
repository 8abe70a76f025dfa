"""Two network namespaces with a cable between them: a host, and another host beside it.  Nothing needs privileges."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

HERE: Final = "10.77.0.1"
THERE: Final = "10.77.0.2"
_CABLE: Final = """
ip link set lo up
ip link add cable0 type veth peer name cable1 netns {there}
ip addr add {here_address}/24 dev cable0
ip link set cable0 up
ip route add default dev cable0
"""
_OTHER_END: Final = f"""
ip link set lo up
ip addr add {THERE}/24 dev cable1
ip link set cable1 up
ip route add default dev cable1
"""


class NamespaceError(Exception):
    """No network namespaces can be made on this machine."""


class Hosts:
    """The two hosts; `here` and `there` prefix a command so that it runs on one of them."""

    def __init__(self, here: int, there: int) -> None:
        self.here = _inside(here)
        self.there = _inside(there)


def _inside(process: int) -> list[str]:
    return ["nsenter", f"--target={process}", "--user", "--net", "--preserve-credentials", "--"]


@contextmanager
def two_hosts() -> Iterator[Hosts]:
    """Makes the two hosts.  Raises NamespaceError if this machine cannot have them."""
    if missing := [tool for tool in ("unshare", "nsenter", "ip") if shutil.which(tool) is None]:
        raise NamespaceError(f"missing: {', '.join(missing)}")
    holders: list[subprocess.Popen[str]] = []
    try:
        holders.append(_hold(["unshare", "--user", "--map-root-user", "--net"]))
        holders.append(_hold([*_inside(holders[0].pid), "unshare", "--net"]))
        hosts = Hosts(holders[0].pid, holders[1].pid)
        for inside, script in (
            (hosts.here, _CABLE.format(there=holders[1].pid, here_address=HERE)),
            (hosts.there, _OTHER_END),
        ):
            done = subprocess.run(
                [*inside, "sh", "-ec", script], capture_output=True, text=True, timeout=20, check=False
            )
            if done.returncode:
                raise NamespaceError(done.stderr.strip())
        yield hosts
    finally:
        for holder in holders:
            holder.kill()
            holder.communicate()


def _hold(prefix: list[str]) -> "subprocess.Popen[str]":
    """Starts a process that keeps a namespace alive."""
    holder = subprocess.Popen(
        [*prefix, "sh", "-c", "echo made; exec sleep 600"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    if holder.stdout.readline() != "made\n":
        raise NamespaceError(holder.communicate()[1].strip())
    return holder
