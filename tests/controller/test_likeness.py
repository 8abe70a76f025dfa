"""Members that are alike: the reduced formation has the eigenvalues of the whole one, whatever is late."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.controller.prediction.largest_delay import _Search, largest_extra_delay
from echelon.controller.prediction.likeness import likeness, reduced
from echelon.controller.prediction.linear_run import LinearRun, edge_of, later
from echelon.controller.prediction.link_sets import link_sets
from echelon.controller.prediction.modes import block_modes
from support.runs import plan_of
from support.trees import like_groups, random_epsilon, scenario, with_random_gains
from support.trees import plan_of as plan_of_table

TREES = (
    ((None,) * 3,) * 3,
    ((None,) * 4, (None,) * 4, (None,) * 2, None, None, None),
    (((None,) * 3,) * 3, ((None, None),) * 3),
)


def eigenvalues(plan) -> np.ndarray:
    """Returns the different eigenvalues of a plan's map that are not of messages on their way."""
    found = np.linalg.eigvals(LinearRun(plan).map().toarray())
    return found[np.abs(found) > 1e-3]


@settings(derandomize=True, deadline=None, max_examples=30)
@given(st.sampled_from(TREES), st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 3, "all"]))
def test_the_reduced_formation_has_the_eigenvalues_of_the_whole(tree, seed, count):
    random = np.random.default_rng(seed)
    periods = {"acceleration": 0.05, "torque": 0.05}
    law = random_epsilon(tree, random) | {"lead": 0.5}
    plan = plan_of_table(scenario(tree, random, law=law, duration=0.05, periods=periods))
    edges = [edge_of(link) for link in plan.links]
    picked = random.permutation(len(edges))[: len(edges) if count == "all" else count]
    late = frozenset(edges[at] for at in picked)
    extra_ns = int(random.choice([0, 20_000_000, 50_000_000, 70_000_000]))
    small, still_late, names = reduced(plan, late)
    whole, part = eigenvalues(later(plan, late, extra_ns)), eigenvalues(later(small, still_late, extra_ns))
    assert np.abs(whole[:, None] - part).min(axis=1).max() < 1e-6  # each of the whole is in the reduced one
    assert np.abs(part[:, None] - whole).min(axis=1).max() < 1e-6
    assert {name for each in names for name in each} == {block.name for block in plan.blocks}


def test_what_is_alike_is_counted_once():
    small, _, names = reduced(plan_of("three_levels"))
    assert (len(small.robots), len(small.nodes)) == (8, 7)
    assert sorted(map(len, set(names))) == [1, 1, 3, 9]
    kinds = likeness(plan_of("three_levels")).kinds
    assert len(set(kinds[:27])) == 1
    assert len({like.name for like in link_sets(plan_of("three_levels")) if like.kind == "robot"}) == 3


def test_coupled_blocks_and_full_gains_are_not_reduced():
    random = np.random.default_rng(1)
    law = {"epsilon": [0.7, 0.6]}
    plan = plan_of_table(scenario(TREES[0], random, law=law))
    for changed in (with_random_gains(plan, random, coupling=0.0), with_random_gains(plan, random, coupling=0.1)):
        assert reduced(changed)[0] is changed
    assert len(set(likeness(with_random_gains(plan, random, coupling=0.0)).kinds[:9])) == 9


@pytest.mark.parametrize(
    "name", ["intra state", "inter reference", "west/g1/r1 state", pytest.param("all links", marks=pytest.mark.slow)]
)
def test_the_largest_delay_is_that_of_the_whole_formation(name):
    plan = plan_of("three_levels")
    late = next(one.edges for one in link_sets(plan) if one.name == name)
    found = _Search(plan, late, tuple((block.name,) for block in plan.blocks)).in_ticks()
    assert found.ticks == largest_extra_delay(plan, late).ticks


@pytest.mark.slow
def test_a_thousand_robots_in_a_hundred_like_groups_are_seven_members():
    plan = like_groups(100, 10)
    small, _, _ = reduced(plan)
    assert len(small.formation) == 7
    assert [len(one.names) for one in block_modes(plan)] == [100, 1, 1]
    few = like_groups(3, 3)
    for name in ("intra state", "inter reference", "all links"):
        of_many, of_few = (
            next(largest_extra_delay(each, one.edges).seconds for one in link_sets(each) if one.name == name)
            for each in (plan, few)
        )
        assert of_many == pytest.approx(of_few, rel=1e-9)
