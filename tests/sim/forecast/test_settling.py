"""Predicted settling and modes, against runs of the same scenario."""

import numpy as np
import pytest

from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.prediction.modes import block_modes
from echelon.sim.forecast.settling import predicted_settling
from echelon.sim.results.block_series import block_series
from echelon.sim.results.settling import settle
from support.runs import plan_of, trace_of


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("lab", ()),
        ("lab", ('links=[{channel="state", delay=0.1}]',)),
        ("unequal", ("robot.torque_limit=inf", "robot.torque_rate_limit=inf", "robot.wheel_speed_limit=inf")),
        ("paper", ("duration=12.0",)),
    ],
)
def test_blocks_settle_when_predicted(name: str, overrides: tuple[str, ...]) -> None:
    """Within two periods, or 2 % with delays: robots start at rest, and messages on their way at the start are not known."""
    plan = plan_of(name, "avoidance.enabled=false", *overrides)
    run = block_series(trace_of(plan))
    series = {one.block.name: one for one in run.series}
    for found in predicted_settling(plan):
        measured_ns = settle(plan, series[found.block], run.times_ns, 0.02).settled_ns
        assert found.settled is not None
        assert measured_ns is not None
        allowed = 2 * plan.root.period_ns * 1e-9 + (
            0.02 * found.settled if any(not one.ideal for one in plan.links) else 0
        )
        assert found.settled == pytest.approx(measured_ns / 1e9, abs=allowed), found.block


@pytest.mark.parametrize("name", ["lab", "paper", "multi", "integral"])
def test_modes_of_the_blocks_are_all_eigenvalues_of_the_map(name: str) -> None:
    plan = plan_of(name)
    values = np.linalg.eigvals(LinearRun(plan).map().toarray())
    found = np.array([value for modes in block_modes(plan) for value in modes.eigenvalues])
    assert np.abs(found[:, None] - values).min(axis=1).max() < 1e-7
    assert np.abs(values[:, None] - found).min(axis=1).max() < 1e-7


def test_rates_of_sampled_modes_are_those_of_continuous_time_for_short_periods() -> None:
    for modes in block_modes(plan_of("lab")):
        rate = modes.rate(0.01)
        assert rate is not None
        nearest = min(modes.poles, key=lambda pole: abs(pole - rate))
        assert rate == pytest.approx(nearest, rel=1e-4)
