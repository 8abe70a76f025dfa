"""How much is computed for a thousand robots in like groups: as much as for a few of them, counted in sizes of linear runs."""

import numpy as np
import pytest

from echelon.controller.prediction.linear_run import LinearRun
from echelon.sim.forecast.analysing import analysis_of
from echelon.sim.forecast.motion import Asked
from support.trees import like_groups


@pytest.mark.slow
def test_a_thousand_robots_in_a_hundred_like_groups_are_as_much_work_as_nine(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    first = LinearRun.__init__

    def counted(run: LinearRun, plan) -> None:
        first(run, plan)
        made.append(run.size)

    monkeypatch.setattr(LinearRun, "__init__", counted)
    work = []
    for groups, robots in ((3, 3), (100, 10)):
        made.clear()
        plan = like_groups(groups, robots)
        count = len(plan.robots)
        still = Asked(np.zeros((count, 2)), np.zeros(count))
        found = analysis_of(plan, "three", [0.5, 0.5], still, runs=0)
        assert found.settles
        assert {one.name for one in found.table} >= {"intra state", "inter reference", "all links"}
        work.append((max(made), sum(made)))
    (few_largest, few_sum), (many_largest, many_sum) = work
    assert many_largest <= few_largest
    assert many_sum <= 1.5 * few_sum
