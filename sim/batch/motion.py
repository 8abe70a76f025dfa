"""How a robot moves: inverse, torque limits and plants (agents.torque and agents.plant, as arrays)."""

from math import ceil, isfinite, sqrt
from typing import Any, Final

from echelon.agents.plant import FAST_TURN, INNER
from echelon.sim.batch.angles import cos_sin, turned
from echelon.sim.batch.compiled import fused
from echelon.sim.batch.records import (
    COS,
    HELD_S,
    OMEGA,
    P_LEFT,
    P_PART,
    P_PEAK,
    P_RIGHT,
    P_SATURATED,
    PAPER,
    SIN,
    TAU_LEFT,
    TAU_RIGHT,
    THETA,
    V,
)

_ENDS: Final = 1 / 12
_MIDDLE: Final = 5 / 12
"""The weights of the Gauss-Lobatto rule with four points on [0, 1]; `INNER` and 1 less that are its inner points"""
State = tuple[float, float, float, float, float, float, float]
"""x, y, θ, v, ω, cos θ and sin θ"""


@fused
def move(robot: Any, real: Any, now_ns: int, until_ns: int, ax: float, ay: float, commanded: bool) -> None:
    """Runs torque loop and plant from one instant to another with an acceleration."""
    h_ns = robot.torque_period_ns
    if until_ns - now_ns == robot.period_ns:  # a whole period, which begins with a torque period
        _pass(robot, real, robot.torque_periods, ax, ay, commanded)
        return
    while now_ns < until_ns:
        left_ns, count = h_ns - now_ns % h_ns, (until_ns - now_ns) // h_ns
        if left_ns == h_ns and count > 0:
            _pass(robot, real, count, ax, ay, commanded)
            now_ns += count * h_ns
        else:  # an acceleration arrives within this torque period, or has arrived
            span_ns = min(left_ns, until_ns - now_ns)
            _pass_part(robot, real, span_ns * 1e-9, left_ns * 1e-9, left_ns == h_ns, ax, ay, commanded)
            now_ns += span_ns


@fused
def _pass(robot: Any, real: Any, count: int, ax: float, ay: float, commanded: bool) -> None:
    """Runs torque loop and plant through whole torque periods."""
    at, h = robot.at, robot.h
    x, y, theta, v, omega, c, s = _state(real, at, robot.place)
    last_right, last_left = real[at + TAU_RIGHT], real[at + TAU_LEFT]
    held_s = real[at + HELD_S] if robot.on_arrival else h
    right_square, left_square, peak = real[at + P_RIGHT], real[at + P_LEFT], real[at + P_PEAK]
    saturated = real[at + P_SATURATED]
    for _ in range(count):
        right = left = 0.0
        if commanded:
            right, left = inverse(robot, theta, v, omega, c, s, ax, ay, 0.5 * h)
        if robot.limited:
            right, left, acted = limits(robot, v, omega, last_right, last_left, held_s, right, left)
            last_right, last_left, held_s = right, left, h
            saturated += acted
        x, y, theta, v, omega, c, s = _step(robot, x, y, theta, v, omega, c, s, right, left, h)
        right_square += right * right
        left_square += left * left
        peak = max(peak, abs(right), abs(left))
    _keep(real, at, robot.place, x, y, theta, v, omega, c, s)
    if robot.limited:
        real[at + TAU_RIGHT], real[at + TAU_LEFT] = last_right, last_left
        real[at + P_SATURATED] = saturated
        if robot.on_arrival:
            real[at + HELD_S] = h
    real[at + P_RIGHT], real[at + P_LEFT], real[at + P_PEAK] = right_square, left_square, peak


@fused
def _pass_part(
    robot: Any, real: Any, span: float, left_s: float, first: bool, ax: float, ay: float, commanded: bool
) -> None:
    """Runs torque loop and plant through `span` [s] of a torque period of which `left_s` [s] are left; `first`: it begins
    now."""
    at = robot.at
    x, y, theta, v, omega, c, s = _state(real, at, robot.place)
    right = left = 0.0
    if commanded:
        right, left = inverse(robot, theta, v, omega, c, s, ax, ay, 0.5 * left_s)
    if first:
        real[at + P_PART] = 0.0
    if robot.limited:
        last_right, last_left, held_s = real[at + TAU_RIGHT], real[at + TAU_LEFT], real[at + HELD_S]
        right, left, acted = limits(robot, v, omega, last_right, last_left, held_s, right, left)
        real[at + TAU_RIGHT], real[at + TAU_LEFT] = right, left
        if acted > real[at + P_PART]:
            real[at + P_SATURATED] += 1.0
            real[at + P_PART] = 1.0
    real[at + HELD_S] = span
    x, y, theta, v, omega, c, s = _step(robot, x, y, theta, v, omega, c, s, right, left, span)
    _keep(real, at, robot.place, x, y, theta, v, omega, c, s)
    share = span / robot.h
    real[at + P_RIGHT] += share * right * right
    real[at + P_LEFT] += share * left * left
    real[at + P_PEAK] = max(real[at + P_PEAK], abs(right), abs(left))


