"""Philox 4x64-10, a counter-based generator of random numbers (Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as
1, 2, 3", SC 2011).  It gives the numbers of `numpy.random.Philox`."""

from typing import Final

import numpy as np

from echelon.sim.batch.compiled import compiled

_LOW: Final = np.uint64(0xFFFFFFFF)
_HALF: Final = np.uint64(32)
_M_0: Final = np.uint64(0xD2E7470EE14C6C93)
_M_1: Final = np.uint64(0xCA5A826395121157)
_W_0: Final = np.uint64(0x9E3779B97F4A7C15)
_W_1: Final = np.uint64(0xBB67AE8584CAA73B)


@compiled
def high(a: np.uint64, b: np.uint64) -> np.uint64:
    """Returns the upper 64 bits of the product a b."""
    a_0, a_1, b_0, b_1 = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    middle = a_1 * b_0 + ((a_0 * b_0) >> _HALF)
    carried = a_0 * b_1 + (middle & _LOW)
    return a_1 * b_1 + (middle >> _HALF) + (carried >> _HALF)


@compiled
def philox(
    key_0: np.uint64, key_1: np.uint64, counter: np.uint64, stream: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Returns the four words of a counter whose lowest 64 bits are `counter`, and whose highest are `stream`."""
    a, b, c, d = counter, np.uint64(0), np.uint64(0), stream
    for _ in range(10):
        a, b, c, d = high(_M_1, c) ^ b ^ key_0, _M_1 * c, high(_M_0, a) ^ d ^ key_1, _M_0 * a
        key_0 += _W_0
        key_1 += _W_1
    return a, b, c, d
