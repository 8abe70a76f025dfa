"""Where the eigenvalues of a loop cross the unit circle, and which delays therefore bring it to the edge of stability.

A loop that is closed over a delay τ has the frequency response L(jω) e^{-jωτ} (generalised Nyquist criterion).  The closed loop
has a root s = jω where some eigenvalue λ of L(jω) has λ e^{-jωτ} = 1: at frequencies ω with |λ(ω)| = 1, for the delays

    τ = (arg λ + 2π m)/ω,   m = 0, 1, 2, …

As τ grows beyond such a delay, the root leaves the stable side if |λ| falls with ω, and comes back to it if |λ| rises
(differentiate λ(s) e^{-sτ} = 1 with respect to τ).  So a loop that is stable for τ = 0 is stable up to the smallest such τ.
The same holds for sampled loops, with z = e^{jω} and delays of whole samples.
"""

from collections.abc import Callable, Iterator
from math import floor, inf, pi
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from echelon.plan.plan import Array

Eigenvalues = Callable[[Array], NDArray[np.complex128]]
"""A function from frequencies ω, (m,), to the n eigenvalues of the loop at each, (m, n)"""

PER_DECADE: Final = 120
"""Number of frequencies per decade at which the eigenvalues are computed"""
NEAR: Final = 0.05
"""Where log|λ| has an extremum within this distance from 0, a finer search follows: two crossings may lie between two
frequencies"""
SAME: Final = 1e-6
"""Eigenvalues with |log|λ|| below this lie on the unit circle"""


class Crossing(NamedTuple):
    """An eigenvalue λ on the unit circle: its frequency ω, arg λ in [0, 2π), and whether |λ| falls with ω."""

    omega: float
    angle: float
    falls: bool


def crossings(eigenvalues: Eigenvalues, low: float, high: float) -> list[Crossing]:
    """Returns the crossings of the unit circle between the frequencies `low` and `high`."""
    omegas = np.geomspace(low, high, max(3, round(PER_DECADE * np.log10(high / low))))
    logs = _logs(eigenvalues(omegas))
    found: list[tuple[float, bool]] = []
    for left, right, column, falls in _brackets(eigenvalues, omegas, logs):
        if any(
            left <= omega <= right and same == falls and abs(_log(eigenvalues, omega, column)) < SAME
            for omega, same in found
        ):
            continue
        found.append((brentq(lambda omega, at=column: _log(eigenvalues, omega, at), left, right, rtol=1e-13), falls))
    return [
        Crossing(omega, float(np.angle(value) % (2 * pi)), falls)
        for omega, falls in found
        for value in eigenvalues(np.array([omega]))[0]
        if value and abs(np.log(abs(value))) < SAME
    ]


def smallest_delay(found: list[Crossing]) -> float:
    """Returns the smallest delay for which a root lies on the edge of stability, in units of 1/ω; infinite without
    crossings."""
    return min((crossing.angle / crossing.omega for crossing in found), default=inf)


def unstable_roots(found: list[Crossing], delay: float) -> int:
    """Returns the number of pairs of unstable roots for a delay, if the loop without delay is stable."""
    return sum(
        (1 if crossing.falls else -1) * max(0, floor((delay * crossing.omega - crossing.angle) / (2 * pi)) + 1)
        for crossing in found
    )


def _brackets(eigenvalues: Eigenvalues, omegas: Array, logs: Array) -> Iterator[tuple[float, float, int, bool]]:
    """Yields pairs of frequencies between which an eigenvalue crosses the unit circle: left, right, its number in the order of
    magnitudes (0 is the largest), and whether its magnitude falls there.  `logs` are log|λ| at `omegas`, (m, n)."""
    above = logs >= 0
    for row, column in zip(*np.nonzero(above[:-1] != above[1:]), strict=True):
        yield omegas[row], omegas[row + 1], column, above[row, column]
    before, at, after = logs[:-2], logs[1:-1], logs[2:]
    with np.errstate(invalid="ignore"):  # the logarithm of zero is -∞
        turned = (at - before) * (after - at) < 0
    turns = turned & (np.abs(at) < NEAR) & (above[:-2] == above[1:-1]) & (above[2:] == above[1:-1])
    for row, column in zip(*np.nonzero(turns), strict=True):
        left, right, sign = omegas[row], omegas[row + 2], 1 if above[row, column] else -1
        lowest = minimize_scalar(
            lambda omega, at=column, by=sign: by * _log(eigenvalues, omega, at), bounds=(left, right), method="bounded",
            options={"xatol": 1e-9 * left},
        )  # fmt: skip
        if lowest.fun < 0:
            yield left, lowest.x, column, sign > 0
            yield lowest.x, right, column, sign < 0


def _logs(values: NDArray[np.complex128]) -> Array:
    """Returns log|λ| of eigenvalues, (m, n), the largest first."""
    with np.errstate(divide="ignore"):
        return np.asarray(-np.sort(-np.log(np.abs(values)), axis=1))


def _log(eigenvalues: Eigenvalues, omega: float, column: int) -> float:
    """Returns log|λ| of the eigenvalue with this number in the order of magnitudes."""
    return float(_logs(eigenvalues(np.array([omega])))[0, column])
