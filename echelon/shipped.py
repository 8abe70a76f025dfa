"""The scenarios that come with the package, by their names."""

from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent / "deploy" / "scenarios"


def shipped() -> dict[str, Path]:
    """Returns the files of all shipped scenarios by name, in alphabetical order."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}
