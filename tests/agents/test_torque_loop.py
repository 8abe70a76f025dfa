"""The usual torque loop is inverse, limits and step one after the other, to the last bit; compiled or not."""

import importlib
from dataclasses import replace
from functools import reduce
from math import inf
from operator import add

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.agents.plant import make_step, state_at
from echelon.agents.torque import TorqueLimits, make_inverse
from echelon.agents.torque_loop import constants, usual
from echelon.sim.batch import torque_loop as compiled
from support.runs import plan_of

PAPER = plan_of("paper").robots[0]
LIMITED = replace(PAPER, torque_limit=40.0, torque_rate_limit=2e4, wheel_speed_limit=80.0)
COUNT = 10
number = st.floats(-30.0, 30.0)


@pytest.mark.parametrize("loop", [usual, compiled.usual], ids=["python", "compiled"])
@pytest.mark.parametrize("robot", [PAPER, LIMITED], ids=["free", "limited"])
@given(
    state=st.tuples(number, number, number, number, st.floats(-3000.0, 3000.0)),
    command=st.none() | st.tuples(number, number),
    last=st.tuples(number, number, st.sampled_from([1e-4, 3e-5])),
)
def test_the_loop_is_inverse_limits_and_step_to_the_last_bit(loop, robot, state, command, last):
    h, inverse, step = robot.torque_period_ns * 1e-9, make_inverse(robot), make_step(robot)
    limits = TorqueLimits(
        robot.torque_limit, robot.torque_rate_limit, robot.wheel_speed_limit, robot.wheel_radius, robot.arm, *last[:2]
    )
    begun = expected = state_at(*state)
    torques, held, stopped = [], last[2], False
    for _ in range(COUNT):
        right, left = inverse(expected, *command, 0.5 * h) if command else (0.0, 0.0)
        right, left, limited = limits.apply(right, left, expected.v, expected.omega, held)
        limited |= abs(expected.v) + robot.arm * abs(expected.omega) > robot.wheel_speed_limit * robot.wheel_radius
        omega_dot = (right - left) * robot.arm / ((robot.inertia - robot.mass * robot.offset**2) * robot.wheel_radius)
        if stopped := limited or h * (abs(expected.omega) + abs(omega_dot) * h) > 0.5:
            break
        expected, held = step(expected, right, left, h), h
        torques.append((right, left))
    given_command = (*command, 1.0) if command else (0.0, 0.0, 0.0)
    passed, after, after_last, sums = loop(COUNT, begun, given_command, last, constants(robot))
    assert passed == len(torques)
    assert (passed < COUNT) is stopped
    assert after == expected
    assert after_last == ((*torques[-1], h) if torques else last)
    right, left = zip(*torques, strict=True) if torques else ((), ())
    assert sums == (
        *(reduce(add, each, 0.0) for each in (right, left, [tau * tau for tau in right], [tau * tau for tau in left])),
        max(map(abs, right), default=0.0), max(map(abs, left), default=0.0),
    )  # fmt: skip


def test_where_it_cannot_be_compiled_the_import_fails(monkeypatch):
    """So the fork server goes on without it, and the robots run the loop as Python."""

    def broken(function):
        raise RuntimeError("no place for compiled code")

    monkeypatch.setattr("echelon.sim.batch.compiled.compiled", broken)
    with pytest.raises(ImportError, match="no place for compiled code"):
        importlib.reload(compiled)


def test_other_plants_have_no_usual_loop():
    assert constants(PAPER) is not None
    assert constants(plan_of("paper", 'robot.model="rigid_body"').robots[0]) is None
    assert PAPER.torque_limit == inf
