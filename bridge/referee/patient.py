"""A referee on a bus that does not judge a run's own stop: whoever listens learns of that stop only later.

When a run breaks off, its bridge stops the wheels out of turn, and drives and bridge fall silent after that.  None of it is a
finding.  But the frames of the stop are on the bus before anybody has told the referee.  So frames are judged `HOLD_NS` after
they came, and from `hold` on, when the run breaks off, not until `finish` says when the wheels were stopped.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.referee import Referee
from echelon.bridge.referee_reports import RefereeReport
from echelon.plan.can_plan import NEVER_NS

HOLD_NS: Final = 1_000_000_000
"""How long frames wait for the news that the run breaks off [ns]: processes tell the supervisor within 0.1 s, on a busy machine
later"""
SKEW_NS: Final = 1_000_000
"""By how much the clock of the frames may be behind that of the bridge [ns]"""


class PatientReferee:
    """Judges frames up to run time `end_ns`, in the order in which they came; later ones are left out."""

    def __init__(self, referee: Referee, end_ns: int) -> None:
        self._referee = referee
        self._end_ns = end_ns
        self.waiting: deque[tuple[int, int, Frame]] = deque()
        """Frames that have not been judged"""
        self._holds = False
        self._judged_ns = -NEVER_NS

    def hear(self, now_ns: int, frames: Sequence[tuple[int, int, Frame]]) -> None:
        """Takes frames with run time [ns] and number of the bus, and judges those that have waited long enough."""
        waiting = self.waiting
        waiting.extend(frame for frame in frames if frame[0] <= self._end_ns)
        while not self._holds and waiting and waiting[0][0] <= now_ns - HOLD_NS:
            self._judge(*waiting.popleft())

    def hold(self) -> None:
        """Says that the run breaks off."""
        self._holds = True

    def finish(self, now_ns: int, stopped_ns: int | None) -> RefereeReport | None:
        """Judges what is left, and ends the listening; returns the report.

        `stopped_ns` is when the bridge stopped the wheels.  If the run breaks off and that is not known (None), or if frames of
        the stop have been judged already, there is no report."""
        if self._holds and stopped_ns is None:
            return None
        until_ns = self._end_ns if stopped_ns is None else min(stopped_ns - SKEW_NS, self._end_ns)
        if self._judged_ns > until_ns:
            return None
        later = 0
        for time_ns, bus, frame in self.waiting:
            if time_ns <= until_ns:
                self._judge(time_ns, bus, frame)
            else:
                later += 1
        if until_ns == self._end_ns:  # bridge and drives stop one after the other
            self._referee.finish(min(now_ns, until_ns))
            return self._referee.report("bus")
        self._referee.finish(until_ns, cut=True)
        return replace(self._referee.report("bus"), until=until_ns / 1e9, later=later)

    def _judge(self, time_ns: int, bus: int, frame: Frame) -> None:
        self._judged_ns = max(self._judged_ns, time_ns)
        self._referee.observe(time_ns, bus, frame)
