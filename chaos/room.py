"""Rooms of their own for plans that need a small disk or another host: namespaces, which need no privilege on most machines.

In such a room is a host with one cable to another host.  The run, its listener and whatever attacks from here are on the one,
what attacks from elsewhere is on the other.
"""

import ctypes
import os
import subprocess
import sys
from functools import cache
from typing import Final

HOST: Final = "10.99.0.1"
_OTHER: Final = "10.99.0.2"
INSIDE: Final = "ECHELON_CHAOS_ROOM"
"""Environment variable: the process that is the other host"""
_NEW_NET: Final = 0x40000000  # CLONE_NEWNET
_ENTER: Final = ("unshare", "--map-root-user", "--mount", "--net", "--propagation", "private")


@cache
def why_none() -> str | None:
    """Returns why no room can be made on this machine; None if it can."""
    try:
        tried = subprocess.run(
            [*_ENTER, "sh", "-c", "ip link add name a type veth peer name b && mount -t tmpfs none /mnt"],
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
    except OSError as error:
        return str(error)
    return None if tried.returncode == 0 else tried.stderr.strip() or f"exit code {tried.returncode}"


def enter(words: list[str]) -> list[str]:
    """Returns the words of a command in a room."""
    return [*_ENTER, sys.executable, "-m", "chaos.room", *words]


def enter_other() -> list[str]:
    """Returns the words before a command that runs it on the other host of this room."""
    return ["nsenter", "--target", os.environ[INSIDE], "--net"]


def _furnish() -> int:
    """Sets up the two hosts of a room; returns the process that is the other one."""
    reading, writing = os.pipe()
    other = os.fork()
    if other == 0:
        os.close(reading)
        if ctypes.CDLL(None, use_errno=True).unshare(_NEW_NET):
            os._exit(1)
        os.write(writing, b".")
        os.close(writing)
        os.execvp("sleep", ["sleep", "infinity"])
    os.close(writing)
    os.read(reading, 1)
    os.close(reading)
    there = f"nsenter --target {other} --net ip"
    for line in (
        "ip link set lo up",
        "ip link add name cable type veth peer name plug",
        f"ip link set plug netns {other}",
        f"ip address add {HOST}/24 dev cable",
        "ip link set cable up",
        "ip route add 224.0.0.0/4 dev cable",
        f"{there} link set lo up",
        f"{there} address add {_OTHER}/24 dev plug",
        f"{there} link set plug up",
        f"{there} route add 224.0.0.0/4 dev plug",
    ):
        subprocess.run(line.split(), check=True)
    return other


def main(words: list[str]) -> int:
    """Runs a command in this room; returns its exit code."""
    other = _furnish()
    try:
        return subprocess.run(words, env=os.environ | {INSIDE: str(other)}, check=False).returncode
    finally:
        os.kill(other, 9)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
