"""The torque loop: its inverse against the plant, the order of its error with half a step of lead, and its limits."""

from dataclasses import replace
from itertools import pairwise, product
from math import cos, inf, nan, sin

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from echelon.agents.plant import RobotState, make_step, state_at
from echelon.agents.robot import Robot
from echelon.agents.torque import TorqueLimits, make_inverse
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Array, RobotPlan
from echelon.sim.parts.loading import load
from support.synthetic import PAPER
from support.trees import plan_of, scenario

FIELD = {name: at for at, name in enumerate(STATE_FIELDS)}
STATES = list(product((0.0, 1.1, -2.5), (-1.2, 0.0, 0.8), (-6.0, 0.0, 3.0)))
WANTED = [(0.0, 0.0), (1.0, -0.5), (-3.0, 2.0)]


@pytest.fixture(scope="module")
def lab() -> RobotPlan:
    return load(PAPER.parent / "lab.toml")[1].robots[0]


def velocity(robot: RobotPlan, state: RobotState) -> Array:
    theta, v, omega = state[2:5]
    d = robot.offset
    return np.array([v * cos(theta) - d * omega * sin(theta), v * sin(theta) + d * omega * cos(theta)])


def test_wanted_acceleration_is_what_the_plant_does(lab):
    inverse, step, h = make_inverse(lab), make_step(lab), 1e-5
    for (theta, v, omega), wanted in product(STATES, WANTED):
        state = state_at(1.0, 2.0, theta, v, omega)
        torques = inverse(state, *wanted, 0.0)
        after, before = step(state, *torques, h), step(state, *torques, -h)
        found = (velocity(lab, after) - velocity(lab, before)) / (2 * h)
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_wanted_acceleration_with_the_point_behind_the_axle(lab):
    behind = replace(lab, offset=-lab.offset)
    inverse, step, h = make_inverse(behind), make_step(behind), 1e-5
    state = state_at(0.0, 0.0, 0.4, 0.5, -1.0)
    torques = inverse(state, 1.0, -2.0, 0.0)
    found = (velocity(behind, step(state, *torques, h)) - velocity(behind, step(state, *torques, -h))) / (2 * h)
    np.testing.assert_allclose(found, (1.0, -2.0), atol=1e-6)


def drift(robot: RobotPlan, h: float, lead: float) -> float:
    """Returns the difference between ṗ after 0.2 s of one acceleration and its value under continuous torque [m/s]."""
    inverse, step, wanted = make_inverse(robot), make_step(robot), np.array([1.5, -2.0])
    state = state_at(0.0, 0.0, 1.2, 0.6, 2.0)
    start = velocity(robot, state)
    for _ in range(round(0.2 / h)):
        state = step(state, *inverse(state, *wanted, lead * h), h)
    return float(np.hypot(*(velocity(robot, state) - start - 0.2 * wanted)))


def test_half_a_step_of_lead_takes_away_the_first_order_error(lab):
    """The error of held torque is of first order in h without lead, and of second order with half a step of lead."""
    steps = [0.02, 0.01, 0.005, 0.0025, 0.00125]
    without, with_half = ([drift(lab, h, lead) for h in steps] for lead in (0.0, 0.5))
    orders = [np.log2(coarse / fine) for coarse, fine in pairwise(without)]
    orders_half = [np.log2(coarse / fine) for coarse, fine in pairwise(with_half)]
    assert orders[-1] == pytest.approx(1.0, abs=0.15)
    assert orders_half[-1] == pytest.approx(2.0, abs=0.2)
    assert with_half[1] < without[1] / 10


