"""The folder that a run writes into: nothing in it is overwritten or deleted but what an earlier run left.

A run notes in `.echelon.json` which files it writes.  Those go when the next run of the same scenario takes the folder.  Of
files that people edit the note holds the SHA-256, so that an edited one is not taken for the run's.  The folder is locked
while a run writes into it.
"""

import json
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Final

from echelon.bridge.protocols.plan_dbc import dbc_names
from echelon.bridge.stations.closed import LOG
from echelon.errors import UsageError
from echelon.files import is_locked, lock, write_text
from echelon.plan.plan import Plan
from echelon.shipped import EFFECTIVE
from echelon.sim.recording.mcap_reader import read_metadata, read_scenario
from echelon.sim.run_state import STATE

NOTE: Final = ".echelon.json"
RECORDING: Final = "run.mcap"
CUT: Final = "run.mcap.cut"
"""The recording of a run that was killed, once it has been mended (echelon.sim.recovery)"""
SUMMARY: Final = "summary.json"
REPORT: Final = "report.html"
TABLES: Final = ("csv", "parquet")
"""Folders of exported tables"""


def run_files(plan: Plan, bus: bool) -> tuple[str, ...]:
    """Returns the names of the files that a run may write; those of parts that others wrote come on top."""
    return (EFFECTIVE, STATE, RECORDING, CUT, SUMMARY, REPORT, *((LOG, *dbc_names(plan)) if bus else ()))


@dataclass(slots=True)
class OutFolder:
    """A folder that a run has for itself."""

    path: Path
    scenario: str
    stays: tuple[str, ...]
    """What is in it, is not of this run, and might be taken for it: files of the same names, tables"""
    _files: dict[str, str | None] = field(default_factory=dict)

    def note(self, files: Iterable[str], texts: Mapping[str, str]) -> None:
        """Notes files as the run's, and the texts of files that it is about to write, by name.  Raises OSError."""
        self._files |= dict.fromkeys(files)
        self._files |= {name: sha256(text.encode()).hexdigest() for name, text in texts.items()}
        write_text(self.path / NOTE, json.dumps({"scenario": self.scenario, "files": self._files}, indent=1) + "\n")


@contextmanager
def out_folder(scenario: str, out: Path | None, files: Iterable[str], replace: bool = False) -> Iterator[OutFolder]:
    """Makes the folder of a run: `out`, or `runs/<scenario>-<utc time>`, for a run that writes `files`.

    What an earlier run of the same scenario left there goes; of another scenario only if `replace` says so.  Raises UsageError
    where a file is in the way, or a run goes on, and OSError."""
    path = _new(scenario) if out is None else out
    path.mkdir(parents=True, exist_ok=True)
    try:
        held = lock(path)
    except BlockingIOError:
        raise UsageError(f"--out {path}: a run is going on there; give another folder") from None
    try:
        _clear(path, scenario, files, replace)
        folder = OutFolder(path, scenario, tuple(_misleading(path)))
        folder.note(files, {})
        yield folder
    finally:
        os.close(held)


def _new(scenario: str) -> Path:
    """Makes `runs/<scenario>-<utc time>`; with a number if two runs begin in the same second."""
    stamp, count = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ"), 1
    while True:
        path = Path("runs") / f"{scenario}-{stamp}{f'-{count}' if count > 1 else ''}"
        path.parent.mkdir(exist_ok=True)
        try:
            path.mkdir()
        except FileExistsError:
            count += 1
        else:
            return path


def _clear(path: Path, scenario: str, files: Iterable[str], replace: bool) -> None:
    """Deletes what an earlier run left.  Raises UsageError if a file is in the way that it did not leave."""
    with suppress(FileNotFoundError):
        if is_locked(path / RECORDING):
            raise UsageError(f"--out {path}: a run is going on there; give another folder")
    earlier = _earlier(path)
    left, edited = {}, set[str]()
    for name, digest in earlier[1].items() if earlier else ():
        file = path / name
        if file.is_file():
            if digest is None or sha256(file.read_bytes()).hexdigest() == digest:
                left[name] = file
            else:
                edited.add(name)
    for name in files:
        if name not in left and os.path.lexists(path / name):
            why = "was changed after its run" if name in edited else "is there, and no run of echelon left it"
            raise UsageError(f"--out {path}: {name} {why}; move it away, or give another folder")
    if earlier and left and earlier[0] != scenario and not replace:
        what = f"holds a run of the scenario {earlier[0]}, not {scenario}"
        raise UsageError(f"--out {path}: {what}; give another folder, or --replace to delete that run")
    for file in left.values():
        file.unlink()


def _earlier(path: Path) -> tuple[str, dict[str, str | None]] | None:
    """Returns the scenario of the run that a folder holds, and its files with their digests; None if it holds none."""
    try:
        note = json.loads((path / NOTE).read_text(encoding="utf-8"))
        files = {str(name): digest for name, digest in note["files"].items() if Path(name).name == name}
        return str(note["scenario"]), files
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        pass
    # A copy without the note: its recordings tell.
    scenario, files = "", dict[str, str | None]()
    for recording in (path / CUT, path / RECORDING):
        with suppress(OSError, ValueError, KeyError):
            toml, metadata = read_scenario(recording), read_metadata(recording)
            buses = tomllib.loads(toml)["can"]["buses"]
            scenario = metadata["scenario"]
            files |= dict.fromkeys((recording.name, STATE, SUMMARY, REPORT, LOG, "torque.dbc"))
            files |= dict.fromkeys(f"torque-{bus}.dbc" for bus in buses)
            files[EFFECTIVE] = sha256(toml.encode()).hexdigest()
    return (scenario, files) if files else None


def _misleading(path: Path) -> Iterator[str]:
    """Yields what is in a folder beside a run's files and looks as if it were of the run."""
    stems = {name.partition(".")[0] for name in (RECORDING, SUMMARY, REPORT, LOG)} | {"torque", *TABLES}
    for entry in sorted(path.iterdir()):
        if entry.name.partition(".")[0].partition("-")[0] in stems:
            yield entry.name
