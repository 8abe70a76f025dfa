"""What the referee finds in the can.log of a run: up to where, and how late frames may be."""

from pathlib import Path

from echelon.bridge.referee_reports import RefereeReport
from echelon.plan.plan import Plan
from echelon.sim.processes.outcome import Outcome


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


def judged(log: Path, plan: Plan, clock: str, whole: bool, until_ns: int | None = None) -> RefereeReport:
    """Returns the referee's report on a run's can.log.

    On a wall clock frames may be later, since processes wait for a processor, and those after the end of the run are not
    judged, as a referee that listens does not judge them.  `whole` and `until_ns` as in `judge_log`."""
    from echelon.bridge.referee.log import judge_log

    wall = clock == "wall"
    return judge_log(
        log,
        plan,
        tolerance_ns=plan.can.watchdog_ns // 2 if wall else None,
        whole=whole,
        until_ns=until_ns,
        end_ns=plan.duration_ns if wall else None,
    )
