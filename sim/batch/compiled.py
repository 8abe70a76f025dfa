"""The one place that knows the compiler.  Everything else in this room that is marked `compiled` is plain Python on numbers and
arrays: it runs uncompiled too, only slowly (with NUMBA_DISABLE_JIT=1 in the environment).

What is marked may call what is marked.  It allocates nothing: its scratch is an argument.  It uses floats and integers
only.  So the same source can be compiled for other targets.

Compiled code is kept in a folder for the sources it was made of, because numba looks only at the file of a function itself and
not at the files of what that function calls, or takes numbers from.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

from echelon.agents import plant, torque_loop
from echelon.controller.laws import terminal_sliding
from echelon.plan import delay_tables
from echelon.runtime import admission, ages, fates

_compiler: Any = numba  # without types: what there is of them changes from version to version
P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a function when it is first called; its arithmetic is that of Python to the last bit."""
    return _compiled(function, fused=False)


def fused(function: Callable[P, R]) -> Callable[P, R]:
    """The same, but a product may go into a sum without being rounded before."""
    return _compiled(function, fused=True)


def apart(function: Callable[P, R]) -> Callable[P, R]:
    """As `compiled`, for what is seldom called: it stays a function of its own, out of the way of what is called often."""
    return _compiled(function, fused=False, inlined=False)


def _compiled(function: Callable[P, R], fused: bool, inlined: bool = True) -> Callable[P, R]:
    _compiler.config.CACHE_DIR, before = str(cache_folder()), _compiler.config.CACHE_DIR
    try:
        # Nothing is allocated, so nothing needs counts of references (_nrt).  A call passes seven numbers for each array, often
        # more than the function itself has to do: what is called often becomes one function.
        marked: Callable[P, R] = _compiler.njit(
            cache=True,
            nogil=True,
            error_model="numpy",
            fastmath={"contract"} if fused else False,
            forceinline=inlined,
            _nrt=False,
        )(function)
        return marked
    finally:
        _compiler.config.CACHE_DIR = before


def is_kept() -> bool:
    """True if the compiled code of these sources is kept, so that loading it takes less than a second, or if none is wanted."""
    return _compiler.config.DISABLE_JIT or any(cache_folder().rglob("whole_run.many_runs*.nbc"))


def sources() -> list[Path]:
    """Returns the sources of the compiled code: this room, and modules whose numbers are compiled into it."""
    modules = plant, torque_loop, terminal_sliding, delay_tables, admission, ages, fates
    return [*sorted(Path(__file__).parent.glob("*.py")), *(Path(module.__file__ or "") for module in modules)]


@cache
def cache_folder() -> Path:
    """Returns the folder of the compiled code: below `$NUMBA_CACHE_DIR`, `$XDG_CACHE_HOME/echelon` or `~/.cache/echelon`, or
    below the folder for temporary files where that cannot be written."""
    digest = hashlib.blake2b(numba.__version__.encode(), digest_size=8)
    for source in sources():
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
