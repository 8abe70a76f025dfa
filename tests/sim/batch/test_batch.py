"""The batch engine: its runs are those of the in-process engine, and so are its measures."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from echelon.errors import UsageError
from echelon.messages import STATE_FIELDS, field_index
from echelon.plan.plan import Plan
from echelon.runtime.admission import within
from echelon.sim.batch.batch import run_many
from echelon.sim.batch.outcomes import BatchRuns
from echelon.sim.engines.in_process import Engine
from echelon.sim.results.block_series import block_series
from echelon.sim.results.ending import levels
from echelon.sim.results.rates import amplitude
from echelon.sim.results.records import RunFacts, Summary
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Trace, TraceBuilder
from support.batch_cases import CASES, LATE
from support.runs import EXAMPLES, plan_of


def in_process(plan: Plan) -> tuple[Trace, Summary]:
    """Runs a plan in process, to the first instant with a state that is not finite or out of bounds."""
    builder = TraceBuilder(plan)
    engine = Engine(plan, builder.add)
    for _ in engine.instants():
        last = builder.last()
        if last is not None and not all(map(within, last[1])):
            break
    trace = builder.build()
    facts = RunFacts("inprocess", "virtual", 0.0, 0.0, None, None, engine.messages, None)
    return trace, summarise(trace, engine.link_counts(), None, facts)


@cache
def both(case: str) -> tuple[Trace, Summary, BatchRuns]:
    """Returns a case's run in process, its summary, and the batch of that one run."""
    plan = plan_of(*CASES[case])
    return *in_process(plan), run_many(plan, [plan.seed], traces=True)


def same(measured: Any, summary: Any, names: tuple[str, ...], rtol: float = 1e-9, atol: float = 1e-12) -> None:
    """Asserts that a record has the numbers of a part of a summary; NaN is None."""
    for name in names:
        expected = getattr(summary, name)
        wanted = np.nan if expected is None else expected
        np.testing.assert_allclose(measured[name], wanted, rtol, atol, err_msg=f"{name} of {summary}")


@pytest.mark.parametrize("case", CASES)
def test_positions_are_those_of_the_run_in_process(case: str) -> None:
    trace, _, runs = both(case)
    times_ns, states = trace.common()
    np.testing.assert_array_equal(runs.times[: len(times_ns)], times_ns / 1e9)
    assert runs.traces is not None
    found = runs.traces[0, : len(times_ns)]
    fields = field_index(STATE_FIELDS, "x", "y", "theta", "v", "omega")
    if case == "diverges":
        np.testing.assert_array_equal(np.isnan(found[-1, :, :5]), np.isnan(states[-1][:, fields]))
        assert np.isnan(runs.traces[0, len(times_ns) :]).all()
        found, states = found[:-2], states[:-2]  # where it diverges, its numbers are of any size
    assert np.abs(found[:, :, :2] - states[:, :, fields[:2]]).max() < 1e-9
    rtol = 1e-8 if case == "diverges" else 1e-9  # what diverges magnifies rounding
    np.testing.assert_allclose(found[:, :, :5], states[:, :, fields], rtol=rtol, atol=1e-9)


@pytest.mark.parametrize("case", [case for case in CASES if case != "diverges"])
def test_links_do_the_same(case: str) -> None:
    _, summary, runs = both(case)
    plan = runs.plan
    names = [one.name for one in plan.all_roles]
    links = {(link.source, link.receiver, link.channel): link for link in summary.links}
    assert len(links) == len(plan.links)
    for link, found in zip(plan.links, runs.links[0], strict=True):
        expected = links[names[link.source], names[link.receiver], link.channel.name.lower()]
        for name in ("sent", "lost", "duplicates", "used", "held"):
            assert found[name] == getattr(expected, name), (name, expected)
        if link.punctual:
            assert found["delivered"] == expected.delivered
        # In process an overtaken message is taken for sent at its nominal instant; it may count as delivered sooner.
        assert found["delivered"] + found["in_flight"] == expected.delivered + expected.in_flight
        same(found, expected, ("age_mean", "age_p50", "age_p95", "age_p99", "age_max"))


