"""How close robots come in the batch engine: as if all pairs were looked at in each instant."""

import numpy as np
import pytest
from numpy.typing import NDArray

from echelon.sim.batch import records as r
from echelon.sim.batch.measures import note_distances
from echelon.sim.batch.pools import Pools, records_of

RADIUS = 0.3


def paths(robots: int, spread: float, step: float, seed: int) -> NDArray[np.float64]:
    """Returns random walks of robots that move on together, (T, robots, 2); some of them stand still for a while."""
    draw = np.random.default_rng(seed)
    steps = draw.normal(0, step, (400, robots, 2)) * (draw.uniform(size=(400, 1, 1)) < 0.7)
    start = draw.uniform(0, spread, (1, robots, 2))
    return start + np.cumsum(steps, axis=0) + np.linspace(0, 40, 400)[:, None, None]


def by_all_pairs(places: NDArray[np.float64]) -> tuple[float, int]:
    """Returns the smallest distance on straight lines between instants, and how often a pair came within the radius."""
    smallest, violations = np.inf, 0
    for one in range(places.shape[1]):
        for other in range(one):
            offset = places[:, one] - places[:, other]
            change = np.diff(offset, axis=0)
            squares = (change**2).sum(1)
            along = np.clip(-(offset[:-1] * change).sum(1) / np.where(squares > 0, squares, 1), 0, 1)
            nearest = np.hypot(*(offset[:-1] + along[:, None] * change).T)
            ends = np.hypot(*offset.T)
            smallest = min(smallest, nearest.min(), ends.min())
            violations += int(ends[0] <= RADIUS) + int(((nearest <= RADIUS) & (ends[:-1] > RADIUS)).sum())
    return smallest, violations


def noted(walks: NDArray[np.float64]) -> tuple[float, int]:
    """Returns the same as the batch engine finds it."""
    robots = walks.shape[1]
    pools = Pools()
    places = {name: pools.real(2 * robots) for name in ("places_at", "before_at")}
    at = places | {name: pools.real(1) for name in ("distance_at", "apart_at")}
    at |= {"order_at": pools.whole(robots + 1), "closest_at": pools.whole(4)}
    (run,) = records_of(r.RUN, [at | {"avoidance_radius": RADIUS}])
    real, whole = np.zeros(pools.reals), np.zeros(pools.wholes, dtype=np.int64)
    real[run.distance_at], real[run.apart_at] = 1e300, -1.0
    whole[run.order_at : run.order_at + robots] = np.arange(robots)
    now, before = (slice(at[name], at[name] + 2 * robots) for name in ("places_at", "before_at"))
    real[before] = walks[0].ravel()
    for number, instant in enumerate(walks):
        real[now] = instant.ravel()
        note_distances(run, robots, real, whole, number * 1000, 1000 if number else 0)
        real[before] = real[now]
    return float(np.sqrt(real[run.distance_at])), int(whole[run.closest_at + 3])


@pytest.mark.parametrize("robots", [2, 9, 16, 17, 40])
@pytest.mark.parametrize("step", [1e-4, 0.01, 0.1])
@pytest.mark.parametrize("spread", [1.0, 30.0])
def test_no_pair_is_missed(robots: int, step: float, spread: float) -> None:
    walks = paths(robots, spread, step, robots)
    smallest, violations = by_all_pairs(walks)
    assert noted(walks) == (pytest.approx(smallest, rel=1e-9, abs=1e-12), violations)


@pytest.mark.parametrize("others", [1, 20])
def test_robots_that_come_back_are_seen_to_meet(others: int) -> None:
    apart = np.concatenate([np.linspace(10, 0.5, 100), np.linspace(0.5, 10, 100), np.linspace(10, -10, 200)])
    walks = np.zeros((400, 2 + others, 2))
    walks[:, :others, 1] = 50 + 3 * np.arange(others)
    walks[:, others, 0] = -apart
    walks[:, others + 1, 0] = apart
    walks[:, others + 1, 1] = 0.25
    assert by_all_pairs(walks)[1] == 1
    assert noted(walks) == (pytest.approx(0.25), 1)
