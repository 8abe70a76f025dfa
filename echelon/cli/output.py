"""What a command prints, when it cannot be printed: the reader has ended, the disk is full, or the encoding lacks a character.

A command's exit code is about its work.  So its work goes on, and what cannot be printed is dropped.  Characters that the
encoding lacks become question marks.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from typing import Any, TextIO


class Output:
    """A stream that drops what cannot be written to it, and then everything; `trouble` is why.

    With `live` it raises BrokenPipeError when the reader has ended: for commands that print until they are stopped."""

    def __init__(self, stream: TextIO, live: bool = False) -> None:
        self._stream, self.live = stream, live
        self.trouble: OSError | None = None
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")

    def write(self, text: str) -> int:
        """Writes a text; returns its length."""
        if self.trouble is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self._give_up(error)
        return len(text)

    def flush(self) -> None:
        """Writes what is buffered."""
        if self.trouble is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.trouble = error
        try:
            with open(os.devnull, "w", encoding="utf-8") as nowhere:
                # what is buffered would be written again when the interpreter ends
                os.dup2(nowhere.fileno(), self._stream.fileno())
        except OSError:
            pass
        if self.live and isinstance(error, BrokenPipeError):
            raise error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def patient_output() -> Iterator[Output | None]:
    """A context in which standard output and standard error are each an `Output`; gives that of standard output, or None if it
    is closed."""
    before = sys.stdout, sys.stderr
    out = None if sys.stdout is None else Output(sys.stdout)
    try:
        if out is not None:
            sys.stdout = out
        if sys.stderr is not None:
            sys.stderr = Output(sys.stderr)
        yield out
    finally:
        sys.stdout, sys.stderr = before