@pytest.mark.parametrize("case", CASES)
def test_measures_are_those_of_a_summary(case: str) -> None:
    trace, summary, runs = both(case)
    for block, found in zip(summary.blocks, runs.blocks[0], strict=True):
        same(found, block, ("settling_2", "settling_5", "peak_time"), rtol=0)
        if case != "diverges":
            same(found, block, ("start_error", "residual", "peak_error", "ise", "iae", "itae"))
        else:
            assert np.isnan(found["residual"]) == (block.residual is None)
    if case != "diverges":
        blocks = block_series(trace)
        for series, found in zip(blocks.series, runs.blocks[0], strict=True):
            of_sixths = levels(amplitude(series), blocks.times_ns)
            np.testing.assert_allclose([found[name] for name in ("sooner", "earlier", "level")], of_sixths, 1e-9, 1e-12)
        for robot, found in zip(summary.torque, runs.robots[0], strict=True):
            same(found, robot, ("rms", "peak", "saturation_share", "saturated_after_first_second"))
        same(runs.runs[0], summary.distance, ("smallest",))
    pair = tuple(runs.plan.robots[robot].name for robot in runs.runs[0]["pair"])
    assert pair == summary.distance.pair
    assert runs.runs[0]["closest_time"] == pytest.approx(summary.distance.time, abs=2e-9)
    assert runs.runs[0]["violations"] == len(summary.distance.violations)
    assert [bool(passed) for passed in runs.claims[0]] == [claim.outcome == "passed" for claim in summary.claims]


def test_cases_show_what_they_are_for() -> None:
    _, meet, runs = both("robots meet")
    assert meet.distance.violations
    assert runs.runs[0]["violations"] > 0
    assert both("lab")[2].claims.all()
    assert np.isfinite(both("diverges")[2].runs[0]["diverged"])
    assert np.isnan(both("lab")[2].runs[0]["diverged"])
    assert both("late and lossy")[1].links[0].lost > 0
    assert max(row.saturation_share or 0 for row in both("limits act")[1].torque) > 0


def test_a_run_that_diverges_ends_at_the_instant_at_which_the_run_in_process_does() -> None:
    trace, _, runs = both("diverges")
    assert runs.runs[0]["diverged"] == trace.common()[0][-1] / 1e9


def test_runs_depend_on_their_seed_alone() -> None:
    plan = plan_of("lab", "duration=2", LATE)
    seeds = list(range(40, 0, -1))
    one, two = (run_many(plan, seeds, threads=threads, traces=True) for threads in (1, 3))
    for kind in ("runs", "blocks", "robots", "links", "claims", "traces"):
        assert getattr(one, kind).tobytes() == getattr(two, kind).tobytes()
    assert one.traces is not None
    assert len(np.unique(one.blocks["ise"][:, 0])) == len(seeds)
    for row in (0, 23):
        trace, _ = in_process(replace(plan, seed=seeds[row]))
        states = trace.common()[1][:, :, field_index(STATE_FIELDS, "x", "y")]
        np.testing.assert_allclose(one.traces[row, :, :, :2], states, rtol=0, atol=1e-9)


def test_progress_is_told() -> None:
    told: list[int] = []
    run_many(plan_of("lab", "duration=0.1"), range(100), progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 100


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("drives",), "can.path = 'closed'"),
        (("lab", f'law={{use="{EXAMPLES}/my_laws.py:SlidingMode"}}'), "my_laws.py"),
    ],
)
def test_what_it_cannot_run_is_refused(arguments: tuple[str, ...], said: str) -> None:
    with pytest.raises(UsageError, match="inprocess") as refused:
        run_many(plan_of(*arguments), [1])
    assert said in str(refused.value)


def test_no_seeds_are_refused() -> None:
    with pytest.raises(UsageError, match="0 seeds"):
        run_many(plan_of("lab"), [])


def test_a_link_of_which_it_does_not_know_everything_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echelon.sim.batch.refusals._LINK", frozenset({"source", "receiver", "channel", "period_ns"}))
    with pytest.raises(UsageError, match="does not know loss"):
        run_many(plan_of("lab", 'links=[{source="**", receiver="**", loss=0.1}]'), [1])
