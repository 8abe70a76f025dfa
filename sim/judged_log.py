"""What the referee finds in the can.log of a run: up to where, and how late frames may be."""

from pathlib import Path
from typing import NamedTuple, Self

from echelon.bridge.referee_reports import RefereeReport
from echelon.plan.plan import Plan
from echelon.sim.processes.outcome import Outcome


class Terms(NamedTuple):
    """The terms on which the frames of a run are judged."""

    tolerance_ns: int | None
    """How late a cyclic frame may be [ns]; None: as the referee has it"""
    whole: bool
    """True if the log must go to the end of the run.  Of a run that goes on, was stopped or broke off it need not"""
    until_ns: int | None
    """Run time up to which frames are judged [ns], if the run was stopped or broke off: what its stop sends is no finding"""
    end_ns: int | None
    """End of a run on a wall clock [ns]: later frames are no findings, either"""

    @classmethod
    def of(cls, plan: Plan, clock: str, whole: bool, until_ns: int | None = None) -> Self:
        """Returns the terms for a run.

        On a wall clock frames may be late, since processes wait for a processor, and bridge and drives stop one after the
        other after the end: a referee that listens does not judge what comes then, either."""
        if clock != "wall":
            return cls(None, whole, until_ns, None)
        return cls(plan.can.watchdog_ns // 2, whole, until_ns, plan.duration_ns)

    @property
    def last_ns(self) -> int | None:
        """Run time up to which frames are judged [ns]; None: all are."""
        return self.end_ns if self.until_ns is None else self.until_ns


def until_ns(plan: Plan, outcome: Outcome) -> int | None:
    """Returns the run time up to which the frames of a run are judged [ns]; None: all are.

    Of a run that was stopped these are the frames up to the last instant of all robots, of one that broke off those before its
    own stop of the wheels."""
    if outcome.stopped:
        common_ns = outcome.trace.common_ns()
        return int(common_ns[-1]) if len(common_ns) else None
    stop_s = outcome.can.wheels_stopped if outcome.can is not None and outcome.failure else None
    # can.log has whole microseconds, rounded down
    return None if stop_s is None else min(round(stop_s * 1e9) // 1000 * 1000 - 1, plan.duration_ns)


def judged(log: Path, plan: Plan, terms: Terms) -> RefereeReport:
    """Returns the referee's report on a run's can.log.  Raises OSError if the log cannot be read."""
    from echelon.bridge.referee.log import judge_log

    return judge_log(log, plan, **terms._asdict())
