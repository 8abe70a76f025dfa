"""What the name of a scenario stands for: a file, the folder of a run, or one of the scenarios that come with the package."""

from pathlib import Path
from typing import Final

from echelon.errors import UsageError

FOLDER: Final = Path(__file__).parent / "deploy" / "scenarios"
EFFECTIVE: Final = "scenario.toml"
"""The file in a run's folder that holds its scenario"""


def shipped() -> dict[str, Path]:
    """Returns the files of all shipped scenarios by name, in alphabetical order."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}


def run_folder(name: str) -> Path | None:
    """Returns the folder of a run that a name stands for, or None if it stands for something else."""
    path = Path(name)
    return path if path.is_dir() and (name not in shipped() or (path / EFFECTIVE).exists()) else None


def scenario_path(name: str) -> Path:
    """Returns the file that a name stands for; it need not exist if it looks like one.  Raises UsageError."""
    path = Path(name)
    if folder := run_folder(name):
        return folder / EFFECTIVE
    if path.is_file() or path.suffix or "/" in name:
        return path
    if name not in (known := shipped()):
        raise UsageError(f"{name}: no such file, and no shipped scenario; those are {', '.join(known)}")
    return known[name]
