"""The transformed state over time: for every block its value, its desired value, its error, and their rates of change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echelon.controller.transformation import Transformation
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
    times_ns, states = trace.common()
    plan = trace.plan
    transformation = Transformation(plan)
    instants, size = len(times_ns), 2 * len(plan.robots)
    reference = Desired(plan).sample(times_ns / 1e9)
    desired = np.empty((instants, size))
    desired[:, :-2] = transformation.desired_shape.reshape(-1)
    desired[:, -2:] = reference[:, 0]
    desired_rate = np.zeros((instants, size))
    desired_rate[:, -2:] = reference[:, 1]
    with np.errstate(all="ignore"):
        value = _transformed(transformation, states[:, :, POSITION]).reshape(instants, size)
        rate = _transformed(transformation, states[:, :, VELOCITY]).reshape(instants, size)
        error, error_rate = value - desired, rate - desired_rate
        series = []
        for block in plan.blocks:
            at = slice(block.offset, block.offset + block.size)
            norm = np.sqrt(np.square(error[:, at]).sum(axis=1))
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
