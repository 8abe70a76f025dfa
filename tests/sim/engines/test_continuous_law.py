"""Runs against the law in continuous time: robots that are points under the central law without look-ahead, integrated by
`solve_ivp`.  What remains is the hold of accelerations and torques, of second order in their periods."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from echelon.controller.laws.central import CentralLaw
from echelon.plan.plan import Array, Plan
from echelon.sim.engines.in_process import Engine
from echelon.sim.results.trace import TraceBuilder
from support.runs import plan_of


def continuous(plan: Plan, seconds: Array) -> Array:
    """Returns the positions of points under the law in continuous time, (instants, robots, 2)."""
    law, count = CentralLaw(replace(plan, lead=0.0)), len(plan.robots)

    def motion(t: float, state: Array) -> Array:
        p, v = state.reshape(2, count, 2)
        return np.concatenate([v, law(t, p, v)]).ravel()

    start = np.concatenate([[robot.start for robot in plan.robots], np.zeros((count, 2))]).ravel()
    found = solve_ivp(motion, (0, seconds[-1]), start, "DOP853", seconds, rtol=1e-10, atol=1e-10)
    return found.y.T.reshape(len(seconds), 2, count, 2)[:, 0]


def difference(plan: Plan) -> float:
    """Returns the largest distance between a robot's position in a run and in continuous time [m]."""
    builder = TraceBuilder(plan)
    Engine(plan, builder.add).run()
    times_ns, states = builder.build().common()
    at = slice(None, None, 20)
    return float(np.linalg.norm(states[at, :, :2] - continuous(plan, times_ns[at] * 1e-9), axis=2).max())


WITHOUT_LIMITS = ("robot.torque_limit=inf", "robot.torque_rate_limit=inf", "robot.wheel_speed_limit=inf")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lab", "unequal"])
def test_with_half_a_period_of_look_ahead_a_run_is_the_continuous_law_to_second_order(name):
    """Away from limits of torque and speed, and from each other."""
    plan = plan_of(name, "duration=20", "avoidance.enabled=false", *WITHOUT_LIMITS)
    whole = difference(plan)
    T = plan.root.period_ns * 1e-9
    shorter = [f"periods={{acceleration={T / 2}, torque={plan.robots[0].torque_period_ns * 0.5e-9}}}"]
    half = difference(plan_of(name, "duration=20", "avoidance.enabled=false", *WITHOUT_LIMITS, *shorter))
    assert whole < 2e-5
    assert half < 0.3 * whole
