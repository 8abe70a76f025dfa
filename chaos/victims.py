"""The processes of a run, as the kernel shows them: found by name, and what they leave behind."""

import os
import signal
import socket
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

MARK: Final = "ECHELON_CHAOS"
"""Environment variable that all processes of a run inherit; it tells them from those of other runs"""
_LISTENS: Final = "0A"
SHARED_MEMORY: Final = Path("/dev/shm")


def marked(token: str) -> list[int]:
    """Returns the processes whose environment has the mark of a run, without zombies."""
    found, mark = [], f"{MARK}={token}".encode()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            if mark in (entry / "environ").read_bytes().split(b"\0") and _state(entry) != "Z":
                found.append(int(entry.name))
        except OSError:
            continue  # it has ended, or is another user's
    return found


def _state(entry: Path) -> str:
    """Returns the letter of a process's state."""
    return (entry / "stat").read_text(errors="replace").rpartition(")")[2].split()[0]


def name_of(pid: int) -> str:
    """Returns the name that a process shows; "" if it is gone."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().rstrip("\n")
    except OSError:
        return ""


def described(pid: int) -> str:
    """Returns the name of a process and the beginning of its command line."""
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        line = ""
    return f"{name_of(pid)} ({line[:160]})"


def find(name: str, token: str) -> int | None:
    """Returns the process of a run with a name; None if there is none."""
    return next((pid for pid in marked(token) if name_of(pid) == name), None)


def _links(pid: int) -> list[str]:
    """Returns what a process has open; what it closes meanwhile is left out."""
    found: list[str] = []
    with suppress(OSError):
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                found.append(os.readlink(descriptor))
    return found


def listening(pids: list[int]) -> list[tuple[str, int]]:
    """Returns the TCP addresses at which processes listen."""
    own = {link for pid in pids for link in _links(pid)}
    found = []
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        words = line.split()
        if words[3] == _LISTENS and f"socket:[{words[9]}]" in own:
            address, _, port = words[1].partition(":")
            found.append((socket.inet_ntoa(bytes.fromhex(address)[::-1]), int(port, 16)))
    return found


def kill(pids: Iterable[int]) -> None:
    """Kills processes, as far as they are there."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def shared_memory() -> frozenset[str]:
    """Returns the names in shared memory."""
    return frozenset(path.name for path in SHARED_MEMORY.iterdir()) if SHARED_MEMORY.exists() else frozenset()


def in_use(names: frozenset[str]) -> frozenset[str]:
    """Returns those of some names in shared memory that a living process has open or mapped."""
    wanted = {str(SHARED_MEMORY / name): name for name in names}
    used = set[str]()
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and len(used) < len(names):
            try:
                text = (entry / "maps").read_text(errors="replace")
            except OSError:
                continue
            links = _links(int(entry.name))
            used |= {name for path, name in wanted.items() if path in links or path in text}
    return frozenset(used)
