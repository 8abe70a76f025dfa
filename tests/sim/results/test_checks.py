"""Every check of a run: passed, failed, not tested, and switched off."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from echelon.bridge.referee_reports import FindingReport, RefereeReport
from echelon.bridge.reports import DrivesReport, IntrusionReport, WheelsReport
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.scenario.tables import CheckName
from echelon.sim.results.checks import CHECKS
from echelon.sim.results.records import RefusalResult, StandstillResult, Summary
from echelon.sim.results.summary import summarise, summary_text
from echelon.sim.results.trace import Trace
from echelon.sim.results.verdict import CheckResult
from support.runs import plan_of
from support.synthetic import FIELD, can_report, of_errors, run_facts, with_states

CLAIM = "claims=[{block='intra', settled_by=5.0}]"
NO_RECORDING = "health.off=['recording']"
LIMIT = "robot.torque_limit=2.0"
FINDING = RefereeReport(7, 0, {"gap": 1}, (FindingReport(2.5, "can0", "100", "gap", "late", "g1/r1"),), {})
CLEAN = RefereeReport(7, 0, {}, (), {})
INTRUSIONS = (IntrusionReport("can0", "10.0.0.7", "100", 12),)
SILENT = RefereeReport(0, 0, {}, (), {})
WHEELS = WheelsReport("native", 100, {}, 0.1, came_up=-0.5, enabled=True)


def decaying(scale: float = 0.1, *overrides: str, grow: float = 0.0) -> Trace:
    """A run of the lab scenario of 20 s with errors scale e^(-t/0.5 s) + grow e^((t - 20 s)/1.2 s) [m]."""
    plan = plan_of("lab", "claims=[]", "duration=20.0", *overrides)

    def motion(block, seconds):
        unit = np.ones(block.size) / np.sqrt(block.size)
        fall, rise = scale * np.exp(-seconds / 0.5), grow * np.exp((seconds - 20) / 1.2)
        return (fall + rise)[:, None] * unit, (rise / 1.2 - fall / 0.5)[:, None] * unit

    return of_errors(plan, motion)


def counted(plan: Plan, **given: Any) -> list[LinkCounts]:
    """Returns counts of all links of a plan; the first link has the given counts."""
    every = [LinkCounts(link.source, link.receiver, link.channel, 10, 10, 0, 0, 10, 0, 0.0, 0) for link in plan.links]
    return [replace(every[0], **given), *every[1:]]


def judged(trace: Trace, **given: Any) -> Summary:
    parts = {"links": counted(trace.plan), "can": can_report(referee=CLEAN), "run": run_facts()} | given
    return summarise(trace, parts["links"], parts["can"], parts["run"])


def only(summary: Summary, name: str) -> CheckResult:
    (check,) = (check for check in summary.verdict.checks if check.name == name)
    return check


def states(trace: Trace, field: str, value: float, robot: int = 0, rows: slice = slice(1, None)) -> Trace:
    changed = [part.copy() for part in trace.states]
    changed[robot][rows, FIELD[field]] = value
    return with_states(trace, changed)


def without(trace: Trace, robot: int, rows: slice) -> Trace:
    """Returns the trace without some instants of a robot."""
    keep = np.ones(len(trace.times_ns[robot]), dtype=bool)
    keep[rows] = False
    times, values = list(trace.times_ns), list(trace.states)
    times[robot], values[robot] = times[robot][keep], values[robot][keep]
    return Trace(trace.plan, tuple(times), tuple(values))


def short(trace: Trace, rows: int) -> Trace:
    return Trace(trace.plan, tuple(t[:rows] for t in trace.times_ns), tuple(s[:rows] for s in trace.states))


def met(distance: float, *overrides: str) -> Trace:
    """A run in which the first two robots are this far apart, all the time."""
    trace = decaying(0.1, *overrides)
    changed = [part.copy() for part in trace.states]
    changed[1][:, FIELD["x"]] = changed[0][:, FIELD["x"]] + distance
    changed[1][:, FIELD["y"]] = changed[0][:, FIELD["y"]]
    return with_states(trace, changed)


def ends_higher() -> Trace:
    """Errors that are larger at the end than at the start, and do not grow in the last third."""
    plan = plan_of("lab", "claims=[]", "duration=20.0")

    def motion(block, seconds):
        error = np.interp(seconds, [0, 5, 6, 20], [0.1, 0.1, 0.3, 0.3])
        return np.repeat(error[:, None], block.size, 1), np.zeros((len(seconds), block.size))

    return of_errors(plan, motion)


def closed(**robot: Any) -> Summary:
    trace = decaying(0.1, "can.path=closed", *robot.pop("overrides", ()))
    rows = {one.name: WHEELS for one in trace.plan.robots}
    rows["g1/r1"] = replace(WHEELS, **robot)
    return judged(trace, can=can_report(path="closed", robots=rows, referee=CLEAN))


REFUSALS = (
    RefusalResult("recorder", "g1/r1", "from the future", 2),
    RefusalResult("g2", "g2/r4", "number sent before", 1),
)
UNUSED = {"used": 0, "age_mean_ns": 0.0}


def stood_still(**lasted: float) -> Summary:
    """A run on a wall clock in which processes stood still from 3 s on, for so many seconds."""
    standstills = {name: StandstillResult(seconds, 3.0) for name, seconds in lasted.items()}
    return judged(decaying(), run=run_facts(clock="wall", standstills=standstills))


CASES: dict[str, dict[str, tuple[Callable[[], Summary], str]]] = {
    "whole": {
        "passed": (lambda: judged(decaying()), "the run reached 20 s of 20 s"),
        "failed": (lambda: judged(short(decaying(), 1500)), "every robot ended early"),
    },
    "finite": {
        "passed": (lambda: judged(decaying()), "all states are finite"),
        "failed": (lambda: judged(states(decaying(), "vx", np.nan, 2, slice(500, None))), "g1/r3: a state is not finite"),
    },
    "growth": {
        "passed": (lambda: judged(decaying()), "no error grows"),
        "not tested": (lambda: judged(decaying(0.1, "duration=2.0")), "a third of the run is shorter than the dwell time"),
    },
    "end": {
        "passed": (lambda: judged(decaying()), "no block ends with a larger error than at the start"),
        "not tested": (lambda: judged(decaying(0.1, "duration=2.0")), "a third of the run is shorter than the dwell time"),
    },
    "distance": {
        "passed": (lambda: judged(met(0.9, "avoidance.enabled=false")), "no two robots came closer than 0"),
        "failed": (lambda: judged(met(0.1, "avoidance.enabled=false")), "violation(s) of 0."),
    },
    "avoidance": {
        "passed": (lambda: judged(met(0.5, "avoidance.enabled=true")), "no two robots came closer than 0."),
        "failed": (lambda: judged(met(0.1, "avoidance.enabled=true")), "g1/r1 and g1/r2 came to 0.1 m"),
        "not tested": (lambda: judged(decaying(0.1)), "no two robots came within"),
    },
    "saturation": {
        "passed": (lambda: judged(states(decaying(0.1, LIMIT), "saturated", 1.0, 0, slice(1, 301))), "for 15 % of the time"),
        "failed": (lambda: judged(states(decaying(0.1, LIMIT), "saturated", 1.0, 4)), "limits of g2/r5 acted for 100 %"),
        "not tested": (
            lambda: judged(decaying(0.1, *(f"robot.{kind}_limit=inf" for kind in ("torque", "torque_rate", "wheel_speed")))),
            "no robot has a limit",
        ),
    },
    "messages": {
        "passed": (lambda: judged(decaying()), "messages were used on each of"),
        "failed": (
            lambda: judged(t := decaying(), links=counted(t.plan, delivered=0, lost=10, **UNUSED)),
            "no message arrived on 1 of",
        ),
        "not tested": (lambda: judged(decaying(), links=[]), "the messages of the links were not counted"),
    },
    "silence": {
        "passed": (lambda: judged(without(decaying(0.1, NO_RECORDING), 3, slice(100, 149))), "g2/r4 sent no state for 0.5 s"),
        "failed": (lambda: judged(without(decaying(), 3, slice(100, 150))), "g2/r4 sent no state for 0.51 s"),
    },
    "refused": {
        "passed": (lambda: judged(decaying()), "no message was refused"),
        "failed": (
            lambda: judged(decaying(), run=run_facts(refused=3, refusals=REFUSALS)),
            "3 messages refused: recorder 2 of g1/r1 (from the future), g2 1 of g2/r4 (number sent before)",
        ),
    },
    "late": {
        "passed": (lambda: judged(decaying(), run=run_facts(clock="wall", stages=100, late_stages=10)), "10 of 100 stages"),
        "failed": (lambda: judged(decaying(), run=run_facts(clock="wall", stages=100, late_stages=11)), "11 of 100 stages"),
    },
    "standstill": {
        "passed": (lambda: stood_still(g1=0.1, coordinator=0.05, recorder=3.0), "g1 for 0.1 s, the longest"),
        "failed": (
            lambda: stood_still(g1=2.0, bridge=0.11, coordinator=0.05),
            "stood still: g1 for 2 s from t = 3 s on, bridge for 0.11 s from t = 3 s on; at most 0.1 s",
        ),
    },
    "drives": {
        "passed": (lambda: closed(), "the drives of 9 robots came up"),
        "failed": (lambda: closed(fault="over-temperature"), "g1/r1 in fault at the end (over-temperature)"),
        "not tested": (
            lambda: judged(decaying(0.1, "can.path=closed"), can=can_report(path="closed", robots={}, referee=CLEAN)),
            "the bridge gave no report",
        ),
    },
    "referee": {
        "passed": (lambda: judged(decaying()), "nothing breaks the contract in 7 frames"),
        "failed": (lambda: judged(decaying(), can=can_report(referee=FINDING)), "1 finding(s) on the bus"),
        "not tested": (lambda: judged(decaying(), can=can_report(frames=0, referee=SILENT)), "no frame was on the bus"),
    },
    "senders": {
        "passed": (lambda: judged(decaying(), can=can_report(listen="candump vcan0")), "nobody else sent frames"),
        "failed": (
            lambda: judged(decaying(), can=can_report(listen="candump vcan0", intrusions=INTRUSIONS)),
            "12 frames with identifiers of this run came from elsewhere: 10.0.0.7 sent 100 on can0, 12 times",
        ),
    },
    "recording": {
        "passed": (lambda: judged(decaying()), "the recording lacks nothing"),
        "failed": (lambda: judged(without(decaying(), 3, slice(100, 103))), "the recording lacks 3 states"),
    },
}  # fmt: skip
EACH = [(name, outcome) for name, cases in CASES.items() for outcome in cases]


def test_every_check_has_a_name_that_the_scenario_knows_and_is_tested_here():
    assert set(CHECKS) == set(get_args(CheckName)) == set(CASES)


@pytest.mark.parametrize(("name", "outcome"), EACH)
def test_every_check_passes_fails_and_says_what_it_did_not_test(name, outcome):
    make, words = CASES[name][outcome]
    summary = make()
    check = only(summary, name)
    assert (check.outcome, words in check.text) == (outcome, True), check
    assert summary.verdict.fails is (outcome == "failed"), summary.verdict
    if outcome != "not tested":
        assert check.measured is not None
        assert check.bound is not None
    else:
        assert f"{name}: {check.text}" in summary.verdict.not_tested
        assert f"untested {name}: {check.text}" in summary_text(summary)


def test_an_error_that_grows_and_one_that_ends_above_where_it_began_are_two_failures():
    growing = judged(decaying(0.1, grow=0.05))
    assert {check.outcome for check in growing.verdict.checks if check.name == "growth"} == {"failed"}
    assert only(growing, "end").outcome == "passed"
    higher = judged(ends_higher())
    assert only(higher, "growth").outcome == "passed"
    assert {check.outcome for check in higher.verdict.checks if check.name == "end"} == {"failed"}
    assert growing.verdict.fails
    assert higher.verdict.fails


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_check_that_is_switched_off_is_said_and_fails_nothing(name):
    summary = CASES[name]["failed"][0]() if "failed" in CASES[name] else judged(decaying(0.1, grow=0.05))
    plan = replace(summary_plan(name), health=replace(summary_plan(name).health, off=frozenset({name})))
    off = again(summary, plan, name)
    check = only(off, name)
    assert (check.outcome, check.text) == ("not tested", "switched off by the scenario")
    assert not [reason for reason in off.verdict.reasons if reason.startswith(f"{name}:")]


def summary_plan(name: str) -> Plan:
    return made(name).plan


def made(name: str) -> Trace:
    """Returns a trace to which a check applies."""
    overrides = {
        "distance": ("avoidance.enabled=false",),
        "drives": ("can.path=closed",),
        "saturation": (LIMIT,),
    }.get(name, ())
    return decaying(0.1, *overrides)


def again(summary: Summary, plan: Plan, name: str) -> Summary:
    """Returns the summary of a run with another plan and the same facts."""
    trace = made(name)
    return judged(Trace(plan, trace.times_ns, trace.states), can=summary.can, run=replace(summary.run, refused=0))


def test_bounds_are_the_scenarios():
    trace = states(decaying(0.1, LIMIT, "health.saturation=0.1"), "saturated", 1.0, 0, slice(1, 300))
    assert only(judged(trace), "saturation").outcome == "failed"
    gap = without(decaying(0.1, "health.silence=0.6"), 3, slice(100, 150))
    assert only(judged(gap), "silence").outcome == "passed"
    facts = run_facts(clock="wall", stages=100, late_stages=11)
    assert only(judged(decaying(0.1, "health.late=0.2"), run=facts), "late").outcome == "passed"


def test_what_is_missing_has_its_robot_its_time_and_on_a_busy_machine_the_likely_cause():
    trace = without(without(decaying(), 3, slice(100, 160)), 1, slice(500, 501))
    busy = {"clock": "wall", "stages": 200, "late_stages": 9}
    for facts, cause in (({}, ""), (busy, "; 4.5 % of stages were late: was the machine busy?")):
        summary = judged(trace, run=run_facts(**facts))
        silent, lacking = only(summary, "silence").text, only(summary, "recording").text
        assert silent == f"g2/r4 sent no state for 0.61 s from t = 0.99 s on, the longest of all robots{cause}"
        whose = "1 of g1/r2 after t = 4.99 s, 60 of g2/r4 after t = 0.99 s"
        assert lacking == f"the recording lacks 61 states ({whose}){cause}"
    assert "busy" not in only(judged(decaying(), run=run_facts(**busy)), "silence").text


def test_nothing_is_late_in_virtual_time_and_no_drive_is_judged_where_torque_is_mirrored():
    names = {check.name for check in judged(decaying()).verdict.checks}
    assert not names & {"late", "drives", "distance"}
    assert not {check.name for check in judged(decaying(), can=None).verdict.checks} & {"referee"}


def test_a_message_that_came_but_was_never_used_is_told_from_one_that_never_came():
    trace = decaying()
    summary = judged(trace, links=counted(trace.plan, **UNUSED))
    assert only(summary, "messages").text.startswith(
        "messages arrived, but none was used, as too old or empty, on 1 of"
    )
    assert summary.links[0].age_mean is None
    assert summary.links[0].age_max is None


def test_where_nothing_was_ever_used_no_age_is_told():
    trace = decaying()
    none = [replace(one, delivered=0, lost=10, used=0) for one in counted(trace.plan)]
    assert "10 lost, oldest" not in (text := summary_text(judged(trace, links=none)))
    assert "no message was used" in text


@pytest.mark.parametrize(
    ("facts", "text"),
    [
        ({"failure": "interrupted"}, "whole: interrupted (at 14.99 s of 20 s)"),
        (
            {"stopped": "the state of g1/r1 is not finite from 15 s on"},
            "whole: the run was stopped at 14.99 s of 20 s: the state of g1/r1 is not finite from 15 s on",
        ),
    ],
)
def test_a_run_that_broke_off_says_why_and_when_once(facts, text):
    verdict = judged(short(decaying(), 1500), run=run_facts(**facts)).verdict
    assert verdict.reasons == (text,)


def test_a_drive_that_never_came_up_fails_and_a_fault_on_schedule_does_not():
    assert "g1/r1 never came up" in only(closed(came_up=None), "drives").text
    event = "events=[{kind='estop', at=2.0, robot='g1/r1'}]"
    assert only(closed(overrides=(event,), fault="emergency stop"), "drives").outcome == "passed"


@pytest.mark.parametrize("place", ["bridge", "drives"])
def test_what_bridge_and_drives_refused_counts(place):
    report = (
        can_report(referee=CLEAN, refused={"wrong number of values": 3})
        if place == "bridge"
        else can_report(referee=CLEAN, drives=DrivesReport({}, {"wrong number of values": 3}))
    )
    check = only(judged(decaying(), can=report), "refused")
    assert (check.outcome, check.measured) == ("failed", 3.0)


def test_what_was_refused_is_in_the_text_by_receiver_source_and_reason():
    trace = decaying()
    summary = summarise(trace, counted(trace.plan), None, run_facts(refused=3, refusals=REFUSALS))
    text = summary_text(summary)
    assert "  refused  2 messages of g1/r1 by recorder: from the future" in text
    assert "  refused  1 message of g2/r4 by g2: number sent before" in text
    assert [check.about for check in summary.verdict.checks if check.name == "refused"] == [("g1/r1", "g2/r4")]


def test_a_claim_that_fails_fails_the_verdict_though_all_is_healthy():
    trace = decaying(0.1)
    claiming = plan_of("lab", "duration=20.0", CLAIM.replace("5.0", "1.0"))
    verdict = judged(Trace(claiming, trace.times_ns, trace.states)).verdict
    assert verdict.word == "FAILS"
    assert [reason.split(":")[0] for reason in verdict.reasons] == ["claim"]
    holding = judged(Trace(plan_of("lab", "duration=20.0", CLAIM), trace.times_ns, trace.states)).verdict
    assert holding.word == "HOLDS"
    assert holding.sentence == "HOLDS: 1 claim and 10 checks passed, 1 not tested"


def test_without_a_bus_a_standstill_is_bounded_by_silence_and_in_virtual_time_there_is_none():
    facts = run_facts(clock="wall", standstills={"g1/r1": StandstillResult(0.4, 1.0)})
    assert only(judged(decaying(), run=facts), "standstill").outcome == "failed"
    assert only(judged(decaying(), run=facts, can=None), "standstill").outcome == "passed"
    assert not [check for check in judged(decaying()).verdict.checks if check.name == "standstill"]


def test_a_recording_that_was_thinned_by_rule_lacks_nothing_but_what_its_rule_keeps():
    whole = decaying()
    thinned = whole
    for robot in range(len(whole.plan.robots)):
        thinned = without(thinned, robot, np.arange(len(whole.times_ns[robot])) % 5 != 0)
    facts = run_facts(recorded_every=0.05, thinned=14_400)
    check = only(judged(thinned, run=facts), "recording")
    assert (check.outcome, check.text[:37]) == ("passed", "thinned by rule, to an instant every ")
    lacking = without(thinned, 3, slice(10, 12))
    assert "lacks 2 states (2 of g2/r4" in only(judged(lacking, run=facts), "recording").text
