"""Blackouts and policies, as predicted and in runs."""

from dataclasses import replace

import numpy as np
import pytest

from echelon.controller.prediction.blackout import blackout
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import later
from echelon.controller.prediction.policy_effects import (
    largest_stable,
    policy_effects,
    radius_without_loss,
    with_policy,
)
from echelon.messages import Channel
from echelon.plan.punctuality import with_punctuality
from echelon.sim.results.block_series import block_series
from support.near_formation import T, near_formation
from support.points import time_driven
from support.runs import plan_of as shipped
from support.runs import trace_of

BEGIN_NS, LASTS_NS = 800_000_000, 900_000_000


@pytest.mark.parametrize("timing", ["event_driven", "time_driven"])
@pytest.mark.parametrize("channel", [Channel.STATE, Channel.REFERENCE, Channel.COMMAND])
def test_errors_in_a_blackout_are_those_of_the_run(channel, timing):
    plan = near_formation([], timing, duration=6.0)
    dark = [
        replace(link, blackouts=((BEGIN_NS, BEGIN_NS + LASTS_NS),)) if link.channel is channel else link
        for link in plan.links
    ]
    series = block_series(trace_of(replace(plan, links=tuple(with_punctuality(dark, plan.nodes))))).series
    found = blackout(plan, channel, BEGIN_NS, LASTS_NS)
    for one, each in zip(found, series, strict=True):
        assert one.errors == pytest.approx(each.norm, rel=0.01, abs=5e-4)
        late = each.norm[round(BEGIN_NS * 1e-9 / T) :]
        assert one.peak == pytest.approx(late.max(), rel=0.01)
        assert one.recovery is None or one.recovery >= 0
    assert any(one.peak_time > (BEGIN_NS + LASTS_NS) * 1e-9 - T for one in found)


def test_recovery_is_when_the_error_stays_below_what_it_was():
    (*_, centroid) = blackout(near_formation([], duration=6.0), Channel.COMMAND, BEGIN_NS, LASTS_NS)
    errors = np.array(centroid.errors)
    before, end = errors[round(BEGIN_NS * 1e-9 / T)], round((BEGIN_NS + LASTS_NS) * 1e-9 / T)
    assert centroid.recovery is not None
    back = end + round(centroid.recovery / T)
    assert (errors[back:] <= before).all()
    assert back == end or errors[back - 1] > before


def test_blackouts_of_plans_that_are_random_are_refused():
    with pytest.raises(PredictionError, match="its run is random"):
        blackout(near_formation([{"channel": "state", "loss": 0.1}]), Channel.STATE, 0, 1)


@pytest.mark.parametrize(("timing", "part", "is_exact"), [
    ("event_driven", 0.5, False), ("event_driven", 0.0, True), ("time_driven", 0.5, True),
])  # fmt: skip
def test_a_blackout_of_several_channels_is_as_in_the_run_or_refused(timing, part, is_exact):
    """An event-driven node that waits for what was lost acts at the end of its period, when the blackout may be over."""
    plan = near_formation([], timing, duration=6.0)
    channels, lasts_ns = (Channel.STATE, Channel.COMMAND), LASTS_NS + round(part * T * 1e9)
    links = [link for link in plan.links if link.channel in channels]
    if not is_exact:
        with pytest.raises(PredictionError, match="of several channels"):
            blackout(plan, links, BEGIN_NS, lasts_ns)
        return
    dark = [
        replace(link, blackouts=((BEGIN_NS, BEGIN_NS + lasts_ns),)) if link.channel in channels else link
        for link in plan.links
    ]
    series = block_series(trace_of(replace(plan, links=tuple(with_punctuality(dark, plan.nodes))))).series
    for one, each in zip(blackout(plan, links, BEGIN_NS, lasts_ns), series, strict=True):
        assert one.errors == pytest.approx(each.norm, rel=0.01, abs=5e-4)


def test_blackouts_after_the_run_are_a_mistake():
    with pytest.raises(ValueError, match="must begin within the run"):
        blackout(near_formation([], duration=6.0), Channel.STATE, 7_000_000_000, 1)


@pytest.mark.slow
@pytest.mark.parametrize("channel", [Channel.STATE, Channel.COMMAND])
def test_holding_bears_the_same_delay_by_both_ways_to_make_the_map(channel):
    plan = time_driven(near_formation([]))
    (hold, *others) = policy_effects(plan, channel, longest=45)
    assert hold.policy == "hold"
    assert hold.delay == pytest.approx(largest_extra_delay(plan, channel).seconds, abs=1e-9)
    assert hold.loss is not None
    assert 0 < hold.loss.loss < 1
    assert others


@pytest.mark.slow
def test_predict_carries_lab_through_five_times_the_delay_that_hold_bears():
    plan = shipped("lab")
    hold = largest_extra_delay(time_driven(plan), Channel.STATE).seconds
    assert hold is not None
    period_ns = plan.root.period_ns
    periods = round(5.02 * hold * 1e9 / period_ns)
    assert radius_without_loss(with_policy(plan, Channel.STATE, "hold", round(1.03 * hold * 1e9))) > 1
    assert radius_without_loss(with_policy(plan, Channel.STATE, "predict", periods * period_ns)) < 0.999


def test_predict_leaves_the_undelayed_eigenvalues():
    plan = near_formation([])
    undelayed = radius_without_loss(with_policy(plan, Channel.STATE, "hold"))
    for k in (1, 4, 9):
        late = with_policy(plan, Channel.STATE, "predict", k * plan.root.period_ns)
        assert radius_without_loss(late) == pytest.approx(undelayed, rel=1e-9)
    both = later(with_policy(plan, Channel.STATE, "predict"), Channel.COMMAND, plan.root.period_ns)
    with_delayed_command = later(with_policy(plan, Channel.STATE, "hold"), Channel.COMMAND, plan.root.period_ns)
    assert radius_without_loss(both) < 1 > radius_without_loss(with_delayed_command)


@pytest.mark.parametrize(
    ("edge", "most", "expected"),
    [(0, 99, (None, True)), (1, 99, (0, True)), (38, 99, (37, True)), (200, 99, (99, False))],
)
def test_search_for_the_largest_stable_number(edge, most, expected):
    assert largest_stable(lambda number: number < edge, most) == expected
