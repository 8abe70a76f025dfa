"""Losses in bursts, in the mean square: on every channel, against losses without memory and between both timings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from echelon.controller.prediction.mean_square import Losses, bursts_of, mean_square
from echelon.controller.prediction.second_moment import SecondMoment
from echelon.messages import Channel
from echelon.plan.plan import Plan
from support.trees import plan_of, scenario

CHANNELS = [Channel.STATE, Channel.GROUP_STATE, Channel.REFERENCE, Channel.COMMAND]
TIMINGS = ["event_driven", "time_driven"]


@cache
def tree(timing: str, shape: tuple[object, ...] = ((None, None), (None,))) -> Plan:
    """Returns two groups, of two robots and of one, whose blocks all have time scales near their period."""
    law = {"epsilon": [0.7, 0.7], "lead": 0.5}
    periods = {"acceleration": 0.4, "torque": 0.1}
    still = {"kind": "line", "velocity": (0.0, 0.0)}
    random = np.random.default_rng(3)
    return plan_of(scenario(shape, random, law=law, periods=periods, timing=timing, trajectory=still, duration=2.0))


def places(plan: Plan, channel: Channel) -> list[int]:
    """Returns the links of one message: those of a source's broadcast, by their places."""
    source = next(link.source for link in plan.links if link.channel is channel)
    return [at for at, link in enumerate(plan.links) if (link.channel, link.source) == (channel, source)]


def lossy(plan: Plan, at: list[int], loss: float, burst: float | None = None) -> Plan:
    """Returns a plan that loses a message for all of its receivers at once: each by itself, or in bursts."""
    bursts = None if burst is None else bursts_of(loss, burst)
    links = list(plan.links)
    for each in at:
        links[each] = replace(links[each], loss=loss, bursts=bursts, loss_of_message=len(at) > 1)
    return replace(plan, links=tuple(links))


@pytest.mark.slow
@pytest.mark.parametrize("timing", TIMINGS)
@pytest.mark.parametrize("channel", CHANNELS)
def test_bursts_without_memory_are_independent_losses(channel: Channel, timing: str) -> None:
    """A burst that goes on with the probability with which it begins is none."""
    plan = tree(timing)
    at = places(plan, channel)
    for loss in (0.2, 0.6):
        alone = Losses(lossy(plan, at, loss), (), None).radius(0.0)
        bursts = Losses(lossy(plan, at, loss, 1 / (1 - loss)), (), None).radius(0.0)
        assert bursts == pytest.approx(alone, rel=1e-6)
        assert alone != pytest.approx(Losses(plan, (), None).radius(0.0), rel=1e-3)  # they do harm


@pytest.mark.parametrize("channel", [Channel.REFERENCE, Channel.COMMAND])
def test_without_delays_both_timings_bear_the_same_bursts(channel: Channel) -> None:
    """Nodes wait for states that are lost, but not for what comes from above."""
    radii = [Losses(lossy(plan, places(plan, channel), 0.4, 3.0), (), None).radius(0.0) for plan in map(tree, TIMINGS)]
    assert radii[0] == pytest.approx(radii[1], rel=1e-6)


@pytest.mark.parametrize("timing", TIMINGS)
@pytest.mark.parametrize("channel", CHANNELS)
def test_at_the_boundary_the_links_own_bursts_change_from_vanishing_to_growing(channel: Channel, timing: str) -> None:
    plan = tree(timing)
    at = places(plan, channel)
    for burst in (4.0, 3.0, 2.5, 2.0, 1.5):  # of long ones even few do harm, of short ones all are borne
        with_bursts = lossy(plan, at, 0.1, burst)
        found = mean_square(with_bursts, [with_bursts.links[each] for each in at], burst=burst)
        if found.loss is not None:
            break
    assert found.loss is not None
    assert found.ends == "unstable"
    for loss, vanishes in ((found.loss - 1e-3, True), (found.loss + 1e-3, False)):
        own = Losses(lossy(plan, at, loss, burst), (), None)
        assert (own.gain(0.0) < 1) == vanishes
        parts = [SecondMoment(part, own.chances(0.0)) for part in own.parts]
        assert all(part.radius() < 1 for part in parts) == vanishes