@fused
def _state(real: Any, at: int, place: int) -> State:
    """Returns x, y, θ, v, ω, cos θ and sin θ of a robot.  They are read at once, and written at once (`_keep`): between, they
    need no memory."""
    return (
        real[place],
        real[place + 1],
        real[at + THETA],
        real[at + V],
        real[at + OMEGA],
        real[at + COS],
        real[at + SIN],
    )


@fused
def _keep(
    real: Any, at: int, place: int, x: float, y: float, theta: float, v: float, omega: float, c: float, s: float
) -> None:
    """Writes the state of a robot."""
    real[place], real[place + 1] = x, y
    real[at + THETA] = theta
    real[at + V] = v
    real[at + OMEGA] = omega
    real[at + COS] = c
    real[at + SIN] = s


@fused
def _step(
    robot: Any, x: float, y: float, theta: float, v: float, omega: float, c: float, s: float,
    right: float, left: float, span: float,
) -> State:  # fmt: skip
    """Moves a robot with torques through `span` [s]; returns its state then."""
    if robot.plant == PAPER:
        return paper_step(robot, x, y, theta, v, omega, c, s, right, left, span)
    return body_step(robot, x, y, theta, v, omega, c, s, right, left, span)


@fused
def limits(
    robot: Any, v: float, omega: float, last_right: float, last_left: float, held_s: float, right: float, left: float
) -> tuple[float, float, float]:
    """Returns the limited torques, and 1 if one was limited, else 0.  The torques before were held for `held_s` [s]."""
    turning = robot.arm * omega
    most, change = robot.torque_limit, robot.torque_rate_limit * held_s
    acted = 0.0
    if not (
        abs(right) <= most
        and abs(left) <= most
        and abs(right - last_right) <= change
        and abs(left - last_left) <= change
        and abs(v) + abs(turning) <= robot.speed_limit
    ):
        wanted_right, wanted_left = right, left
        right = _limited(robot, right, last_right, change, v + turning)
        left = _limited(robot, left, last_left, change, v - turning)
        if right != wanted_right or left != wanted_left:
            acted = 1.0
    return right, left, acted


@fused
def inverse(
    robot: Any, theta: float, v: float, omega: float, c: float, s: float, ax: float, ay: float, lead: float
) -> tuple[float, float]:
    """Returns the wheel torques for a wanted acceleration, for the state after `lead` [s]."""
    d = robot.offset
    v_dot = c * ax + s * ay + d * omega * omega
    omega_dot = (c * ay - s * ax - v * omega) * robot.per_offset
    c, s = turned(c, s, theta, lead * (omega + 0.5 * lead * omega_dot))
    v += lead * v_dot
    omega += lead * omega_dot
    total = robot.half_sum * (c * ax + s * ay + d * omega * omega)
    difference = robot.half_difference * (c * ay - s * ax - v * omega)
    return total + difference, total - difference


@fused
def _limited(robot: Any, wanted: float, last: float, change: float, speed: float) -> float:
    """Returns the limited torque of one wheel, whose torque was `last` and changes by `change` at most.  It runs over the
    ground with `speed` [m/s]."""
    if wanted != wanted:
        return 0.0
    tau = min(max(wanted, last - change), last + change)
    tau = min(max(tau, -robot.torque_limit), robot.torque_limit)
    if abs(speed) > robot.speed_limit and tau * speed > 0.0:
        return 0.0
    return float(tau)


