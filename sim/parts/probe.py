"""A trial of the users' parts of a plan before a run, so that a failure is reported as a mistake in the scenario.

Each part is called as in a run: a trajectory at instants of the run; a law for each block, with the errors at the start and
with zero errors; a plant for each robot, at rest and moving.  The results are checked as in a run.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeVar

import numpy as np

from echelon.agents.plant import make_step, state_at
from echelon.controller.laws.law import Block, law_block, make_nu, make_state, make_weight
from echelon.controller.trajectory import Desired, make_trajectory
from echelon.controller.transformation import Transformation
from echelon.errors import PartRunError
from echelon.plan.plan import Array, Plan, RobotPlan
from echelon.plugins import Part
from echelon.sim.parts.time_limit import no_longer

PATIENCE_S: Final = 2.0
"""Time limit of one call [s]"""
INSTANTS: Final = 100
"""Number of instants, spread over the run, at which a trajectory is tried; fewer if they take longer than `INSTANTS_S`"""
INSTANTS_S: Final = 0.5
"""Time limit for trying a trajectory at its instants [s]; the comparison of its derivatives has as much again"""
SLOPES: Final = 25
"""Number of instants at which the derivatives of a trajectory are compared with its differences"""
SLOPE_STEPS_S: Final = (1e-3, 1e-2, 1e-1)
"""Differences use values up to one of these times before and after an instant [s]; long ones even out the steps of a table"""
SLOPE_TOLERANCE: Final = 0.005
"""Largest difference that is allowed, as a fraction of the derivative's largest value; `SLOPE_FLOORS` is added to it"""
SLOPE_FLOORS: Final = np.array([[1e-4], [1e-3]])
"""Difference that is always allowed [m/s for velocities, m/s² for accelerations]"""
SLOPE_TRUST: Final = 0.05
"""Differences over half a step and over the whole step may differ by this fraction of the derivative's largest value; if they
differ by more, a step longer than the first is too long for the path"""
_T = TypeVar("_T")


def probe(plan: Plan) -> None:
    """Tries the users' parts of a plan.

    Raises PartRunError, which names file and class, if a part raises, returns a wrong shape, or takes longer than
    `PATIENCE_S`."""
    if not plan.trajectory.is_own:
        _probe_trajectory(plan)
    if not plan.law.is_own:
        _probe_law(plan)
    for robot in plan.robots:
        if not robot.model.is_own:
            _probe_plant(robot)


def _asked(who: str, ask: Callable[[], _T]) -> _T:
    with no_longer(PATIENCE_S, PartRunError(f"{who} takes longer than {PATIENCE_S:g} s")):
        return ask()


def _probe_trajectory(plan: Plan) -> None:
    trajectory = make_trajectory(plan.trajectory)
    end_s, begun_s = plan.duration_ns / 1e9, time.monotonic()
    for number, t in enumerate([0.0, end_s, *np.linspace(0.0, end_s, INSTANTS).tolist()]):
        if number > 1 and time.monotonic() - begun_s > INSTANTS_S:
            break
        _asked(f"{plan.trajectory.use}: at({t:g})", partial(trajectory.at, t))
    _probe_slopes(plan.trajectory.use, trajectory, end_s)


