"""From the delays of a scenario to those of a plan: bounds, tables of distributions, traces.

All functions raise PlanError with the key, the value and what is allowed.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache
from math import erfc, isfinite, sqrt
from statistics import NormalDist
from typing import Final

import numpy as np

from echelon.plan.delay_tables import BITS, LOST, Z_BITS, Z_CELL_LOG2, Z_MAX, Z_TABLE, DelayTable, DelayTrace, edges
from echelon.plan.plan import Array, PlanError
from echelon.scenario.link_tables import Gamma, LinkRule, Normal, Pareto, Trace, Uniform

MAX_DELAY: Final = 1e6
"""Largest delay of a link [s].  Distributions end there"""
MAX_CUT: Final = 8.0
"""How many standard deviations above its mean a normal distribution may be cut at most"""
LOST_WORD: Final = "lost"
"""Stands in a trace for a message that was lost"""

Quantiles = Callable[[Array, Array], Array]
"""Returns the delays [s] at which the distribution function is p.  The second argument is 1 - p, which is more exact for p near
1"""


def delays_of(rule: LinkRule, key: str) -> tuple[int, int, DelayTable | DelayTrace | None]:
    """Returns the least and the largest delay of a rule, to the nearest nanosecond, and what tells the delays between them.

    None: they are constant, or uniform between the two."""
    delay = rule.delay
    if isinstance(delay, Trace):
        trace = _measured(delay, key)
        come = [each for each in trace.delays_ns if each != LOST] or [0]
        return min(come), max(come), trace
    if isinstance(delay, Uniform):
        low, high, at = delay.min, delay.max, f"{key}.max"
    elif isinstance(delay, float | int):
        low = high = delay
        at = key
    else:
        low, high, at = delay.min, delay.min, f"{key}.min"
    if high > MAX_DELAY:
        raise PlanError(f"{at} = {high}: must be at most {MAX_DELAY:g}")
    if isinstance(delay, Normal) and delay.min - delay.mean > MAX_CUT * delay.std:
        raise PlanError(
            f"{key}: min = {delay.min} cuts off nearly everything; must be at most mean + {MAX_CUT:g} std = "
            f"{delay.mean + MAX_CUT * delay.std:g}"
        )
    if isinstance(delay, float | int) or (isinstance(delay, Uniform) and not delay.correlation):
        return round(low * 1e9), round(high * 1e9), None
    table = make_table(delay)
    return table.delays_ns[0], table.delays_ns[-1], table


@lru_cache(maxsize=64)
def make_table(delay: Uniform | Normal | Gamma | Pareto) -> DelayTable:
    """Returns the table of a distribution.  Equal distributions get the same object."""
    quantiles = _quantiles(delay)
    with np.errstate(over="ignore", divide="ignore"):
        if delay.correlation:
            z: Array = np.arange(Z_TABLE, dtype=float) * 2.0 ** (Z_CELL_LOG2 - Z_BITS) - Z_MAX
            seconds = quantiles(_normal(z), _normal(-z))
        else:
            below: Array = edges().astype(float) * 2.0**-BITS
            last = below[1] / 2  # where the distribution has no end, its last cell ends in its middle
            ends = np.concatenate(([last], below[1:-1]))
            seconds = np.concatenate((quantiles(below, 1 - below), quantiles(1 - ends, ends)[::-1]))
    nanoseconds = np.rint(np.minimum(seconds, MAX_DELAY) * 1e9).astype(np.int64)
    return DelayTable(tuple(np.maximum.accumulate(nanoseconds).tolist()), delay.correlation)


def _quantiles(delay: Uniform | Normal | Gamma | Pareto) -> Quantiles:
    """Returns the quantile function of a distribution."""
    match delay:
        case Uniform():
            return lambda p, q: np.where(
                p < 0.5, delay.min + p * (delay.max - delay.min), delay.max - q * (delay.max - delay.min)
            )
        case Normal():
            cut = (delay.min - delay.mean) / delay.std
            below, above = _normal(np.array([cut, -cut]))
            inverse = NormalDist().inv_cdf

            def normal(p: Array, q: Array) -> Array:
                lower, upper = below + p * above, q * above
                z = [
                    -inverse(b) if b < 0.5 else inverse(a) if a > 0 else cut for a, b in zip(lower, upper, strict=True)
                ]
                return np.maximum(delay.min, delay.mean + delay.std * np.array(z))

            return normal
        case Gamma():
            from scipy.special import gammainccinv, gammaincinv  # imported here because it takes long

            def gamma(p: Array, q: Array) -> Array:
                where = np.where(p < 0.5, gammaincinv(delay.shape, p), gammainccinv(delay.shape, q))
                return delay.min + delay.scale * where

            return gamma
        case Pareto():
            return lambda p, q: delay.min * np.exp(-np.where(p < 0.5, np.log1p(-p), np.log(q)) / delay.shape)


def _normal(z: Array) -> Array:
    """Returns the standard normal distribution function."""
    return np.array([erfc(-each / sqrt(2)) / 2 for each in z.tolist()])


def _measured(trace: Trace, key: str) -> DelayTrace:
    """Returns the delays of a trace file.  Raises PlanError that names the line."""
    where = f"{key}.file = {trace.file.name!r}"
    rows = list(_rows(trace.file.text))
    if not rows:
        raise PlanError(f"{where}: holds no delay")
    names = ["delay"] if len(rows[0][1]) == 1 else ["time", "delay"]
    if not _is_value(rows[0][1][-1]):
        names = [cell.lower() for cell in rows.pop(0)[1]]
        if "delay" not in names:
            raise PlanError(f"{where}: its columns are {', '.join(names)}; one must be called delay")
    if trace.by == "time" and "time" not in names:
        raise PlanError(f"{where}: by = 'time' needs a column called time, or two columns: time and delay")
    delays, times = [], []
    for line, cells in rows:
        if len(cells) != len(names):
            raise PlanError(f"{where}: line {line} has {len(cells)} values, not {len(names)}")
        row = dict(zip(names, cells, strict=True))
        delays.append(_delay_ns(row["delay"], f"{where}: line {line}"))
        if trace.by == "time":
            times.append(_time_ns(row["time"], f"{where}: line {line}"))
            if times[1:] and times[-1] <= times[-2]:
                raise PlanError(f"{where}: line {line}: time {row['time']} must be later than that of the line before")
    if not delays:
        raise PlanError(f"{where}: holds no delay")
    return DelayTrace(tuple(delays), tuple(times))


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yields each line of a trace that holds values: its number, and its values.  Empty lines and remarks hold none."""
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines(), start=1):
        if said := line.partition("#")[0].strip():
            yield number, [cell.strip() for cell in said.replace(";", ",").split(",")]


