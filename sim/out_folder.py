"""The folder that a run writes into.  Only files that an earlier run wrote are ever overwritten or deleted there.

A run notes in `.echelon.json` which files it writes, and when it ends the SHA-256 of each.  The next run of the same scenario
in the folder deletes those that have this hash still.  A run that was killed has noted hashes of the scenario and of users'
parts alone; its other files count as its own by their names.  Without the note nothing counts as written by a run.  The folder
is locked while a run writes into it.

file in the folder                          a new run of the same scenario   a new run of another scenario
written by an earlier run, unchanged        deletes it                       is refused, or with `replace` deletes it
written by an earlier run, then edited      is refused if it needs the name  is refused if it needs the name
not written by a run                        is refused if it needs the name  is refused if it needs the name
"""

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Final

from echelon.bridge.protocols.plan_dbc import dbc_names
from echelon.bridge.stations.closed import LOG
from echelon.errors import UsageError
from echelon.files import is_locked, lock, read_json, write_text
from echelon.plan.plan import Plan
from echelon.runtime.arrivals import FILE as ARRIVALS
from echelon.shipped import EFFECTIVE
from echelon.sim.observing import TICKET
from echelon.sim.run_state import STATE

NOTE: Final = ".echelon.json"
RECORDING: Final = "run.mcap"
CUT: Final = "run.mcap.cut"
"""The recording of a killed run as it was before it was mended (echelon.sim.recovery)"""
SUMMARY: Final = "summary.json"
REPORT: Final = "report.html"
TABLES: Final = ("csv", "parquet")
"""Folders of exported tables"""
TRACES: Final = "latencies"
"""Folder of the traces that are made from a run's latencies (echelon.sim.measured_links)"""

_DBC: Final = re.compile(r"torque(?:-[\w.-]+)?\.dbc")
_ALWAYS: Final = (EFFECTIVE, STATE, RECORDING, CUT, ARRIVALS, SUMMARY, REPORT, LOG, TICKET)
"""Names that a run may write.  Of a run that was killed no hashes are noted, and these count as its files by their names"""


def run_files(plan: Plan, bus: bool, observed: bool = False) -> tuple[str, ...]:
    """Returns the names of the files that a run may write, except for the files of users' parts.

    `bus` says whether the run makes CAN frames, `observed` whether it is open to observers."""
    with_bus = (LOG, *dbc_names(plan)) if bus else ()
    return (EFFECTIVE, STATE, RECORDING, CUT, ARRIVALS, SUMMARY, REPORT, *with_bus, *((TICKET,) if observed else ()))


@dataclass(slots=True)
class OutFolder:
    """The folder of a run, locked for it."""

    path: Path
    scenario: str
    stays: tuple[str, ...]
    """Names in the folder that are not of this run, but look as if they were: `can.blf`, tables"""
    _files: dict[str, str | None] = field(default_factory=dict)

    def note(self, files: Iterable[str], texts: Mapping[str, str]) -> None:
        """Notes the files of the run: names in `files`, and in `texts` files that are written at its start, with their texts.

        Raises OSError."""
        self._files |= dict.fromkeys(files)
        self._files |= {name: sha256(text.encode()).hexdigest() for name, text in texts.items()}
        _write_note(self.path, self.scenario, self._files)

    def seal(self) -> None:
        """Notes the hashes of all files that have none yet: the run writes no more.  Raises OSError."""
        for name, digest in self._files.items():
            if digest is None and (self.path / name).is_file():
                self._files[name] = _hash(self.path / name)
        _write_note(self.path, self.scenario, self._files)


