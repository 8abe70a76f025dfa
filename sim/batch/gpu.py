"""Many runs at once on an NVIDIA GPU, from the same source as on the processor.

Each thread makes one run after the other.  There are as many threads as the card holds at once, fewer if their scratch does not
fit into its memory.
"""

from collections.abc import Callable
from functools import cache
from math import ceil, pi
from types import FunctionType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

if not hasattr(np, "row_stack"):
    np.row_stack = np.vstack  # type: ignore[attr-defined, unused-ignore]  # numba-cuda 0.30 asks for it, numpy 2.5 has it no longer

from numba import config, cuda

from echelon.errors import UsageError
from echelon.sim.batch import ages, angles, philox, streams, whole_run
from echelon.sim.batch.compiled import cache_folder
from echelon.sim.batch.lane import WIDTH, lane_of, upto
from echelon.sim.batch.outcomes import Kept
from echelon.sim.batch.pools import Pools
from echelon.sim.batch.records import Model

_IS_SIMULATED: Final = bool(config.ENABLE_CUDASIM)
BLOCK: Final = 64
"""Threads of a block"""
REGISTERS: Final = 128
"""Of a thread, at most.  The kernel waits for memory most of the time: twice as many threads are worth some registers that go
there"""
MEMORY_SHARE: Final = 0.85
"""Of the memory that is free, this is used at most"""


def why_not() -> str | None:
    """Returns why there is no GPU for this process; None if there is one."""
    try:
        return None if cuda.is_available() else "there is no NVIDIA GPU with a driver on this machine"
    except Exception as error:  # a driver may fail in any way
        return f"the NVIDIA GPU cannot be used: {str(error).strip().partition(chr(10))[0]}"


def is_kept() -> bool:
    """True if the compiled kernel of these sources is kept."""
    return _IS_SIMULATED or any(cache_folder().rglob("gpu.*many_runs*.nbc"))


def _bin_of(age_ns: int) -> int:
    return int((cuda.libdevice.double_as_longlong(np.float64(age_ns)) >> 45) - (1023 << 7))


def _high(a: np.uint64, b: np.uint64) -> np.uint64:
    return np.uint64(cuda.libdevice.umul64hi(a, b))


def _within_one_turn(angle: float) -> float:
    turns: float = cuda.libdevice.rint(angle / (2 * pi))
    return angle - 2 * pi * turns


_OWN: Final = {ages.bin_of: _bin_of, philox.high: _high, angles.within_one_turn: _within_one_turn}
"""What a GPU has instructions of its own for, or does in less code"""


@cache
def on_gpu(function: Callable[..., Any]) -> Any:
    """Returns what `compiled` marked, for a GPU, with all that it calls."""
    if _IS_SIMULATED:
        return function
    plain = _OWN.get(function) or function.py_func  # type: ignore[attr-defined]
    names = {**plain.__globals__, "upto": upto}
    for name in plain.__code__.co_names:
        if hasattr(names.get(name), "py_func"):
            names[name] = on_gpu(names[name])
    code = plain.__code__.replace(
        co_names=tuple("upto" if name == "range" else name for name in plain.__code__.co_names)
    )
    return cuda.jit(device=True, forceinline=True)(FunctionType(code, names, plain.__name__))


def make_kernel(**options: Any) -> Any:
    """Returns the kernel: each thread makes the runs `lane`, `lane` + number of lanes, … of a model."""
    one_run, finish = on_gpu(whole_run.whole_run), on_gpu(streams.finish)

    def many_runs(
        model: Any, keys: Any, real: Any, whole: Any, traces: Any, sums: Any, lost_ns: Any,
        kept_reals: Any, kept_wholes: Any, reals: Any, wholes: Any,
    ) -> None:  # fmt: skip
        lane = cuda.grid(1)
        lanes = real.shape[0] * WIDTH
        if lane >= lanes:
            return
        my_real = lane_of(real, lane)
        my_whole = lane_of(whole, lane)
        for number in range(lane, len(lost_ns), lanes):
            trace = traces[min(number, len(traces) - 1)]
            lost_ns[number] = one_run(model, keys[number], my_real, my_whole, trace, sums)
            for at in range(len(model.links)):
                finish(model.links[at], my_whole)
            for place in range(len(kept_reals)):
                reals[place, number] = my_real[kept_reals[place]]
            for place in range(len(kept_wholes)):
                wholes[place, number] = my_whole[kept_wholes[place]]

    return cuda.jit(**options)(many_runs)


