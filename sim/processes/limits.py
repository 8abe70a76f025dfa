"""The limits that the system sets to a process and its user (`ulimit`), before a run as processes starts.

Where a limit is reached in the middle of a start, errors come from many places.  So it is compared with the needs.
"""

import os
import resource
from pathlib import Path
from typing import Final

from echelon.errors import UsageError

FILES: Final = 28
"""Open files of the supervisor before it starts processes; measured: 10"""
FILES_EACH: Final = 5
"""Open files of the supervisor for each process of the run; measured: 5"""
THREADS_EACH: Final = 14
"""Threads of a process of a run; measured: 7 to 13, most of them Zenoh's"""
MEMORY: Final = 512 << 20
"""Address space of a process of a run [bytes]; measured: 0.6 GB, of which Zenoh can do without some"""
CHECKED_THREADS: Final = 100_000
"""Larger limits are not compared with the threads that the user has: to count them takes time"""
ADVICE: Final = "or run in one process with --engine inprocess"


def check_limits(processes: int) -> None:
    """Raises UsageError if a run as so many processes does not fit the limits of this process.

    The limit of open files is raised if that is allowed."""
    need = FILES + FILES_EACH * processes
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if _is_less(soft, need) and not _is_less(hard, need):
        resource.setrlimit(resource.RLIMIT_NOFILE, (need, hard))
    elif _is_less(soft, need):
        raise UsageError(_text("-n", f"{soft} open files", f"{processes} processes needs {need}"))
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if _is_less(soft, MEMORY):
        least = f"processes needs {MEMORY >> 20} MiB for each"
        raise UsageError(_text("-v", f"{soft >> 20} MiB of address space", least))
    soft, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    if _is_less(soft, CHECKED_THREADS) and os.geteuid() != 0:  # root is not held to it
        have, need = _threads(), THREADS_EACH * processes
        if have + need > soft:
            found = f"{soft} threads of one user, of which there are {have}"
            raise UsageError(_text("-u", found, f"{processes} processes needs {need}"))


def _is_less(limit: int, need: int) -> bool:
    return limit != resource.RLIM_INFINITY and limit < need


def _text(option: str, found: str, need: str) -> str:
    return f"the system allows {found} (ulimit {option}), and a run as {need}; raise the limit, {ADVICE}"


def _threads() -> int:
    """Returns how many threads the user has."""
    user, count = os.getuid(), 0
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                if folder.stat().st_uid == user:
                    count += sum(1 for _ in (folder / "task").iterdir())
            except OSError:  # it has just ended
                continue
    return count
