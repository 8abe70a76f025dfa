"""The parts of a loop that is cut open, against the whole loop."""

from typing import Any

import numpy as np
import pytest

from echelon.controller.prediction.cut_loop import mirrored, parts
from echelon.controller.prediction.largest_delay import edges_of
from echelon.controller.prediction.linear_run import LinearRun
from echelon.messages import Channel
from support.random_formations import random_formation
from support.runs import plan_of


@pytest.mark.parametrize("channel", [Channel.STATE, Channel.COMMAND])
@pytest.mark.parametrize(
    ("plan", "halves"),
    [
        pytest.param(lambda: plan_of("paper"), 2, id="x and y act on each other alike"),
        pytest.param(lambda: plan_of("lab"), 1, id="x and y are apart"),
        pytest.param(lambda: random_formation(0), 2, id="x and y differ"),
    ],
)
def test_parts_have_the_eigenvalues_of_the_whole_loop(plan: Any, halves: int, channel: Channel) -> None:
    run = LinearRun(plan := plan())
    loop = run.loop(edges_of(plan, channel))
    A, B, C, D = (matrix.toarray() for matrix in (loop.A, loop.B, loop.C, loop.D))
    found = list(parts(loop))
    assert sum(part._size for part in found) <= len(A) // 2 * halves
    for omega in (0.003, 0.2, 3.0):
        whole = np.linalg.eigvals(C @ np.linalg.solve(np.exp(1j * omega) * np.eye(len(A)) - A, B) + D)
        apart = np.concatenate([part.eigenvalues(np.array([omega]))[0] for part in found])
        whole, apart = (each[np.abs(each) > 1e-6 * np.abs(whole).max()] for each in (whole, apart))
        distance = np.abs(whole[:, None] - apart)
        assert distance.min(axis=0).max() < 1e-6 * np.abs(whole).max()
        assert distance.min(axis=1).max() < 1e-6 * np.abs(whole).max()


def test_each_half_moves_as_the_whole_loop_does() -> None:
    plan = plan_of("paper")
    loop = LinearRun(plan).loop(edges_of(plan, Channel.STATE))
    halves = mirrored(loop)
    assert len(halves) == 2
    for sign, (half, into_whole) in zip((1.0, -1.0), halves, strict=True):
        inputs, outputs = (np.kron(np.eye(size), [[1.0], [sign]]) for size in (half.B.shape[1], half.C.shape[0]))
        assert np.array_equal(into_whole.toarray(), np.kron(np.eye(half.A.shape[0]), [[1.0], [sign]]))
        for matrix, part, to, of in (
            (loop.A, half.A, into_whole, into_whole.toarray()),
            (loop.B, half.B, into_whole, inputs),
            (loop.C, half.C, outputs, into_whole.toarray()),
            (loop.D, half.D, outputs, inputs),
        ):
            assert matrix @ of == pytest.approx(to @ part.toarray(), abs=1e-15)
