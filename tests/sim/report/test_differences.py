"""What differs between the scenarios of runs, as a user would set it."""

import pytest

from echelon.planning.loading import effective_toml
from echelon.sim.parts.loading import load
from echelon.sim.report.differences import differences
from echelon.sim.results.summary import summarise
from support.runs import SCENARIOS
from support.synthetic import decaying, link_counts, run_facts

CHANGES = {
    "law.lead": "0.25",
    "links.0.delay": "0.02",
    "formation.groups.g1.robots.r1.start": "[0.0, -1.5]",
    "description": '"a \\"b\\""',
}
LINK = 'links=[{channel="state", delay=0.01}]'


@pytest.fixture(scope="module")
def summary():
    run = decaying(["duration=0.05"])
    return summarise(run.trace, link_counts(run.plan), None, run_facts())


def effective(*overrides: str) -> str:
    return effective_toml(load(SCENARIOS / "lab.toml", overrides)[0])


def test_the_same_run_twice_differs_in_nothing(summary) -> None:
    assert differences([effective(), effective()], [summary, summary]) == []


def test_what_differs_can_be_typed_as_it_stands(summary) -> None:
    one, other = effective(LINK), effective(LINK, *(f"{key}={value}" for key, value in CHANGES.items()))
    rows = differences([one, other, one], [summary] * 3)
    assert {row[0]: row[2] for row in rows} == CHANGES
    assert all(row[1] == row[3] != row[2] for row in rows)
    assert effective(LINK, *(f"{key}={value}" for key, _, value, _ in rows)) == other


def test_how_runs_were_made_differs_too(summary) -> None:
    from dataclasses import replace

    wall = replace(summary, run=replace(summary.run, clock="wall"))
    assert differences([effective()] * 2, [summary, wall]) == [["run: clock", summary.run.clock, "wall"]]


def test_a_key_that_only_one_has_is_a_dash_in_the_other(summary) -> None:
    rows = differences([effective(LINK), effective()], [summary] * 2)
    assert ["links.0.delay", "0.01", "–"] in rows
