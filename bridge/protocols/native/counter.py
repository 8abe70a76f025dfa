"""The counter of the native frames, which shows missing and repeated frames.  Pure."""

from dataclasses import dataclass

COUNTERS = 16
"""A counter increases by one with each frame, modulo COUNTERS."""


@dataclass(slots=True)
class CounterCheck:
    """Counts missing and repeated frames of one identifier by their counters, in the order of arrival.

    A gap is known modulo 16 only: sixteen frames lost in a row look like none, fifteen look like a repeated frame."""

    frames: int = 0
    missed: int = 0
    repeated: int = 0
    _last: int | None = None

    def step(self, counter: int) -> int:
        """Takes the counter of the next frame; returns how many frames are missing before it, -1 for a repeated frame."""
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
        """Accepts any counter next, since sender or receiver has begun anew."""
        self._last = None
