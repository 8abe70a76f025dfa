"""`run.json` in the folder of a run: how it is run and where its frames can be heard, from its first moment on.

It says what summary.json, which is written at the end, cannot say while a run goes on, or after it was killed.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from echelon.files import is_locked, write_text

STATE: Final = "run.json"


@dataclass(frozen=True, slots=True)
class RunState:
    """How a run is run."""

    pid: int
    """Of the process that runs it, or supervises its processes"""
    engine: str
    clock: str
    buses: dict[str, str]
    """By name of the bus, the URL where its frames can be heard; none where there is no bus"""


def write_state(folder: Path, engine: str, clock: str, buses: dict[str, str]) -> None:
    """Notes that this process begins a run.  Raises OSError."""
    state = RunState(os.getpid(), engine, clock, buses)
    write_text(folder / STATE, json.dumps(asdict(state), indent=2) + "\n")


def read_state(folder: Path) -> RunState | None:
    """Returns what is noted of a run; None if nothing is that can be read."""
    try:
        return RunState(**json.loads((folder / STATE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def goes_on(folder: Path) -> bool:
    """True while a run holds its folder and has not written its summary yet."""
    try:
        return not (folder / "summary.json").exists() and is_locked(folder)
    except OSError:
        return False
