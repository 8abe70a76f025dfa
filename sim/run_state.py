"""`run.json` in the folder of a run: how it is run and where its frames can be heard, from its first moment on.

It says what summary.json, which is written at the end, cannot say while a run goes on, or after it was killed.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

FILE: Final = "run.json"


@dataclass(frozen=True, slots=True)
class RunState:
    """How a run is run."""

    pid: int
    """Of the process that runs it, or supervises its processes"""
    pid_start: int
    """When that process began, in the kernel's clock ticks: another one may get its number later"""
    engine: str
    clock: str
    buses: dict[str, str]
    """By name of the bus, the URL where its frames can be heard; none where there is no bus"""


def write_state(folder: Path, engine: str, clock: str, buses: dict[str, str]) -> None:
    """Notes that this process begins a run.  Raises OSError."""
    state = RunState(os.getpid(), _start_of(os.getpid()), engine, clock, buses)
    (folder / FILE).write_text(json.dumps(asdict(state), indent=2) + "\n", encoding="utf-8")


def read_state(folder: Path) -> RunState | None:
    """Returns what is noted of a run; None if nothing is that can be read."""
    try:
        return RunState(**json.loads((folder / FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def goes_on(folder: Path) -> bool:
    """True while a run has not written its summary yet, and its process is there."""
    state = read_state(folder)
    if state is None or (folder / "summary.json").exists():
        return False
    return _start_of(state.pid) == state.pid_start


def _start_of(pid: int) -> int:
    """Returns when a process began, in the kernel's clock ticks since it booted; -1 if there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return -1
    return int(text.rpartition(")")[2].split()[19])  # its name, in parentheses, may hold anything
