"""The law in the tree, node by node and message by message, against the central law."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon import controller
from echelon.controller.laws.central import CentralLaw
from echelon.controller.laws.in_tree import BlockGains
from echelon.messages import NULL, STATE_FIELDS, Channel, Message
from echelon.plan.layout import with_message_sizes
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan
from echelon.sim.engines.in_process import Engine
from support.points import time_driven
from support.trees import PAPER_TREE, plan_of, scenario, trees, with_random_gains
from support.watched import LAWS, NEAR, Watched, random_plan

SETTINGS = settings(derandomize=True, deadline=None, max_examples=60)
SEEDS = st.integers(0, 2**32 - 1)
FIELD = {name: at for at, name in enumerate(STATE_FIELDS)}


assert set(LAWS) == set(controller.laws.LAWS)


@pytest.mark.slow
@SETTINGS
@given(
    trees(),
    SEEDS,
    st.sampled_from(["three", "multi"]),
    st.sampled_from([0.0, 0.5]),
    st.booleans(),
    st.sampled_from(sorted(LAWS)),
)
def test_tree_computes_what_the_central_law_does(tree, seed, time_scales, coupling, avoidance, use):
    plan = random_plan(tree, seed, time_scales, coupling, avoidance, use)
    central, run = CentralLaw(plan), Watched(plan, seed)
    assert plan.coupled == (coupling > 0 and len(plan.robots) > 1)
    for time_ns in run.instants:
        states = run.states(time_ns)
        expected = central(time_ns * 1e-9, states[:, :2], states[:, 2:4])
        precision = 1e-9 if use == "terminal_sliding" else 1e-12  # its slope is steep for small errors
        np.testing.assert_allclose(run.commanded(time_ns), expected, atol=precision * (1 + np.abs(expected).max()))
    assert run.engine.messages == len(run.said)


def test_avoidance_changes_the_accelerations_of_nine_robots():
    """Avoidance changes the accelerations of nine robots, so the random trees above do test it."""
    plan = random_plan(PAPER_TREE, 5, "three", 0.5, avoidance=True)
    near = Watched(plan, 5).commanded(0)
    far = Watched(with_message_sizes(replace(plan, avoidance=replace(NEAR, enabled=False))), 5).commanded(0)
    assert np.abs(near - far).max() > 1.0


@SETTINGS
@given(trees(max_robots=8), SEEDS)
def test_torque_is_that_of_the_acceleration(tree, seed):
    """u = B⁻¹(a - A ṗ - C), written as in label 801.  The period is so short that the robot does not turn in it."""
    periods = {"acceleration": 1e-9, "torque": 1e-9}
    plan = random_plan(tree, seed, "three", 0.5, avoidance=True, duration=1e-9, periods=periods)
    run = Watched(plan, seed)
    before, after = (run.states(time_ns) for time_ns in run.instants)
    for robot, a, state, did in zip(plan.robots, run.commanded(0), before, after, strict=True):
        np.testing.assert_array_equal(did[[FIELD["ax"], FIELD["ay"]]], a)
        theta, omega = state[FIELD["theta"]], state[FIELD["omega"]]
        m1, d, r, R = robot.mass, robot.offset, robot.wheel_radius, robot.arm
        J, s, c = robot.inertia - m1 * d**2, np.sin(theta), np.cos(theta)
        A = omega * np.array([[-s * c, -s * s], [c * c, s * c]])
        B = np.array(
            [
                [c / (m1 * r) - d * R * s / (J * r), c / (m1 * r) + d * R * s / (J * r)],
                [s / (m1 * r) + d * R * c / (J * r), s / (m1 * r) - d * R * c / (J * r)],
            ]
        )
        C = -d * omega**2 * np.array([c, s])
        # The lead of 0.5 ns changes the torque by about 1e-9 of |a| ω.
        u = np.linalg.solve(B, a - A @ state[2:4] - C)
        np.testing.assert_allclose(did[[FIELD["tau_right"], FIELD["tau_left"]]], u, rtol=1e-5, atol=1e-5)


def test_messages_are_null_until_every_child_has_sent():
    """The states of one robot take 2 ms.  Until then its leader, the nodes above, and all members below them send null
    messages.  Nodes are time-driven, so that messages are sent at multiples of the period."""
    tree = ((None, None), (None, None))
    plan = random_plan(tree, 1, "three", 0.5, avoidance=True, duration=0.004)
    late = tuple(
        replace(link, delay_min_ns=2_000_000, delay_max_ns=2_000_000) if link.source == 0 else link
        for link in plan.links
    )
    run = Watched(time_driven(replace(plan, links=late)), 1)
    first, second, root = (node.index for node in plan.nodes)
    for time_ns in run.instants:
        silent = time_ns < 2_000_000
        assert run.said[Channel.GROUP_STATE, first, time_ns].is_null == silent
        assert not run.said[Channel.GROUP_STATE, second, time_ns].is_null
        for channel, source in ((Channel.REFERENCE, root), (Channel.COMMAND, first), (Channel.COMMAND, second)):
            assert run.said[channel, source, time_ns].is_null == silent
    # Without a command the torque is zero, and nothing counts as saturated.
    for time_ns in run.instants[1:3]:
        np.testing.assert_array_equal(run.states(time_ns)[:, FIELD["ax"] :], 0.0)
    assert (run.states(run.instants[3])[:, FIELD["tau_right_peak"]] > 0).all()


def test_a_node_without_a_reference_commands_nothing():
    plan = random_plan(((None, None), (None, None)), 1, "three", 0.0, avoidance=False)
    leader = Watched(plan, 1).engine.roles[plan.nodes[0].index]
    gather, steer = leader.stages
    states = [Message(Channel.STATE, robot, 0, 0, np.ones(len(STATE_FIELDS))) for robot in (0, 1)]
    gather.run(0, states)
    (message,) = steer.run(0, [None])
    assert message.is_null
    assert message.channel is Channel.COMMAND
    (message,) = steer.run(0, [Message(Channel.REFERENCE, plan.root.index, 0, 0, np.ones(4))])
    assert message.values.shape == (4,)
    gather.run(0, [states[0], None])
    (message,) = steer.run(0, [Message(Channel.REFERENCE, plan.root.index, 0, 0, np.ones(4))])
    assert message.values is NULL


def slow_root(ratio: int, coupling: float, avoidance: bool, ticks: int = 9) -> Plan:
    table = scenario(PAPER_TREE, np.random.default_rng(2), duration=0.001 * ratio * (ticks // ratio))
    table["formation"]["period"] = 0.001 * ratio
    table["law"] = {"epsilon": [0.5, 0.5], "lead": 0.5}
    plan = with_random_gains(plan_of(table), np.random.default_rng(3), coupling)
    return with_message_sizes(replace(plan, avoidance=NEAR)) if avoidance else plan


@pytest.mark.parametrize("ratio", [2, 3])
@pytest.mark.parametrize("coupling", [0.0, 0.5])
def test_the_references_of_a_slow_coordinator_are_held(ratio, coupling):
    """Leaders use states of every T.  ν of inter and centroid, and the error rates of other blocks, are those of the last
    multiple of k T."""
    plan = slow_root(ratio, coupling, avoidance=False)
    run = Watched(plan, 7)
    cbt, gains = CentralLaw(plan).transformation, [BlockGains.of(plan, block) for block in plan.blocks]
    trajectory = CentralLaw(plan).trajectory
    intra, ahead = slice(0, 12), plan.lead * plan.root.period_ns * 1e-9

    def error(time_ns: int) -> tuple[Array, Array, Array]:
        states, z_cd = run.states(time_ns), trajectory.at(time_ns * 1e-9)
        e, e_dot = cbt.forward(states[:, :2]) - cbt.desired(z_cd[0]), cbt.forward(states[:, 2:4])
        e_dot[-1] -= z_cd[1]
        return e.ravel(), e_dot.ravel(), trajectory.at(time_ns * 1e-9 + ahead)[2]

    for time_ns in run.instants:
        due = time_ns % (ratio * 1_000_000) == 0
        assert ((Channel.REFERENCE, plan.root.index, time_ns) in run.said) == due
        assert all(((Channel.GROUP_STATE, node.index, time_ns) in run.said) == due for node in plan.nodes[:-1])
        now, last = error(time_ns), error(time_ns - time_ns % (ratio * 1_000_000))
        nu = np.zeros(18)
        for block, gain in zip(plan.blocks, gains, strict=True):
            rows = slice(block.offset, block.offset + block.size)
            e, e_dot, _ = now if rows.stop <= intra.stop else last
            nu[rows] = -gain.K_1 @ e[rows] - gain.K_2 @ e_dot[rows] - gain.K_coupling @ last[1]
        nu[-2:] += last[2]
        expected = cbt.backward(nu.reshape(-1, 2))
        np.testing.assert_allclose(run.commanded(time_ns), expected, atol=1e-12 * (1 + np.abs(expected).max()))


def test_slow_coordinator_hands_down_forces_of_its_own_pairs_only():
    """Forces within a group are those of every T; forces between groups are those of the last multiple of k T."""
    plan = slow_root(3, 0.0, avoidance=True)
    run, quiet = Watched(plan, 7), Watched(with_message_sizes(replace(plan, avoidance=replace(NEAR, enabled=False))), 7)
    np.testing.assert_array_equal(run.states(0), quiet.states(0))
    time_ns = 3_000_000
    states = run.states(time_ns)
    expected = CentralLaw(plan)(time_ns * 1e-9, states[:, :2], states[:, 2:4])
    np.testing.assert_allclose(run.commanded(time_ns), expected, atol=1e-12 * np.abs(expected).max())
    for time_ns in (1_000_000, 2_000_000, 4_000_000):
        reference = run.said[Channel.REFERENCE, plan.root.index, time_ns - time_ns % 3_000_000]
        forces = reference.values[-18:].reshape(-1, 2)
        for node in plan.nodes[:-1]:
            below = slice(node.first_robot, node.first_robot + 3)
            group_plan = replace(plan, avoidance=replace(NEAR, enabled=False))
            x = run.states(time_ns)[:, :2]
            bare = _leader_alone(group_plan, node.index, run, time_ns, reference.values[:6])
            pair = _forces_within(x[below]) + forces[below]
            phi = np.array([[2**-0.5, -(2**-0.5), 0], [-0.5, -0.5, 1], [1 / 3, 1 / 3, 1 / 3]])
            f_pot = phi @ pair
            gain = BlockGains.of(plan, plan.block_of(node.index)).K_pot
            nu = np.vstack([(gain @ f_pot[:-1].ravel()).reshape(-1, 2), np.zeros(2)])
            expected = bare + np.linalg.solve(phi, nu)
            tolerance = 1e-11 * (1 + np.abs(expected).max())
            np.testing.assert_allclose(run.commanded(time_ns)[below], expected, atol=tolerance)


def _leader_alone(plan: Plan, index: int, run: Watched, time_ns: int, reference: Array) -> Array:
    """Returns the command of a leader for given states and a given reference, without avoidance."""
    leader = Engine(plan).roles[index]
    node = plan.formation[index]
    leader.stages[0].run(time_ns, [run.said[Channel.STATE, child, time_ns] for child in node.children])
    (message,) = leader.stages[1].run(time_ns, [Message(Channel.REFERENCE, plan.root.index, 0, 0, reference)])
    return message.values.reshape(-1, 2)


def _forces_within(x: Array) -> Array:
    """Returns ∇f within a group, computed for each pair from the formula of the potential's slope."""
    f = np.zeros_like(x)
    for i in range(len(x)):
        for j in range(len(x)):
            s = float(np.hypot(*(x[i] - x[j])))
            if i != j and s < 4.0:
                slope = 4 * s * (16 - s**2) * (16 - 0.09) / (s**2 - 0.09) ** 3 if s > 0.3 else np.inf
                f[i] += min(slope, 500.0) * (x[i] - x[j]) / s
    return f


def test_links_of_a_plan_are_the_inputs_of_its_roles():
    plan = random_plan((None, (None, (None, None)), None), 3, "multi", 0.5, avoidance=True)
    run = Watched(plan, 3)
    listened = {
        (heard.source, role.index, heard.channel)
        for role in run.engine.roles
        for stage in role.stages
        for heard in stage.inputs
    }
    assert listened == {(link.source, link.receiver, link.channel) for link in plan.links}
    assert all(isinstance(link, LinkPlan) and link.ideal for link in plan.links)
