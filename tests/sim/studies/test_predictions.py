"""Predictions beside sweeps, against other derivations: closed forms, the linear run, and integration of the delay equation."""

from dataclasses import replace

import numpy as np
import pytest

from echelon.controller.laws.law import LinearGains
from echelon.controller.prediction.block_margin import delay_margin
from echelon.controller.prediction.gains import linear_gains
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.mean_square import mean_square
from echelon.messages import Channel
from echelon.plan.plan import Plan
from echelon.sim.studies.predictions import boundary, decay_rates, loop_delay, rightmost, stable
from support.runs import plan_of

UPLINK = 'links=[{name="up",channel="state"}]'
COARSE = "periods.acceleration=0.1"


def late(value: float) -> Plan:
    return plan_of("lab", UPLINK, f"links.up.delay={value!r}")


def integrated_rate(gains: LinearGains, delay: float) -> float:
    """Returns the decay rate of the delay equation in one dimension, from its integration in steps of a hundredth of the delay:
    the envelope of e² + (ė/ω)² over the last part."""
    steps, end = 100, 60.0
    h = delay / steps
    k_1, k_2 = gains.K_1[0, 0], gains.K_2[0, 0]
    e, v = np.zeros(int(end / h) + 1), np.zeros(int(end / h) + 1)
    e[: steps + 1] = 1.0
    for n in range(steps, len(e) - 1):
        now, then = n - steps, n - steps + 1
        a_0, a_1 = -k_1 * e[now] - k_2 * v[now], -k_1 * e[then] - k_2 * v[then]
        e[n + 1] = e[n] + h * v[n] + h * h * (2 * a_0 + a_1) / 6
        v[n + 1] = v[n] + h * (a_0 + a_1) / 2
    size = np.abs(e)
    peaks = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
    first, last = peaks[len(peaks) // 2], peaks[-2]
    return float(-np.log(size[last] / size[first]) / ((last - first) * h))


def test_the_rightmost_root_is_that_of_the_delay_equation() -> None:
    block = plan_of("lab").blocks[0]
    gains = linear_gains(plan_of("lab"), block, 0.0)
    one = replace(gains, K_1=gains.K_1[:1, :1], K_2=gains.K_2[:1, :1], K_i=gains.K_i[:1, :1])
    for delay in (0.2, 0.3):
        assert -rightmost(one, delay) == pytest.approx(integrated_rate(one, delay), rel=2e-3)
    margin = delay_margin(gains)
    assert margin is not None
    assert rightmost(gains, 0.999 * margin) < 0 < rightmost(gains, 1.001 * margin)
    assert rightmost(gains, 0.0) == pytest.approx(rightmost(gains, 1e-6), rel=1e-4)


def test_the_delay_of_a_loop_is_that_of_its_way_up_and_down() -> None:
    delays_of = {"state": 0.01, "group_state": 0.02, "reference": 0.03, "command": 0.04}
    rules = ",".join(f'{{channel="{channel}",delay={delay}}}' for channel, delay in delays_of.items())
    links = f"links=[{rules}]"
    plan = plan_of("lab", links)
    delays = {block.name: loop_delay(plan, block) for block in plan.blocks}
    assert delays["g1"] == pytest.approx(0.05)
    assert delays["inter"] == delays["centroid"] == pytest.approx(0.10)
    held = plan_of("lab", links, "law.lead=0")
    assert loop_delay(held, held.blocks[0]) == pytest.approx(0.055)  # half a period more
    ticks = plan_of("lab", 'links=[{channel="state",delay=0.011}]', 'timing="time_driven"')
    assert loop_delay(ticks, ticks.blocks[0]) == pytest.approx(0.02)


def test_rates_fall_with_the_delay_to_zero_at_the_margin() -> None:
    assert decay_rates(late(0.0))["g1"] == pytest.approx(1.0)  # poles -1 ± j√3
    assert decay_rates(late(0.34))["g1"] > 0 > decay_rates(late(0.37))["g1"]


def test_a_delay_of_a_whole_channel_has_the_boundary_of_the_analysis() -> None:
    found, known = boundary(late, [0.0, 0.1, 0.4])
    assert known
    assert found == largest_extra_delay(late(0.0), Channel.STATE).seconds
    assert found is not None
    assert stable(late(found - 0.002))
    assert not stable(late(found + 0.002))


def test_other_values_are_searched_for() -> None:
    def lossy(value: float) -> Plan:
        return plan_of("lab", UPLINK, COARSE, f"links.up.loss={value!r}")

    found, known = boundary(lossy, [0.0, 0.5, 0.96])
    exact = mean_square(lossy(0.0), Channel.STATE).loss
    assert known
    assert exact is not None
    assert found == pytest.approx(exact, abs=2e-3)
    assert boundary(lossy, [0.0, 0.1]) == (float("inf"), True)
    assert boundary(lossy, [exact + 0.05, 0.99]) == (None, True)


@pytest.mark.parametrize("delay", [0.005, 0.01, 0.015])
def test_losses_are_judged_at_delays_between_two_periods_too(delay: float) -> None:
    def lossy(loss: float) -> Plan:
        return plan_of("lab", f'links=[{{channel="state",delay={delay},loss={loss}}}]')

    exact = mean_square(lossy(0.0), Channel.STATE).loss
    assert exact is not None
    assert stable(lossy(exact - 0.005))
    assert stable(lossy(exact + 0.005)) is False


def test_what_cannot_be_predicted_is_not_guessed() -> None:
    def jittery(value: float) -> Plan:
        return plan_of("lab", UPLINK, f"links.up.delay={{min=0.0,max={value!r}}}")

    assert stable(jittery(0.05)) is None
    assert boundary(jittery, [0.01, 0.05]) == (None, False)
    assert decay_rates(jittery(0.05)) == {}
