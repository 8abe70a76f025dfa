"""A time limit for users' code, which may never return.

A timer of the kernel interrupts the code by a signal.  Python handles signals in the main thread only, so there is no limit in
other threads.
"""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

REPEAT_S: Final = 1.0
"""Code that catches the interruption is interrupted again after this time."""


class TookTooLong(BaseException):
    """Raised within code that took too long.  It is a BaseException, so that `except Exception` does not catch it."""


class Limit:
    """An active limit."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.in_force = True

    def renew(self) -> None:
        """Restarts the time."""
        if threading.current_thread() is threading.main_thread():
            signal.setitimer(signal.ITIMER_REAL, self._seconds, REPEAT_S)


@contextmanager
def time_limit(seconds: float) -> Iterator[Limit]:
    """A context that raises TookTooLong in its block if this takes longer than `seconds`.

    Limits may be nested: the inner one applies, and the time of the outer one keeps running."""
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


@contextmanager
def no_longer(seconds: float, late: Exception) -> Iterator[None]:
    """A context that raises `late` if its block takes longer than `seconds`."""
    try:
        with time_limit(seconds):
            yield
    except TookTooLong:
        raise late from None
