"""Percentiles of ages in the batch engine: those of `echelon.runtime.ages`."""

import numpy as np
import pytest

from echelon.runtime.ages import EXACT, AgeCounts
from echelon.runtime.link import PERCENTILES
from echelon.sim.batch import records as r
from echelon.sim.batch.ages import bin_of, find_percentiles, middle_of, note_age
from echelon.sim.batch.pools import records_of

DRAWN = np.random.default_rng(3)
AGES: dict[str, list[int]] = {
    "none": [],
    "few": [10_000_000, 20_000_000, 10_000_000],
    "as many as are counted one by one": [*range(1, EXACT + 1), EXACT],
    "one more": [*range(1, EXACT + 2), 3, 3],
    "one more, after all of them twice": [*range(EXACT, 0, -1), *range(1, EXACT + 2)],
    "few, many times": DRAWN.integers(1, 40, 3000).tolist(),
    "more and more": [int(age) for age in 1 + DRAWN.uniform(0, 1, 8000) * np.arange(8000) / 6],
    "of all sizes": [int(age) for age in 10 ** DRAWN.uniform(0, 10.4, 3000)],
    "random, few": DRAWN.integers(10_000_000, 50_000_000, 900).tolist(),
    "all that are counted one by one, twice": [*range(1, EXACT + 1), *range(1, EXACT + 1)],
    "twice as many, all of them different": list(range(1, 2 * EXACT + 1)),
    "all in one slot": [((1 << 24) * number) for number in range(1, 600)],
    "random, many": DRAWN.integers(10_000_000, 50_000_000, 5000).tolist(),
}


@pytest.mark.parametrize("zeros", [0, 1, 60, 4000])
@pytest.mark.parametrize("kind", AGES)
def test_percentiles_are_those_of_the_runtime(kind: str, zeros: int) -> None:
    ages, expected = AGES[kind], AgeCounts()
    slots = 2 * EXACT
    bins = r.LINK_WHOLES + 2 * slots
    (link,) = records_of(r.LINK, [{"ages_at": r.LINK_WHOLES, "ages_mask": slots - 1, "bins": 36 << 7, "bins_at": bins}])
    whole = np.zeros(bins + (36 << 7), dtype=np.int64)
    whole[bins:] = 7  # of an earlier run
    for age_ns in ages:
        expected.note(age_ns)
        note_age(link, whole, age_ns)
    whole[r.USED], whole[r.AGE_MAX] = len(ages) + zeros, max(ages, default=0)
    find_percentiles(link, whole)
    wanted = expected.percentiles(PERCENTILES, zeros) if ages else [0] * 3
    assert whole[r.AGE_P50 : r.AGE_P99 + 1].tolist() == [min(age_ns, whole[r.AGE_MAX]) for age_ns in wanted]


def test_a_bin_has_the_ages_with_the_same_eight_leading_bits() -> None:
    ages = [1, 2, 255, 256, 257, 258, 511, 512, 515, 516, 30_000_000_000, (1 << 50) - 1]
    for age_ns in ages:
        dropped = max(0, age_ns.bit_length() - 8)
        low = age_ns >> dropped << dropped
        assert bin_of(low) == bin_of(age_ns) == bin_of(low + (1 << dropped) - 1) != bin_of(low + (1 << dropped))
        assert middle_of(bin_of(age_ns)) == low + (1 << dropped >> 1)
