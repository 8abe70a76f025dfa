"""The transformed state over time: for every block its value, its desired value, its error, and their rates of change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echelon.controller.transformation import Transformation
from echelon.large_arrays import large_empty
from echelon.messages import STATE_FIELDS, field_index
from echelon.plan.plan import BlockPlan
from echelon.sim.results.desired import Desired
from echelon.sim.results.trace import Trace

Array = NDArray[np.float64]
POSITION = field_index(STATE_FIELDS, "x", "y")
VELOCITY = field_index(STATE_FIELDS, "vx", "vy")


@dataclass(frozen=True, slots=True)
class BlockSeries:
    """A block Z_b of the transformed state (docs/architecture.md, 2.3) at T instants; arrays are (T, block.size) but for
    `norm`."""

    block: BlockPlan
    value: Array
    """Z_b [m]"""
    desired: Array
    """Z_bd [m]"""
    error: Array
    """e = Z_b - Z_bd [m]"""
    rate: Array
    """dZ_b/dt [m/s]"""
    error_rate: Array
    """de/dt [m/s]"""
    norm: Array
    """|e| [m], (T,)"""


@dataclass(frozen=True, slots=True)
class Blocks:
    """All blocks at the same instants (T,), in the order of the plan."""

    times_ns: NDArray[np.int64]
    series: tuple[BlockSeries, ...]

    @property
    def seconds(self) -> Array:
        """The instants [s], (T,)."""
        return self.times_ns / 1e9


def block_series(trace: Trace) -> Blocks:
    """Returns all blocks at the instants at which every robot has a state.

    A state that is not finite gives values that are not finite, without an exception or a warning."""
    times_ns, plan = trace.common_ns(), trace.plan
    transformation, reference = Transformation(plan), Desired(plan)
    instants, size = len(times_ns), 2 * len(plan.robots)
    value, desired, error, rate, error_rate = (large_empty((instants, size)) for _ in range(5))
    desired[:, :-2] = transformation.desired_shape.reshape(-1)
    norms = [large_empty(instants) for _ in plan.blocks]
    with np.errstate(all="ignore"):
        for part, states in trace.windows((*POSITION, *VELOCITY)):
            value[part] = _transformed(transformation, states[:, :, :2]).reshape(-1, size)
            rate[part] = _transformed(transformation, states[:, :, 2:]).reshape(-1, size)
            wanted = reference.sample(times_ns[part] / 1e9)
            desired[part, -2:] = wanted[:, 0]
            np.subtract(value[part], desired[part], out=error[part])
            error_rate[part] = rate[part]
            error_rate[part, -2:] -= wanted[:, 1]
            for block, norm in zip(plan.blocks, norms, strict=True):
                of_block = error[part, block.offset : block.offset + block.size]
                np.sqrt(np.square(of_block).sum(axis=1), out=norm[part])
    series = []
    for block, norm in zip(plan.blocks, norms, strict=True):
        at = slice(block.offset, block.offset + block.size)
        series.append(
            BlockSeries(block, value[:, at], desired[:, at], error[:, at], rate[:, at], error_rate[:, at], norm)
        )
    return Blocks(times_ns, tuple(series))


def _transformed(transformation: Transformation, x: Array) -> Array:
    """Returns Z = Φ_M x, (T, N, 2), for positions or velocities x of N robots, (T, N, 2).

    A robot whose x is not finite makes only those variables NaN that it is part of: a plain product would spoil all of them,
    since 0 · NaN is not 0."""
    finite = np.isfinite(x)
    if finite.all():
        return transformation.forward(x)
    z = transformation.forward(np.where(finite, x, 0.0))
    z[(transformation.matrix != 0).astype(float) @ ~finite > 0] = np.nan
    return z


def component_names(block: BlockPlan) -> tuple[str, ...]:
    """Returns the names of a block's components in order: `x`, `y` for the centroid, `z1_x`, `z1_y`, `z2_x`, … for a shape."""
    if block.node is None:
        return ("x", "y")
    return tuple(f"z{number}_{axis}" for number in range(1, block.size // 2 + 1) for axis in "xy")
