"""A limit to the time that code of others may take, for it may never end.

The kernel's timer interrupts the code by a signal, whatever it does in Python.  Python hears of signals in its main thread
alone: in other threads there is no limit.
"""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

REPEAT_S: Final = 1.0
"""Code that swallows the interruption is interrupted again after so long."""


class TookTooLong(BaseException):
    """Raised within the code that took too long.  No Exception, so that `except Exception` does not swallow it."""


class Limit:
    """A limit in force."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.in_force = True

    def renew(self) -> None:
        """Lets the time begin anew."""
        if threading.current_thread() is threading.main_thread():
            signal.setitimer(signal.ITIMER_REAL, self._seconds, REPEAT_S)


@contextmanager
def time_limit(seconds: float) -> Iterator[Limit]:
    """Raises TookTooLong in the block if it takes longer than that.

    Limits may be nested: the inner one is in force, and the time of the outer one goes on."""
    limit = Limit(seconds)
    if threading.current_thread() is not threading.main_thread():
        yield limit
        return

    def ring(number: int, frame: object) -> None:
        if limit.in_force:
            raise TookTooLong(f"more than {seconds:g} s")

    handler = signal.signal(signal.SIGALRM, ring)
    left_s, repeat_s = signal.setitimer(signal.ITIMER_REAL, seconds, REPEAT_S)
    begun_s = time.monotonic()
    try:
        yield limit
    finally:
        limit.in_force = False
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if handler is None else handler)
        if left_s > 0:
            signal.setitimer(signal.ITIMER_REAL, max(1e-3, left_s - (time.monotonic() - begun_s)), repeat_s)
