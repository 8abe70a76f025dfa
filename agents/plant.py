"""Plants: the motion of a robot under held wheel torques (label 801; docs/architecture.md, 2.1 and 2.2).

The state is the reference point p = (x, y), the heading θ, the forward speed v and the yaw rate ω.  With e_v = (cos θ, sin θ)
and e_n = (-sin θ, cos θ),

    ṗ = v e_v + d ω e_n

*Paper*: v̇ = (τ_r + τ_l)/(m1 r), ω̇ = R (τ_r - τ_l)/(J r), J = I - m1 d².
*Rigid body*, with its mass at the reference point: v̇ = F/m1 + d ω², ω̇ = (τ - m1 d v ω)/(I_c + m1 d²), where
F = (τ_r + τ_l)/r, τ = R (τ_r - τ_l)/r, I_c = I - m1 d².
*Hill*: the rigid body with a load, on a slope, with rolling resistance.  The controller does not know these.

If numbers overflow, a step raises ValueError or OverflowError, as the functions of `math` do; the robot then has the state
`LOST`.

Steps are pure functions of floats.  They run in the torque loop, thousands of times per second of run time, so they are written
with floats and not with arrays.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from math import ceil, cos, hypot, isfinite, nan, sin, sqrt
from typing import Final, NamedTuple

from echelon.errors import PartRunError
from echelon.parameters import NonNegative, Point
from echelon.plan.plan import RobotPlan
from echelon.plugins import PART_ERRORS, Plugin

GRAVITY: Final = 9.81
"""Acceleration of gravity [m/s²]"""
INNER: Final = (1 - sqrt(1 / 5)) / 2
"""Inner points of the Gauss-Lobatto rule with four points on [0, 1]: `INNER` and 1 - `INNER`.  Its weights are 1/12, 5/12,
5/12, 1/12.  It is exact up to degree 5, and its two outer points are the ends, where cos θ and sin θ are needed anyway."""
FAST_TURN: Final = 0.5
"""With a turn of more than this [rad] a step of the paper's plant is divided into panels"""


class RobotState(NamedTuple):
    """Position of the reference point [m], heading [rad], forward speed [m/s], yaw rate [rad/s], and e_v = (cos θ, sin θ).
    `state_at` makes it.

    This is a named tuple because it is made ten thousand times per second of run time: it takes a tenth of the time of a
    frozen dataclass.
    """

    x: float
    y: float
    theta: float
    v: float
    omega: float
    cos_theta: float
    sin_theta: float


def state_at(x: float, y: float, theta: float, v: float, omega: float) -> RobotState:
    """Returns the state with these coordinates.  Raises ValueError for an infinite heading."""
    return RobotState(x, y, theta, v, omega, cos(theta), sin(theta))


Step = Callable[[RobotState, float, float, float], RobotState]
"""(state, τ_right [N m], τ_left [N m], h [s]) → state after h under held torques"""


