"""What a command's SCENARIO stands for: a file, the folder of a run, a shipped scenario, or standard input."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from echelon.errors import UsageError
from echelon.load import ScenarioError
from echelon.plan import Plan
from echelon.scenario import Scenario
from echelon.shipped import shipped
from echelon.sim.parts import load, parse

STANDARD_INPUT: Final = "-"
EFFECTIVE: Final = "scenario.toml"
"""The file in a run's folder that holds its scenario"""


def read_scenario(name: str, overrides: Sequence[str] = ()) -> tuple[Scenario, Plan]:
    """Returns the scenario that a name stands for, with overrides, and its plan.  Raises UserError."""
    if name != STANDARD_INPUT:
        return load(_path(name), overrides)
    try:
        text = sys.stdin.buffer.read().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"standard input: is not UTF-8 text (byte {error.start})") from None
    return parse(text, "standard input", overrides)


def run_folder(name: str) -> Path | None:
    """Returns the folder that a name stands for, or None if it stands for something else."""
    path = Path(name)
    return path if path.is_dir() and (name not in shipped() or (path / EFFECTIVE).exists()) else None


def _path(name: str) -> Path:
    path = Path(name)
    if folder := run_folder(name):
        return folder / EFFECTIVE
    if path.is_file() or path.suffix or "/" in name:
        return path
    if name not in (known := shipped()):
        raise UsageError(f"{name}: no such file, and no shipped scenario; those are {', '.join(known)}")
    return known[name]
