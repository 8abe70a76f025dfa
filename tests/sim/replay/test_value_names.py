"""sim.replay.value_names: as many names as values, and each name stands at the place of its value."""

import pytest

from echelon.messages import Channel
from echelon.plan.layout import NodeLayout, message_sizes
from echelon.plan.plan import NodePlan, Plan
from echelon.sim.replay.value_names import unit_of, value_names
from support.runs import plan_of

COUPLED = "law.coupling=[{block='inter',onto='g1',value=0.1}]"


@pytest.mark.parametrize("scenario", ["lab", "paper", "three_levels", "drives", "unequal", "multi"])
@pytest.mark.parametrize("overrides", [("avoidance.enabled=true",), ("avoidance.enabled=false",)])
def test_every_value_has_a_name_of_its_own(scenario: str, overrides: tuple[str, ...]) -> None:
    check_names(plan_of(scenario, *overrides))


def test_every_value_has_a_name_of_its_own_where_blocks_are_coupled() -> None:
    check_names(
        plan_of("three_levels", "law.coupling=[{block='inter',onto='intra',value=0.1}]", "avoidance.enabled=true")
    )


def check_names(plan: Plan) -> None:
    """Checks that all messages have as many names as values, each once."""
    for (source, channel), size in message_sizes(plan).items():
        if size is not None:
            names = value_names(plan, source, channel)
            assert len(names) == len(set(names)) == size
            assert all(unit_of(name) or name in ("saturated", "commanded") for name in names)


def test_a_name_stands_at_the_place_of_its_value() -> None:
    plan = plan_of("unequal", "avoidance.enabled=true")
    node = plan.nodes[1]
    assert isinstance(node, NodePlan)
    assert node.name == "trio"
    layout = NodeLayout.of(plan, node)
    state = value_names(plan, node.index, Channel.GROUP_STATE)
    assert state[layout.state.centroid] == ("x", "y", "vx", "vy")
    assert state[layout.state.positions][2:4] == ("x of trio/t2", "y of trio/t2")
    root = NodeLayout.of(plan, plan.root).reference
    assert root is not None
    reference = value_names(plan, plan.root.index, Channel.REFERENCE)
    assert reference[root.accelerations][2:4] == ("ax of trio", "ay of trio")
    assert reference[root.forces][:2] == ("fx of pair/p1", "fy of pair/p1")
    assert value_names(plan, node.index, Channel.COMMAND)[4:] == ("ax of trio/t3", "ay of trio/t3")


def test_error_rates_are_those_of_the_blocks_child_by_child() -> None:
    plan = plan_of("lab", COUPLED)
    assert plan.coupled
    layout = NodeLayout.of(plan, plan.root).reference
    assert layout is not None
    rates = value_names(plan, plan.root.index, Channel.REFERENCE)[layout.rates]
    assert rates[:2] == ("error rate z1_x of g1", "error rate z1_y of g1")
    assert rates[-2:] == ("error rate x of centroid", "error rate y of centroid")
    assert [name.rpartition(" ")[2] for name in rates[::4]] == ["g1", "g2", "g3", "inter", "centroid"]
    own = value_names(plan, plan.nodes[0].index, Channel.GROUP_STATE)
    assert own[NodeLayout.of(plan, plan.nodes[0]).state.rates] == tuple(name for name in rates if name.endswith(" g1"))


def test_what_sends_no_such_messages_is_refused() -> None:
    plan = plan_of("drives")
    assert plan.bridge is not None
    with pytest.raises(ValueError, match="g1/r1 sends no COMMAND"):
        value_names(plan, 0, Channel.COMMAND)
    with pytest.raises(ValueError, match="bridge sends no FRAMES with values that have names"):
        value_names(plan, plan.bridge.index, Channel.FRAMES)
