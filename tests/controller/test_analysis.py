"""How old positions are at the coordinator: against the steady error of runs whose formation moves."""

import pytest

from echelon.controller.prediction.analysis import analyse
from echelon.controller.prediction.cost import expected_cost
from echelon.controller.prediction.gains import PredictionError
from echelon.sim.forecast.settling import predicted_settling
from echelon.sim.results.block_series import block_series
from support.near_formation import near_formation
from support.runs import trace_of

SPEED = 0.5
"""Speed of the trajectory of `near_formation` [m/s]"""
STATES = {"channel": "state", "delay": 0.055}
LATE = {"channel": "state", "source": "g0/r0", "delay": 0.055}


@pytest.mark.parametrize(("links", "timing", "age"), [
    ([STATES], "event_driven", 0.055),
    ([STATES], "time_driven", 0.075),
    # The coordinator began with a group state of the period before, and need not wait for a newer one.
    ([STATES, {"channel": "group_state", "delay": 0.01}], "event_driven", 0.075),
    ([STATES, {"channel": "group_state", "delay": 0.01}], "time_driven", 0.1),
    # All are used when the late one has come, 0.005 s after the beginning of a period; one of five is 0.05 s older.
    ([LATE], "event_driven", 0.005 + 0.05 / 5),
    ([LATE], "time_driven", 0.075 / 5),
])  # fmt: skip
def test_a_moving_formation_is_off_by_its_velocity_times_the_age_of_positions(links, timing, age):
    plan = near_formation(links, timing, reference="now")
    assert predicted_settling(plan) == ()
    with pytest.raises(PredictionError, match="do not vanish"):
        expected_cost(plan)
    assert analyse(plan).centroid_age == pytest.approx(age, abs=1e-9)
    (*_, centroid) = block_series(trace_of(plan)).series
    assert centroid.norm[-1] == pytest.approx(SPEED * age, abs=0.002 * SPEED)
