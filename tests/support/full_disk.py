"""An open file on a disk that is full."""

import os


def fill(descriptor: int) -> None:
    """Lets all further writes to an open file fail, as on a full disk."""
    full = os.open("/dev/full", os.O_WRONLY | os.O_CLOEXEC)
    os.dup2(full, descriptor, inheritable=False)
    os.close(full)
