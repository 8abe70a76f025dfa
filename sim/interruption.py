"""Ctrl-C in a run in one process: the run ends between two instants, and all that it has said by then is kept.

An exception in the middle of an instant would leave half of it: frames on the bus twice or not at all, states that nobody
recorded.  So the first Ctrl-C (or SIGTERM) is only noted, and the run looks at the note after each instant; the second raises
KeyboardInterrupt at once, for a run that does not get to the end of an instant.
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
    """Whether somebody has asked the run to end."""

    asked: bool = False


@contextmanager
def interruption(at_once: Callable[[], None]) -> Iterator[Interruption]:
    """Notes interruptions while it is open; `at_once` is called at each, for what must not wait for the end of an instant.

    In another thread than the main one, where Python hears of no signal, nothing is ever noted."""
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
