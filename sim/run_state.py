"""`run.json` in the folder of a run: how the run is made, and where its CAN frames can be heard.

It is written when a run begins; summary.json is written only at the end, and not at all if the run is killed.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from echelon.files import is_locked, read_json, write_text

STATE: Final = "run.json"


@dataclass(frozen=True, slots=True)
class RunState:
    """The content of run.json."""

    pid: int
    """Process id of the process that runs the roles, or that supervises their processes"""
    engine: str
    """`processes` or `inprocess`"""
    clock: str
    """`virtual` or `wall`"""
    buses: dict[str, str]
    """The URL of each bus, by its name; empty if the run makes no frames"""


def write_state(folder: Path, engine: str, clock: str, buses: dict[str, str]) -> None:
    """Writes run.json for a run of this process; `buses` are the URLs by the names of the buses.  Raises OSError."""
    state = RunState(os.getpid(), engine, clock, buses)
    write_text(folder / STATE, json.dumps(asdict(state), indent=2) + "\n")


def read_state(folder: Path) -> RunState | None:
    """Returns the content of run.json in a run's folder; None if there is none or it cannot be read."""
    try:
        state = RunState(**read_json((folder / STATE).read_bytes()))
        texts = (state.engine, state.clock, *state.buses, *state.buses.values())
        return state if isinstance(state.pid, int) and all(isinstance(text, str) for text in texts) else None
    except (OSError, ValueError, TypeError, AttributeError):
        return None


def goes_on(folder: Path) -> bool:
    """Returns whether a run goes on: it has its folder locked and has not written its summary yet."""
    try:
        return not (folder / "summary.json").exists() and is_locked(folder)
    except OSError:
        return False
