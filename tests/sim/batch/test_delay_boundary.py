"""Predicted and measured boundary of the delay, for each link class: robots with their torque loops, in the batch engine."""

import numpy as np
import pytest

from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.likeness import reduced
from echelon.controller.prediction.linear_run import Edges, LinearRun, later
from echelon.controller.prediction.link_sets import link_sets
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.plan.plan import Plan
from support.random_formations import AT_REST, FREE, dies_away, random_formation
from support.runs import plan_of

CLOSE = 0.01
"""How closely event-driven boundaries agree, as a share of the delay"""
FACTORS = 12.0
"""Number of e-folds of the predicted growth that a run lasts, if that is not too long"""
INSTANTS = 150_000
"""Longest run [acceleration periods]"""


def around(plan: Plan, late: Edges) -> tuple[int, int]:
    """Returns a delay just below the predicted boundary, and one just above it [ns]."""
    found = largest_extra_delay(plan, late)
    assert found.ends == "unstable"
    assert found.ticks is not None
    assert found.seconds is not None
    if any(one.event_driven for one in plan.formation):
        return round((1 - CLOSE) * found.seconds * 1e9), round((1 + CLOSE) * found.seconds * 1e9)
    tick_ns = round(found.tick_s * 1e9)
    return found.ticks * tick_ns, (found.ticks + 1) * tick_ns


def check(plan: Plan, late: Edges, name: str) -> None:
    """Holds what robots do around the predicted boundary against the prediction."""
    for extra_ns, holds in zip(around(plan, late), (True, False), strict=True):
        delayed = later(plan, late, extra_ns)
        rate = abs(np.log(spectral_radius(LinearRun(reduced(delayed, late)[0]).map())))
        periods = min(INSTANTS, max(2000, FACTORS / rate))
        assert dies_away(delayed, periods * plan.root.period_ns * 1e-9) == holds, (name, extra_ns)


def classes_of(plan: Plan) -> list[tuple[str, Edges]]:
    return [(one.name, one.edges) for one in link_sets(plan) if one.kind == "class"]


@pytest.mark.slow
@pytest.mark.parametrize("timing", ["event_driven", "time_driven"])
@pytest.mark.parametrize("name", ["lab", "three_levels", "multi", "paper"])
def test_robots_of_shipped_scenarios_bear_the_predicted_delay_in_each_link_class(name: str, timing: str) -> None:
    plan = plan_of(name, *FREE, AT_REST, f'timing="{timing}"')
    for what, late in classes_of(plan):
        check(plan, late, what)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_robots_of_random_formations_bear_the_predicted_delay_in_each_link_class(seed: int) -> None:
    plan = random_formation(seed)
    for what, late in classes_of(plan):
        check(plan, late, what)
