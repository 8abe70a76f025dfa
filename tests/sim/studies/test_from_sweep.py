"""From finished sweeps to what their figures are drawn from: every sweep that can be made can be drawn."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import echelon
from echelon.sim.report.studies.figures import study_figures
from echelon.sim.studies.from_sweep import results_of


@pytest.mark.parametrize(
    ("key", "values", "more"),
    [
        ("can.queue", [64, 128, 256], {"duration": 0.1}),  # a key that takes whole numbers alone
        (
            "periods.acceleration",
            [0.1, 0.8, 1.6],
            {"duration": 1.6},
        ),  # of the periods between these few divide the duration
    ],
)
def test_a_key_that_does_not_take_all_numbers_can_be_drawn(
    key: str, values: list[float], more: dict[str, Any], tmp_path: Path
) -> None:
    changes = {"claims": [], "avoidance.enabled": False, **more}
    sweep = echelon.sweep("lab", changes, vary={key: values}, engine="inprocess", out=tmp_path, quiet=True)
    results = results_of(sweep)
    assert results.axis is not None
    assert results.axis.name == key
    assert not results.predicted.boundaries
    assert "integrals" in study_figures(results)


@pytest.mark.parametrize("scenario", ["x=" + "[" * 2000, "a." * 2000 + "b=1", "links = 5", "not TOML"])
def test_a_sweep_whose_scenario_was_spoiled_is_drawn_without_it(scenario: str, tmp_path: Path) -> None:
    changes = {"links": [{"name": "up", "channel": "group_state"}], "claims": [], "duration": 0.5}
    vary = {"links.up.channel": ["state", "group_state"], "links.up.delay": [0.0, 0.1]}
    sweep = echelon.sweep("lab", changes, vary=vary, out=tmp_path, quiet=True)
    assert [key.label for key in results_of(sweep, predict=False).keys][1] == "delay of links [s]"  # the channel varies
    (tmp_path / "scenario.toml").write_text(scenario)
    assert len(results_of(sweep, predict=False).keys) == 2


def test_a_search_is_drawn_as_far_as_it_holds_by_both_judgements(tmp_path: Path) -> None:
    changes = {"links": [{"name": "up", "channel": "state"}], "claims": [], "duration": 20.0}
    sweep = echelon.sweep("lab", changes, find={"links.up.delay": "0:1:0.5"}, out=tmp_path, quiet=True)
    results = results_of(sweep)
    assert [one.by for one in results.found] == ["both", "share", "second moment"]
    assert [(one.by, one.value, one.fails) for one in results.boundaries()] == [("both", 0.0, 0.5)]


def test_expected_costs_are_those_of_the_runs_and_are_drawn_against_them(tmp_path: Path) -> None:
    """Without loss the one run is the mean; with it the cost grows."""
    changes = {
        "claims": [], "duration": 30.0, "periods.acceleration": 0.05, "avoidance.enabled": False,
        "robot.torque_limit": 1e6, "robot.torque_rate_limit": 1e9, "robot.wheel_speed_limit": 1e6, "robot.envelope": {},
        "links": [{"name": "up", "channel": "state"}],
    }  # fmt: skip
    sweep = echelon.sweep("lab", changes, vary={"links.up.loss": [0.0, 0.2, 0.4]}, out=tmp_path, quiet=True)
    results = results_of(sweep)
    assert list(results.predicted.costs) == ["g1", "g2", "g3", "inter", "centroid"]
    for block, expected in results.predicted.costs.items():
        assert expected[0] == pytest.approx(results.points[f"ise_mean.{block}"][0], rel=2e-3)
        assert (np.diff(expected) > 0).all()
    assert "costs" in study_figures(results)
    assert not results_of(sweep, predict=False).predicted.costs
