"""The referee that listens: it judges what came before a run's own stop, though it learns of that stop late."""

import pytest

from echelon.bridge.referee.patient import HOLD_NS, SKEW_NS, PatientReferee
from echelon.bridge.referee.referee import Referee
from echelon.bridge.referee_reports import RefereeReport
from echelon.plan.plan import Plan
from support.closed_run import Heard, run

MS = 1_000_000
STOP_NS = 612 * MS
"""When the bridge stops the wheels, out of turn"""
LOOK_NS = 10 * MS
"""How often the referee reads what has come"""


def whole_run() -> tuple[Plan, list[Heard]]:
    plan, frames = run("native")
    return plan, list(frames)


def broken_off() -> tuple[Plan, list[Heard], int]:
    """Returns the frames of a run that breaks off: each robot's torque is commanded once more, with zero, and then all are
    silent; and how many frames there were before."""
    plan, frames = whole_run()
    before = [heard for heard in frames if heard[0] < STOP_NS]
    stops = {frame.can_id: (STOP_NS, bus, frame) for _, bus, frame in before}
    return plan, [*before, *stops.values()], len(before)


def listened(referee: PatientReferee, heard: list[Heard], until_ns: int) -> list[Heard]:
    """Lets the referee read the frames as they come, until a run time; returns the later ones."""
    waiting = list(heard)
    for now_ns in range(min(waiting)[0], until_ns + 1, LOOK_NS):
        count = sum(time_ns <= now_ns for time_ns, _, _ in waiting)
        referee.hear(now_ns, waiting[:count])
        del waiting[:count]
    return waiting


def finished(heard: list[Heard], plan: Plan, told_ns: int | None, stopped_ns: int | None) -> RefereeReport | None:
    """Returns the report of a referee that hears at `told_ns` that the run breaks off, and later when the wheels stopped."""
    referee = PatientReferee(Referee(plan), plan.duration_ns)
    end_ns = plan.duration_ns if told_ns is None else told_ns
    rest = listened(referee, heard, end_ns)
    if told_ns is not None:
        referee.hold()
    referee.hear(end_ns + 2 * HOLD_NS, rest)
    return referee.finish(end_ns + 2 * HOLD_NS, stopped_ns)


def test_a_whole_run_is_judged_as_by_a_referee_that_does_not_wait() -> None:
    plan, heard = whole_run()
    heard = [one for one in heard if one[0] <= plan.duration_ns]
    for frames in heard, heard[:800] + heard[1000:]:  # once with a gap
        direct = Referee(plan)
        for one in frames:
            direct.observe(*one)
        direct.finish(plan.duration_ns)
        assert finished(frames, plan, None, plan.duration_ns + 5 * MS) == direct.report("bus")


@pytest.mark.parametrize("told_ns", [STOP_NS + LOOK_NS, STOP_NS + HOLD_NS - LOOK_NS])
def test_the_stop_of_a_run_is_no_finding_and_what_came_before_is_judged(told_ns: int) -> None:
    plan, heard, before = broken_off()
    direct = Referee(plan)
    for one in heard:
        direct.observe(*one)
    assert direct.kinds, "frames out of turn are findings elsewhere"
    report = finished(heard, plan, told_ns, STOP_NS)
    assert report is not None
    just_before = sum(STOP_NS - SKEW_NS < time_ns < STOP_NS for time_ns, _, _ in heard)
    assert (report.kinds, report.frames, report.later) == ({}, before - just_before, len(heard) - before + just_before)
    assert (report.until, report.source) == ((STOP_NS - SKEW_NS) / 1e9, "bus")
    gap = heard[:800] + heard[1000:]
    report = finished(gap, plan, told_ns, STOP_NS)
    assert report is not None
    assert report.kinds["counter gap"] > 0


def test_what_comes_after_the_end_of_a_run_is_left_out_and_not_kept() -> None:
    plan, heard = whole_run()
    end_ns = plan.duration_ns - 200 * MS  # as if the run had ended there
    late = [one for one in heard if one[0] > end_ns]
    assert len(late) > 100
    reports = []
    for frames in [one for one in heard if one[0] <= end_ns], heard:
        referee = PatientReferee(Referee(plan), end_ns)
        rest = listened(referee, frames, plan.duration_ns)
        referee.hear(plan.duration_ns, rest)
        assert not any(time_ns > end_ns for time_ns, _, _ in referee.waiting)
        reports.append(referee.finish(plan.duration_ns + 2 * HOLD_NS, plan.duration_ns))
    assert reports[0] == reports[1]
    assert reports[0] is not None
    assert (reports[0].kinds, reports[0].until) == ({}, None)


def test_a_stop_that_is_told_too_late_or_never_gives_no_report() -> None:
    plan, heard, _ = broken_off()
    assert finished(heard, plan, STOP_NS + HOLD_NS + 2 * LOOK_NS, STOP_NS) is None
    assert finished(heard, plan, STOP_NS + LOOK_NS, None) is None