def paper_step(robot: RobotPlan) -> Step:
    """Returns the step of the paper's plant (docs/architecture.md, 2.1).

    v and ω are linear in time, θ is quadratic.  The part of ṗ along e_n integrates to d (e_v(t1) - e_v(t0)) exactly; only
    v e_v needs a quadrature."""
    per_sum = 1 / (robot.mass * robot.wheel_radius)
    per_difference = robot.arm / ((robot.inertia - robot.mass * robot.offset**2) * robot.wheel_radius)
    d = robot.offset

    def step(state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        x, y, theta, v, omega, c_0, s_0 = state
        v_dot = (tau_right + tau_left) * per_sum
        omega_dot = (tau_right - tau_left) * per_difference
        half = 0.5 * omega_dot
        theta_1, v_1 = theta + h * (omega + half * h), v + v_dot * h
        c_1, s_1 = cos(theta_1), sin(theta_1)
        x += d * (c_1 - c_0)
        y += d * (s_1 - s_0)
        turn = h * (abs(omega) + abs(omega_dot) * h)
        if turn <= FAST_TURN:
            t_1, t_2 = INNER * h, (1 - INNER) * h
            a_1, a_2 = theta + t_1 * (omega + half * t_1), theta + t_2 * (omega + half * t_2)
            v_i, v_j = v + v_dot * t_1, v + v_dot * t_2
            ends, inner = h / 12, 5 * h / 12
            x += ends * (v * c_0 + v_1 * c_1) + inner * (v_i * cos(a_1) + v_j * cos(a_2))
            y += ends * (v * s_0 + v_1 * s_1) + inner * (v_i * sin(a_1) + v_j * sin(a_2))
        else:  # a fast turn: divide the step into panels of half a radian, at most 16
            panels = min(ceil(2 * turn), 16) if isfinite(turn) else 1
            width = h / panels
            ends, inner = width / 12, 5 * width / 12
            for panel in range(panels):
                for weight, node in ((ends, 0.0), (inner, INNER), (inner, 1 - INNER), (ends, 1.0)):
                    t = (panel + node) * width
                    along = weight * (v + v_dot * t)
                    angle = theta + t * (omega + half * t)
                    x += along * cos(angle)
                    y += along * sin(angle)
        return RobotState(x, y, theta_1, v_1, omega + omega_dot * h, c_1, s_1)

    return step


def rigid_body_step(robot: RobotPlan) -> Step:
    """Returns the step of the rigid body (docs/architecture.md, 2.2)."""
    return _body_step(robot, 0.0, (0.0, 0.0), 0.0)


def _body_step(robot: RobotPlan, load: float, pull: tuple[float, float], resistance: float) -> Step:
    """Returns the step of a rigid body that carries `load` [kg] at its reference point.  The acceleration `pull` [m/s²] acts on
    all mass there, `resistance` [N s/m] on the wheels.

    v and ω have no closed form under held torque.  So the five equations are integrated with the classical Runge-Kutta rule.
    The number of sub-steps grows with the turn in the step, so that the error stays near rounding."""
    m, d, r, arm = robot.mass + load, robot.offset, robot.wheel_radius, robot.arm
    inertia = robot.inertia + load * d**2  # I_c + m d²
    lever = m * d / inertia
    pull_x, pull_y = pull
    drag, turn_drag = resistance / m, resistance * arm**2 / inertia
    always = drag + turn_drag + sqrt(lever * hypot(*pull))

    def rates(theta: float, v: float, omega: float, push: float, turn: float) -> tuple[float, ...]:
        c, s = cos(theta), sin(theta)
        return (
            v * c - d * omega * s,
            v * s + d * omega * c,
            omega,
            push + d * omega * omega + (pull_x * c + pull_y * s) - drag * v,
            turn - lever * (v * omega - (pull_y * c - pull_x * s)) - turn_drag * omega,
        )

    def step(state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        push = (tau_right + tau_left) / (m * r)
        turn = arm * (tau_right - tau_left) / (r * inertia)
        x, y, theta, v, omega, _, _ = state
        pace = h * (abs(omega) + lever * abs(v) + sqrt(abs(turn)) + sqrt(lever * abs(push)) + always)
        count = min(max(1, ceil(pace / 0.02)), 500) if isfinite(pace) else 1
        k = h / count
        for _ in range(count):
            a = rates(theta, v, omega, push, turn)
            b = rates(theta + 0.5 * k * a[2], v + 0.5 * k * a[3], omega + 0.5 * k * a[4], push, turn)
            c = rates(theta + 0.5 * k * b[2], v + 0.5 * k * b[3], omega + 0.5 * k * b[4], push, turn)
            e = rates(theta + k * c[2], v + k * c[3], omega + k * c[4], push, turn)
            sixth = k / 6
            x += sixth * (a[0] + 2 * (b[0] + c[0]) + e[0])
            y += sixth * (a[1] + 2 * (b[1] + c[1]) + e[1])
            theta += sixth * (a[2] + 2 * (b[2] + c[2]) + e[2])
            v += sixth * (a[3] + 2 * (b[3] + c[3]) + e[3])
            omega += sixth * (a[4] + 2 * (b[4] + c[4]) + e[4])
        return state_at(x, y, theta, v, omega)

    return step


class Plant(Plugin, ABC):
    """Base class of all plants.  The fields of a class are its parameters.

    A step is a pure function.  If numbers overflow it may raise ValueError or OverflowError, as the functions of `math` do;
    the robot then has the state `LOST`."""

    @abstractmethod
    def step(self, robot: RobotPlan, state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        """Returns the state after h [s] under held wheel torques [N m].  Use `state_at` to make it."""

    def step_of(self, robot: RobotPlan) -> Step:
        """Returns the step of one robot.  A class may override this to compute values once per robot."""
        return partial(self.step, robot)


class Paper(Plant):
    """The paper's equations."""

    def step(self, robot: RobotPlan, state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        """Returns the state after h [s] under held torques; exact but for the quadrature of v e_v."""
        return paper_step(robot)(state, tau_right, tau_left, h)

    def step_of(self, robot: RobotPlan) -> Step:
        """Returns the step of one robot."""
        return paper_step(robot)


class RigidBody(Plant):
    """A rigid body with its mass at the reference point."""

    def step(self, robot: RobotPlan, state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        """Returns the state after h of held torque."""
        return rigid_body_step(robot)(state, tau_right, tau_left, h)

    def step_of(self, robot: RobotPlan) -> Step:
        """Returns the step of one robot."""
        return rigid_body_step(robot)


class Hill(Plant):
    """A rigid body that carries a load, on a slope, with rolling resistance.

    With m = m1 + load, I' = I + load d², gravity along the slope g⃗ = -9.81 rise/√(1 + |rise|²), c = `resistance`, and F, τ, d,
    R of the robot,

        v̇ = (F - c v)/m + d ω² + g⃗·e_v,       ω̇ = (τ - c R² ω - m d (v ω - g⃗·e_n))/I'

    (Newton and Euler; the load is at the reference point, and each wheel has half of c).  x and y are along the slope."""

    rise: Point = (0.0, 0.0)
    """Slope of the ground along x and along y: 0.05 is five metres in a hundred"""
    load: NonNegative = 0.0
    """Mass of the load [kg]"""
    resistance: NonNegative = 0.0
    """c, rolling resistance: force per speed [N s/m]"""

    def step(self, robot: RobotPlan, state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        """Returns the state after h of held torque."""
        return self.step_of(robot)(state, tau_right, tau_left, h)

    def step_of(self, robot: RobotPlan) -> Step:
        """Returns the step of one robot."""
        steep = -GRAVITY / hypot(1.0, *self.rise)
        return _body_step(robot, self.load, (steep * self.rise[0], steep * self.rise[1]), self.resistance)


PLANTS: Final[dict[str, type[Plugin]]] = {"paper": Paper, "rigid_body": RigidBody, "hill": Hill}
"""The built-in plants by name"""

LOST: Final = RobotState(nan, nan, nan, nan, nan, nan, nan)
"""The state of a robot whose numbers overflowed"""
_HUGE: Final = 1e12
"""From this magnitude of its inputs on a plant that is not built in may fail: the run has diverged"""


def make_step(robot: RobotPlan) -> Step:
    """Returns the step of a robot's plant.  The answers of a plant that is not built in are checked.

    Raises PartRunError if `step_of` of the plant raises."""
    plant: Plant = robot.model.made
    if robot.model.is_own:
        return plant.step_of(robot)
    try:
        step = plant.step_of(robot)
    except PART_ERRORS as error:
        raise robot.model.raised(f" of {robot.name}", "step_of", error) from error
    return _checked(step, robot)


def _checked(step: Step, robot: RobotPlan) -> Step:
    """Returns a step with its answers checked: it raises PartRunError if `step` raises, or returns anything but a state of
    finite numbers.  In a run that has diverged (inputs from `_HUGE` on) the step may raise ValueError or OverflowError, or
    return numbers that are not finite."""

    who = f"{robot.model.use} of {robot.name}"

    def checked(state: RobotState, tau_right: float, tau_left: float, h: float) -> RobotState:
        given = (*state, tau_right, tau_left)
        diverged = not all(abs(number) < _HUGE for number in given)
        try:
            after = step(state, tau_right, tau_left, h)
        except PART_ERRORS as error:
            if diverged and isinstance(error, (ValueError, OverflowError)):
                raise
            raise robot.model.raised(f" of {robot.name}", "step", error) from error
        if not isinstance(after, RobotState):
            raise PartRunError(f"{who}: step must return a RobotState (state_at), not {after!r:.60}")
        if not diverged and not all(map(isfinite, after)):
            raise PartRunError(f"{who}: step is not finite: {after}")
        return after

    return checked
