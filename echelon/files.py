"""Files that appear whole or not at all, and locks that end with their process."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path, durable: bool = False) -> Iterator[Path]:
    """Gives a path to write to, and puts what was written there in the place of `path` at the end.

    With `durable` it is on the disk then, so that a loss of power leaves the old file or the new one.

    If writing fails, `path` stays as it was.  What is no regular file, such as a pipe, is written to directly.  Raises OSError
    that names `path`."""
    if path.exists() and not path.is_file():
        yield path
        return
    target = Path(os.path.realpath(path))  # where a link leads, so that the link stays
    partial = target.with_name(f".{target.name}.part")
    try:
        yield partial
        if durable:
            _sync(partial)
        os.replace(partial, target)
        if durable:
            _sync(target.parent)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename in (None, str(partial)):
            error.filename, error.filename2 = str(path), None
        try:
            partial.unlink(missing_ok=True)
        except OSError:  # of a folder that cannot be written to
            pass
        raise


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str, durable: bool = False) -> None:
    """Writes a text file that is there whole or not at all; `durable` as in `replacing`.  Raises OSError that names it."""
    with replacing(path, durable) as partial:
        partial.write_text(text, encoding="utf-8")


def write_new(path: Path, text: str) -> None:
    """Writes a text file that was not there.  Raises OSError, also if there is one or a link."""
    with path.open("x", encoding="utf-8") as file:
        file.write(text)


def read_json(data: str | bytes) -> Any:
    """Returns what a JSON text from outside says.  Raises ValueError if it is none, or nested too deep."""
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("nested too deep") from None


def lock(path: Path) -> int:
    """Locks a file or folder until the descriptor that this returns is closed, or the process ends.

    Raises BlockingIOError if somebody else has it locked, and OSError if it cannot be opened.  On file systems without locks
    nobody is kept out."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:
        pass
    return descriptor


def is_locked(path: Path) -> bool:
    """Returns whether somebody else has a file or folder locked.  Raises OSError if it cannot be opened."""
    try:
        os.close(lock(path))
    except BlockingIOError:
        return True
    return False
