"""The counter of the native frames: what is missing, and what is repeated.  Pure."""

from dataclasses import dataclass

COUNTERS = 16
"""A counter is one more with each frame, modulo this."""


@dataclass(slots=True)
class CounterCheck:
    """Finds frames that are missing, by the counter of one identifier's frames in the order they arrived.

    A gap is only known modulo 16: sixteen frames lost in a row look like none, and fifteen like a repeated frame."""

    frames: int = 0
    missed: int = 0
    repeated: int = 0
    _last: int | None = None

    def step(self, counter: int) -> int:
        """Takes the next frame's counter; how many frames are missing before it, or -1 if it repeats the last one."""
        self.frames += 1
        last, self._last = self._last, counter
        if last is None:
            return 0
        gap = (counter - last - 1) % COUNTERS
        if gap == COUNTERS - 1:
            self.repeated += 1
            return -1
        self.missed += gap
        return gap

    def forget(self) -> None:
        """Takes whatever counter comes next: one of the two ends began anew."""
        self._last = None
