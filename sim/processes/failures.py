"""Why a run as processes breaks off."""

from collections.abc import Sequence
from typing import Final

from echelon.sim.processes.children import Child, last_words_of

NAMED: Final = 12
"""The largest number of processes that a note names; the others are counted."""


class RunError(Exception):
    """The run cannot go on; the text says why."""


class StallError(RunError):
    """A run in virtual time made no progress for `still_s` seconds; `who` says which processes everyone waits for."""

    def __init__(self, still_s: float, who: str) -> None:
        self._still_s, self._who = still_s, who
        super().__init__(self.text("an unknown instant"))

    def text(self, when: str) -> str:
        """Returns what happened, in words.  `when` it happened is certain only after the recorder has reported."""
        return f"stalled for {self._still_s:.0f} s at {when}: {self._who}"


class LostError(RunError):
    """A process has ended without its report, or does not end.

    How it ended is asked when the text is needed: to learn it may take a second, and the wheels stop first."""

    def __init__(self, child: Child) -> None:
        super().__init__()
        self._child = child

    def __str__(self) -> str:
        child = self._child
        still = f", {child.state()}{child.runs()}" if child.alive else ""
        return f"lost {child.kind_and_name} ({child.ending()}{still}){last_words_of([child])}"


class DivergedError(Exception):
    """A robot has diverged, so the run stops; the text names the robot and the instant."""


def few(names: Sequence[str], between: str = ", ") -> str:
    """Returns names as text, `NAMED` of them at most; the others are counted."""
    more = [f"and {len(names) - NAMED} more"] if len(names) > NAMED else []
    return between.join([*names[:NAMED], *more])
