"""All plants against scipy's integrator, against the equations of the paper and of Newton, and against known solutions."""

import time
import warnings
from itertools import product
from math import inf, isinf, isnan, nan

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from echelon.agents.plant import GRAVITY, LOST, PLANTS, RobotState, make_step, state_at
from echelon.agents.robot import Robot
from echelon.messages import Channel, Message
from echelon.plan.plan import Array, RobotPlan
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import load
from support.synthetic import PAPER
from support.trees import plan_of, scenario

HILL = {"rise": (0.05, -0.1), "load": 1.5, "resistance": 3.0}
IN_FILE = {"hill": "{use='hill',parameters={rise=[0.05,-0.1],load=1.5,resistance=3.0}}"}
assert set(IN_FILE) < set(PLANTS)


def robot_of(path: str, model: str) -> RobotPlan:
    return load(PAPER.parent / path, [f"robot.model={IN_FILE.get(model, model)}"])[1].robots[0]


def rates(robot: RobotPlan, right: float, left: float):
    """Returns the function for d(x, y, θ, v, ω)/dt of a plant, written from docs/architecture.md, 2.1 and 2.2."""
    m1, inertia, r, arm, d = robot.mass, robot.inertia, robot.wheel_radius, robot.arm, robot.offset
    push, turn = (right + left) / r, arm * (right - left) / r

    def paper(_, s):
        _, _, theta, v, omega = s
        p_dot = v * np.cos(theta) - d * omega * np.sin(theta), v * np.sin(theta) + d * omega * np.cos(theta)
        return [*p_dot, omega, push / m1, turn / (inertia - m1 * d**2)]

    def rigid_body(_, s):
        _, _, theta, v, omega = s
        p_dot = v * np.cos(theta) - d * omega * np.sin(theta), v * np.sin(theta) + d * omega * np.cos(theta)
        i_c = inertia - m1 * d**2
        return [*p_dot, omega, push / m1 + d * omega**2, (turn - m1 * d * v * omega) / (i_c + m1 * d**2)]

    def hill(_, s):
        """Newton's law for the mass and Euler's law about it; the force N keeps the axle from slipping sideways."""
        _, _, theta, v, omega = s
        m, i_c, c = m1 + HILL["load"], inertia - m1 * d**2, HILL["resistance"]
        along, across = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        rise = np.array(HILL["rise"])
        gravity = -GRAVITY * rise / np.sqrt(1 + rise @ rise)
        wheels = [right / r - c / 2 * (v + arm * omega), left / r - c / 2 * (v - arm * omega)]
        # m (v̇ - d ω²) = wheels + m g·e_v;  m (v ω + d ω̇) = N + m g·e_n;  I_c ω̇ = arm (right - left) - d N
        v_dot, omega_dot, _ = np.linalg.solve(
            [[m, 0, 0], [0, m * d, -1], [0, i_c, d]],
            [
                sum(wheels) + m * gravity @ along + m * d * omega**2,
                m * gravity @ across - m * v * omega,
                arm * (wheels[0] - wheels[1]),
            ],
        )
        return [*(v * along + d * omega * across), omega, v_dot, omega_dot]

    return {"paper": paper, "rigid_body": rigid_body, "hill": hill}[robot.model.use]


def integrated(robot: RobotPlan, state: RobotState, right: float, left: float, h: float) -> Array:
    solution = solve_ivp(rates(robot, right, left), (0, h), state[:5], method="DOP853", rtol=1e-13, atol=1e-14)
    assert solution.success
    return solution.y[:, -1]


def close(found, expected, metres: float) -> None:
    """Asserts that positions agree within `metres`, and θ, v, ω within 1e-8 of their size."""
    np.testing.assert_allclose(found[:2], expected[:2], atol=metres, rtol=0)
    np.testing.assert_allclose(found[2:], expected[2:], rtol=1e-8, atol=1e-9)


TORQUES_FAST = ((0, 0), (5e3, -5e3), (-2e4, 3e4))
TORQUES_LAB = ((0, 0), (1.5, -1.5), (0.3, 0.7), (-1.5, -1.5))
FAST = list(product((0.0, 2.5), (-850.0, 0.0, 300.0), (-1000.0, -40.0, 0.0, 3.0, 940.0), TORQUES_FAST))
LAB = list(product((0.0, -2.0), (-1.2, 0.0, 0.8), (-10.0, 0.0, 2.0, 13.0), TORQUES_LAB))
"""Tuples of θ, v, ω and the wheel torques"""


