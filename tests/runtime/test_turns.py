"""The order of an instant: written out for a small tree, and checked against the inputs of all stages in random trees."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng

from echelon.messages import Channel
from echelon.plan.can_plan import BusRolePlan
from echelon.plan.plan import NodePlan, Plan, RobotPlan
from echelon.role import Role
from echelon.runtime.turns import ON_BUS, Turn, deadline_ns, level, turns
from echelon.sim.engines.in_process import make_roles
from support.trees import Tree, plan_of, scenario, trees

SETTINGS = settings(derandomize=True, deadline=None, max_examples=25)
WHOSE = {
    Turn.REPORT: "drives",
    Turn.HEAR: "bridge",
    Turn.CATCH_UP: "robot",
    Turn.SAY: "robot",
    Turn.GATHER: "node",
    Turn.STEER: "node",
    Turn.ACT: "robot",
    Turn.SEND: "bridge",
    Turn.SERVE: "drives",
}

SAID_IN = {
    ("robot", Channel.STATE): Turn.SAY,
    ("robot", Channel.TORQUE): Turn.ACT,
    ("node", Channel.GROUP_STATE): Turn.GATHER,
    ("node", Channel.REFERENCE): Turn.STEER,
    ("node", Channel.COMMAND): Turn.STEER,
    ("bridge", Channel.WHEELS): Turn.HEAR,
    ("bridge", Channel.FRAMES): Turn.SEND,
    ("drives", Channel.FRAMES): Turn.REPORT,
}


def made(tree: Tree, path: str, **can: object) -> Plan:
    return plan_of(scenario(tree, default_rng(1), can={"path": path, **can}))


def kind(one: RobotPlan | NodePlan | BusRolePlan) -> str:
    return "node" if isinstance(one, NodePlan) else one.role


def levels(plan: Plan, role: Role) -> list[int]:
    return [level(plan, stage.turn, stage.depth) for stage in role.stages]


def test_the_order_of_an_instant_in_full():
    """The tree has three nodes, one below the other."""
    tree = (((None,),),)
    mirrored = [
        (Turn.SAY, 0), (Turn.GATHER, 2), (Turn.GATHER, 1), (Turn.GATHER, 0),
        (Turn.STEER, 0), (Turn.STEER, 1), (Turn.STEER, 2), (Turn.ACT, 0),
    ]  # fmt: skip
    assert turns(made(tree, "mirror")) == mirrored
    before, after = [(Turn.REPORT, 0), (Turn.HEAR, 0), (Turn.CATCH_UP, 0)], [(Turn.SEND, 0), (Turn.SERVE, 0)]
    assert turns(made(tree, "closed")) == [*before, *mirrored, *after]
    assert turns(made(tree, "closed", virtual_drives=False)) == [*before, *mirrored, *after]


@SETTINGS
@given(trees(max_robots=8), st.sampled_from(["mirror", "closed"]))
def test_stages_use_messages_of_earlier_turns(tree, path):
    plan = made(tree, path)
    roles = make_roles(plan)
    for role in roles:
        assert levels(plan, role) == sorted(
            set(levels(plan, role))
        )  # each level once, in the order of the role's stages
        for stage, own in zip(role.stages, levels(plan, role), strict=True):
            assert WHOSE[stage.turn] == kind(plan.all_roles[role.index])
            for heard in stage.inputs:
                turn = SAID_IN[kind(plan.all_roles[heard.source]), heard.channel]
                (said,) = [each for each in roles[heard.source].stages if each.turn is turn]
                assert level(plan, said.turn, said.depth) < own


@SETTINGS
@given(trees(max_robots=8), st.sampled_from(["mirror", "closed"]), st.integers(1, 10**9))
def test_deadlines_share_the_period_evenly(tree, path, period_ns):
    """The first deadline is the beginning of the period, the last one its end; the others are evenly spaced, rounded down."""
    plan = made(tree, path)
    found = [deadline_ns(plan, turn, depth, period_ns) for turn, depth in turns(plan)]
    assert (found[0], found[-1]) == (0, period_ns)
    gaps = [later - earlier for earlier, later in zip(found, found[1:], strict=False)]
    assert max(gaps) - min(gaps) <= 1
    deepest = max(node.depth for node in plan.nodes)
    assert len(gaps) == 2 * deepest + (8 if path == "closed" else 3)


def test_deadlines_of_robots_in_groups():
    """The deadlines of a period of 10 ms, as numbers."""
    tree, period_ns = ((None, None), (None, None)), 10_000_000
    for path, first, apart in (("mirror", 0, 2_000_000), ("closed", 3_000_000, 1_000_000)):
        plan = made(tree, path)
        places = [(Turn.SAY, 0), (Turn.GATHER, 1), (Turn.GATHER, 0), (Turn.STEER, 0), (Turn.STEER, 1), (Turn.ACT, 0)]
        found = [deadline_ns(plan, turn, depth, period_ns) for turn, depth in places]
        assert found == [first + at * apart for at in range(6)]


def test_a_turn_that_a_plan_does_not_have_is_refused():
    plan = made((None, None), "mirror")
    for turn in ON_BUS:
        with pytest.raises(ValueError, match="not in list"):
            level(plan, turn, 0)
    with pytest.raises(ValueError, match="not in list"):
        deadline_ns(plan, Turn.GATHER, 1, 1000)
