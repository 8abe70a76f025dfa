"""What `echelon validate` tells of a verdict before the run is what the run's verdict then says."""

import pytest

from echelon.cli import main
from echelon.sim.results.beforehand import beforehand
from support.runs import plan_of


@pytest.mark.parametrize("name", ["lab", "paper", "unequal", "multi", "three_levels", "drives", "integral", "sliding"])
def test_of_shipped_scenarios_everything_can_be_tested(name: str) -> None:
    assert list(beforehand(plan_of(name))) == []


@pytest.mark.parametrize(
    ("overrides", "notes"),
    [
        (
            ["duration=1.21", "claims=[{block='intra', settled_by=5.0}]"],
            [
                "claim: intra by 5 s cannot be tested, for the run ends at 1.21 s; a claim that is not tested fails",
                "growth, end: cannot be tested of g1, g2, g3, inter, centroid; a run of 18 s or more tells",
            ],
        ),
        (
            ["claims=[{block='g1', settled_by=5.0, dwell=200.0}]"],
            ["claim: g1 by 5 s cannot be tested, for its dwell time is 50 s and the run ends at 40 s"],
        ),
        (["duration=18.0", "claims=[]"], []),
        (
            ["links=[{source='g1/r1', channel='state', delay=100.0}, {source='g3', loss=1.0, channel='group_state'}]"],
            ["messages: nothing can arrive over 2 of 24 links: g1/r1 → g1, g3 → coordinator"],
        ),
    ],
)
def test_what_cannot_be_tested_is_told(
    overrides: list[str], notes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(beforehand(plan_of("lab", *overrides))) == notes
    sets = [word for override in overrides for word in ("--set", override)]
    assert main(["validate", "lab", *sets]) == 0
    assert [line.removeprefix("  note ") for line in capsys.readouterr().out.splitlines() if "  note " in line] == notes
