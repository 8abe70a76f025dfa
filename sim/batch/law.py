"""The law of a node's own blocks, the transformation, and the trajectory (controller.laws, transformation and trajectory, as
arrays).

Values of the children of a node, or of its variables, are rows of `width` numbers each.
"""

from math import sqrt
from typing import Any, Final

from echelon.controller.laws.terminal_sliding import PRECISION, STEPS
from echelon.sim.batch.angles import cos_sin
from echelon.sim.batch.compiled import fused
from echelon.sim.batch.records import CIRCLE, INTEGRAL, LINE, SINE, SLIDING

_ROOT_2: Final = sqrt(2.0)
_PER_ROOT_2: Final = 1 / _ROOT_2


@fused
def to_shape(node: Any, width: int, table: Any, real: Any, x: int, z: int) -> None:
    """Writes Φ_node x to z for the first two numbers of each row: the shape variables, then the centroid.  x and z must not
    overlap."""
    mean_x, mean_y = real[x], real[x + 1]
    for child in range(1, node.count):
        x += width
        apart_x, apart_y = real[x] - mean_x, real[x + 1] - mean_y
        if child == 1:
            real[z], real[z + 1] = -apart_x * _PER_ROOT_2, -apart_y * _PER_ROOT_2
        else:
            real[z], real[z + 1] = apart_x, apart_y
        share = table[node.shares_at + child]
        mean_x += apart_x * share
        mean_y += apart_y * share
        z += width
    real[z], real[z + 1] = mean_x, mean_y


@fused
def to_children(node: Any, table: Any, real: Any, z: int, x: int) -> None:
    """Writes Φ_node⁻¹ z to x, two numbers for each child."""
    last = 2 * (node.count - 1)
    mean_x, mean_y = real[z + last], real[z + last + 1]
    for child in range(node.count - 1, 1, -1):
        apart_x, apart_y = real[z + 2 * child - 2], real[z + 2 * child - 1]
        share = table[node.shares_at + child]
        mean_x -= apart_x * share
        mean_y -= apart_y * share
        real[x + 2 * child], real[x + 2 * child + 1] = mean_x + apart_x, mean_y + apart_y
    if node.count > 1:
        apart_x, apart_y = real[z] * _ROOT_2, real[z + 1] * _ROOT_2
        share = table[node.shares_at + 1]
        mean_x += apart_x * share
        mean_y += apart_y * share
        real[x + 2], real[x + 3] = mean_x - apart_x, mean_y - apart_y
    real[x], real[x + 1] = mean_x, mean_y


@fused
def own_law(run: Any, block: Any, table: Any, index: Any, real: Any, e: int, rates: int, force: int, eta: int) -> None:
    """Writes η = ν - Z̈_bd + W (-Σ K̄_bb' ė_b' + F_pot,b/σ_b) of one block to `eta`, and integrates once.

    `e`: place of the errors and their rates, rows (e_x, e_y, ė_x, ė_y).  `rates`: those of all blocks, or -1.  `force`: F_pot
    of the block, or -1."""
    size = block.rows
    if run.law == SLIDING:
        for row in range(size):
            at = e + 2 * row - row % 2
            value = _led(run, real[at], block.sigma * real[at + 2], block.ahead / block.sigma)
            real[eta + row] = value / (block.sigma * block.sigma)
    elif block.is_diagonal:
        for row in range(size):
            at = e + 2 * row - row % 2
            real[eta + row] = -table[block.k1_at + row] * real[at] - table[block.k2_at + row] * real[at + 2]
    else:
        for row in range(size):
            k1, k2 = block.k1_at + row * size, block.k2_at + row * size
            value = 0.0
            for column in range(size):
                at = e + 2 * column - column % 2
                value -= table[k1 + column] * real[at] + table[k2 + column] * real[at + 2]
            real[eta + row] = value
    if run.law == INTEGRAL:
        _integrate(block, table, real, e, eta)
    if force >= 0:
        for row in range(size):
            if block.is_diagonal:
                real[eta + row] += table[block.pot_at + row] * real[force + row]
            else:
                for column in range(size):
                    real[eta + row] += table[block.pot_at + row * size + column] * real[force + column]
    if rates >= 0:
        columns = block.rows_at + size + 1
        for row in range(size):
            for entry in range(index[block.rows_at + row], index[block.rows_at + row + 1]):
                real[eta + row] -= table[block.values_at + entry] * real[rates + index[columns + entry]]