@pytest.mark.parametrize("model", PLANTS)
@pytest.mark.parametrize(
    ("path", "grid", "h", "metres"),
    [("paper.toml", FAST, 1e-4, 2e-10), ("paper.toml", FAST, 1e-3, 1e-6), ("lab.toml", LAB, 1e-2, 1e-10)],
)
def test_step_is_the_solution(model, path, grid, h, metres):
    """The grid reaches from robots of a lab to 850 m/s and 1000 rad/s, with turns of more than a radian in a step."""
    robot = robot_of(path, model)
    step = make_step(robot)
    for theta, v, omega, torques in grid:
        state = state_at(3.0, -2.0, theta, v, omega)
        close(step(state, *torques, h)[:5], integrated(robot, state, *torques, h), metres)


@pytest.mark.parametrize("model", PLANTS)
def test_two_half_steps_are_one_step(model):
    step, h = make_step(robot_of("paper.toml", model)), 1e-4
    for theta, v, omega, torques in FAST:
        state = state_at(3.0, -2.0, theta, v, omega)
        half = step(state, *torques, h / 2)
        close(step(half, *torques, h / 2)[:5], step(state, *torques, h)[:5], 2e-10)
        np.testing.assert_array_equal(step(state, *torques, 0.0), state)


def kinetic_energy(robot: RobotPlan, state: RobotState) -> float:
    """Returns ½ m |ṗ|² + ½ I_c ω²; the mass is at the reference point, and |ṗ|² = v² + d² ω²."""
    i_c = robot.inertia - robot.mass * robot.offset**2
    return 0.5 * robot.mass * (state.v**2 + (robot.offset * state.omega) ** 2) + 0.5 * i_c * state.omega**2


@pytest.mark.parametrize(("v", "omega"), [(-1.0, 5.0), (2.0, -3.0), (0.0, 8.0), (-300.0, 900.0)])
def test_rigid_body_without_torque_is_the_chaplygin_sleigh(v, omega):
    """v̇ = d ω², ω̇ = -m d v ω/I: energy is conserved, and v = V tanh φ, ω = ± V √(m/I) sech φ, φ = (d m/I) V t + φ(0).

    So in the end it moves forwards (d > 0), whatever its direction at the start."""
    robot = robot_of("lab.toml" if abs(v) < 100 else "paper.toml", "rigid_body")
    step, state, h = make_step(robot), state_at(0.0, 0.0, 0.3, v, omega), 2e-3 / max(1, abs(v) / 10)
    start = kinetic_energy(robot, state)
    ratio = np.sqrt(robot.mass / robot.inertia)
    speed = np.hypot(v, omega / ratio)
    for k in range(1, 400):
        state = step(state, 0.0, 0.0, h)
        phi = np.arctanh(v / speed) + robot.offset * ratio**2 * speed * k * h
        assert state.v == pytest.approx(speed * np.tanh(phi), abs=1e-8 * speed)
        assert state.omega == pytest.approx(np.sign(omega) * speed * ratio / np.cosh(phi), abs=1e-8 * speed * ratio)
        assert kinetic_energy(robot, state) == pytest.approx(start, rel=1e-9)
    assert state.v > 0.5 * speed


MOVING = [(1.0, 5.0, (0, 0)), (-0.7, 2.0, (1.5, -0.5)), (0.0, -3.0, (-1.0, 0.7))]


@pytest.mark.parametrize(("v", "omega", "torques"), MOVING)
def test_rigid_body_obeys_newton_and_euler(v, omega, torques):
    """An unknown sideways force λ holds the axle, d behind the mass; its lever arm is -d.  m p̈ = F e_v + λ e_n and
    I_c ω̇ = τ - d λ, so m p̈ · e_v = F and I_c ω̇ + d m p̈ · e_n = τ for any λ."""
    robot, h = robot_of("lab.toml", "rigid_body"), 1e-4
    step, d = make_step(robot), robot.offset
    states = [state_at(0.0, 0.0, 0.4, v, omega)]
    for _ in range(2):
        states.append(step(states[-1], *torques, h))
    x, y, theta, _, w = np.array(states)[:, :5].T
    p_ddot = np.array([x[0] - 2 * x[1] + x[2], y[0] - 2 * y[1] + y[2]]) / h**2
    e_v, e_n = np.array([np.cos(theta[1]), np.sin(theta[1])]), np.array([-np.sin(theta[1]), np.cos(theta[1])])
    push, turn = sum(torques) / robot.wheel_radius, robot.arm * (torques[0] - torques[1]) / robot.wheel_radius
    i_c = robot.inertia - robot.mass * d**2
    assert robot.mass * p_ddot @ e_v == pytest.approx(push, abs=1e-4)
    assert i_c * (w[2] - w[0]) / (2 * h) + d * robot.mass * p_ddot @ e_n == pytest.approx(turn, abs=1e-4)


