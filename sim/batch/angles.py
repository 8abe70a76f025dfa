"""Cosine and sine at once.  The compiler's own functions give one of them at a time, which takes twice as long."""

from math import atan2, cos, floor, sin
from typing import Final

from echelon.sim.batch.compiled import apart, fused

_PER_QUARTER: Final = 6.36619772367581382433e-01
_QUARTER: Final = 1.57079632673412561417e00
"""The first 33 bits of π/2, so that its product with a small integer is exact"""
_REST: Final = 6.07710050650619224932e-11
"""π/2 - `_QUARTER`"""
_LARGE: Final = 1e5


_SMALL: Final = 0.0625


@fused
def turned(c: float, s: float, angle: float, by: float) -> tuple[float, float]:
    """Returns cos and sin of `angle` + `by`, where c and s are those of `angle`; the Taylor polynomials of a small angle."""
    if not abs(by) < _SMALL:
        return cos_sin(angle + by)
    z = by * by
    sine = by - by * z * (1 / 6 - z * (1 / 120 - z * (1 / 5040)))
    less = z * (0.5 - z * (1 / 24 - z * (1 / 720 - z * (1 / 40320))))  # 1 - cos
    return c - (c * less + s * sine), s + (c * sine - s * less)


@fused
def cos_sin(angle: float) -> tuple[float, float]:
    """Returns cos and sin of an angle, each to 1e-16 or a little more.

    The angle is reduced to ±π/4 [rad]; there the polynomials of fdlibm hold (k_sin.c, k_cos.c)."""
    if not abs(angle) < _LARGE:
        angle = within_one_turn(angle)
    quarters = floor(angle * _PER_QUARTER + 0.5)
    x = (angle - quarters * _QUARTER) - quarters * _REST
    z = x * x
    s = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
    s = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * s)
    s = x + x * z * (-1.66666666666666324348e-01 + z * s)
    c = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
    c = -1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * c)
    c = 1.0 - (0.5 * z - z * z * (4.16666666666666019037e-02 + z * c))
    quadrant = int(quarters) & 3
    if quadrant & 1:
        c, s = -s, c
    if quadrant & 2:
        c, s = -c, -s
    return c, s


@apart
def within_one_turn(angle: float) -> float:
    """Returns an angle without whole turns."""
    return atan2(sin(angle), cos(angle))
