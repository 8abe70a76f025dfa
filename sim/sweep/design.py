"""The points of a sweep: which values the varied keys have together.

design   points
grid     every value of each key with every value of the others; the last key changes first
zip      the first values of all keys, the second values, …
random   independent uniform draws
sobol    a scrambled Sobol' sequence (scipy.stats.qmc): the same number of draws, spread more evenly
"""

from collections.abc import Sequence
from itertools import product
from math import prod
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from echelon.errors import UsageError
from echelon.sim.sweep.values import MOST_VALUES, Vary

Kind = Literal["grid", "zip", "random", "sobol"]
Point = tuple[Any, ...]
"""The values of the varied keys, in their order"""
MOST_KEYS: Final = 100


def design(kind: Kind, varied: Sequence[Vary], samples: int = 0, seed: int = 0) -> list[Point]:
    """Returns the points of a design; one point without values if nothing varies.

    `samples` is the number of points of random and Sobol' designs, `seed` is that of their draws.  Raises UsageError."""
    keys = [each.key for each in varied]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise UsageError(f"--vary {twice[0]}: is varied twice")
    if kind in ("random", "sobol"):
        return _drawn(kind, varied, samples, seed)
    for each in varied:
        if not each.values:
            assert each.span is not None
            text = f"{each.span.low}:{each.span.high}"
            raise UsageError(f"--vary {each.key}={text}: give a step ({text}:step), or --random N or --sobol N")
    if kind == "zip":
        counts = {each.key: len(each.values) for each in varied}
        if len(set(counts.values())) > 1:
            told = ", ".join(f"{count} of {key}" for key, count in counts.items())
            raise UsageError(f"--zip: all keys must have the same number of values, there are {told}")
        return list(zip(*(each.values for each in varied), strict=True)) if varied else [()]
    if (count := prod(len(each.values) for each in varied)) > MOST_VALUES:
        raise UsageError(f"--vary: the grid has {count} points, more than {MOST_VALUES}")
    return list(product(*(each.values for each in varied)))


def _drawn(kind: Kind, varied: Sequence[Vary], samples: int, seed: int) -> list[Point]:
    if not varied:
        raise UsageError(f"--{kind}: needs a key to vary, such as --vary law.lead=0:1")
    if not 0 < samples <= MOST_VALUES:
        raise UsageError(f"--{kind} {samples}: must be a number of points from 1 to {MOST_VALUES}")
    if kind == "sobol" and samples & (samples - 1):
        near = 1 << (samples.bit_length() - 1)
        raise UsageError(f"--sobol {samples}: must be a power of two, such as {near} or {2 * near}")
    if len(varied) > MOST_KEYS:
        raise UsageError(f"--{kind}: at most {MOST_KEYS} keys can vary")
    shares = unit_points(kind, len(varied), samples, seed)
    return [tuple(_value(each, float(share)) for each, share in zip(varied, row, strict=True)) for row in shares]


def unit_points(kind: Kind, keys: int, samples: int, seed: int) -> NDArray[np.float64]:
    """Returns the draws of a random or Sobol' design in the unit cube, (samples, keys)."""
    generator = np.random.default_rng(seed)
    if kind == "random":
        return generator.random((samples, keys))
    from scipy.stats import qmc  # takes long to import

    return np.asarray(qmc.Sobol(keys, scramble=True, seed=generator).random(samples))


def _value(varied: Vary, share: float) -> Any:
    if varied.values:
        return varied.values[min(int(share * len(varied.values)), len(varied.values) - 1)]
    assert varied.span is not None
    return varied.span.between(min(share, 1 - 2**-53))
