"""The largest delay for which one block alone is stable, in continuous time (docs/architecture.md, 2.7).

The block is ë(t) = -K_1 e(t - τ) - K_2 ė(t - τ) - K_i q(t - τ), q̇ = e.  Its loop, cut open, has the
frequency response

    L(jω) e^{-jωτ},   L(jω) = (K_1 + jω K_2 + K_i/(jω))/ω²

and `controller.prediction.crossings` gives the smallest τ that brings a root to the imaginary axis.  With gains that are
numbers and K_i = 0 there is one crossing: τ* = atan(K2 ω_c/K1)/ω_c with ω_c² = (K2² + √(K2⁴ + 4 K1²))/2; for K1 = 1/σ² and
K2 = 1/σ that is 0.7112 σ.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.controller.laws.law import LinearGains
from echelon.controller.prediction.crossings import crossings, smallest_delay
from echelon.controller.prediction.gains import poles
from echelon.plan.plan import Array

SLOW: Final = 1e-3
"""Crossings are searched from this multiple of the slowest pole's magnitude upwards"""


def delay_margin(gains: LinearGains) -> float | None:
    """Returns the delay margin τ* of a block [s]: it is stable for delays below it.  Returns None if it is unstable without
    delay."""
    K_1, K_2, K_i = gains.K_1, gains.K_2, gains.K_i
    found = poles(gains)
    if found.real.max() >= 0:
        return None

    def eigenvalues(omega: Array) -> NDArray[np.complex128]:
        w = omega[:, None, None]
        loop = np.asarray((K_1 + 1j * w * K_2 + K_i / (1j * w)) / w**2, dtype=np.complex128)
        return np.asarray(np.linalg.eigvals(loop), dtype=np.complex128)

    # At frequencies above `high` |λ| ≤ ‖L‖ < 1, so there are no crossings.
    high = sum(np.linalg.norm(matrix, 2) ** power for matrix, power in ((K_1, 1 / 2), (K_2, 1), (K_i, 1 / 3)))
    return smallest_delay(crossings(eigenvalues, SLOW * np.abs(found).min(), float(high)))
