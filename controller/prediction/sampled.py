"""Exact stability of the sampled, delayed loop (docs/architecture.md, 2.7): what period, hold and delay leave of the law.

Between ticks every block is a double integrator under a held η = Z̈_b - Z̈_bd; with e_n = e(nT) and ė_n = ė(nT)

    e_{n+1} = e_n + T ė_n + T²/2 η_n        ė_{n+1} = ė_n + T η_n

Where the law is linear, with the gains as they act (`controller.laws.law.LinearGains`: lead included), and the robots' states
k = ceil(d/T) ticks old when they are used,

    η_n = -K_1 e_{n-k} - K_2 ė_{n-k} - K̄ ė_{n-k} - K_i q_{n-k}        q_{n+1} = q_n + T e_n + T²/2 ė_n

for all blocks at once, q only where there is integral action.  Together that is a finite linear map of the errors and of the
k answers on their way; spectral radius < 1 decides.  Taken for granted: torque does what acceleration asks, no loss, no
avoidance, one period for all, integrals within their bounds.

Lengths are written in ticks, (e, T ė, q/T, T² η), so the map's entries are of one size whatever the period.
"""

from collections.abc import Iterator
from math import atan, atan2, inf, pi, sqrt

import numpy as np
from scipy.linalg import block_diag, eigvals
from scipy.sparse.csgraph import connected_components

from echelon.controller.laws.in_tree import BlockGains
from echelon.controller.laws.law import Law, LinearGains, law_block
from echelon.plan.plan import Array, BlockPlan, Plan


def linear_gains(plan: Plan, block: BlockPlan, lead: float | None = None) -> LinearGains:
    """Returns the gains of a block; with `lead` [periods] instead of the plan's, if given.

    Raises ValueError if the plan's law is not linear."""
    law: Law = plan.law.made
    gains = law.linear(law_block(plan, block, lead))
    if gains is None:
        raise ValueError(f"law.use = {plan.law.use!r}: is not linear, and what is computed here holds for linear laws")
    return gains


def delay_margin(K1: float, K2: float, K_i: float = 0.0) -> float:
    """Returns the largest delay τ* [s] of one block in continuous time; 0 if it is unstable without any.

    τ* = atan(K2 ω_c/K1)/ω_c with the gain crossover ω_c² = (K2² + √(K2⁴ + 4 K1²))/2, where |K2 jω + K1| = ω²; 0.7112 σ for
    K1 = 1/σ² [1/s²], K2 = 1/σ [1/s].  With integral action K_i [1/s³] the loop is (K2 s² + K1 s + K_i)/s³: τ* is the least
    phase margin over crossover, of all crossovers |K_i - K2 ω² + K1 jω| = ω³."""
    if K_i == 0:
        crossover = sqrt((K2**2 + sqrt(K2**4 + 4 * K1**2)) / 2)
        return atan(K2 * crossover / K1) / crossover
    if K_i >= K1 * K2:
        return 0.0
    squares = np.roots([1.0, -(K2**2), 2 * K_i * K2 - K1**2, -(K_i**2)])
    crossovers = [sqrt(root.real) for root in squares if root.real > 0 and abs(root.imag) <= 1e-9 * abs(root)]
    return min((atan2(K1 * w, K_i - K2 * w**2) - pi / 2) % (2 * pi) / w for w in crossovers)


def spectral_radius(plan: Plan, delay_ticks: int = 0) -> float:
    """Returns the spectral radius of the sampled error dynamics with states `delay_ticks` ticks old: below 1 is stable.

    Raises ValueError for a negative delay, or if the plan's nodes have different periods or its law is not linear.
    """
    return max(_radius(part, delay_ticks) for part in _parts(plan))


def largest_stable_delay(plan: Plan, limit: int = 10_000) -> int | None:
    """Returns the largest k up to `limit` such that every delay of 0 to k ticks is stable; None if already 0 is not.

    Every delay is tried in turn, each with the eigenvalues of matrices of (2 + k) n rows, n variables that act on each
    other.  Raises ValueError if the plan's nodes have different periods or its law is not linear."""
    parts = list(_parts(plan))
    for k in range(limit + 1):
        if max(_radius(part, k) for part in parts) >= 1:
            return k - 1 if k else None
    return limit


def error_map(gains: Array, delay_ticks: int) -> Array:
    """Returns the map of (e, T ė, the answers on their way with the oldest first), ((2 + k) n, (2 + k) n), for an
    answer T² η = -gains @ (e, T ė), `gains` (n, 2 n); with integral action that of (e, T ė, q/T, …), `gains` (n, 3 n)."""
    if delay_ticks < 0:
        raise ValueError(f"delay_ticks = {delay_ticks}: must not be negative")
    n = len(gains)
    of_state, of_answer = [[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]]
    if gains.shape[1] == 3 * n:
        of_state, of_answer = [[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.5, 1.0]], [[0.5], [1.0], [0.0]]
    a, b = np.kron(of_state, np.eye(n)), np.kron(of_answer, np.eye(n))
    if delay_ticks == 0:
        return np.asarray(a - b @ gains)
    size = len(a)
    whole = np.zeros((size + delay_ticks * n,) * 2)
    whole[:size, :size] = a
    whole[:size, size : size + n] = b
    whole[size:-n, size + n :] = np.eye((delay_ticks - 1) * n)
    whole[-n:, :size] = -gains
    return whole


def tick_gains(plan: Plan) -> Array:
    """Returns the law of all blocks in ticks, coupling and lead included: T² η = -gains @ (e, T ė), (2N, 4N), and with integral
    action (e, T ė, q/T), (2N, 6N).

    Raises ValueError if the plan's nodes have different periods or its law is not linear."""
    periods = {node.period_ns for node in plan.nodes}
    if len(periods) > 1:
        raise ValueError(f"periods {sorted(period / 1e9 for period in periods)} s: all nodes must have the same")
    T = periods.pop() * 1e-9
    blocks = [linear_gains(plan, block) for block in plan.blocks]
    K_1, K_2, K_i = (block_diag(*[getattr(block, name) for block in blocks]) for name in ("K_1", "K_2", "K_i"))
    K_coupling = np.vstack([BlockGains.of(plan, block).K_coupling for block in plan.blocks])
    parts = [T**2 * K_1, T * (K_2 + K_coupling)]
    return np.hstack([*parts, T**3 * K_i] if K_i.any() else parts)


def _parts(plan: Plan) -> Iterator[Array]:
    """Yields the gains of variables that act on each other, part by part, each different part once: the spectrum of a
    block triangular map is that of its diagonal blocks."""
    gains = tick_gains(plan)
    n = len(gains)
    acts = (gains.reshape(n, -1, n) != 0).any(axis=1)
    count, label = connected_components(acts, directed=True, connection="strong")
    seen = set()
    for number in range(count):
        rows = np.flatnonzero(label == number)
        part = gains[np.ix_(rows, np.concatenate([rows + at for at in range(0, gains.shape[1], n)]))]
        if part.tobytes() not in seen:
            seen.add(part.tobytes())
            yield part


def _radius(gains: Array, delay_ticks: int) -> float:
    whole = error_map(gains, delay_ticks)
    if not np.isfinite(whole).all():
        return inf
    return float(np.abs(eigvals(whole)).max())
