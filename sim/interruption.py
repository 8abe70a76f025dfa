"""Ctrl-C in a run in one process: the run ends between two instants, and everything up to then is recorded.

An exception in the middle of an instant would leave it half done: frames could be sent twice or not at all, and states could
be missing in the recording.  So the first Ctrl-C (or SIGTERM) is only noted, and the run asks for it after each instant.  The
second raises KeyboardInterrupt at once, in case an instant never ends.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


@dataclass(slots=True)
class Interruption:
    """`asked` becomes True when the user asks the run to end."""

    asked: bool = False


@contextmanager
def interruption(at_once: Callable[[], None]) -> Iterator[Interruption]:
    """A context in which Ctrl-C and SIGTERM are noted instead of raised.

    `at_once` is called at each of them, for work that must not wait for the end of an instant.  Python handles signals only in
    the main thread, so in other threads nothing is noted."""
    noted = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, frame: FrameType | None) -> None:
        at_once()
        if noted.asked:
            raise KeyboardInterrupt
        noted.asked = True

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
