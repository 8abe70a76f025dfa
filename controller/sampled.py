"""Exact stability of the sampled, delayed loop (theory.md section 5): what period, hold and delay leave of the law.

Between ticks every block is a double integrator under a held η = Z̈_b - Z̈_bd; with e_n = e(nT) and ė_n = ė(nT)

    e_{n+1} = e_n + T ė_n + T²/2 η_n        ė_{n+1} = ė_n + T η_n

The law is linear, and with the gains as they act (`controller.law.BlockGains`: lead included), and the robots' states
k = ceil(d/T) ticks old when they are used,

    η_n = -K_1 e_{n-k} - K_2 ė_{n-k} - K̄ ė_{n-k}

for all blocks at once.  Together that is a finite linear map of the errors and of the k answers on their way; spectral
radius < 1 decides.  Taken for granted: torque does what acceleration asks, no loss, no avoidance, one period for all.

Lengths are written in ticks, (e, T ė, T² η), so the map's entries are of one size whatever the period.
"""

from collections.abc import Iterator
from math import atan, inf, sqrt

import numpy as np
from scipy.linalg import block_diag, eigvals
from scipy.sparse.csgraph import connected_components

from echelon.controller.law import BlockGains
from echelon.plan import Array, Plan


def delay_margin(K1: float, K2: float) -> float:
    """Returns the largest delay [s] of one block in continuous time: τ* = atan(K2 ω_c/K1)/ω_c with the gain crossover
    ω_c² = (K2² + √(K2⁴ + 4 K1²))/2, where |K2 jω + K1| = ω²; 0.7112 σ for K1 = 1/σ² [1/s²], K2 = 1/σ [1/s]."""
    crossover = sqrt((K2**2 + sqrt(K2**4 + 4 * K1**2)) / 2)
    return atan(K2 * crossover / K1) / crossover


def spectral_radius(plan: Plan, delay_ticks: int = 0) -> float:
    """Returns the spectral radius of the sampled error dynamics with states `delay_ticks` ticks old: below 1 is stable.

    Raises ValueError for a negative delay, or if the plan's nodes have different periods.
    """
    return max(_radius(part, delay_ticks) for part in _parts(plan))


def largest_stable_delay(plan: Plan, limit: int = 10_000) -> int | None:
    """Returns the largest k up to `limit` such that every delay of 0 to k ticks is stable; None if already 0 is not.

    Every delay is tried in turn, each with the eigenvalues of matrices of (2 + k) n rows, n variables that act on each
    other.  Raises ValueError if the plan's nodes have different periods."""
    parts = list(_parts(plan))
    for k in range(limit + 1):
        if max(_radius(part, k) for part in parts) >= 1:
            return k - 1 if k else None
    return limit


def error_map(gains: Array, delay_ticks: int) -> Array:
    """Returns the map of (e, T ė, the answers on their way with the oldest first), ((2 + k) n, (2 + k) n), for an
    answer T² η = -gains @ (e, T ė); `gains` is (n, 2 n)."""
    if delay_ticks < 0:
        raise ValueError(f"delay_ticks = {delay_ticks}: must not be negative")
    n = len(gains)
    a, b = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(n)), np.kron([[0.5], [1.0]], np.eye(n))
    if delay_ticks == 0:
        return np.asarray(a - b @ gains)
    whole = np.zeros(((2 + delay_ticks) * n,) * 2)
    whole[: 2 * n, : 2 * n] = a
    whole[: 2 * n, 2 * n : 3 * n] = b
    whole[2 * n : -n, 3 * n :] = np.eye((delay_ticks - 1) * n)
    whole[-n:, : 2 * n] = -gains
    return whole


def tick_gains(plan: Plan) -> Array:
    """Returns the law of all blocks in ticks, (2N, 4N): T² η = -gains @ (e, T ė), coupling and lead included.

    Raises ValueError if the plan's nodes have different periods."""
    periods = {node.period_ns for node in plan.nodes}
    if len(periods) > 1:
        raise ValueError(f"periods {sorted(period / 1e9 for period in periods)} s: all nodes must have the same")
    T = periods.pop() * 1e-9
    blocks = [BlockGains.of(plan, block) for block in plan.blocks]
    K_1, K_2 = block_diag(*[block.K_1 for block in blocks]), block_diag(*[block.K_2 for block in blocks])
    K_coupling = np.vstack([block.K_coupling for block in blocks])
    return np.hstack([T**2 * K_1, T * (K_2 + K_coupling)])


def _parts(plan: Plan) -> Iterator[Array]:
    """Yields the gains of variables that act on each other, part by part, each different part once: the spectrum of a
    block triangular map is that of its diagonal blocks."""
    gains = tick_gains(plan)
    n = len(gains)
    acts = (gains[:, :n] != 0) | (gains[:, n:] != 0)
    count, label = connected_components(acts, directed=True, connection="strong")
    seen = set()
    for number in range(count):
        rows = np.flatnonzero(label == number)
        part = gains[np.ix_(rows, np.concatenate([rows, n + rows]))]
        if part.tobytes() not in seen:
            seen.add(part.tobytes())
            yield part


def _radius(gains: Array, delay_ticks: int) -> float:
    whole = error_map(gains, delay_ticks)
    if not np.isfinite(whole).all():
        return inf
    return float(np.abs(eigvals(whole)).max())
