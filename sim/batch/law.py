"""The law of a node's own blocks, the transformation, and the trajectory (controller.laws, transformation and trajectory, as
arrays).

Values of n children, or of n variables, are rows of `width` numbers each.
"""

from math import cos, sin, sqrt
from typing import Any, Final

from echelon.controller.laws.terminal_sliding import PRECISION, STEPS
from echelon.sim.batch.compiled import compiled
from echelon.sim.batch.records import CIRCLE, INTEGRAL, LINE, SINE, SLIDING

_ROOT_2: Final = sqrt(2.0)


@compiled
def to_shape(count: int, width: int, weights: Any, weights_at: int, real: Any, x: int, z: int) -> None:
    """Writes Φ_node x to z: the shape variables, then the centroid.  x and z must not overlap."""
    last = z + (count - 1) * width
    for part in range(width):
        mean = real[x + part]
        total = weights[weights_at]
        for child in range(1, count):
            value = real[x + child * width + part]
            if child == 1:
                real[z + part] = (mean - value) / _ROOT_2
            else:
                real[z + (child - 1) * width + part] = value - mean
            weight = weights[weights_at + child]
            total += weight
            mean += (value - mean) * (weight / total)
        real[last + part] = mean


@compiled
def to_children(count: int, weights: Any, weights_at: int, total: int, real: Any, z: int, x: int) -> None:
    """Writes Φ_node⁻¹ z to x; rows of two numbers.  `total` is the sum of the weights."""
    for part in range(2):
        mean = real[z + (count - 1) * 2 + part]
        all_weights = total
        for child in range(count - 1, 1, -1):
            value = real[z + (child - 1) * 2 + part]
            mean -= value * (weights[weights_at + child] / all_weights)
            real[x + child * 2 + part] = mean + value
            all_weights -= weights[weights_at + child]
        if count == 1:
            real[x + part] = mean
        else:
            apart = _ROOT_2 * real[z + part]
            real[x + part] = mean + apart * (weights[weights_at + 1] / all_weights)
            real[x + 2 + part] = mean - apart * (weights[weights_at] / all_weights)


@compiled
def product(matrix: Any, at: int, diagonal: int, size: int, row: int, vector: Any, first: int, stride: int) -> float:
    """Returns one row of a matrix of gains times the x and y, `stride` numbers apart from variable to variable, from `first` on
    in `vector`."""
    if diagonal:
        return float(matrix[at + row] * vector[first + (row // 2) * stride + row % 2])
    total = 0.0
    for column in range(size):
        total += matrix[at + row * size + column] * vector[first + (column // 2) * stride + column % 2]
    return total


@compiled
def own_law(run: Any, block: Any, table: Any, index: Any, real: Any, e: int, rates: int, force: int, eta: int) -> None:
    """Writes η = ν - Z̈_bd + W (-Σ K̄_bb' ė_b' + F_pot,b/σ_b) of one block to `eta`, and integrates once.

    `e`: place of the errors and their rates, rows (e_x, e_y, ė_x, ė_y).  `rates`: those of all blocks, or -1.  `force`: F_pot of
    the block, or -1."""
    size = block.size
    for row in range(size):
        value = 0.0
        if run.law == SLIDING:
            at = e + 4 * (row // 2) + row % 2
            value = _led(run, real[at], block.sigma * real[at + 2], block.ahead / block.sigma)
            value /= block.sigma * block.sigma
        else:
            value -= product(table, block.k1_at, block.diagonal, size, row, real, e, 4)
            value -= product(table, block.k2_at, block.diagonal, size, row, real, e + 2, 4)
            if run.law == INTEGRAL:
                value -= product(table, block.ki_at, block.diagonal, size, row, real, block.integral_at, 2)
        if rates >= 0:
            for entry in range(index[block.rows_at + row], index[block.rows_at + row + 1]):
                value -= table[block.values_at + entry] * real[rates + index[block.rows_at + size + 1 + entry]]
        if force >= 0:
            value += product(table, block.pot_at, block.diagonal, size, row, real, force, 2)
        real[eta + row] = value
    if run.law == INTEGRAL:
        T, bound = block.period, block.bound
        for row in range(size):
            at = e + 4 * (row // 2) + row % 2
            q = real[block.integral_at + row] + T * real[at] + T * T / 2 * real[at + 2]
            real[block.integral_at + row] = min(max(q, -bound), bound)


@compiled
def _sig(x: float, power: float) -> float:
    return float(abs(x) ** power) if x >= 0.0 else -float(abs(x) ** power)


@compiled
def _pull(run: Any, e: float, rate: float) -> float:
    """Returns f of terminal sliding (controller.laws.terminal_sliding)."""
    s = e + _sig(rate, run.gamma) / run.beta
    return -run.beta / run.gamma * _sig(rate, 2 - run.gamma) - run.kappa * _sig(s, 2 / run.gamma - 1)


@compiled
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


@compiled
def desired(run: Any, table: Any, t: float) -> tuple[float, float, float, float, float, float]:
    """Returns z_cd, ż_cd and z̈_cd at t [s], x and y of each."""
    at = run.trajectory_at
    if run.trajectory == LINE:
        vx, vy = table[at + 2], table[at + 3]
        return table[at] + vx * t, table[at + 1] + vy * t, vx, vy, 0.0, 0.0
    if run.trajectory == CIRCLE:
        radius, rate, phase = table[at + 2], table[at + 3], table[at + 4]
        c, s = radius * cos(rate * t + phase), radius * sin(rate * t + phase)
        return table[at] + c, table[at + 1] + s, -rate * s, rate * c, -(rate * rate) * c, -(rate * rate) * s
    if run.trajectory == SINE:
        speed, amplitude, rate = table[at + 2], table[at + 3], table[at + 4]
        s, c = amplitude * sin(rate * t), amplitude * cos(rate * t)
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