@contextmanager
def out_folder(scenario: str, out: Path | None, files: Iterable[str], replace: bool = False) -> Iterator[OutFolder]:
    """A context with the folder of a run: `out`, by default `runs/<scenario>-<utc time>`.  It is made if it does not exist.

    `scenario` is the name of the scenario, `files` are the names of the files that the run may write.  Files of an earlier run
    are deleted: those of the same scenario, with `replace` those of any scenario.  Raises UsageError if a file is in the way or
    a run goes on in the folder, and OSError."""
    path = new_folder(scenario) if out is None else out
    path.mkdir(parents=True, exist_ok=True)
    try:
        held = lock(path)
    except BlockingIOError:
        raise UsageError(f"--out {path}: a run is going on there; give another folder") from None
    try:
        _clear(path, scenario, files, replace)
        folder = OutFolder(path, scenario, tuple(_misleading(path)))
        folder.note(files, {})
        try:
            yield folder
        finally:
            with suppress(OSError):  # the files then count as those of a run that was killed
                folder.seal()
    finally:
        os.close(held)


def note_again(path: Path, names: Iterable[str]) -> None:
    """Notes the hashes of files of a finished run that were written anew, and of those that have none yet; does nothing in a
    folder without the note of a run.  Raises OSError."""
    if earlier := _earlier(path):
        scenario, files = earlier
        anew = {*names, *(name for name, digest in files.items() if digest is None and (path / name).is_file())}
        _write_note(path, scenario, files | {name: _hash(path / name) for name in sorted(anew)})


def _write_note(path: Path, scenario: str, files: Mapping[str, str | None]) -> None:
    write_text(path / NOTE, json.dumps({"scenario": scenario, "files": files}, indent=1) + "\n")


def _hash(file: Path) -> str:
    with file.open("rb") as opened:
        return file_digest(opened, "sha256").hexdigest()


def new_folder(name: str) -> Path:
    """Makes and returns `runs/<name>-<utc time>`, with a number at the end if another run began in the same second.  Raises
    OSError."""
    stamp, count = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ"), 1
    while True:
        path = Path("runs") / f"{name}-{stamp}{f'-{count}' if count > 1 else ''}"
        path.parent.mkdir(exist_ok=True)
        try:
            path.mkdir()
        except FileExistsError:
            count += 1
        else:
            return path


def _clear(path: Path, scenario: str, files: Iterable[str], replace: bool) -> None:
    """Deletes the files of an earlier run.  Raises UsageError, before anything is deleted, if a file is in the way."""
    with suppress(FileNotFoundError):
        if is_locked(path / RECORDING):
            raise UsageError(f"--out {path}: a run is going on there; give another folder")
    earlier = _earlier(path)
    left, edited = {}, set[str]()
    known = {*files, *_ALWAYS, *(name for name in (earlier[1] if earlier else ()) if _DBC.fullmatch(name))}
    for name, digest in earlier[1].items() if earlier else ():
        file = path / name
        if file.is_file():
            ours = not file.is_symlink() and (name in known if digest is None else _hash(file) == digest)
            if ours:
                left[name] = file
            else:
                edited.add(name)
    for name in files:
        if name not in left and os.path.lexists(path / name):
            why = (
                "was changed after its run"
                if name in edited
                else f"exists, and {NOTE} does not say that a run wrote it"
            )
            raise UsageError(f"--out {path}: {name} {why}; move it away, or give another folder")
    if earlier and left and earlier[0] != scenario and not replace:
        what = f"holds a run of the scenario {earlier[0]}, not {scenario}"
        raise UsageError(f"--out {path}: {what}; give another folder, or --replace to delete that run")
    for file in left.values():
        file.unlink()


def _earlier(path: Path) -> tuple[str, dict[str, str | None]] | None:
    """Returns the scenario's name and the files of the run in a folder, with their SHA-256 or None; None without a note."""
    try:
        note = read_json((path / NOTE).read_bytes())
        files = {str(name): digest for name, digest in note["files"].items() if Path(name).name == name}
        return str(note["scenario"]), files
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _misleading(path: Path) -> Iterator[str]:
    """Yields the names in a folder that look like files of a run.  Called when those of earlier runs are deleted already."""
    stems = {name.partition(".")[0] for name in (RECORDING, SUMMARY, REPORT, LOG)} | {"torque", TRACES, *TABLES}
    for entry in sorted(path.iterdir()):
        if entry.name.partition(".")[0].partition("-")[0] in stems:
            yield entry.name
