"""What is drawn of long lines and paths: all that can be seen, and no more the longer a run is."""

import gc
import tracemalloc

import numpy as np
import pytest
from matplotlib.figure import Figure

from echelon import large_arrays
from echelon.messages import STATE_FIELDS
from echelon.sim.report.comparison import Compared, comparison
from echelon.sim.report.figures import FIGURES, picture, smallest_distance
from echelon.sim.report.thinning import ThinPath, span, thin
from echelon.sim.results.block_series import block_series
from echelon.sim.results.distances import distances
from echelon.sim.results.trace import Trace
from support.runs import plan_of


def circling(laps: int) -> np.ndarray:
    """Returns the points of a robot that goes round on the same circle, (T, 2), with a spike of a single point."""
    angle = np.arange(laps * 4001) * 2 * np.pi / 4001
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[3210] = (0.0, 1.5)
    return points


def thinned(points: np.ndarray, pixel: float, piece: int = 8192) -> np.ndarray:
    path = ThinPath(points.min(axis=0), pixel)
    for start in range(0, len(points), piece):
        path.add(points[start : start + piece])
    return path.points


@pytest.mark.parametrize("piece", [999, 8192])
def test_a_path_keeps_all_that_can_be_seen(piece: int) -> None:
    points, pixel = circling(1), 0.01
    kept = thinned(points, pixel, piece)
    kept = kept[np.isfinite(kept).all(axis=1)]
    assert len(kept) < 1000
    assert (0.0, 1.5) in [tuple(point) for point in kept.tolist()]
    away = np.hypot(*(points[:, None] - kept[None]).transpose(2, 0, 1)).min(axis=1)
    assert away.max() < 1.5 * pixel


def test_a_path_that_is_gone_again_and_again_has_no_more_points() -> None:
    once, often = (len(thinned(circling(laps), 0.01)) for laps in (1, 30))
    assert often < 1.1 * once


def test_a_way_that_is_gone_again_later_does_not_join_what_is_apart() -> None:
    """To and fro between two places, with a visit to a third one: no line from the first place to the third."""
    a, b, c = (0.0, 0.0), (5.0, 0.0), (5.0, 5.0)
    kept = thinned(np.array([a, b, a, b, a, b, c]), 1.0)
    lines = {(tuple(one), tuple(other)) for one, other in zip(kept[:-1].tolist(), kept[1:].tolist(), strict=True)}
    assert {line for line in lines if not np.isnan(line).any()} == {(a, b), (b, a), (b, c)}


def test_a_gap_in_a_path_stays_a_gap() -> None:
    points = np.array([(0.0, 0.0), (1.0, 0.0), (np.nan, 0.0), (3.0, 0.0), (4.0, 0.0)])
    path = ThinPath(np.zeros(2), 0.1)
    path.add(points)
    kept = path.points
    assert np.isnan(kept[np.flatnonzero(kept[:, 0] == 1.0)[0] + 1]).any()
    assert {*kept[np.isfinite(kept[:, 0]), 0]} == {0.0, 1.0, 3.0, 4.0}


@pytest.mark.parametrize("log", [False, True])
def test_a_spike_and_a_gap_stay_visible_in_a_line(log: bool) -> None:
    times_ns = np.arange(1, 100_001) * 1_000_000
    values = np.sin(times_ns / 1e9)
    values[70_000], values[80_000], values[90_000] = 9.0, -9.0, np.nan
    times, shown = thin(times_ns, values, log)
    assert len(times) < 2001
    assert {9.0, -9.0} <= {*shown}
    assert np.isnan(shown[times == 90.001]).all()
    assert (times == 90.001).any()
    assert span(values) == (-9.0, 9.0)


def of_length(instants: int) -> Trace:
    """Returns a trace of nine robots that go round, with small random errors."""
    plan, luck = plan_of("lab", f"duration={instants / 100}"), np.random.default_rng(1)
    t = np.arange(instants)
    angle = t % 3000 * 2 * np.pi / 3000
    states = [1e-3 * luck.normal(size=(instants, len(STATE_FIELDS))) for _ in plan.robots]
    for robot, rows in zip(plan.robots, states, strict=True):
        rows[:, 0] = robot.index + np.cos(angle)
        rows[:, 1] = np.sin(angle)
    return Trace(plan, (10_000_000 * t,) * len(states), tuple(states))


def drawn(instants: int) -> dict[str, int]:
    """Draws all figures of a run and of a comparison; returns the largest memory that each takes [bytes]."""
    trace = of_length(instants)
    blocks, near = block_series(trace), distances(trace)
    compared, peaks = comparison([Compared("a", trace, blocks, near)]), {}
    pictures = {name: lambda name=name: picture(name, trace, blocks) for name in FIGURES}
    pictures["distance"] = lambda: smallest_distance(near, trace.plan, 11.5)
    pictures |= {f"compared {name}": lambda name=name: compared[name][0] for name in compared}
    pictures["all compared"] = lambda: comparison([Compared("a", trace, blocks, near)])["trajectories"][0]
    for name, make in pictures.items():
        gc.collect()
        tracemalloc.start()
        try:
            drawing = make()
            drawing.draw(Figure(figsize=(drawing.width, drawing.height)))
            peaks[name] = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    return peaks


@pytest.mark.slow
def test_the_figures_of_a_long_run_take_no_more_memory_than_those_of_a_short_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of what is in a file from the beginning; small ones are in memory."""
    monkeypatch.setattr(large_arrays, "LARGE", 1)
    short, long = drawn(9_000), drawn(36_000)
    for name, peak in short.items():
        assert long[name] < 1.25 * peak, name
