"""The factor of the torque loop: against the formula for the paper's plant, and against the robot's own loop for others."""

from dataclasses import replace

import numpy as np
import pytest

from echelon.agents.plant import state_at
from echelon.agents.torque import make_inverse
from echelon.sim.forecast.torque_loop import torque_loops
from support.runs import plan_of


@pytest.mark.parametrize("q", [0.1, 0.7, 1.0, 1.7, 1.99, 2.01, 3.0])
def test_the_factor_of_the_papers_plant_is_that_of_its_formula(q: float) -> None:
    plan = plan_of("lab")
    robot = plan.robots[0]
    speed = q * robot.offset / (robot.torque_period_ns * 1e-9)
    loop = torque_loops(plan, [speed] * 9)[0]
    assert loop.factor == pytest.approx(1 - q + q * q / 2, rel=1e-5)
    assert loop.is_stable == (q < 2)
    assert loop.longest_period == pytest.approx(2 * robot.offset / speed, rel=1e-4)


@pytest.mark.parametrize("model", ["rigid_body", "paper"])
@pytest.mark.parametrize("share", [0.5, 0.97, 1.03])
def test_a_small_yaw_rate_of_a_robot_changes_by_the_factor_in_each_period(model: str, share: float) -> None:
    """Torque loop and plant, period after period, around the longest stable period."""
    plan = plan_of("lab", f'robot.model="{model}"')
    robot, speed = plan.robots[0], 3.0
    longest = torque_loops(plan, [speed] * 9)[0].longest_period
    assert longest is not None
    h_ns = round(share * longest * 1e9)
    changed = replace(plan, robots=(replace(robot, torque_period_ns=h_ns), *plan.robots[1:]))
    loop = torque_loops(changed, [speed] * 9)[0]
    inverse, step, h = make_inverse(robot), robot.model.made.step_of(robot), h_ns * 1e-9
    state, rates = state_at(0.0, 0.0, 0.0, speed, 1e-7), []
    for _ in range(30):
        state = step(state, *inverse(state, 0.0, 0.0, 0.5 * h), h)
        rates.append(abs(state.omega))
    assert (rates[-1] / rates[9]) ** (1 / 20) == pytest.approx(loop.factor, rel=1e-3)
    assert loop.is_stable == (share < 1)


def test_late_torques_make_the_loop_less_stable() -> None:
    """ω⁺ = ω - c ω₋ₖ by itself, with the torques k periods late."""
    plan = plan_of("lab", 'can={path="closed", watchdog=5.0}', 'links=[{channel="torque", delay=0.02}]')
    loop = torque_loops(plan, [4.0] * 9)[0]
    q = 0.01 * 4.0 / 0.1
    c, omega = q - q * q / 2, [1.0, 1.0, 1.0]
    for _ in range(400):
        omega.append(omega[-1] - c * omega[-3])
    peaks = np.abs(omega)
    measured = (peaks[-60:].max() / peaks[-160:-100].max()) ** (1 / 100)
    assert loop.factor == pytest.approx(measured, rel=0.01)
    assert loop.factor > torque_loops(plan_of("lab"), [4.0] * 9)[0].factor


def test_a_robot_at_rest_has_no_edge() -> None:
    loop = torque_loops(plan_of("lab"), [0.0] * 9)[0]
    assert loop.is_stable
    assert loop.longest_period is None
