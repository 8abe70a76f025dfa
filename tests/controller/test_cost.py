"""Expected cost: against the mean of many runs, a run without loss, and Lyapunov's equation."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from echelon.controller.prediction.cost import Cost, expected_cost, steady_cost, waiting
from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.transformation import Transformation
from echelon.sim.batch.batch import run_many
from support.near_formation import T, near_formation
from support.trees import plan_of, scenario

RUNS = 400
SURE = 4.0
"""Standard errors of the mean that the runs may be off; they are about 0.5 %"""


def of(cost: Cost | None) -> np.ndarray:
    assert cost is not None
    return np.array([block.value for block in cost.blocks])


@pytest.mark.slow
@pytest.mark.parametrize("timing", ["event_driven", "time_driven"])
@pytest.mark.parametrize("links", [
    [{"loss": 0.1}],
    [{"channel": "state", "loss": 0.3, "delay": T}],
    [{"channel": "command", "loss": 0.4}],
])  # fmt: skip
def test_cost_is_the_mean_of_runs(links, timing):
    plan = near_formation(links, timing)
    runs = run_many(plan, range(RUNS))
    ise = runs.blocks["ise"]
    error = ise.std(axis=0) / np.sqrt(len(ise))
    found = of(expected_cost(plan))
    off = np.abs(found - ise.mean(axis=0))
    assert (off <= 0.02 * ise.mean(axis=0)).all()
    assert (off <= SURE * error).all()
    assert (error < 0.0125 * ise.mean(axis=0)).all()


@pytest.mark.slow
def test_cost_without_loss_is_that_of_the_run():
    plan = near_formation([])
    (ise,) = run_many(plan, [1]).blocks["ise"]
    assert of(expected_cost(plan)) == pytest.approx(ise, rel=2e-3)


def test_steady_errors_without_loss_are_those_of_lyapunovs_equation():
    plan, q = near_formation([]), 0.3
    run = LinearRun(plan)
    M, H = run.map().toarray(), T
    Q = np.zeros_like(M)
    for robot in range(len(plan.robots)):
        own = slice(4 * robot, 4 * robot + 4)
        scale = np.diag([1, 1, H, H])
        Q[own, own] = q * scale @ np.kron([[H**3 / 3, H**2 / 2], [H**2 / 2, H]], np.eye(2)) @ scale
    X = solve_discrete_lyapunov(M, Q)
    places = [4 * robot + axis for robot in range(len(plan.robots)) for axis in (0, 1)]
    phi = np.kron(Transformation(plan).matrix, np.eye(2))
    squares = np.diag(phi @ X[np.ix_(places, places)] @ phi.T)
    expected = [squares[block.offset : block.offset + block.size].sum() for block in plan.blocks]
    assert of(steady_cost(plan, q)) == pytest.approx(expected, rel=1e-7)
    with pytest.raises(ValueError, match="must not be negative"):
        steady_cost(plan, -1.0)


@pytest.mark.parametrize("timing", ["event_driven", "time_driven"])
def test_bursts_as_short_as_independent_losses_cost_the_same(timing):
    link = {"channel": "state", "source": "g0/r0"}
    one = near_formation([link | {"loss": 0.3}], timing)
    other = near_formation([link | {"loss": {"mean": 0.3, "burst": 1 / 0.7}}], timing)
    assert any(link.bursts for link in other.links)
    assert of(expected_cost(other)) == pytest.approx(of(expected_cost(one)), rel=1e-5)
    noisy, also = steady_cost(one, 0.1), steady_cost(other, 0.1)
    assert of(noisy) == pytest.approx(of(also), rel=1e-7)


def test_no_cost_where_errors_do_not_vanish():
    assert expected_cost(near_formation([{"loss": 0.97}])) is None


def test_robots_wait_until_the_coordinator_has_heard_of_all():
    """Three robots below the coordinator: the largest of three geometric waits, beside a constant delay."""
    table = scenario((None,) * 3, np.random.default_rng(1), links=[{"channel": "state", "loss": 0.4, "delay": 0.002}])
    found = waiting(plan_of(table))
    n = np.arange(len(found))
    expected = np.diff(np.where(n >= 2, 1 - 0.4 ** np.maximum(n - 1, 0), 0.0) ** 3, prepend=0.0)
    assert found == pytest.approx(expected, abs=1e-12)
    assert found.sum() == pytest.approx(1.0, abs=1e-8)
