"""What is estimated from runs agrees with what is exact; plans without chance, for what is exact there alone."""

from pathlib import Path

import numpy as np
import pytest

from echelon.controller.prediction.blackout import effect
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import edges_of, later, ruled_links
from echelon.controller.prediction.mean_square import Losses, mean_square
from echelon.messages import Channel
from echelon.sim.forecast.estimating import HALVINGS, Estimates
from echelon.sim.forecast.link_rows import LOSSES, LinkRows
from echelon.sim.forecast.own_links import OwnLinks, calm
from support.runs import plan_of

LOSSY = 'links=[{channel="state", loss=0.4}]'


def test_the_rate_of_runs_is_that_of_the_second_moment() -> None:
    plan = plan_of("lab", LOSSY, "duration=20")
    rate, low, high = Estimates(plan, 32).growth(plan).rates()
    H_s = plan.root.period_ns / 1e9
    exact = -np.log(Losses(plan, (), None).radius(0.0)) / (2 * H_s)
    assert rate is not None
    assert low is not None
    assert high is not None
    assert low < rate < high
    assert rate == pytest.approx(exact, rel=0.3)
    assert OwnLinks(plan, Estimates(plan, 0)).verdict().rate == pytest.approx(exact, rel=1e-6)


def test_later_links_share_one_table_of_delays() -> None:
    plan = plan_of("lab", 'links=[{channel="state", delay={kind="gamma", min=0.005, shape=2.0, scale=0.004}}]')
    moved = later(plan, Channel.STATE, 1_000_000)
    tables = {id(link.delays) for link in moved.links if link.delays is not None}
    assert len(tables) == len({id(link.delays) for link in plan.links if link.delays is not None}) == 1
    for link, before in zip(moved.links, plan.links, strict=True):
        if link.delays is not None and before.delays is not None:
            assert link.delays.delays_ns == tuple(each + 1_000_000 for each in before.delays.delays_ns)


def test_what_a_trace_loses_is_left_out_by_name(tmp_path: Path) -> None:
    (tmp_path / "wifi.csv").write_text("0.001\nlost\n0.002\nlost\n")
    plan = plan_of("lab", f'links=[{{channel="state", delay={{kind="trace", file="{tmp_path / "wifi.csv"}"}}}}]')
    assert {link.share_lost for link in plan.links} == {0.0, 0.5}
    assert calm(plan)[1] == "without losses, delays that vary at their mean"


@pytest.mark.parametrize("begin_ms", range(10, 2000, 70))
def test_a_blackout_begins_at_the_first_instant_that_it_holds(begin_ms: int) -> None:
    """Errors grow in it from 1 to 2 at its second instant, and are 1.5 and 0.5 after it."""
    begin = -(-begin_ms // 10)
    errors = np.full(300, 0.5)
    errors[begin : begin + 3] = 1.0, 2.0, 1.5
    found = effect("inter", errors, 10_000_000, begin_ms * 1_000_000, (begin_ms + 20) * 1_000_000)
    assert (found.peak, found.peak_time) == (2.0, pytest.approx((begin + 1) / 100))
    assert found.recovery == pytest.approx(0.01)  # at its end the error is 1.5, an instant later below 1
    at_its_begin = effect("inter", np.where(errors == 2.0, 0.5, errors), 10_000_000, begin_ms * 1_000_000, 10**11)
    assert at_its_begin.peak_time == pytest.approx((begin + 2) / 100)
    assert effect("inter", np.full(300, 1.0), 10_000_000, 10**11, 2 * 10**11).peak_time == pytest.approx(2.99)


def test_blackouts_by_runs_are_those_that_are_exact() -> None:
    """Also where they begin on the grid of the hyperperiods, and a sum of floats would be an instant later."""
    events = 'events=[{kind="blackout", at=1.11, duration=0.4}]'
    plan = plan_of("lab", "duration=10", "avoidance.enabled=false", events)
    own = OwnLinks(plan, Estimates(plan, 1))
    (exact,) = own.blackouts()
    assert exact.method == "exact"
    (window,) = {window for link in plan.links for window in link.blackouts}
    links = [link for link in plan.links if link.blackouts]
    runs = own.runs()
    assert runs.mean_squares is not None
    estimated = own._blackout(*window, links, 2)  # as if there were another one
    assert estimated.method == "estimated"
    for one, other in zip(estimated.blocks, exact.blocks, strict=True):
        assert one.block == other.block
        assert one.peak_time == pytest.approx(other.peak_time, abs=2 * plan.root.period_ns / 1e9)


def test_late_references_of_a_formation_that_moves_are_no_growth() -> None:
    plan = plan_of("lab", 'links=[{channel="state", loss=0.1}, {channel="command", delay=0.04}]', "duration=20")
    found = Estimates(plan, 16).growth(
        plan
    )  # along the circle an error of 3 mm stays, which neither grows nor vanishes
    assert found.high < 0.5


def test_the_largest_delay_by_runs_is_the_exact_one() -> None:
    plan = plan_of("lab", "duration=20")
    edges = edges_of(plan, Channel.STATE)
    exact = largest_extra_delay(plan, edges).seconds
    assert exact is not None
    found = Estimates(plan, 4).boundary(
        lambda extra: later(plan, edges, round(extra * 1e9)), [by * exact for by in (0.0, 0.5, 1.0, 1.5)], 2
    )
    assert found.value is not None
    assert found.value == pytest.approx(exact, rel=0.08)
    assert found.high is not None
    assert found.low is not None
    assert found.low <= exact * 1.02
    assert found.high >= exact * 0.98


@pytest.mark.parametrize(("channel", "rare"), [(Channel.STATE, False), (Channel.GROUP_STATE, True)])
def test_the_largest_loss_by_runs_is_the_exact_one_or_a_little_more(channel: Channel, rare: bool) -> None:
    """It is within the interval of the runs; only where rare runs count that these do not hold, links bear less."""
    plan = plan_of("lab", "duration=20", "periods.acceleration=0.05", "periods.torque=0.05")
    exact = mean_square(plan, channel).loss
    assert exact is not None
    found = LinkRows(plan, plan, Estimates(plan, 16), lambda *said: None)._loss_by_runs(edges_of(plan, channel))
    assert found.low is not None
    assert found.value is not None
    assert found.high is not None
    assert found.low <= exact or rare
    assert exact <= found.high
    below, above = (max(loss for loss in LOSSES if loss < exact), min(loss for loss in LOSSES if loss > exact))
    assert exact - (above - below) / 2**HALVINGS <= found.value < above
    assert found.high - found.low < 0.05


@pytest.mark.parametrize(
    ("delay", "mean"),
    [
        ("{min=0.01, max=0.03}", 0.02),
        ('{kind="gamma", min=0.005, shape=2.0, scale=0.004}', 0.013),
        ('{kind="gamma", min=0.005, shape=2.0, scale=0.004, correlation=0.5}', 0.013),
    ],
)
def test_delays_that_vary_take_their_mean(delay: str, mean: float) -> None:
    plan = plan_of("lab", f'links=[{{channel="state", loss=0.1, delay={delay}}}]')
    still, left_out = calm(plan)
    assert left_out == "without losses, delays that vary at their mean"
    for link in ruled_links(still, Channel.STATE):
        assert link.steady
        assert link.delay_min_ns == pytest.approx(mean * 1e9, rel=0.01)
    assert calm(still) == (still, "")
