"""Layouts of messages in random trees: against the messages that roles send, and against the central law."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng

from echelon.controller.laws.central import CentralLaw
from echelon.messages import GROUP_FIELDS, STATE_FIELDS, Channel, Message
from echelon.plan.layout import CENTROID, POSITION, NodeLayout, acceleration_of, message_sizes
from echelon.plan.plan import NodePlan, Plan
from echelon.sim.engines.in_process import Engine
from support.trees import plan_of, random_epsilon, scenario, trees, with_random_gains

SETTINGS = settings(derandomize=True, deadline=None, max_examples=25)
COUPLINGS = st.sampled_from([0.0, 0.5])


def made(tree, coupling: float, avoidance: bool, path: str = "mirror") -> Plan:
    random = default_rng(1)
    table = scenario(tree, random, law=random_epsilon(tree, random), can={"path": path})
    if avoidance:
        table["avoidance"] = {"enabled": True, "avoidance_radius": 1e-9, "sensing_radius": 4.0, "force_limit": 500.0}
    return with_random_gains(plan_of(table), random, coupling)


def robots_below(plan: Plan, index: int) -> list[int]:
    """Returns the robots at or below a member, found by walking down the tree."""
    if index < len(plan.robots):
        return [index]
    return [robot for child in plan.formation[index].children for robot in robots_below(plan, child)]


def nodes_below(plan: Plan, index: int) -> list[int]:
    """Returns the nodes at or below a member, each after the nodes below it, found by walking down the tree."""
    if index < len(plan.robots):
        return []
    return [*(node for child in plan.formation[index].children for node in nodes_below(plan, child)), index]


@pytest.mark.slow
@SETTINGS
@given(trees(max_robots=8), st.sampled_from(["mirror", "closed"]), COUPLINGS, st.booleans())
def test_roles_send_the_messages_of_the_layout(tree, path, coupling, avoidance):
    """Roles send on exactly the channels of the layout, with the numbers of values of the layout."""
    plan = made(tree, coupling, avoidance, path)
    said: list[Message] = []
    Engine(plan, said.append).run()
    announced = message_sizes(plan)
    mirrored = {(len(plan.formation), Channel.FRAMES)} if path == "mirror" else set()
    assert {(message.source, message.channel) for message in said} == set(announced) - mirrored
    for message in said:
        if message.channel is Channel.FRAMES:
            assert announced[message.source, message.channel] is None
        elif not message.is_null:
            assert announced[message.source, message.channel] == message.values.size
    assert all(link.size == announced[link.source, link.channel] for link in plan.links)


@SETTINGS
@given(trees(max_robots=10), COUPLINGS, st.booleans())
def test_parts_are_adjacent_and_fill_the_message(tree, coupling, avoidance):
    plan = made(tree, coupling, avoidance)
    for node in plan.nodes:
        layout = NodeLayout.of(plan, node)
        state, reference, command = layout.state, layout.reference, layout.command
        rows = [(state.size, [state.centroid, state.rates, state.positions])]
        if reference is not None:
            rows.append((reference.size, [reference.accelerations, reference.rates, reference.forces]))
        if command is not None:
            rows.append((command.size, [command.accelerations]))
        for size, parts in rows:
            assert [at for part in parts for at in range(part.start, part.stop)] == list(range(size))
        # Every value of a node's state has one source: the law, the children, or at the root the trajectory.
        made_of = [state.centroid, state.own_rates, state.centroid_rates, *(part.here for part in layout.carried)]
        assert sorted(at for part in made_of for at in range(part.start, part.stop)) == list(range(state.size))


@SETTINGS
@given(trees(max_robots=10), COUPLINGS, st.booleans())
def test_parts_hold_the_values_of_their_names(tree, coupling, avoidance):
    plan = made(tree, coupling, avoidance)
    said: dict[tuple[int, Channel], np.ndarray] = {}
    Engine(plan, lambda message: said.setdefault((message.source, message.channel), message.values)).run()
    states = np.array([said[robot.index, Channel.STATE] for robot in plan.robots])
    central = CentralLaw(plan)
    rates = central.transformation.forward(states[:, 2:4])  # these are the velocities: only the desired centroid moves
    rates[-1] -= central.trajectory.at(0.0)[1]
    block_of = {block.node: at for at, block in enumerate(plan.blocks)}
    starts = np.cumsum([0, *(block.size // 2 for block in plan.blocks)])

    def of_blocks(nodes: list[int]) -> np.ndarray:
        found = [
            rates[starts[block_of[node]] : starts[block_of[node] + 1]].ravel() for node in nodes if node in block_of
        ]
        return np.concatenate([*found, np.empty(0)])

    for node in plan.nodes:
        layout, robots = NodeLayout.of(plan, node), robots_below(plan, node.index)
        if node.parent is not None:
            values, state = said[node.index, Channel.GROUP_STATE], layout.state
            np.testing.assert_allclose(values[state.centroid], states[robots, :4].mean(axis=0), atol=1e-12)
            expected = of_blocks(nodes_below(plan, node.index)) if plan.coupled else np.empty(0)
            np.testing.assert_allclose(values[state.rates], expected, atol=1e-12)
            assert values[state.positions].tolist() == (states[robots, :2].ravel().tolist() if avoidance else [])
        if layout.reference is not None:
            values = said[node.index, Channel.REFERENCE]
            expected = rates.ravel() if plan.coupled else np.empty(0)
            np.testing.assert_allclose(values[layout.reference.rates], expected, atol=1e-12)
            for child in (plan.formation[index] for index in node.children):
                if isinstance(child, NodePlan):
                    _check_part_of(plan, node, child, said)


def _check_part_of(plan: Plan, parent: NodePlan, child: NodePlan, said: dict[tuple[int, Channel], np.ndarray]) -> None:
    """Checks that the group's centroid has the acceleration that the parent sent, and that forces are those of its own
    robots."""
    mine, reference = NodeLayout.of(plan, child).mine, NodeLayout.of(plan, parent).reference
    values = said[parent.index, Channel.REFERENCE]
    given_to = {robot.index: said[robot.parent, Channel.COMMAND][acceleration_of(robot)] for robot in plan.robots}
    robots = robots_below(plan, child.index)
    mean = np.mean([given_to[robot] for robot in robots], axis=0)
    np.testing.assert_allclose(
        values[mine.acceleration], mean, atol=1e-11 * (1 + np.abs(list(given_to.values())).max())
    )
    assert mine.rates == reference.rates
    if plan.avoidance.enabled:
        places = np.arange(reference.size)[reference.forces].reshape(-1, 2)
        order = robots_below(plan, parent.index)
        assert (
            np.arange(reference.size)[mine.forces].tolist() == places[[order.index(r) for r in robots]].ravel().tolist()
        )


def test_a_state_begins_with_the_fields_of_a_group_state():
    assert STATE_FIELDS[CENTROID] == GROUP_FIELDS
    assert STATE_FIELDS[POSITION] == ("x", "y")
