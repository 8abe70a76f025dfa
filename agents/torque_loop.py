"""The usual torque loop: many torque periods of a robot of the paper's plant in one call, in plain arithmetic.

It gives what inverse, limits and step (`agents.torque`, `agents.plant`) give one after the other, to the last bit.  It stops
before a torque period in which a limit may act or the robot turns fast; that period and the rest of the call are left to the
three of them.  The source runs as Python, and compiled in long runs as processes (`sim.batch.torque_loop`).
"""

from collections.abc import Callable
from math import cos, sin

from echelon.agents.plant import FAST_TURN, INNER, Paper
from echelon.plan.plan import RobotPlan

Numbers = tuple[float, ...]


Last = tuple[float, float, float]
Sums = tuple[float, float, float, float, float, float]
Loop = Callable[[int, Numbers, Numbers, Last, Numbers], tuple[int, Numbers, Last, Sums]]
"""(number of torque periods, state, command, last torques, constants) → (number of those passed, state, last torques, sums).

State: as in `RobotState`.  Command: (a_x, a_y, 1), or zeros if there is none.  Last torques: right and left wheel, and how long
they have been held [s].  Sums, right wheel first: of both torques the sums, the sums of squares and the largest magnitudes"""


def constants(robot: RobotPlan) -> Numbers | None:
    """Returns the constants of a robot's loop; None if it has another plant."""
    if type(robot.model.made) is not Paper:
        return None
    m, d, r, arm, h = robot.mass, robot.offset, robot.wheel_radius, robot.arm, robot.torque_period_ns * 1e-9
    return (
        h,
        d,
        m * r / 2,
        (robot.inertia - m * d * d) * r / (d * arm) / 2,
        1 / (m * r),
        arm / ((robot.inertia - m * d**2) * r),
        arm,
        robot.torque_limit,
        robot.torque_rate_limit,
        robot.wheel_speed_limit * r,
    )


def usual(
    count: int, state: Numbers, command: Numbers, last: Last, numbers: Numbers
) -> tuple[int, Numbers, Last, Sums]:
    """Passes up to `count` torque periods; the types are explained at `Loop`."""
    x, y, theta, v, omega, c_0, s_0 = state
    ax, ay, commanded = command
    last_right, last_left, held = last
    h, d, half_sum, half_difference, per_sum, per_difference, arm, limit, rate, speed = numbers
    lead, t_1, t_2, ends, inner = 0.5 * h, INNER * h, (1 - INNER) * h, h / 12, 5 * h / 12
    right_sum = left_sum = right_square = left_square = right_peak = left_peak = 0.0
    done = 0
    while done < count:
        right, left, change = 0.0, 0.0, rate * held
        if commanded != 0.0:  # the inverse
            v_dot = c_0 * ax + s_0 * ay + d * omega * omega
            omega_dot = (c_0 * ay - s_0 * ax - v * omega) / d
            ahead = theta + lead * (omega + 0.5 * lead * omega_dot)
            v_ahead = v + lead * v_dot
            omega_ahead = omega + lead * omega_dot
            c, s = cos(ahead), sin(ahead)
            total = half_sum * (c * ax + s * ay + d * omega_ahead * omega_ahead)
            difference = half_difference * (c * ay - s * ax - v_ahead * omega_ahead)
            right, left = total + difference, total - difference
        if not (
            -limit <= right <= limit
            and -limit <= left <= limit
            and -change <= right - last_right <= change
            and -change <= left - last_left <= change
            and abs(v) + arm * abs(omega) <= speed
        ):
            break
        v_dot = (right + left) * per_sum  # the step
        omega_dot = (right - left) * per_difference
        if not h * (abs(omega) + abs(omega_dot) * h) <= FAST_TURN:
            break
        half = 0.5 * omega_dot
        theta_1, v_1 = theta + h * (omega + half * h), v + v_dot * h
        c_1, s_1 = cos(theta_1), sin(theta_1)
        a_1, a_2 = theta + t_1 * (omega + half * t_1), theta + t_2 * (omega + half * t_2)
        v_i, v_j = v + v_dot * t_1, v + v_dot * t_2
        x += d * (c_1 - c_0)
        y += d * (s_1 - s_0)
        x += ends * (v * c_0 + v_1 * c_1) + inner * (v_i * cos(a_1) + v_j * cos(a_2))
        y += ends * (v * s_0 + v_1 * s_1) + inner * (v_i * sin(a_1) + v_j * sin(a_2))
        theta, v, omega, c_0, s_0 = theta_1, v_1, omega + omega_dot * h, c_1, s_1
        right_sum += right
        left_sum += left
        right_square += right * right
        left_square += left * left
        right_peak = max(right_peak, abs(right))
        left_peak = max(left_peak, abs(left))
        last_right, last_left, held = right, left, h
        done += 1
    return (
        done,
        (x, y, theta, v, omega, c_0, s_0),
        (last_right, last_left, held),
        (right_sum, left_sum, right_square, left_square, right_peak, left_peak),
    )
