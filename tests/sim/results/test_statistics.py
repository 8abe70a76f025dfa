"""What many runs say together: Wilson's interval, medians, growth of the second moment."""

from math import inf, isnan, nan, sqrt

import numpy as np
import pytest
from scipy.stats import norm

from echelon.sim.results.statistics import NORMAL, median, moment_growth, runs_needed, wilson


@pytest.mark.parametrize(("holds", "runs"), [(0, 1), (1, 1), (3, 10), (50, 50), (7999, 8000), (0, 64), (37, 64)])
def test_the_interval_is_wilsons(holds: int, runs: int) -> None:
    """Wilson (1927): the shares p at which |k/n - p| = z sqrt(p (1 - p)/n)."""
    z, p = norm.ppf(0.975), holds / runs
    middle, width = p + z**2 / (2 * runs), z * sqrt(p * (1 - p) / runs + z**2 / (4 * runs**2))
    low, high = ((middle + sign * width) / (1 + z**2 / runs) for sign in (-1, 1))
    assert wilson(holds, runs) == pytest.approx((low, high), abs=1e-12)


def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    generator = np.random.default_rng(1)
    intervals = [wilson(holds, 64) for holds in range(65)]
    for truth in (0.5, 0.8, 0.95):
        drawn = generator.binomial(64, truth, 20_000)
        covered = np.mean([intervals[holds][0] <= truth <= intervals[holds][1] for holds in drawn])
        assert 0.93 < covered < 0.975


@pytest.mark.parametrize("share", [0.5, 0.9, 0.95, 0.99])
def test_so_many_runs_are_needed_to_show_a_share(share: float) -> None:
    needed = runs_needed(share)
    assert wilson(needed, needed)[0] >= share - 1e-12
    assert needed == 1 or wilson(needed - 1, needed - 1)[0] < share


def test_a_median_counts_what_is_missing_as_infinite() -> None:
    assert median(np.array([3.0, 1.0, 2.0])) == 2.0
    assert median(np.array([4.0, 1.0, nan, 2.0])) == 3.0
    assert isnan(median(np.array([1.0, nan, nan])))
    assert isnan(median(np.array([1.0, nan])))
    assert isnan(median(np.array([])))


def test_growth_is_the_ratio_of_means_and_its_interval_covers_the_truth() -> None:
    generator, covered = np.random.default_rng(2), 0
    for _ in range(400):
        before = np.exp(generator.normal(0, 0.5, 100))
        last = before * np.exp(generator.normal(0.1, 0.2, 100))
        found = moment_growth(before, last)
        assert found.ratio == pytest.approx(np.mean(last**2) / np.mean(before**2))
        # For X log-normal: E X² = exp(2 μ + 2 s²), and the factors are independent.
        covered += found.low <= np.exp(0.2 + 2 * 0.04) <= found.high
    assert 0.9 < covered / 400 < 0.99
    assert pytest.approx(norm.ppf(0.975)) == NORMAL


def test_one_run_or_equal_runs_have_no_interval() -> None:
    one = moment_growth(np.array([2.0]), np.array([3.0]))
    assert (one.ratio, one.low, one.high, one.heaviest) == pytest.approx((2.25, 2.25, 2.25, 1.0))
    equal = moment_growth(np.full(5, 2.0), np.full(5, 3.0))
    assert (equal.low, equal.high, equal.heaviest) == pytest.approx((2.25, 2.25, 0.2))


def test_a_lost_run_is_infinite_growth() -> None:
    assert moment_growth(np.array([1.0, nan]), np.array([0.5, nan]), lost=1).ratio == inf


def test_rare_large_runs_are_told() -> None:
    last = np.full(100, 0.01)
    last[7] = 10.0
    assert moment_growth(np.ones(100), last).heaviest > 0.99


def test_nothing_to_say() -> None:
    assert isnan(moment_growth(np.array([nan]), np.array([nan])).ratio)
    assert moment_growth(np.zeros(3), np.zeros(3)).ratio == 1.0