def literal(robot: RobotPlan, theta: float, omega: float) -> tuple[Array, Array, Array]:
    """Returns A, B and C of label 801, written entry by entry."""
    m1, d, r, R = robot.mass, robot.offset, robot.wheel_radius, robot.arm
    J, s, c = robot.inertia - m1 * d**2, np.sin(theta), np.cos(theta)
    A = np.array([[-s * c * omega, -(s**2) * omega], [c**2 * omega, s * c * omega]])
    B = np.array(
        [
            [c / (m1 * r) - d * R * s / (J * r), c / (m1 * r) + d * R * s / (J * r)],
            [s / (m1 * r) + d * R * c / (J * r), s / (m1 * r) - d * R * c / (J * r)],
        ]
    )
    C = np.array([-d * omega**2 * c, -d * omega**2 * s])
    return A, B, C


def velocity(robot: RobotPlan, state: RobotState) -> Array:
    c, s = np.cos(state.theta), np.sin(state.theta)
    return state.v * np.array([c, s]) + robot.offset * state.omega * np.array([-s, c])


def test_paper_plant_is_the_equation_of_the_paper():
    """Along a step, p̈ from finite differences of ṗ is A ṗ + B u + C, and finite differences of p give ṗ."""
    robot, h = robot_of("lab.toml", "paper"), 1e-5
    step = make_step(robot)
    for theta, v, omega, torques in LAB:
        state = state_at(0.0, 0.0, theta, v, omega)
        after, before = step(state, *torques, h), step(state, *torques, -h)
        A, B, C = literal(robot, theta, omega)
        expected = A @ velocity(robot, state) + B @ torques + C
        p_ddot = (velocity(robot, after) - velocity(robot, before)) / (2 * h)
        np.testing.assert_allclose(p_ddot, expected, atol=1e-6 * (1 + np.abs(expected).max()))
        p_dot = (np.array(after[:2]) - np.array(before[:2])) / (2 * h)
        np.testing.assert_allclose(p_dot, velocity(robot, state), atol=1e-6)


@pytest.fixture(scope="module", params=list(PLANTS))
def lonely(request):
    """Returns a plan of a single robot with a given plant."""
    robot = {"model": request.param, "mass": 10.0, "inertia": 0.5, "wheel_radius": 0.1, "arm": 0.4, "offset": 0.2}
    random = np.random.default_rng(1)
    return plan_of(scenario((None,), random, robot=robot, periods={"acceleration": 1e-3, "torque": 1e-4}))


WILD = (0.0, 1.0, -1e3, 1e8, -1e16, 1e77, -1e154, 1e200, -1e308, inf, -inf, nan)


def test_no_state_and_no_command_raises(lonely):
    """A robot moves and sends its state whatever the numbers are.  When they overflow its state is LOST, and stays LOST."""
    robot = Robot(lonely, 0)
    say, move = robot.stages
    headings = [theta for theta in WILD if not isinf(theta)]  # no robot has an infinite heading: its step raises before
    for theta, v, omega, ax in product(headings, WILD, WILD, (0.0, -1e6, 1e120, 1e308, inf, nan)):
        robot.state = state_at(0.0, 0.0, theta, v, omega)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for _ in range(3):
                move.run(0, [Message(Channel.COMMAND, 1, 0, 0, np.array([ax, 1.0]))])
                (message,) = say.run(0, [])
        assert message.values.shape == (16,)
        if not all(np.isfinite((theta, v, omega))):
            assert not np.isfinite(message.values[2:7]).all()


def test_lost_robots_stay_lost(lonely):
    robot = Robot(lonely, 0)
    robot.state = LOST
    for command in (None, Message(Channel.COMMAND, 1, 0, 0, np.zeros(2))):
        robot.stages[1].run(0, [command])
        assert all(isnan(number) for number in robot.state)


DIVERGING = ["duration=1.0", "periods.torque=0.001"]


@pytest.mark.parametrize("model", PLANTS)
def test_a_diverging_run_ends_and_says_so(model):
    """Torque held for 1 ms at hundreds of rad/s diverges (docs/architecture.md, 2.10); the run still reaches its end, soon."""
    _, plan = load(PAPER, [*DIVERGING, f'robot.model="{model}"'])
    states: dict[int, Array] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = time.process_time()
        Engine(plan, lambda message: states.update({message.source: message.values})).run()
        spent = time.process_time() - began
    assert not all(np.isfinite(states[robot.index]).all() for robot in plan.robots)
    assert spent < 10.0
