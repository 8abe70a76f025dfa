"""Files of awkward names in a user's folder: nothing may import them in place of the modules that have these names."""

from pathlib import Path

AWKWARD = (
    "numpy",
    "controller",
    "types",
    "echelon",
    "agents",
    "sim",
    "signal",
    "json",
    "zenoh",
    "can",
    "site",
    "my_laws-2",
)
"""Names of files that others have, too"""


def write_awkward_files(folder: Path) -> None:
    """Writes the files; importing one raises RuntimeError."""
    for name in AWKWARD:
        (folder / f"{name}.py").write_text("raise RuntimeError('not this one')\n")