@cache
def kernel() -> Any:
    """Returns the kernel, which is kept once it is compiled."""
    if _IS_SIMULATED:
        return make_kernel()
    config.CACHE_DIR, before = str(cache_folder()), config.CACHE_DIR
    try:
        return make_kernel(cache=True, max_registers=REGISTERS)
    finally:
        config.CACHE_DIR = before


def lanes_for(runs: int, scratch_bytes: int, free_bytes: int, most: int) -> int:
    """Returns the number of threads for a number of runs: at most `most`, and all make as many runs or one less.  Raises
    UsageError if the scratch of a few does not fit."""
    fitting = min(most, int(MEMORY_SHARE * free_bytes) // scratch_bytes) // WIDTH * WIDTH
    if fitting == 0:
        raise UsageError(
            f"{WIDTH} runs at once take {WIDTH * scratch_bytes / 1e9:.3g} GB, and the GPU has {free_bytes / 1e9:.3g} GB free; "
            "use --engine batch"
        )
    return ceil(ceil(runs / ceil(runs / fitting)) / WIDTH) * WIDTH


def _resident() -> int:
    """Returns how many threads the card holds at once, once the kernel is compiled."""
    if _IS_SIMULATED:
        return WIDTH
    (made,) = kernel().overloads.values()
    return BLOCK * int(made.max_cooperative_grid_blocks(BLOCK))


def run_on_gpu(
    model: Model, pools: Pools, keys: NDArray[np.int64], kept: Kept, traces: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Makes the runs of a model with these keys, (runs, links, 4); returns the instants at which they were lost [ns], -1 if
    not, and their results, (runs, reals) and (runs, wholes).  States go to `traces`, (runs, T, robots, 7), unless it is empty.
    Raises UsageError if the scratch does not fit into the card's memory."""
    on_card = Model(*(cuda.to_device(np.asarray(part)) for part in model))
    places = cuda.to_device(kept.reals), cuda.to_device(kept.wholes)
    sums, traces_there = cuda.device_array((0, 1, 2)), cuda.to_device(traces)

    def launch(lanes: int, keys: NDArray[np.int64]) -> tuple[Any, Any, Any]:
        tiles, runs = lanes // WIDTH, len(keys)
        real = cuda.device_array((tiles, pools.reals, WIDTH))
        whole = cuda.device_array((tiles, pools.wholes, WIDTH), dtype=np.int64)
        lost_ns = cuda.device_array(runs, dtype=np.int64)
        reals = cuda.device_array((len(kept.reals), runs))
        wholes = cuda.device_array((len(kept.wholes), runs), dtype=np.int64)
        blocks = ceil(lanes / BLOCK)
        kernel()[blocks, BLOCK](
            on_card, cuda.to_device(keys), real, whole, traces_there, sums, lost_ns, *places, reals, wholes
        )
        return lost_ns, reals, wholes

    launch(WIDTH, keys[:0])  # compiles
    free_bytes = 1 << 40 if _IS_SIMULATED else cuda.current_context().get_memory_info().free
    lanes = lanes_for(len(keys), 8 * (pools.reals + pools.wholes), free_bytes, _resident())
    lost_ns, reals, wholes = (part.copy_to_host() for part in launch(lanes, keys))
    traces_there.copy_to_host(traces)
    return lost_ns, reals.T, wholes.T