@fused
def _integrate(block: Any, table: Any, real: Any, e: int, eta: int) -> None:
    """Adds -K_i q to η, then integrates q."""
    size, q, T = block.rows, block.integral_at, block.period
    for row in range(size):
        if block.is_diagonal:
            real[eta + row] -= table[block.ki_at + row] * real[q + row]
        else:
            for column in range(size):
                real[eta + row] -= table[block.ki_at + row * size + column] * real[q + column]
    for row in range(size):
        at = e + 2 * row - row % 2
        value = real[q + row] + T * real[at] + T * T / 2 * real[at + 2]
        real[q + row] = min(max(value, -block.bound), block.bound)


@fused
def _sig(x: float, power: float) -> float:
    size: float = abs(x) ** power
    return size if x >= 0.0 else -size


@fused
def _pull(run: Any, e: float, rate: float) -> float:
    """Returns f of terminal sliding (controller.laws.terminal_sliding)."""
    s = e + _sig(rate, run.gamma) / run.beta
    return float(-run.beta / run.gamma * _sig(rate, 2 - run.gamma) - run.kappa * _sig(s, 2 / run.gamma - 1))


@fused
def _led(run: Any, e: float, rate: float, h: float) -> float:
    """Returns f with look-ahead (controller.laws.terminal_sliding)."""
    e += h * rate
    far = _pull(run, e, rate)
    if h == 0.0 or far == 0.0 or far != far:
        return far
    near, near_miss, far_miss = 0.0, -far, far - _pull(run, e + h * h / 2 * far, rate + h * far)
    for _ in range(STEPS):
        if far_miss * near_miss >= 0.0:
            return far
        v = far - far_miss * (far - near) / (far_miss - near_miss)
        miss = v - _pull(run, e + h * h / 2 * v, rate + h * v)
        if miss * far_miss < 0.0:
            near, near_miss = far, far_miss
        else:
            near_miss /= 2
        far, far_miss = v, miss
        if abs(far - near) <= PRECISION * abs(far) or miss == 0.0:
            break
    return far


@fused
def desired(run: Any, table: Any, t: float) -> tuple[float, float, float, float, float, float]:
    """Returns z_cd, ż_cd and z̈_cd at t [s], x and y of each."""
    at = run.trajectory_at
    if run.trajectory == LINE:
        vx, vy = table[at + 2], table[at + 3]
        return table[at] + vx * t, table[at + 1] + vy * t, vx, vy, 0.0, 0.0
    if run.trajectory == CIRCLE:
        radius, rate, phase = table[at + 2], table[at + 3], table[at + 4]
        c, s = cos_sin(rate * t + phase)
        c, s = radius * c, radius * s
        return table[at] + c, table[at + 1] + s, -rate * s, rate * c, -(rate * rate) * c, -(rate * rate) * s
    if run.trajectory == SINE:
        speed, amplitude, rate = table[at + 2], table[at + 3], table[at + 4]
        c, s = cos_sin(rate * t)
        c, s = amplitude * c, amplitude * s
        return table[at] + speed * t, table[at + 1] + s, speed, rate * c, 0.0, -(rate * rate) * s
    leg = 0
    while leg < run.trajectory_legs - 1 and t >= table[at + 3 * (leg + 1)]:
        leg += 1
    begin, end = at + 3 * leg, at + 3 * (leg + 1)  # rows (time, x, y)
    length = table[end] - table[begin]
    s = min(max((t - table[begin]) / length, 0.0), 1.0)
    ratio = s * s * s * (10 - 15 * s + 6 * s * s)
    rate = 30 * s * s * (1 - s) * (1 - s) / length
    bend = 60 * s * (1 - s) * (1 - 2 * s) / (length * length)
    dx, dy = table[end + 1] - table[begin + 1], table[end + 2] - table[begin + 2]
    return table[begin + 1] + dx * ratio, table[begin + 2] + dy * ratio, dx * rate, dy * rate, dx * bend, dy * bend
