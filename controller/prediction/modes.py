"""The modes of each block, in continuous time and as sampled, and how errors settle from the scenario's start
(docs/architecture.md, 2.7).

*In continuous time* the modes of a block alone are the poles of ë = -K_1 e - K_2 ė - K_i ∫e dt, gains as full matrices, without
`lead`.  *As sampled* they are the eigenvalues λ of the map M of one hyperperiod H, with the law as it acts, the periods, the
links and the couplings as they are; a mode belongs to the block that moves most in it.  e^{sH} = λ gives its rate s."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.controller.prediction.gains import linear_gains, poles
from echelon.controller.prediction.likeness import reduced
from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.prediction.spectrum import strong_parts
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.plan.plan import Array, Plan

Complex = NDArray[np.complex128]
DENSE: Final = 1000
"""Size of the largest part of the map whose eigenvectors are computed"""
ZERO: Final = 1e-6
"""Eigenvalues up to this magnitude belong to messages on their way and say nothing about blocks"""
SAME: Final = 1e-9
"""Modes closer than this share are the same"""
MOST: Final = 200
"""Largest number of robots whose errors are computed over time"""


@dataclass(frozen=True, slots=True)
class BlockModes:
    """The modes of a block, or of several that are alike."""

    names: tuple[str, ...]
    layer: str
    size: int
    """Number of values of e"""
    sigma: float
    """Time scale σ [s]"""
    poles: tuple[complex, ...]
    """Poles of the block alone in continuous time [1/s], each once, the slowest first"""
    eigenvalues: tuple[complex, ...]
    """Eigenvalues of the sampled run in which this block moves most, each once, the largest first; without those of messages on
    their way"""

    def rate(self, hyperperiod_s: float) -> complex | None:
        """Returns the rate s of the slowest sampled mode [1/s]; None if there is no mode."""
        if not self.eigenvalues:
            return None
        return complex(np.log(complex(self.eigenvalues[0])) / hyperperiod_s)


def block_modes(plan: Plan) -> tuple[BlockModes, ...]:
    """Returns the modes of the blocks of a plan.  Blocks that are alike are one.

    Raises PredictionError as `LinearRun` does."""
    small, _, names = reduced(plan)
    of_block: dict[tuple[str, ...], list[complex]] = {each: [] for each in names}
    transformation = Transformation(small)
    owner = [
        each for block, each in zip(small.blocks, names, strict=True) for _ in range(block.size // 2)
    ]  # of each variable
    matrix = LinearRun(small).map()
    robots = 4 * len(small.robots)
    for rows in strong_parts(matrix):
        if len(rows) > DENSE or not (rows < robots).any():
            continue
        values, vectors = np.linalg.eig(matrix[rows][:, rows].toarray())
        here = rows < robots
        whole = np.zeros((len(values), robots), dtype=complex)
        whole[:, rows[here]] = vectors[here].T
        z = np.linalg.norm(transformation.forward(whole.reshape(len(values), -1, 4)[:, :, :2]), axis=2)
        for value, moves in zip(values, z, strict=True):
            if abs(value) > ZERO and moves.any():
                of_block[owner[int(moves.argmax())]].append(complex(value))
    found: dict[tuple[str, ...], BlockModes] = {}
    for block, each in zip(small.blocks, names, strict=True):
        if block.size and each not in found:
            alone = poles(linear_gains(small, block, 0.0))
            found[each] = BlockModes(
                each,
                block.layer,
                next(one.size for one in plan.blocks if one.name == each[0]),
                block.sigma,
                _each_once(alone, -alone.real),
                _each_once(np.array(of_block[each], dtype=complex), -np.abs(of_block[each])),
            )
    return tuple(found.values())


def _each_once(values: Complex, order: Array) -> tuple[complex, ...]:
    """Returns values in ascending order of `order`, without those that are nearly the same as one before."""
    found: list[complex] = []
    for value in values[np.argsort(order, kind="stable")]:
        if all(abs(value - one) > SAME * max(abs(one), abs(value)) for one in found):
            found.append(complex(value))
    return tuple(found)


def linear_errors(plan: Plan) -> tuple[NDArray[np.int64], Array]:
    """Returns the errors of all blocks, (T, 2N) [m], at the beginning of each hyperperiod, (T,) [ns]: those of the linear run
    from the scenario's start.

    Raises PredictionError as `LinearRun` does, ValueError for more than `MOST` robots."""
    if len(plan.robots) > MOST:
        raise ValueError(f"{len(plan.robots)} robots: at most {MOST}")
    run, transformation = LinearRun(plan), Transformation(plan)
    matrix, H = run.map(), run.hyperperiod_ns * 1e-9
    desired = make_trajectory(plan.trajectory).at(0.0)
    x: Array = np.zeros(run.size)
    state: Array = x[: 4 * len(plan.robots)].reshape(-1, 4)
    places = transformation.backward(transformation.desired(desired[0]))
    state[:, :2] = np.array([robot.start for robot in plan.robots]) - places
    state[:, 2:] = -H * desired[1]
    times_ns = np.arange(0, plan.duration_ns + 1, run.hyperperiod_ns)
    errors = np.empty((len(times_ns), 2 * len(plan.robots)))
    with np.errstate(all="ignore"):
        for row in errors:
            row[:] = transformation.forward(state[:, :2]).ravel()
            x = np.asarray(matrix @ x, dtype=np.float64).reshape(-1)
            state = x[: 4 * len(plan.robots)].reshape(-1, 4)
    return times_ns, errors
