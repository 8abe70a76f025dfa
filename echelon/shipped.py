"""Names of scenarios on the command line: a file, the folder of a run, or one of the scenarios shipped with the package."""

from pathlib import Path
from typing import Final

from echelon.errors import UsageError

FOLDER: Final = Path(__file__).parent / "deploy" / "scenarios"
EFFECTIVE: Final = "scenario.toml"
"""The file in a run's folder that holds its scenario"""


def shipped() -> dict[str, Path]:
    """Returns the files of all shipped scenarios by name, in alphabetical order of the names."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}


def run_folder(name: str) -> Path | None:
    """Returns `name` as the folder of a run, or None if it is not one.

    A folder with the name of a shipped scenario counts only if it holds a `scenario.toml`."""
    path = Path(name)
    return path if path.is_dir() and (name not in shipped() or (path / EFFECTIVE).exists()) else None


def scenario_path(name: str) -> Path:
    """Returns the file of the scenario that a name stands for.  A name with a suffix or a slash is taken as a path, even if
    there is no such file.  Raises UsageError for any other name that is not a shipped scenario."""
    path = Path(name)
    if folder := run_folder(name):
        return folder / EFFECTIVE
    if path.is_file() or path.suffix or "/" in name:
        return path
    if name not in (known := shipped()):
        raise UsageError(f"{name}: no such file, and no shipped scenario; those are {', '.join(known)}")
    return known[name]
