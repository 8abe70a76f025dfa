"""E|e|² over many runs: against their own traces, and against the recursion of the second moment under random loss."""

from dataclasses import replace

import numpy as np
import pytest

from echelon.controller.transformation import Transformation
from echelon.messages import Channel
from echelon.plan.plan import Array, Plan
from echelon.sim.batch.batch import run_many
from support.growth import single
from support.points import at_rest, time_driven
from support.runs import plan_of

T = 0.1


def lossy(loss: float, k1: float, k2: float, seconds: float) -> Plan:
    """Returns one robot, a tenth of a millimetre from where it should be, whose states are lost by chance."""
    plan = time_driven(at_rest(single(T, k1=k1, k2=k2)))
    robot = replace(plan.robots[0], start=(0.8e-4, 0.6e-4), heading=0.0, torque_period_ns=1_000_000)
    links = [replace(link, loss=loss) if link.channel is Channel.STATE else link for link in plan.links]
    return replace(plan, robots=(robot,), links=tuple(links), duration_ns=round(seconds * 1e9))


def expected(loss: float, k1: float, k2: float, steps: int) -> Array:
    """Returns E|e|² at the beginning of each period: of s = (p, v, p̂, v̂), where p̂ and v̂ came last, each axis for itself."""

    def step(heard: Array) -> Array:
        """Returns the map over a period, from what was heard."""
        moved = heard.copy()
        moved[:2] = np.array([[1, T], [0, 1]]) @ heard[:2] - np.outer([T**2 / 2, T], [k1, k2]) @ heard[2:]
        return moved

    hold, take = step(np.eye(4)), step(np.eye(4)[[0, 1, 0, 1]])
    second, found = np.zeros((4, 4)), []
    second[0, 0] = 1e-8
    for _ in range(steps):
        found.append(second[0, 0])
        second = (1 - loss) * take @ second @ take.T + loss * hold @ second @ hold.T
    return np.array(found)


@pytest.mark.parametrize(("loss", "k1", "k2"), [(0.3, 4.0, 2.0), (0.5, 12.0, 5.0), (0.6, 30.0, 8.0)])
def test_the_second_moment_is_that_of_its_recursion(loss: float, k1: float, k2: float) -> None:
    """With the last gains and loss it grows, though most runs settle."""
    runs = run_many(lossy(loss, k1, k2, 1.5), range(20_000), mean_squares=True)
    assert runs.mean_squares is not None
    assert runs.mean_squares_error is not None
    found, error = runs.mean_squares[:, -1], runs.mean_squares_error[:, -1]
    wanted = expected(loss, k1, k2, len(found))
    assert (wanted[-1] > wanted[0]) == (loss > 0.5)
    assert (np.abs(found - wanted) < 5 * error + 0.01 * wanted).all()


def test_it_is_the_mean_over_the_runs() -> None:
    plan = plan_of("lab", "duration=1", 'links=[{source="**", receiver="**", loss=0.3}]')
    seeds = range(100)
    runs = run_many(plan, seeds, traces=True, mean_squares=True)
    assert runs.traces is not None
    assert runs.mean_squares is not None
    assert runs.mean_squares_error is not None
    forward = Transformation(plan).forward(runs.traces[:, -1, :, :2])
    first = plan.blocks[0]
    desired = Transformation(plan).desired(np.zeros(2))[: first.size // 2]
    squares = np.square(forward[:, : first.size // 2] - desired).sum(axis=(1, 2))
    assert runs.mean_squares[-1, 0] == pytest.approx(squares.mean(), rel=1e-12)
    assert runs.mean_squares_error[-1, 0] == pytest.approx(squares.std(ddof=1) / 10, rel=1e-6)
    again = run_many(plan, seeds, threads=3, mean_squares=True)
    assert again.mean_squares is not None
    assert again.mean_squares.tobytes() == runs.mean_squares.tobytes()
    assert run_many(plan, [1]).mean_squares is None


def test_it_is_infinite_from_where_a_run_has_diverged() -> None:
    plan = plan_of("paper", "duration=0.3", 'links=[{source="**", receiver="**", delay=0.02}]')
    runs = run_many(plan, range(3), mean_squares=True)
    assert runs.mean_squares is not None
    diverged = float(runs.runs["diverged"].min())
    late = runs.times > diverged
    assert late.any()
    assert np.isinf(runs.mean_squares[late]).all()
    assert np.isfinite(runs.mean_squares[runs.times < diverged - 0.01]).all()