def test_lead_looks_at_the_robot_as_it_will_be(lab):
    """Torque with a lead equals torque without lead for the state that continuous torque reaches after the lead, up to
    O(lead²)."""

    def ideal(_, s):
        _, _, theta, v, omega = s
        c, sn, d = cos(theta), sin(theta), lab.offset
        return [
            v * c - d * omega * sn, v * sn + d * omega * c, omega,
            c * 2.0 + sn * -1.0 + d * omega**2, (c * -1.0 - sn * 2.0 - v * omega) / d,
        ]  # fmt: skip

    state, inverse = state_at(0.0, 0.0, 0.7, 0.9, -2.0), make_inverse(lab)
    errors = []
    for lead in (4e-3, 2e-3, 1e-3):
        later = solve_ivp(ideal, (0, lead), state[:5], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        then = inverse(state_at(*later.tolist()), 2.0, -1.0, 0.0)
        errors.append(np.abs(np.subtract(inverse(state, 2.0, -1.0, lead), then)).max())
    assert [errors[0] / errors[1], errors[1] / errors[2]] == pytest.approx([4, 4], rel=0.2)


def drives(torque=inf, rate=inf, speed=inf) -> TorqueLimits:
    return TorqueLimits(torque, rate, speed, wheel_radius=0.05, arm=0.15)


def test_the_magnitude_is_limited_for_each_wheel():
    limits = drives(torque=1.5)
    assert limits.apply(1.5, -1.5, 0.0, 0.0, 0.01) == (1.5, -1.5, False)
    assert limits.apply(1.6, 0.3, 0.0, 0.0, 0.01) == (1.5, 0.3, True)
    assert limits.apply(0.2, -9.0, 0.0, 0.0, 0.01) == (0.2, -1.5, True)
    assert limits.apply(inf, -inf, 0.0, 0.0, 0.01) == (1.5, -1.5, True)


def test_the_change_is_limited_from_the_last_limited_torque():
    limits = drives(rate=100.0)  # 1 N m in 10 ms
    assert limits.apply(2.5, 0.5, 0.0, 0.0, 0.01) == (1.0, 0.5, True)
    assert limits.apply(2.5, 0.5, 0.0, 0.0, 0.01) == (2.0, 0.5, True)
    assert limits.apply(2.5, 0.5, 0.0, 0.0, 0.01) == (2.5, 0.5, False)
    assert limits.apply(-2.5, 0.5, 0.0, 0.0, 0.01) == (1.5, 0.5, True)
    assert limits.apply(1.0, 0.0, 0.0, 0.0, 0.005) == (1.0, 0.0, False)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wheel_beyond_its_speed_limit_can_only_be_braked(sign):
    limits = drives(speed=40.0)  # 2 m/s at the rim
    assert limits.apply(sign, sign, sign * 1.99, 0.0, 0.01) == (sign, sign, False)
    assert limits.apply(sign, sign, sign * 2.01, 0.0, 0.01) == (0.0, 0.0, True)
    assert limits.apply(-sign, -sign, sign * 2.01, 0.0, 0.01) == (-sign, -sign, False)
    # Right wheel (v + R ω)/r, left wheel (v - R ω)/r: turning alone makes one fast forwards, the other backwards.
    assert limits.apply(sign, sign, 0.0, sign * 14.0, 0.01) == (0.0, sign, True)
    assert limits.apply(-sign, -sign, 0.0, sign * 14.0, 0.01) == (-sign, 0.0, True)
    assert limits.apply(sign, sign, sign * 1.0, sign * 7.0, 0.01) == (0.0, sign, True)


def test_nan_becomes_zero():
    limits = drives(torque=1.5)
    assert limits.apply(nan, 1.0, 0.0, 0.0, 0.01) == (0.0, 1.0, True)
    assert limits.apply(1.0, nan, nan, nan, 0.01) == (1.0, 0.0, True)
    assert (limits.tau_right, limits.tau_left) == (1.0, 0.0)
    for _ in range(2):  # twice, because NaN must not stay in the state of the limits
        right, left, limited = limits.apply(0.5, 0.5, 0.0, 0.0, 0.01)
    assert (right, left, limited) == (0.5, 0.5, False)


def test_limits_hold_for_any_wanted_torques():
    random, h = np.random.default_rng(5), 0.01
    limits = drives(torque=1.5, rate=100.0, speed=40.0)
    last = np.zeros(2)
    for _ in range(3000):
        wanted = random.normal(size=2, scale=2.0)
        v, omega = random.normal(size=2, scale=(1.5, 6.0))
        right, left, limited = limits.apply(*wanted.tolist(), v, omega, h)
        given = np.array([right, left])
        speed = np.array([v + 0.15 * omega, v - 0.15 * omega]) / 0.05
        assert (np.abs(given) <= 1.5).all()
        cut = (np.abs(speed) > 40) & (given == 0)  # a wheel beyond its speed limit may drop to zero at once
        assert (cut | (np.abs(given - last) <= 1.0 + 1e-12)).all()
        assert not ((np.abs(speed) > 40) & (given * speed > 0)).any()
        assert limited == bool((given != wanted).any())
        last = given


def counted(inner_period: float, commands: list[tuple[float, float]], **limits: float) -> tuple[Array, RobotPlan]:
    """Returns the states that a robot sends at the end of each 10 ms, one for each command, (T, fields)."""
    base = {"mass": 4.0, "inertia": 0.12, "wheel_radius": 0.05, "arm": 0.15, "offset": 0.1}
    plan = plan_of(
        scenario((None,), np.random.default_rng(1), duration=0.01, robot=base | limits,
                 periods={"acceleration": 0.01, "torque": inner_period})
    )  # fmt: skip
    robot = Robot(plan, 0)
    robot.state = state_at(0.0, 0.0, 0.0, 0.0, 0.0)
    said = []
    for number, command in enumerate(commands):
        now = number * 10_000_000
        robot.stages[1].run(now, [Message(Channel.COMMAND, 1, number, now, np.array(command))])
        (message,) = robot.stages[0].run(now + 10_000_000, [])
        said.append(message.values)
    return np.array(said), plan.robots[0]


def test_saturated_inner_periods_are_counted_exactly():
    """Straight ahead from rest, each wheel needs m r a/2.  At 100 N m/s it gets there in steps of 0.1 N m."""
    said, robot = counted(0.001, [(9.5, 0.0), (9.5, 0.0), (3.0, 0.0)], torque_rate_limit=100.0)
    wanted = robot.mass * robot.wheel_radius * 9.5 / 2
    assert wanted == pytest.approx(0.95)
    expected = np.minimum(0.1 * np.arange(1, 11), 0.95)
    assert said[0, FIELD["saturated"]] == 9  # 0.1 to 0.9 are limited, the tenth step reaches 0.95
    assert said[0, FIELD["tau_right"]] == pytest.approx(expected.mean())
    assert said[0, FIELD["tau_left"]] == pytest.approx(expected.mean())
    assert said[0, FIELD["tau_right_square"]] == pytest.approx((expected**2).mean())
    assert said[0, FIELD["tau_left_peak"]] == pytest.approx(0.95)
    assert said[1, FIELD["saturated"]] == 0
    assert said[2, FIELD["saturated"]] == 6  # from 0.95 to 0.3: 0.85 to 0.35 are limited, the seventh step reaches 0.3
    np.testing.assert_allclose(said[:, [FIELD["ax"], FIELD["ay"]]], [(9.5, 0), (9.5, 0), (3, 0)])
    # v = ∫ 2 τ/(m r) dt of the limited torques
    assert said[0, FIELD["v"]] == pytest.approx(2 * expected.sum() * 0.001 / (robot.mass * robot.wheel_radius))


def test_nothing_is_counted_within_the_limits():
    said, _ = counted(0.002, [(1.0, 0.5)] * 4, torque_limit=1.5, torque_rate_limit=1e4, wheel_speed_limit=40.0)
    np.testing.assert_array_equal(said[:, FIELD["saturated"]], 0)
    free, _ = counted(0.002, [(1.0, 0.5)] * 4)
    np.testing.assert_array_equal(said, free)


def test_every_inner_period_counts_once_however_many_limits_it_hits():
    said, _ = counted(0.001, [(1e4, 0.0)], torque_limit=0.5, torque_rate_limit=1.0)
    assert said[0, FIELD["saturated"]] == 10
    assert said[0, FIELD["tau_right_peak"]] == pytest.approx(0.01)
