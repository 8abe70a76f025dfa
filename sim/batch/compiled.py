"""The one place that knows the compiler.  Everything else in this room that is marked `compiled` is plain Python on numbers and
arrays: it runs uncompiled too, only slowly (with NUMBA_DISABLE_JIT=1 in the environment).

What is marked may call what is marked.  It allocates nothing: its scratch is an argument.  It uses floats and integers only.  So
the same source can be compiled for other targets.

Compiled code is kept in a folder for the sources it was made of, because numba looks only at the file of a function itself and
not at the files of what that function calls.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function when it is first called."""
    numba.config.CACHE_DIR, before = str(cache_folder()), numba.config.CACHE_DIR
    try:
        marked: Callable[P, R] = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
        return marked
    finally:
        numba.config.CACHE_DIR = before


def is_kept() -> bool:
    """True if the compiled code of these sources is kept, so that loading it takes less than a second."""
    return any(cache_folder().rglob("*.nbc"))


@cache
def cache_folder() -> Path:
    """Returns the folder of the compiled code: below `$NUMBA_CACHE_DIR`, `$XDG_CACHE_HOME/echelon` or `~/.cache/echelon`, or
    below the folder for temporary files where that cannot be written."""
    digest = hashlib.blake2b(numba.__version__.encode(), digest_size=8)
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    user = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(user) if user else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "echelon"
    for place in (base, Path(tempfile.gettempdir()) / f"echelon-{os.getuid()}"):
        folder = place / digest.hexdigest()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return folder