def _probe_slopes(use: str, trajectory: Desired, end_s: float) -> None:
    """Compares velocity and acceleration with differences of position and velocity, over a short step and over longer ones.

    Raises PartRunError if they differ at half of the instants or more, whatever the step is; at a few instants a correct path
    may differ, too, since it may have corners there."""

    def ask(t: float) -> Array:
        return _asked(f"{use}: at({t:g})", partial(trajectory.at, t))

    begun_s = time.monotonic()
    times = [(number + 0.382) / SLOPES * end_s for number in range(SLOPES)]  # between round numbers, where corners are
    given, found = [], []
    for number, t in enumerate(times):
        if number and time.monotonic() - begun_s > INSTANTS_S:
            break
        given.append(ask(t)[1:] + 0.0)  # turns -0.0 into 0.0 for the message
        found.append(_slopes(ask, t, min(SLOPE_STEPS_S[0], end_s / 100))[0])
    largest = np.abs(given).max(axis=(0, 2))[:, np.newaxis]
    bound = SLOPE_FLOORS + SLOPE_TOLERANCE * largest
    wrong = np.abs(np.array(given) - found)  # (instants, 2, 2): velocity and acceleration, x and y
    for step_s in SLOPE_STEPS_S[1:]:
        at_fault = np.flatnonzero((wrong > bound).any(axis=(1, 2)))
        if 2 * len(at_fault) < len(given):
            return
        for number in at_fault.tolist():
            if time.monotonic() - begun_s > 2 * INSTANTS_S:
                break
            slopes, doubt = _slopes(ask, times[number], min(step_s, end_s / 100))
            missed = np.where(doubt > SLOPE_FLOORS + SLOPE_TRUST * largest, np.inf, np.abs(given[number] - slopes))
            wrong[number] = np.minimum(wrong[number], missed)
    too_far = wrong > bound
    for row, (what, of, unit) in enumerate((("velocity", "position", "m/s"), ("acceleration", "velocity", "m/s²"))):
        instants = np.flatnonzero(too_far[:, row].any(axis=1))
        if 2 * len(instants) >= len(given):
            at = instants[0]
            axis = int(wrong[at, row].argmax())
            raise PartRunError(
                f"{use}: at t = {times[at]:.3g} s: {what} is not the derivative of {of} "
                f"(in {'xy'[axis]} {given[at][row, axis]:.3g} against {found[at][row, axis]:.3g} {unit})"
            )


def _slopes(ask: Callable[[float], Array], t: float, step_s: float) -> tuple[Array, Array]:
    """Returns the derivatives of position and velocity at `t`, (2, 2), of the fourth order in the step, and by how much
    differences over half the step and over the whole step differ."""
    whole, half = ((ask(t + h) - ask(t - h))[:2] / (2 * h) for h in (step_s, step_s / 2))
    return (4 * half - whole) / 3, np.abs(half - whole)


def _probe_law(plan: Plan) -> None:
    cbt = Transformation(plan)
    z_cd = make_trajectory(plan.trajectory).at(0.0)
    errors = (cbt.forward(np.array([robot.start for robot in plan.robots])) - cbt.desired(z_cd[0])).ravel()
    rates, feed_forward = np.zeros((2, len(errors)))
    rates[-2:], feed_forward[-2:] = -z_cd[1], z_cd[2]
    for given in (errors, rates, feed_forward):
        given.flags.writeable = False
    for block in plan.blocks:
        if block.size:
            rows = slice(block.offset, block.offset + block.size)
            ask = partial(_ask_law, plan.law, law_block(plan, block), errors[rows], rates[rows], feed_forward[rows])
            _asked(f"{plan.law.use} of block {block.name}: nu", ask)


def _ask_law(law: Part[Any], block: Block, e: Array, e_dot: Array, feed_forward: Array) -> None:
    nu, state = make_nu(law, block), make_state(law, block)
    make_weight(law, block)
    nu(0.0, e, e_dot, feed_forward, state)
    nothing = np.zeros(block.size)
    nothing.flags.writeable = False
    nu(block.period_s, nothing, nothing, feed_forward, state)


def _probe_plant(robot: RobotPlan) -> None:
    h = robot.torque_period_ns * 1e-9
    who = f"{robot.model.use} of {robot.name}"
    step = _asked(f"{who}: step_of", partial(make_step, robot))
    torque = 0.1 * robot.mass * robot.wheel_radius  # for 0.2 m/s²
    for v, omega in ((0.0, 0.0), (0.3, -0.2)):
        state = state_at(*robot.start, robot.heading, v, omega)
        _asked(f"{who}: step", partial(step, state, torque, torque / 2, h))
