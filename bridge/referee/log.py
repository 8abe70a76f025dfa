"""The log of a run, or of somebody else, with the eyes of a plan: which frames of it are on the plan's buses, and when."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from echelon.bridge.can.candump import LeftOut, Logged
from echelon.bridge.can.canlog import EPOCH_NS
from echelon.bridge.can.log_files import NO_CHANNEL, read_log
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.referee import Referee
from echelon.bridge.referee_reports import RefereeReport
from echelon.errors import one_line
from echelon.plan.plan import Plan

NEAR_NS: Final = EPOCH_NS // 10
"""A log that begins this near to EPOCH_NS has the clock of can.log"""
REASONS: Final = 20
"""How many reasons are told apart"""
MORE: Final = "others"
LONGEST_NAME: Final = 64
"""How much of the name of a foreign interface is told"""

Entry = tuple[int, int, Frame]
"""Run time [ns], number of the bus, frame"""


class PlanLog:
    """The frames of a log that are on the buses of a plan.

    Run time 0 is EPOCH_NS on the clock of can.log.  A log with another clock is one of somebody else: its first frame is at 0.
    `names` has the number of the bus for each name of an interface in the log; None: the names and numbers in the plan."""

    def __init__(self, entries: Iterable[Logged | LeftOut], plan: Plan, names: Mapping[str, int] | None = None) -> None:
        self._entries = entries
        self._names = names_in(plan) if names is None else names
        self._plan = plan
        self.start_ns: int | None = None
        """Run time 0 on the clock of the log [ns]; None before the first frame"""
        self.left_out: Counter[str] = Counter()
        """What is left out, by reason"""

    @property
    def foreign(self) -> bool:
        """True if the log has another clock than can.log."""
        return self.start_ns not in (None, EPOCH_NS)

    def entries(self) -> Iterator[Entry | None]:
        """Yields frames, and None where the log lacks frames that were on the bus."""
        names, start_ns = self._names, 0
        for entry in self._entries:
            if isinstance(entry, LeftOut):
                self._leave_out(entry.reason)
                if entry.torn:
                    yield None
                continue
            time_ns, channel, frame = entry
            number = names.get(channel)
            if number is None:
                self._leave_out(f"frames of the interface {one_line(channel[:LONGEST_NAME])}")
                continue
            if self.start_ns is None:
                start_ns = self.start_ns = EPOCH_NS if abs(time_ns - EPOCH_NS) < NEAR_NS else time_ns
            yield time_ns - start_ns, number, frame

    def frames(self) -> Iterator[Entry]:
        """Yields frames."""
        return (entry for entry in self.entries() if entry is not None)

    def _leave_out(self, reason: str) -> None:
        known = reason in self.left_out or len(self.left_out) < REASONS
        self.left_out[reason if known else MORE] += 1


def names_in(plan: Plan) -> dict[str, int]:
    """Returns the numbers of a plan's buses by their names, and by 1, 2, … as log files number them."""
    buses = plan.can.buses
    numbered = {str(number): number - 1 for number in range(1, len(buses) + 1)}
    unnamed = {NO_CHANNEL: 0} if len(buses) == 1 else {}
    return numbered | unnamed | {bus.name: number for number, bus in enumerate(buses)}


def read_run_log(path: Path, plan: Plan) -> Iterator[Entry]:
    """Yields run time [ns], number of the bus and frame from a run's can.log; skips what is none of the plan's buses.

    Raises OSError if the log cannot be read."""
    return PlanLog(read_log(path), plan).frames()


def judge_log(
    path: Path,
    plan: Plan,
    *,
    names: Mapping[str, int] | None = None,
    tolerance_ns: int | None = None,
    whole: bool = True,
    until_ns: int | None = None,
    end_ns: int | None = None,
) -> RefereeReport:
    """Returns the referee's report on a log; `names` as in `PlanLog`.

    `whole` says that the run was not cut off: then cyclic frames that are missing at the end of the log are silence.  Of a run
    that was stopped or broke off, only frames up to `until_ns` are judged: some processes go on for a while, others do not, and
    what its own stop sends is no finding.  Frames after `end_ns`, the end of a run on a wall clock, are left out: processes
    then stop one after the other.  A log of somebody else may begin and end within a run.  Raises OSError if the log cannot be
    read."""
    log = PlanLog(read_log(path), plan, names)
    referee = Referee(plan, tolerance_ns=tolerance_ns)
    last_ns = later = 0
    for entry in log.entries():
        if entry is None:
            referee.tear()
            continue
        time_ns, bus, frame = entry
        referee.late = log.foreign
        if until_ns is None and end_ns is not None and time_ns > end_ns:
            continue
        if until_ns is None or time_ns <= until_ns:
            last_ns = time_ns
            referee.observe(time_ns, bus, frame)
        else:
            later += 1
    referee.finish(max(last_ns, plan.duration_ns) if whole and not log.foreign else last_ns, cut=not whole)
    return replace(
        referee.report(),
        until=None if until_ns is None else until_ns / 1e9,
        later=later,
        left_out=dict(log.left_out),
    )
