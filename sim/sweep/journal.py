"""The journal of a sweep: finished runs, in the order in which they finished.

A line is a finished task: its name, and the rows of its runs.  A line is appended in one piece when its task is done, so a
sweep that is killed at any time leaves whole lines, and at most one that is cut short at the end.  Opening the journal again
drops that one; its task is done anew.  No task is there twice.
"""

import json
import os
from pathlib import Path
from typing import Final

from echelon.errors import UsageError
from echelon.files import read_json
from echelon.sim.sweep.rows import Rows

NAME: Final = "journal.jsonl"


class Journal:
    """The journal in a folder.  Without a folder it is kept in memory alone."""

    def __init__(self, folder: Path | None) -> None:
        self.done: dict[str, Rows] = {}
        """The rows of finished tasks by the tasks' names"""
        self._descriptor: int | None = None
        if folder is not None:
            self._open(folder / NAME)

    def _open(self, path: Path) -> None:
        """Reads a journal and opens it for more.  Raises UsageError if a line in it is damaged, and OSError."""
        data = path.read_bytes() if path.exists() else b""
        whole = data.rfind(b"\n") + 1
        for number, line in enumerate(data[:whole].splitlines(), start=1):
            try:
                entry = read_json(line)
                self.done.setdefault(entry["task"], entry["rows"])
            except (ValueError, KeyError, TypeError):
                raise UsageError(f"{path}: line {number} is damaged; move the file away to begin anew") from None
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        if whole < len(data):
            os.ftruncate(self._descriptor, whole)

    def add(self, task: str, rows: Rows) -> None:
        """Notes the rows of a finished task.  Raises OSError."""
        if task in self.done:
            return
        if self._descriptor is not None:
            line = json.dumps({"task": task, "rows": rows}, separators=(",", ":")).encode() + b"\n"
            while line:
                line = line[os.write(self._descriptor, line) :]
        self.done[task] = rows

    def close(self) -> None:
        """Closes the file; everything is on the disk then."""
        if self._descriptor is not None:
            os.fsync(self._descriptor)
            os.close(self._descriptor)
            self._descriptor = None