@fused
def paper_step(
    robot: Any, x: float, y: float, theta: float, v: float, omega: float, c_0: float, s_0: float,
    tau_right: float, tau_left: float, h: float,
) -> State:  # fmt: skip
    """Moves a robot of the paper's plant through h [s]; returns its state then."""
    d = robot.offset
    v_dot = (tau_right + tau_left) * robot.per_sum
    omega_dot = (tau_right - tau_left) * robot.per_difference
    half = 0.5 * omega_dot
    theta_1, v_1 = theta + h * (omega + half * h), v + v_dot * h
    c_1, s_1 = cos_sin(theta_1)
    x, y = x + d * (c_1 - c_0), y + d * (s_1 - s_0)
    turn = h * (abs(omega) + abs(omega_dot) * h)
    if turn <= FAST_TURN:
        t_1, t_2 = INNER * h, (1 - INNER) * h
        c_i, s_i = turned(c_0, s_0, theta, t_1 * (omega + half * t_1))
        c_j, s_j = turned(c_0, s_0, theta, t_2 * (omega + half * t_2))
        v_i, v_j = v + v_dot * t_1, v + v_dot * t_2
        ends, inner = h * _ENDS, h * _MIDDLE
        x += ends * (v * c_0 + v_1 * c_1) + inner * (v_i * c_i + v_j * c_j)
        y += ends * (v * s_0 + v_1 * s_1) + inner * (v_i * s_i + v_j * s_j)
    else:
        panels = 1
        if isfinite(turn):
            panels = 16 if turn >= 8.0 else int(ceil(2 * turn))  # noqa: RUF046
        width = h / panels
        ends, inner = width * _ENDS, width * _MIDDLE
        for panel in range(panels):
            for node in range(4):
                weight = ends if node in (0, 3) else inner
                part = 0.0 if node == 0 else (INNER if node == 1 else (1 - INNER if node == 2 else 1.0))
                t = (panel + part) * width
                along = weight * (v + v_dot * t)
                c, s = cos_sin(theta + t * (omega + half * t))
                x += along * c
                y += along * s
    return x, y, theta_1, v_1, omega + omega_dot * h, c_1, s_1


@fused
def body_step(
    robot: Any, x: float, y: float, theta: float, v: float, omega: float, c: float, s: float,
    tau_right: float, tau_left: float, h: float,
) -> State:  # fmt: skip
    """Moves a rigid body, on a hill or not, through h [s]; returns its state then."""
    push = (tau_right + tau_left) * robot.per_sum
    turn = (tau_right - tau_left) * robot.per_difference
    pace = h * (abs(omega) + robot.lever * abs(v) + sqrt(abs(turn)) + sqrt(robot.lever * abs(push)) + robot.always)
    count = 1
    if isfinite(pace):
        count = 500 if pace >= 10.0 else max(1, int(ceil(pace / 0.02)))  # noqa: RUF046
    k = h / count
    for _ in range(count):
        a_x, a_y, a_v, a_w = _rates(robot, c, s, v, omega, push, turn)
        o_b = omega + 0.5 * k * a_w
        c_b, s_b = turned(c, s, theta, 0.5 * k * omega)
        b_x, b_y, b_v, b_w = _rates(robot, c_b, s_b, v + 0.5 * k * a_v, o_b, push, turn)
        o_c = omega + 0.5 * k * b_w
        c_c, s_c = turned(c, s, theta, 0.5 * k * o_b)
        c_x, c_y, c_v, c_w = _rates(robot, c_c, s_c, v + 0.5 * k * b_v, o_c, push, turn)
        o_e = omega + k * c_w
        c_e, s_e = turned(c, s, theta, k * o_c)
        e_x, e_y, e_v, e_w = _rates(robot, c_e, s_e, v + k * c_v, o_e, push, turn)
        sixth = k / 6
        x += sixth * (a_x + 2 * (b_x + c_x) + e_x)
        y += sixth * (a_y + 2 * (b_y + c_y) + e_y)
        theta += sixth * (omega + 2 * (o_b + o_c) + o_e)
        v += sixth * (a_v + 2 * (b_v + c_v) + e_v)
        omega += sixth * (a_w + 2 * (b_w + c_w) + e_w)
        c, s = cos_sin(theta)
    return x, y, theta, v, omega, c, s


@fused
def _rates(
    robot: Any, c: float, s: float, v: float, omega: float, push: float, turn: float
) -> tuple[float, float, float, float]:
    """Returns the rates of x, y, v and ω; that of θ is ω."""
    d = robot.offset
    return (
        v * c - d * omega * s,
        v * s + d * omega * c,
        push + d * omega * omega + (robot.pull_x * c + robot.pull_y * s) - robot.drag * v,
        turn - robot.lever * (v * omega - (robot.pull_y * c - robot.pull_x * s)) - robot.turn_drag * omega,
    )
