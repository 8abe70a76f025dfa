"""The largest delay of any set of links: against every delay tried with the map, and against the limit of continuous time."""

import numpy as np
import pytest

from echelon.controller.laws.law import LinearGains
from echelon.controller.prediction import largest_delay
from echelon.controller.prediction.block_margin import delay_margin
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import Edges, LinearRun, edges_of, later
from echelon.controller.prediction.link_sets import link_sets
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.messages import Channel
from echelon.plan.plan import Plan
from support.growth import single
from support.points import at_rest, growth_of_points, time_driven
from support.random_formations import TREES, layers_of, random_formation
from support.runs import plan_of
from support.trees import plan_of as plan_of_table
from support.trees import random_epsilon, scenario, with_random_gains

MS = 1_000_000


def radius(plan: Plan, late: Edges, extra_ns: int) -> float:
    return spectral_radius(LinearRun(later(plan, late, extra_ns)).map())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_with_several_periods_no_delay_up_to_the_largest_is_unstable_and_the_next_is(seed):
    """Every fourth tick is tried with the map, and those at the edge; time-driven, groups with periods of 20, 40 and 80 ms."""
    random = np.random.default_rng(seed)
    tree = (((None, None), (None, None)), (None, None))
    table = scenario(
        tree, random, law=random_epsilon(tree, random), duration=0.16, periods={"acceleration": 0.02, "torque": 0.02}
    )
    table["formation"]["period"] = 0.08
    table["formation"]["groups"]["g0"]["period"] = 0.04
    plan = time_driven(with_random_gains(plan_of_table(table), random, coupling=0.1))
    for one in link_sets(plan):
        if one.kind == "class":
            found = largest_extra_delay(plan, one.edges)
            assert found.ends == "unstable"
            assert not found.tried
            assert found.ticks is not None
            tick_ns = round(found.tick_s * 1e9)
            for ticks in (*range(0, found.ticks, 4), found.ticks, found.ticks + 1):
                assert (radius(plan, one.edges, ticks * tick_ns) < 1) == (ticks <= found.ticks), (one.name, ticks)


