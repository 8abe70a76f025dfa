"""Ctrl-C and other signals that ask a run to end: they are noted, and the run ends in order.

An exception in the middle of an instant would leave it half done: frames could be sent twice or not at all, and states could
be missing in the recording.  So the first signal is only noted, and the run asks for it.  While a run goes on in one process
the second raises KeyboardInterrupt, in case an instant never ends.  While a run ends nothing is raised: first the wheels are
stopped, then what was recorded is written.

Wrappers pass a signal on that the process has had from its group, so one Ctrl-C often comes twice.  Signals within `SAME_S` of
the first count as the same.  A signal that the caller ignores stays ignored, as with `nohup`.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum, auto
from types import FrameType
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SAME_S: Final = 1.0
"""Signals within this time of the first are the same request [s]"""


class Raises(Enum):
    """Which signals raise KeyboardInterrupt."""

    NONE = auto()
    SECOND = auto()
    ALL = auto()


@dataclass(slots=True)
class Interruption:
    """What the user has asked for; `asked` becomes True with the first signal."""

    raises: Raises = Raises.ALL
    at_once: Callable[[], None] = lambda: None
    """Called at each signal, for work that must not wait until the run asks"""
    asked: bool = False
    _first_s: float = field(default=0.0, repr=False)

    def note(self, number: int, frame: FrameType | None = None) -> None:
        """Notes a signal.  Raises KeyboardInterrupt as `raises` says."""
        first, now_s = not self.asked, time.monotonic()
        if first:
            self.asked, self._first_s = True, now_s
        self.at_once()
        if not first and now_s - self._first_s < SAME_S:
            return
        if self.raises is Raises.ALL or (self.raises is Raises.SECOND and not first):
            raise KeyboardInterrupt

    @contextmanager
    def during(self, raises: Raises, at_once: Callable[[], None] = lambda: None) -> Iterator[None]:
        """A context in which signals raise as `raises` says, and call `at_once`."""
        before = self.raises, self.at_once
        self.raises, self.at_once = raises, at_once
        try:
            yield
        finally:
            self.raises, self.at_once = before


@contextmanager
def interruption() -> Iterator[Interruption]:
    """A context in which the signals are noted.

    Python handles signals only in the main thread, so in other threads nothing is noted.  Raises KeyboardInterrupt if a signal
    was noted by a context around this one, and its KeyboardInterrupt was lost: a library kept it to itself, or Python ignored
    it, as it does in a destructor."""
    noted = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before, hook = {number: signal.getsignal(number) for number in SIGNALS}, sys.unraisablehook
    around = (getattr(handler, "__self__", None) for handler in before.values())
    if any(isinstance(other, Interruption) and other.asked for other in around):
        raise KeyboardInterrupt

    def tell(ignored: "sys.UnraisableHookArgs") -> None:
        """Tells of an exception that Python ignores, but not of ours: the signal is noted."""
        if not isinstance(ignored.exc_value, KeyboardInterrupt):
            hook(ignored)

    try:
        sys.unraisablehook = tell
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, noted.note)
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        sys.unraisablehook = hook
