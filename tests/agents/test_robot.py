"""The robot's role under commands that stop and commands that arrive within a period."""

import numpy as np
import pytest

from echelon.agents.robot import make_robot
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.layout import CommandLayout
from echelon.plan.plan import NodePlan, Plan
from support.runs import plan_of

FIELD = {name: at for at, name in enumerate(STATE_FIELDS)}


def command(plan: Plan, time_ns: int, ax: float, ay: float) -> Message:
    """Returns a COMMAND of robot 0's leader with the same acceleration for all its robots."""
    node = plan.formation[plan.robots[0].parent]
    assert isinstance(node, NodePlan)
    values = np.tile([ax, ay], CommandLayout.of(node).size // 2)
    return Message(Channel.COMMAND, node.index, time_ns // node.period_ns, time_ns, values)


def said(robot, time_ns: int) -> np.ndarray:
    """Returns the values of the STATE at an instant."""
    (message,) = robot.stages[0].run(time_ns, [])
    return message.values


def test_without_a_command_limited_torques_go_to_zero_at_their_rate():
    """The torque may change by 0.01 N m per torque period of 1 ms: within a period of 10 ms it is zero."""
    free = ("robot.torque_limit=inf", "robot.wheel_speed_limit=inf", "robot.torque_rate_limit=10.0")
    plan = plan_of("lab", "periods={acceleration=0.01, torque=0.001}", *free)
    robot, T = make_robot(plan, 0), plan.robots[0].period_ns
    say, obey = robot.stages
    torques = []
    for n in range(4):
        say.run(n * T, [])
        obey.run(n * T, [command(plan, n * T, 0.3, 0.0) if n < 2 else None])
        torques.append(robot._limits.tau_right)
    before = said(robot, 4 * T)
    assert abs(torques[2]) > 0.01
    assert robot._limits.tau_right == robot._limits.tau_left == 0.0
    assert before[FIELD["tau_right_peak"]] == 0.0  # in the second period without a command


@pytest.mark.parametrize("share", [0.3, 0.5, 0.999])
def test_an_acceleration_is_followed_from_the_instant_of_its_arrival(share):
    """A robot at rest that heads along x: after T it has a (1 - share) T of speed, exactly, for it does not turn."""
    plan = plan_of("lab", "robot.torque_limit=inf", "robot.torque_rate_limit=inf", "robot.wheel_speed_limit=inf")
    robot, T = make_robot(plan, 0), plan.robots[0].period_ns
    say, obey = robot.stages
    theta = plan.robots[0].heading
    say.run(0, [])
    obey.run(0, [None])
    at_ns = round(share * T)
    obey.run(at_ns, [command(plan, 0, 0.5 * np.cos(theta), 0.5 * np.sin(theta))])
    state = said(robot, T)
    rest = (T - at_ns) * 1e-9
    assert state[FIELD["v"]] == pytest.approx(0.5 * rest, rel=1e-12)
    moved = np.hypot(state[0] - plan.robots[0].start[0], state[1] - plan.robots[0].start[1])
    assert moved == pytest.approx(0.25 * rest**2, rel=1e-6)
    mean = state[FIELD["tau_right"]]
    assert mean == pytest.approx(state[FIELD["tau_right_peak"]] * (T - at_ns) / T, rel=1e-12)
    assert state[FIELD["tau_right_square"]] == pytest.approx(mean * state[FIELD["tau_right_peak"]], rel=1e-12)


def test_the_same_acceleration_that_arrives_again_within_a_period_changes_hardly_anything():
    """Torque is computed anew for the rest of the period; the motion differs only in the third order of the period."""
    plan = plan_of("lab")
    T = plan.robots[0].period_ns
    ends = []
    for again in (False, True):
        robot = make_robot(plan, 0)
        say, obey = robot.stages
        for n in range(20):
            say.run(n * T, [])
            obey.run(n * T, [command(plan, n * T, 0.2, 0.1)])
            if again:
                obey.run(n * T + T // 3, [command(plan, n * T, 0.2, 0.1)])
        ends.append(said(robot, 20 * T))
    assert np.abs(ends[0][:4] - ends[1][:4]).max() < 1e-4
