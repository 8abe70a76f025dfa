"""What `predict` buys over `hold` in runs of robots: states may be more than five times as late."""

import numpy as np
import pytest

from echelon.sim.batch.batch import run_many
from support.runs import plan_of

LATE_S = 1.8


@pytest.mark.parametrize(
    ("policy", "delay_s", "settles"), [("predict", LATE_S, True), ("hold", LATE_S / 5, False), ("hold", LATE_S, False)]
)
def test_lab_settles_with_predict_with_five_times_the_delay_that_is_too_long_for_hold(
    policy: str, delay_s: float, settles: bool
) -> None:
    links = f'links=[{{channel="state", delay={delay_s}, policy="{policy}"}}]'
    runs = run_many(plan_of("lab", "duration=30", "claims=[]", links), [1], say=lambda text: None)
    assert np.isnan(runs.runs[0]["diverged"])
    left = runs.blocks[0]["residual"] / runs.blocks[0]["start_error"]
    assert len(left) == 5
    groups = left[:3]
    if settles:
        assert left.max() < 0.01
        assert runs.blocks[0]["settling_2"].max() < 25
    else:
        assert groups.min() > 0.5
