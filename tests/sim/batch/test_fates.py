"""Fates of messages in the batch engine: those of `echelon.runtime.fates`, number by number."""

from typing import Any

import numpy as np
import pytest

from echelon.messages import Channel
from echelon.plan.delay_tables import Bursts, DelayTrace
from echelon.plan.link_plan import LinkPlan
from echelon.planning.delays import make_table
from echelon.runtime.fates import ALL, Fates, link_key
from echelon.scenario.link_tables import Gamma, Normal, Pareto, Uniform
from echelon.sim.batch import records as r
from echelon.sim.batch.fates import fates
from echelon.sim.batch.links import fates_of
from echelon.sim.batch.philox import philox
from echelon.sim.batch.pools import Pools, records_of

PERIOD_NS = 10_000_000
GAMMA = make_table(Gamma(kind="gamma", min=0.001, shape=0.7, scale=0.01))
TABLES = {
    "gamma": GAMMA,
    "Pareto": make_table(Pareto(kind="pareto", min=0.001, shape=1.5)),
    "normal, correlated": make_table(Normal(kind="normal", mean=0.02, std=0.01, correlation=0.95)),
    "uniform, correlated": make_table(Uniform(min=0.0, max=0.03, correlation=0.5)),
}
LINKS: dict[str, dict[str, Any]] = {
    "constant": {"delay_min_ns": 5, "delay_max_ns": 5},
    "uniform, lossy": {"delay_min_ns": 10, "delay_max_ns": 50_000_000, "loss": 0.2},
    "a trace": {"delays": DelayTrace((1, -1, 30_000_000, 7)), "delay_max_ns": 30_000_000, "duplicates": 0.5},
    "a trace by time": {
        "delays": DelayTrace((4, -1, 9), (50_000_000, 300_000_000, 700_000_000)), "delay_max_ns": 9, "duplicates": 0.5,
    },
    "bursts": {"loss": 0.2, "bursts": Bursts(0.05, 0.2, 0.0, 1.0)},
    "bursts shorter than by chance": {"loss": 0.45, "bursts": Bursts(0.7, 0.8, 0.1, 0.9), "loss_of_message": True},
    "blackouts": {"delay_max_ns": 9, "blackouts": ((30_000_000, 90_000_000), (900_000_000, 1_000_000_001))},
    "all at once": {
        "delays": GAMMA, "loss": 0.1, "duplicates": 0.4, "loss_of_message": True, "blackouts": ((0, 25_000_000),),
    },
} | {name: {"delays": table, "loss": 0.1, "duplicates": 0.2} for name, table in TABLES.items()}  # fmt: skip


def drawn(link: LinkPlan, seed: int, count: int) -> list[tuple[int, ...]]:
    """Returns the delays of the copies of the first messages of a link from a to b, as the batch engine draws them."""
    pools = Pools()
    (record,) = records_of(r.LINK, [fates_of(link, pools)])
    _, index = pools.arrays()
    whole = np.zeros(r.LINK_WHOLES, dtype=np.int64)
    keys = [link_key(seed, "a", receiver, link.channel) for receiver in ("b", ALL)]
    words = np.array([word for key in keys for word in (key & (2**64 - 1), key >> 64)], dtype=np.uint64)
    whole[r.KEY_0 : r.KEY_0 + 4] = words.view(np.int64)
    found = [fates(record, number, number * PERIOD_NS, index, whole) for number in range(count)]
    return [tuple(delay for delay in each if delay != r.GONE) for each in found]


@pytest.mark.parametrize("kind", LINKS)
def test_fates_are_those_of_the_runtime(kind: str) -> None:
    link = LinkPlan(0, 1, Channel.STATE, PERIOD_NS, **LINKS[kind])
    told = Fates(link, 7, "a", "b")
    expected = [tuple(sorted(told.of(number, number * PERIOD_NS))) for number in range(3000)]
    assert drawn(link, 7, 3000) == expected
    assert len(set(expected)) > 1 or kind == "constant"


def test_correlated_delays_begin_anew_where_they_do_in_the_runtime() -> None:
    link = LinkPlan(0, 1, Channel.STATE, 1, delays=TABLES["normal, correlated"])
    told = Fates(link, 3, "a", "b")
    count = 66_000
    assert drawn(link, 3, count)[-600:] == [told.of(number, number * PERIOD_NS) for number in range(count - 600, count)]


def test_philox_is_that_of_numpy() -> None:
    key = 0x123456789ABCDEF0FEDCBA9876543210
    for stream in (0, 2):
        expected = np.random.Philox(key=key, counter=(stream << 192) + 5).random_raw(4).tolist()
        words = [np.uint64(word) for word in (key & (2**64 - 1), key >> 64, 6, stream)]
        assert [int(word) for word in philox(*words)] == expected