@pytest.mark.parametrize("name", ["intra state", "inter reference", pytest.param("all links", marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [0])
def test_event_driven_every_delay_up_to_the_largest_is_stable(name, seed):
    """Delays on and between ticks, tried with the map."""
    plan = random_formation(seed)
    if not plan.root.event_driven:
        plan = random_formation(seed + 10)
    late = next(one.edges for one in link_sets(plan) if one.name == name)
    found = largest_extra_delay(plan, late)
    assert found.seconds is not None
    for share in np.linspace(0.02, 0.995, 6):
        assert radius(plan, late, round(share * found.seconds * 1e9)) < 1, share
    assert radius(plan, late, round((found.seconds + 0.01 * found.tick_s) * 1e9)) > 1


def test_a_delay_just_before_an_instant_may_be_worse_than_one_at_it():
    """The references of two layers are late by 18.95 ticks: each acts a little before an instant, and so a tick later."""
    plan = plan_of("three_levels")
    late = edges_of(plan, Channel.REFERENCE)
    found = largest_extra_delay(plan, late)
    assert found.ticks == 19
    assert found.seconds == pytest.approx(0.1889, abs=2e-4)
    assert radius(plan, late, 189 * MS) > 1 > radius(plan, late, 190 * MS)


@pytest.mark.slow
def test_long_delays_have_an_answer():
    """In ticks of 1 ms the delay is more than 700: the truth is that of continuous time, less the hold."""
    for lead, expected in ((0.5, 711), (0.0, 710)):
        plan = time_driven(single(0.001, lead))
        found = largest_extra_delay(plan, Channel.STATE)
        assert (found.ends, found.tried) == ("unstable", False)
        assert found.ticks == pytest.approx(expected, abs=1)
        assert found.ticks is not None
        assert radius(plan, edges_of(plan, Channel.STATE), found.ticks * MS) < 1
        assert radius(plan, edges_of(plan, Channel.STATE), (found.ticks + 1) * MS) > 1


def test_near_its_edge_a_loop_bears_no_tick_more():
    """K2 T = 1.9: the loop is near its edge at z = -1 already."""
    found = largest_extra_delay(time_driven(single(1.9)), Channel.STATE)
    assert (found.ticks, found.ends) == (0, "unstable")


@pytest.mark.slow
@pytest.mark.parametrize("T", [1.9, 0.1, 0.012])
def test_where_the_criterion_is_not_valid_delays_are_tried_and_that_is_said(T, monkeypatch):
    plan = time_driven(single(T))
    by_criterion = largest_extra_delay(plan, Channel.STATE)
    monkeypatch.setattr(largest_delay._Search, "_first_unstable", lambda self, part_ns=0: None)
    found = largest_extra_delay(plan, Channel.STATE)
    assert (found.ticks, found.ends, found.tried) == (by_criterion.ticks, "unstable", True)
    assert not by_criterion.tried


@pytest.mark.slow
@pytest.mark.parametrize("lead", [0.0, 0.5])
def test_margins_of_layers_tend_to_those_of_continuous_time(lead):
    """Coupled blocks: all states late by τ is ë = -(K_1 e + (K_2 + K̄) ė)(t - τ) of the whole, whose margin comes from the
    crossings of continuous time."""
    errors = []
    for T in (0.02, 0.01, 0.005):
        random = np.random.default_rng(4)
        law = random_epsilon(TREES[0], random) | {"lead": lead}
        table = scenario(TREES[0], random, law=law, duration=T, periods={"acceleration": T, "torque": T})
        plan = with_random_gains(plan_of_table(table), random, coupling=0.1)
        size = 2 * len(plan.robots)
        K_1, K_2 = np.zeros((size, size)), plan.coupling.copy()
        for block in plan.blocks:
            rows = slice(block.offset, block.offset + block.size)
            K_1[rows, rows], K_2[rows, rows] = block.k1 / block.sigma**2, block.k2 / block.sigma
        exact = delay_margin(LinearGains(K_1, K_2, np.zeros((size, size)), np.eye(size)))
        assert exact is not None
        found = largest_extra_delay(plan, Channel.STATE).seconds
        assert found is not None
        errors.append(abs(found - exact))
        assert errors[-1] < T
    assert errors[-1] < 0.3 * errors[0]


@pytest.mark.parametrize("layer", ["intra", "inter"])
def test_margins_of_uncoupled_layers_tend_to_those_of_their_blocks(layer):
    for T in (20, 5):
        plan = plan_of("lab", f"periods={{acceleration={T / 1000}, torque={T / 1000}}}")
        expected = {"intra": 0.355586, "inter": 0.711172}[layer]
        for one in link_sets(plan):
            if one.kind == "class" and one.layer == layer:
                found = largest_extra_delay(plan, one.edges)
                assert found.seconds == pytest.approx(expected, abs=0.5e-3 * T)
                assert found.limits == (("g1", "g2", "g3") if layer == "intra" else ("inter",))


@pytest.mark.slow
def test_what_limits_a_delay_is_the_fastest_block_of_its_loop():
    plan = plan_of("multi")
    limits = {one.name: largest_extra_delay(plan, one.edges).limits for one in link_sets(plan) if one.kind == "class"}
    assert limits == {
        "intra state": ("g1",),
        "intra command": ("g1",),
        "inter group_state": ("inter",),
        "inter reference": ("inter",),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "name"), [(7, "middle group_state"), (7, "middle reference"), (17, "middle reference")]
)
def test_in_a_chain_of_late_links_every_delay_up_to_the_largest_is_stable(seed, name):
    """A node that waits for a message of the same period acts at another instant than with a period more."""
    plan = at_rest(random_formation(seed))
    (late,) = (one.edges for one in link_sets(plan) if (one.kind, one.name) == ("class", name))
    found = largest_extra_delay(plan, late)
    assert found.seconds is not None

    def radius(seconds):
        return spectral_radius(LinearRun(later(plan, late, round(seconds * 1e9))).map())

    for share in np.linspace(0.02, 0.999, 30):
        assert radius(share * found.seconds) < 1
    assert radius(1.003 * found.seconds) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 5, 7, 8])
def test_points_of_random_formations_grow_beyond_the_largest_delay_and_not_before(seed, monkeypatch):
    """Trees of up to four layers, several periods, full gains and couplings: the engine with points, each link class."""
    plan = at_rest(random_formation(seed))
    assert 2 <= layers_of(seed) <= 4
    for one in link_sets(plan):
        if one.kind != "class":
            continue
        found = largest_extra_delay(plan, one.edges)
        assert found.seconds is not None
        assert found.ticks is not None
        below, above = 0.97 * found.seconds, 1.03 * found.seconds
        if not plan.root.event_driven:
            below, above = found.ticks * found.tick_s, (found.ticks + 1) * found.tick_s
        for seconds, grows in ((below, False), (above, True)):
            late = later(plan, one.edges, round(seconds * 1e9))
            rate = abs(np.log(spectral_radius(LinearRun(late).map())))
            measured = growth_of_points(late, int(min(4000, max(300, 15 / rate))), monkeypatch)
            assert (measured > 0) == grows, (one.name, seconds)
