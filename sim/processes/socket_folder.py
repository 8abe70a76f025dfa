"""The folder in which the fork server has its socket.

The supervisor makes it and removes it.  One that was killed cannot, so the fork server does, when it ends after it.  The fork
server imports this module first; in any other process it does nothing."""

import atexit
import os
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

FOLDER: Final = "ECHELON_SOCKET_FOLDER"
"""Environment variable of the fork server: the number of the supervisor's process, a space, and the folder"""


def remove(supervisor: int, folder: Path) -> None:
    """Removes the folder and the sockets in it, unless the supervisor is still there to do so.  What is no socket stays."""
    if os.getppid() == supervisor and not _is_dying(supervisor):
        return
    try:
        for path in folder.iterdir():
            if path.is_socket():
                path.unlink()
        folder.rmdir()
    except OSError:  # somebody has put something else there
        pass


def _is_dying(process: int) -> bool:
    """Returns whether a process is about to end: it has closed its files, of which one tells the fork server to end, but may
    still be the parent of its children."""
    try:
        return not os.listdir(f"/proc/{process}/fd")
    except OSError:
        return True


if FOLDER in os.environ:
    _supervisor, _, _folder = os.environ.pop(FOLDER).partition(" ")
    atexit.register(remove, int(_supervisor), Path(_folder))
    with suppress(OSError):
        # Python tries folders for temporary files with a file, which would stay if a process were killed just then.  So it is
        # done here for all processes of the run.
        tempfile.gettempdir()
