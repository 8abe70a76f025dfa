"""Many runs of one plan at once: `run_many`."""

import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.runtime.fates import ALL, link_key
from echelon.sim.batch.model import ModelMaker
from echelon.sim.batch.outcomes import TRACED, BatchRuns, Kept, outcomes
from echelon.sim.batch.records import Model
from echelon.sim.batch.refusals import gpu_refusal, refusal

_WORD: Final = 2**64 - 1
Device = Literal["processor", "gpu"]
MOST_AT_ONCE: Final = 16
"""Largest number of runs that a thread takes at once"""
PARTS: Final = 16
"""Parts into which runs are divided at least if something is summed over runs.  They do not depend on threads, nor do sums"""


def run_many(
    plan: Plan,
    seeds: Sequence[int],
    *,
    device: Device = "processor",
    threads: int | None = None,
    traces: bool = False,
    mean_squares: bool = False,
    say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
    progress: Callable[[int], None] = lambda done: None,
) -> BatchRuns:
    """Runs a plan once for each seed, and returns what was measured.

    Each run is the one that the in-process engine makes of the plan with that seed, to rounding.  It ends at the first instant
    at which a robot's state is not finite.  Runs do not depend on `threads` (by default one for each core).  `traces` asks for
    the robots' states too, `mean_squares`, which only the processor can, for E|e|² of each block over time.  `say` gets a line
    when code must be compiled first, `progress` the number of runs done so far.

    Raises UsageError if there are no seeds, if this engine cannot run the plan, or if there is no such device."""
    if not seeds or (threads is not None and threads < 1):
        raise UsageError(f"{len(seeds)} seeds, {threads} threads: there must be at least one of each")
    if why := refusal(plan):
        raise UsageError(why)
    if device == "gpu":
        if mean_squares:
            raise UsageError("device 'gpu': sums over runs are made by the processor only; use device 'processor'")
        return _on_gpu(plan, seeds, traces, say, progress)
    maker = ModelMaker(plan)
    model, pools = maker.make(), maker.pools
    from echelon.sim.batch import whole_run  # the compiler, when it is needed

    if not whole_run.is_kept():
        say("compiling the batch engine: once on this machine, for about half a minute")
    keys, kept = _keys(plan, seeds), Kept.of(model)
    instants = plan.duration_ns // int(model.run["common_ns"][0]) + 1
    traced = _room_for_traces(plan, model, len(seeds) if traces else 0)
    reals = np.empty((len(seeds), len(kept.reals)))
    wholes = np.empty((len(seeds), len(kept.wholes)), dtype=np.int64)
    lost_ns = np.empty(len(seeds), dtype=np.int64)
    sums_of = instants if mean_squares else 0, len(plan.blocks), 2
    sums = np.zeros(sums_of)

    own = threading.local()

    def work(part: range) -> tuple[int, NDArray[np.float64]]:
        added = np.zeros(sums_of)
        if not hasattr(own, "scratch"):
            own.scratch = np.empty(pools.reals), np.empty(pools.wholes, dtype=np.int64)
        real, whole = own.scratch
        whole_run.many_runs(
            model,
            keys,
            part.start,
            part.stop,
            real,
            whole,
            traced,
            added,
            lost_ns,
            kept.reals,
            kept.wholes,
            reals,
            wholes,
        )
        return len(part), added

    work(range(0))
    count = threads or len(os.sched_getaffinity(0))
    size = max(1, min(MOST_AT_ONCE, len(seeds) // (PARTS if mean_squares else 4 * count)))
    parts = [range(first, min(first + size, len(seeds))) for first in range(0, len(seeds), size)]
    pool, done = ThreadPoolExecutor(count), 0
    try:
        for finished, added in pool.map(work, parts):
            sums += added
            done += finished
            progress(done)
    finally:
        pool.shutdown(cancel_futures=True)
    return outcomes(
        plan,
        model,
        seeds,
        lost_ns,
        reals,
        wholes,
        traced if traces else None,
        sums if mean_squares else None,
    )


def _on_gpu(
    plan: Plan, seeds: Sequence[int], traces: bool, say: Callable[[str], None], progress: Callable[[int], None]
) -> BatchRuns:
    """Runs a plan once for each seed on an NVIDIA GPU.  Raises UsageError if there is none."""
    if why := gpu_refusal():
        raise UsageError(why)
    from echelon.sim.batch import gpu

    if not gpu.is_kept():
        say("compiling the batch engine for the GPU: once on this machine, for about a minute")
    maker = ModelMaker(plan)
    model = maker.make()
    kept = Kept.of(model)
    traced = _room_for_traces(plan, model, len(seeds) if traces else 0)
    lost_ns, reals, wholes = gpu.run_on_gpu(model, maker.pools, _keys(plan, seeds), kept, traced)
    progress(len(seeds))
    return outcomes(plan, model, seeds, lost_ns, reals, wholes, traced if traces else None, None)


def _room_for_traces(plan: Plan, model: Model, runs: int) -> NDArray[np.float64]:
    """Returns room for the states of this number of runs, (max(1, runs), T, robots, len(TRACED)); T is 0 without runs."""
    instants = plan.duration_ns // int(model.run["common_ns"][0]) + 1 if runs else 0
    return np.full((max(1, runs), instants, len(plan.robots), len(TRACED)), np.nan)


def _keys(plan: Plan, seeds: Sequence[int]) -> NDArray[np.int64]:
    """Returns the bits of the Philox keys of each link for each seed, (seeds, links, 4): that of the link, and that of losses
    for all receivers; zero for links that draw nothing."""
    names = [one.name for one in plan.all_roles]
    keys = np.zeros((len(seeds), max(1, len(plan.links)), 4), dtype=np.uint64)
    drawing = [(at, link) for at, link in enumerate(plan.links) if not link.prompt]
    for row, seed in enumerate(seeds):
        for at, link in drawing:
            key = link_key(seed, names[link.source], names[link.receiver], link.channel)
            of_loss = link_key(seed, names[link.source], ALL, link.channel) if link.loss_of_message else 0
            keys[row, at] = key & _WORD, key >> 64, of_loss & _WORD, of_loss >> 64
    return keys.view(np.int64)