def _is_value(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell.lower() == LOST_WORD
    return True


def _delay_ns(cell: str, where: str) -> int:
    """Returns a delay of a trace [ns], or `LOST`.  Raises PlanError."""
    if cell.lower() == LOST_WORD:
        return LOST
    value = _number(cell, where, f"a number, or {LOST_WORD!r}")
    if not 0 <= value <= MAX_DELAY:
        raise PlanError(f"{where}: delay {cell} must be a number from 0 to {MAX_DELAY:g}, or {LOST_WORD!r}")
    return round(value * 1e9)


def _time_ns(cell: str, where: str) -> int:
    """Returns an instant of a trace [ns].  Raises PlanError."""
    value = _number(cell, where, "a number")
    if not abs(value) <= MAX_DELAY:
        raise PlanError(f"{where}: time {cell} must be a number from {-MAX_DELAY:g} to {MAX_DELAY:g}")
    return round(value * 1e9)


def _number(cell: str, where: str, allowed: str) -> float:
    """Returns a finite number of a trace.  Raises PlanError, which says what is `allowed`."""
    try:
        value = float(cell)
    except ValueError:
        raise PlanError(f"{where}: {cell[:40]!r} must be {allowed}") from None
    if not isfinite(value):
        raise PlanError(f"{where}: {cell} must be a finite number")
    return value
