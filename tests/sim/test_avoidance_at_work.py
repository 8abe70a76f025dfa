"""`crossing`: the shipped scenario in which avoidance has work to do."""

import numpy as np

from echelon.plan.plan import Plan
from echelon.sim.batch.batch import run_many
from support.runs import plan_of

MEETING = "duration=8"  # all encounters are over by then


def positions(plan: Plan) -> np.ndarray:
    traces = run_many(plan, [1], traces=True, threads=1).traces
    assert traces is not None
    return traces[0, :, :, :2]


def closest_of_pairs(place: np.ndarray) -> np.ndarray:
    """Returns the smallest distance of each pair over time, from the positions (T, robots, 2)."""
    count = place.shape[1]
    gaps = np.linalg.norm(place[:, :, None] - place[:, None], axis=3).min(axis=0)
    return gaps[np.triu_indices(count, 1)]


def test_robots_come_within_the_sensing_radius_and_keep_the_avoidance_radius() -> None:
    plan = plan_of("crossing", MEETING)
    gaps = closest_of_pairs(positions(plan))
    assert (gaps < plan.avoidance.sensing_radius).sum() >= 6
    assert gaps.min() > plan.avoidance.avoidance_radius


def test_without_avoidance_robots_would_meet() -> None:
    gaps = closest_of_pairs(positions(plan_of("crossing", MEETING, "avoidance.enabled=false")))
    assert gaps.min() < 0.05
    assert (gaps < 0.32).sum() >= 3


def test_all_claims_hold_and_the_check_of_avoidance_passes() -> None:
    runs = run_many(plan_of("crossing"), [1], threads=1)
    assert runs.claims.all()
    assert runs.runs["violations"].tolist() == [0]
