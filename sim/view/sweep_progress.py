"""The progress of a sweep: a bar with the time left, or plain lines if there is no terminal."""

import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

PLAIN_S = 2.0
"""Time between two plain lines [s]"""


class SweepDisplay:
    """Shows the progress of a sweep on a stream, by default standard error; nothing but notes if `quiet`."""

    def __init__(self, notes: Sequence[str] = (), stream: TextIO = sys.stderr, quiet: bool = False) -> None:
        self._quiet, self._stream = quiet, stream
        console = Console(file=stream, stderr=stream is sys.stderr)
        self._bar: Bar | None = None
        for note in notes:
            print(note, file=stream, flush=True)
        if not quiet and console.is_terminal:
            columns = TextColumn("{task.description}"), BarColumn(60), MofNCompleteColumn(), TimeRemainingColumn()
            self._bar = Bar(*columns, console=console, transient=True)
            self._task = self._bar.add_task("runs", total=None)
        self._begun_s = self._said_s = time.monotonic()

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, done: int, total: int, before: int) -> None:
        """Shows how many of all runs are finished; `before` were finished when the sweep was started."""
        if self._bar is not None:
            self._bar.update(self._task, total=total, completed=done)
            return
        now_s = time.monotonic()
        if not self._quiet and now_s - self._said_s >= PLAIN_S:
            self._said_s = now_s
            made, left = done - before, total - done
            time_left = f", {(now_s - self._begun_s) * left / made:.0f} s left" if made else ""
            print(f"{done} of {total} runs{time_left}", file=self._stream, flush=True)
