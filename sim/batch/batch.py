"""Many runs of one plan: `run_many`."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts, link_key
from echelon.sim.batch import records as r
from echelon.sim.batch.model import ModelMaker, refusal

Say = Callable[[str], None]
TRACED: Final = ("x", "y", "theta", "v", "omega", "cos_theta", "sin_theta")
"""What a trace has of each robot"""
_CHUNK: Final = 16
"""Largest number of runs that a thread takes at once"""


@dataclass(frozen=True, slots=True)
class BatchRuns:
    """What was measured of the runs of one plan, one row for each of `seeds`."""

    plan: Plan
    seeds: tuple[int, ...]
    fractions: tuple[float, ...]
    lost_ns: NDArray[np.int64]
    reals: NDArray[np.float64]
    wholes: NDArray[np.int64]
    traces: NDArray[np.float64]


def run_many(
    plan: Plan, seeds: Sequence[int], *, threads: int | None = None, traces: bool = False, say: Say | None = None
) -> Any:
    """Runs a plan once for each seed, on all cores."""
    if why := refusal(plan):
        raise UsageError(why)
    maker = ModelMaker(plan)
    model = maker.make()
    from echelon.sim.batch.compiled import is_kept
    from echelon.sim.batch.whole_run import many_runs

    names = [one.name for one in plan.all_roles]
    keys = np.empty((len(seeds), max(1, len(plan.links)), 2), dtype=np.uint64)
    for row, seed in enumerate(seeds):
        for at, link in enumerate(plan.links):
            key = 0 if link.ideal else link_key(seed, names[link.source], names[link.receiver], link.channel)
            keys[row, at] = key & (2**64 - 1), key >> 64
    common_ns = int(model.run["common_ns"][0])
    shape = (len(seeds), plan.duration_ns // common_ns + 1) if traces else (1, 0)
    traced = np.full((*shape, len(plan.robots), len(TRACED)), np.nan)
    kept_reals = np.arange(maker.pools.reals)
    kept_wholes = np.arange(maker.pools.wholes)
    reals = np.empty((len(seeds), len(kept_reals)))
    wholes = np.empty((len(seeds), len(kept_wholes)), dtype=np.int64)
    lost_ns = np.empty(len(seeds), dtype=np.int64)
    count = threads or len(os.sched_getaffinity(0))

    def work(first: int, last: int) -> None:
        real, whole = np.empty(maker.pools.reals), np.empty(maker.pools.wholes, dtype=np.int64)
        many_runs(model, keys, first, last, real, whole, reals, wholes, traced, lost_ns, kept_reals, kept_wholes)

    work(0, 0)
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(lambda first: work(first, min(first + _CHUNK, len(seeds))), range(0, len(seeds), _CHUNK)))
    return model, maker, BatchRuns(plan, tuple(seeds), maker.fractions, lost_ns, reals, wholes, traced)
