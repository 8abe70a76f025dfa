"""Fates of messages: distributions against scipy.stats, correlation, bursts, duplicates, blackouts, and that no order of calls
matters."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from echelon.messages import Channel
from echelon.plan.delay_tables import (
    BITS,
    FINEST,
    HALF,
    LOST,
    Z_BITS,
    Bursts,
    DelayTable,
    DelayTrace,
    Words,
    looked_up,
    looked_up_z,
    merged,
)
from echelon.plan.link_plan import LinkPlan
from echelon.planning.delays import make_table
from echelon.runtime.fates import BLOCK, CHAIN, Fates, draws, normal_table, words
from echelon.scenario.link_tables import Gamma, Normal, Pareto, Uniform

MS = 1_000_000
COUNT = 1_000_000
KS_1_PERCENT = 1.63
"""Kolmogorov and Smirnov: D √n exceeds this in 1 % of all samples"""

Random = Uniform | Normal | Gamma | Pareto
DISTRIBUTIONS: dict[str, tuple[Random, object]] = {
    "normal": (Normal(kind="normal", mean=0.03, std=0.01), stats.truncnorm(-3, np.inf, loc=0.03, scale=0.01)),
    "normal, most of it cut": (
        Normal(kind="normal", mean=0.03, std=0.01, min=0.05),
        stats.truncnorm(2, np.inf, loc=0.03, scale=0.01),
    ),
    "gamma": (Gamma(kind="gamma", shape=2.5, scale=0.01, min=0.005), stats.gamma(2.5, loc=0.005, scale=0.01)),
    "exponential": (Gamma(kind="gamma", shape=1.0, scale=0.01), stats.gamma(1.0, scale=0.01)),
    "gamma, steep": (Gamma(kind="gamma", shape=0.5, scale=0.1), stats.gamma(0.5, scale=0.1)),
    "pareto": (Pareto(kind="pareto", min=0.01, shape=5.0), stats.pareto(5.0, scale=0.01)),
    "pareto, heavy": (Pareto(kind="pareto", min=0.01, shape=1.1), stats.pareto(1.1, scale=0.01)),
    "uniform": (Uniform(min=0.01, max=0.05), stats.uniform(0.01, 0.04)),
}
each_distribution = pytest.mark.parametrize("name", DISTRIBUTIONS)


def link(delay: Random | None = None, **given_: object) -> LinkPlan:
    """Returns the plan of a link."""
    plan = LinkPlan(0, 9, Channel.STATE, MS)
    if delay is not None:
        table = make_table(delay)
        plan = replace(plan, delay_min_ns=table.delays_ns[0], delay_max_ns=table.delays_ns[-1], delays=table)
    return replace(plan, **given_)  # type: ignore[arg-type]


def fates(plan: LinkPlan, seed: int = 1) -> Fates:
    return Fates(plan, seed, "g1/r1", "g1")


@cache
def million() -> Words:
    """Returns the draws of a million delays."""
    key = fates(link()).key
    return np.concatenate([words(key, block)[:, 1] for block in range(COUNT // BLOCK + 1)])[:COUNT]


def ks(sample_s: object, distribution: object) -> float:
    """Returns D √n of a sample."""
    sample = np.sort(np.asarray(sample_s))
    F = distribution.cdf(sample)  # type: ignore[attr-defined]
    steps = np.arange(sample.size + 1) / sample.size
    return float(max((steps[1:] - F).max(), (F - steps[:-1]).max()) * np.sqrt(sample.size))


@pytest.mark.slow
@each_distribution
def test_delays_have_their_distribution(name: str) -> None:
    delay, distribution = DISTRIBUTIONS[name]
    table = np.array(make_table(delay).delays_ns)
    assert np.all(np.diff(table) >= 0)
    delays = looked_up(table, million()) * 1e-9
    assert ks(delays, distribution) < KS_1_PERCENT
    assert delays.min() >= delay.min
    plan = link(delay)
    assert np.array_equal(fates(plan).block(3)[:, 0] * 1e-9, delays[3 * BLOCK : 4 * BLOCK])


@pytest.mark.slow
@each_distribution
def test_correlated_delays_have_the_same_distribution(name: str) -> None:
    """z has a standard normal distribution at every message; the delay is a function of z."""
    delay, distribution = DISTRIBUTIONS[name]
    table = np.array(make_table(delay.model_copy(update={"correlation": 0.5})).delays_ns)
    z = looked_up(normal_table(), million())
    assert ks(looked_up_z(table, z) * 1e-9, distribution) < KS_1_PERCENT


@each_distribution
def test_mean_and_variance_are_those_of_the_distribution(name: str) -> None:
    delay, distribution = DISTRIBUTIONS[name]
    delays = looked_up(np.array(make_table(delay).delays_ns), million()) * 1e-9
    mean, variance, _, kurtosis = (float(each) for each in distribution.stats("mvsk"))  # type: ignore[attr-defined]
    if np.isfinite(variance):
        assert delays.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / COUNT))
    if np.isfinite(kurtosis):
        assert delays.var() == pytest.approx(variance, rel=4 * np.sqrt((kurtosis + 2) / COUNT))


@each_distribution
@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_the_error_of_a_table_is_below_one_in_ten_thousand(name: str, correlation: float) -> None:
    delay, distribution = DISTRIBUTIONS[name]
    table = np.array(make_table(delay.model_copy(update={"correlation": correlation})).delays_ns)
    ends = np.geomspace(2.0**-40, 0.5, 20_001)
    for p in (ends, 1 - ends):
        k = np.minimum(np.rint(p * 2.0**BITS).astype(np.int64), (1 << BITS) - 1)
        if correlation:
            found = looked_up_z(table, np.rint(stats.norm.ppf(p) * 2.0**Z_BITS).astype(np.int64))
        else:
            found = looked_up(table, k)
        half_ns = [distribution.cdf((found + half) * 1e-9) for half in (-0.5, 0.5)]  # type: ignore[attr-defined]
        error = np.maximum(half_ns[0] - p, p - half_ns[1])
        assert error.max() < 1e-4


def looked_up_one(table: list[int], draw: int) -> int:
    """Returns the value of a table for one draw, by plain numbers alone: what a compiled engine computes."""
    upper = draw >= 1 << (BITS - 1)
    near = (1 << BITS) - 1 - draw if upper else draw
    shift = max(near.bit_length() - 7, FINEST)
    cell = (shift - FINEST) * 64 + (near >> shift)
    at, step = (2 * HALF - cell, -1) if upper else (cell, 1)
    share = (near - (near >> shift << shift)) / 2.0**shift
    return table[at] + round((table[at + step] - table[at]) * share)


@given(
    st.one_of(
        st.integers(0, 2**BITS - 1),
        st.builds(lambda bits, more: (1 << bits) + more, st.integers(0, BITS - 1), st.integers(-1, 1)).filter(
            lambda draw: 0 <= draw < 2**BITS
        ),
        st.integers(0, 5000).map(lambda draw: 2**BITS - 1 - draw),
    )
)
def test_tables_are_read_as_one_would_by_hand(draw: int) -> None:
    delay, distribution = DISTRIBUTIONS["gamma"]
    table = make_table(delay).delays_ns
    (found,) = looked_up(np.array(table), np.array([draw])).tolist()
    assert found == looked_up_one(list(table), draw)
    # The last cell ends in its middle.  In the cell before it 1 - u doubles: a chord there is some 0.06 scales off.
    if draw < 2**BITS - 2**FINEST:
        exact = distribution.isf((2**BITS - draw - 0.5) * 2.0**-BITS)  # type: ignore[attr-defined]
        assert found * 1e-9 == pytest.approx(exact, abs=0.07 * delay.scale)


def test_correlated_delays_are_a_recursion_in_whole_numbers() -> None:
    rho = 0.7
    delay = Gamma(kind="gamma", shape=2.0, scale=0.01, correlation=rho)
    made, normal, table = fates(link(delay)), normal_table().tolist(), make_table(delay).delays_ns
    factor, rest = round(rho * 2**30), round((1 - rho**2) ** 0.5 * 2**30)
    z = 0
    for number in range(3 * BLOCK):
        draw = int(words(made.key, number // BLOCK)[number % BLOCK, 1])
        n = looked_up_one(normal, draw)
        z = (factor * z >> 30) + (n * rest >> 30) if number else n
        cell, within = divmod(z + (8 << 28), 1 << 21)
        expected = table[cell] + round((table[cell + 1] - table[cell]) * (within / 2.0**21))
        assert made.of(number, 0) == (expected,)


def test_the_normal_table_is_exact() -> None:
    z = looked_up(normal_table(), million()) * 2.0**-Z_BITS
    assert ks(z, stats.norm) < KS_1_PERCENT
    assert normal_table()[normal_table().size // 2] == 0
    assert np.array_equal(normal_table(), -normal_table()[::-1])


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.3, 0.9, 0.999])
def test_correlation_is_that_of_a_gaussian_copula(rho: float) -> None:
    """What is left of z after ρ z of the message before is independent and normal, and z itself is normal at all times."""
    made = fates(link(Gamma(kind="gamma", shape=2.0, scale=0.01, correlation=rho)))
    blocks = CHAIN // BLOCK
    z = np.concatenate([made._z(at, words(made.key, at)[:, 1]) for at in range(blocks)]) * 2.0**-Z_BITS
    left = (z[1:] - rho * z[:-1]) / np.sqrt(1 - rho**2)
    assert ks(left, stats.norm) < KS_1_PERCENT
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 4 / np.sqrt(left.size)
    starts = [fates(made.plan, seed)._z(0, words(fates(made.plan, seed).key, 0)[:, 1])[0] for seed in range(1000)]
    assert ks(np.array(starts) * 2.0**-Z_BITS, stats.norm) < KS_1_PERCENT


def test_ranks_of_successive_delays_correlate_as_spearmans_formula_says() -> None:
    rho = 0.8
    made = fates(link(Pareto(kind="pareto", min=0.01, shape=1.5, correlation=rho)))
    delays = np.concatenate([made.block(at)[:, 0] for at in range(CHAIN // BLOCK)])
    for lag in (1, 2, 5):
        expected = 6 / np.pi * np.arcsin(rho**lag / 2)
        assert stats.spearmanr(delays[lag:], delays[:-lag])[0] == pytest.approx(expected, abs=0.02)


BURSTS = {
    "long": Bursts(0.02, 0.1, 0.0, 1.0),
    "as by chance": Bursts(0.3, 0.7, 0.0, 1.0),
    "shorter than by chance": Bursts(0.9, 0.8, 0.0, 1.0),
    "losses in both states": Bursts(0.02, 0.1, 0.1, 0.6),
}


def losses(bursts: Bursts, blocks: int = 1000, seed: int = 1) -> np.ndarray:
    """Returns which messages are lost."""
    loss = bursts.loss_good + (bursts.loss_bad - bursts.loss_good) * bursts.share_bad
    made = fates(link(loss=loss, bursts=bursts), seed)
    return np.concatenate([made.block(at)[:, 0] == LOST for at in range(blocks)])


@pytest.mark.parametrize("name", BURSTS)
def test_losses_in_bursts_have_their_mean(name: str) -> None:
    bursts = BURSTS[name]
    lost = losses(bursts)
    loss = bursts.loss_good + (bursts.loss_bad - bursts.loss_good) * bursts.share_bad
    stays = 1 - bursts.to_bad - bursts.to_good  # by how much the state of a message tells that of the next
    spread = np.sqrt(loss * (1 - loss) / lost.size * max(1.0, (1 + stays) / (1 - stays)))
    assert abs(lost.mean() - loss) < 4 * spread


@pytest.mark.parametrize("name", ["long", "as by chance", "shorter than by chance"])
@pytest.mark.parametrize("bad", [True, False])
def test_lengths_of_bursts_and_of_the_times_between_are_geometric(name: str, bad: bool) -> None:
    bursts = BURSTS[name]
    lost = losses(bursts)
    turns = np.flatnonzero(np.diff(lost))
    lengths, begins_lost = np.diff(turns), lost[turns[:-1] + 1]
    lengths = lengths[begins_lost == bad]
    ends = bursts.to_good if bad else bursts.to_bad
    assert lengths.mean() == pytest.approx(1 / ends, abs=4 * np.sqrt((1 - ends) / ends**2 / lengths.size))
    most = int(stats.geom.ppf(1 - 20 / lengths.size, ends))
    seen = np.bincount(np.minimum(lengths, most + 1), minlength=most + 2)[1:]
    share = np.append(stats.geom.pmf(np.arange(1, most + 1), ends), stats.geom.sf(most, ends))
    assert stats.chisquare(seen, lengths.size * share).pvalue > 0.01


@pytest.mark.parametrize("name", [*BURSTS, "changes rarely"])
def test_bursts_are_the_plain_chain_of_two_states_whatever_the_order_of_calls(name: str) -> None:
    """The chain as textbooks have it, one message after the other, from the same draws."""
    bursts, blocks = BURSTS.get(name, Bursts(1e-3, 2e-3, 0.0, 1.0)), 40
    made = fates(link(loss=0.5, bursts=bursts))
    chain = np.concatenate([draws(made.key, at, stream=2)[:, 0] for at in range(blocks)])
    state = bool(chain[0] < bursts.share_bad)
    expected = [state]
    for draw in chain[1:]:
        state = bool(draw < (1 - bursts.to_good if state else bursts.to_bad))
        expected.append(state)
    assert np.concatenate([made._bad(at, bursts) for at in range(blocks)]).tolist() == expected
    in_turn = np.reshape(expected, (blocks, BLOCK))
    for order in (range(0, blocks, 2), range(blocks - 1, -1, -1), np.random.default_rng(1).permutation(blocks)):
        asked = fates(made.plan)
        for at in map(int, order):
            assert np.array_equal(asked._bad(at, bursts), in_turn[at])


delays = st.sampled_from(
    [
        link(),
        link(delay_min_ns=MS, delay_max_ns=3 * MS),
        *(link(delay) for delay, _ in DISTRIBUTIONS.values()),
        link(Gamma(kind="gamma", shape=2.0, scale=0.01, correlation=0.9)),
        link(delays=DelayTrace((5, LOST, 7, 7)), delay_max_ns=7),
        link(delays=DelayTrace((5, LOST, 7), (0, 300 * MS, 2000 * MS)), delay_max_ns=7),
    ]
)
chains = st.sampled_from(
    [(0.0, None), (0.3, None), (0.9, Bursts(1e-4, 2e-5, 0.0, 1.0)), *((0.3, each) for each in BURSTS.values())]
)
plans = st.builds(
    lambda plan, loss, duplicates, of_message, blackouts: replace(
        plan,
        loss=loss[0],
        bursts=loss[1],
        duplicates=duplicates,
        loss_of_message=of_message,
        blackouts=merged(blackouts),
    ),
    delays,
    chains,
    st.sampled_from([0.0, 0.2, 1.0]),
    st.booleans(),
    st.lists(
        st.tuples(st.integers(0, 2**31), st.integers(1, 2**30)).map(lambda at: (at[0], at[0] + at[1])), max_size=3
    ),
)


@settings(max_examples=60, deadline=None)
@given(plans, st.integers(0, 2**63 - 1), st.lists(st.integers(0, 5000), min_size=1, max_size=30))
def test_a_fate_depends_on_seed_link_and_number_alone(plan: LinkPlan, seed: int, numbers: list[int]) -> None:
    in_order = fates(plan, seed)
    expected = {number: in_order.of(number, number * MS) for number in sorted(numbers)}
    asked = fates(plan, seed)
    assert {number: asked.of(number, number * MS) for number in numbers} == expected
    last = numbers[-1]
    assert fates(plan, seed).of(last, last * MS) == expected[last]


@settings(max_examples=60, deadline=None)
@given(plans, st.integers(0, 2**63 - 1), st.integers(0, 9))
def test_fates_one_by_one_are_those_of_blocks(plan: LinkPlan, seed: int, number: int) -> None:
    plain = replace(plan, blackouts=(), delays=None if isinstance(plan.delays, DelayTrace) else plan.delays)
    made, one_by_one = fates(plain, seed), fates(plain, seed)
    for at, pair in enumerate(made.block(number).tolist()):
        assert one_by_one.of(number * BLOCK + at, 0) == tuple(delay for delay in pair if delay != LOST)


def test_a_message_far_away_is_found_at_once() -> None:
    correlated = link(Gamma(kind="gamma", shape=2.0, scale=0.01, correlation=0.9999), loss=0.2, bursts=BURSTS["long"])
    number = 10**12 + 12345
    assert fates(correlated).of(number, 0) == fates(correlated).of(number, 0)


def test_losses_of_messages_are_the_same_for_all_receivers_and_delays_are_not() -> None:
    for bursts in (None, BURSTS["long"]):
        plan = link(delay_min_ns=0, delay_max_ns=MS, loss=0.3, bursts=bursts, loss_of_message=True)
        one, other = (Fates(plan, 1, "g1", f"g1/r{robot}").block(0)[:, 0] for robot in (1, 2))
        assert np.array_equal(one == LOST, other == LOST)
        assert not np.array_equal(one, other)
        apart = Fates(replace(plan, loss_of_message=False), 1, "g1", "g1/r2").block(0)[:, 0]
        assert not np.array_equal(one == LOST, apart == LOST)


@pytest.mark.slow
def test_duplicates_come_as_often_as_wanted_with_delays_of_their_own() -> None:
    plan = link(DISTRIBUTIONS["gamma"][0], loss=0.5, duplicates=0.3)
    made = fates(plan)
    found = np.concatenate([made.block(at) for at in range(1000)])
    come = found[found[:, 0] != LOST]
    twice = come[come[:, 1] != LOST]
    assert not (found[found[:, 0] == LOST][:, 1] != LOST).any()
    assert len(twice) / len(come) == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / len(come)))
    assert ks(twice[:, 1] * 1e-9, DISTRIBUTIONS["gamma"][1]) < KS_1_PERCENT
    assert abs(np.corrcoef(twice.T)[0, 1]) < 4 / np.sqrt(len(twice))


def test_what_is_sent_in_a_blackout_is_lost() -> None:
    made = fates(link(delay_min_ns=5, delay_max_ns=5, blackouts=((10, 20), (30, 31))))
    sent = range(8, 33)
    lost = [instant for instant in sent if not made.of(instant, instant)]
    assert lost == [*range(10, 20), 30]
    assert merged([(30, 31), (15, 20), (10, 16)]) == ((10, 20), (30, 31))
    assert merged([(2, 3), (5, 9), (0, 2), (6, 7)]) == ((0, 3), (5, 9))


def test_a_trace_is_replayed_line_by_line_or_by_time() -> None:
    trace = (5, LOST, 7)
    by_message = fates(link(delays=DelayTrace(trace), delay_max_ns=7))
    assert [by_message.of(number, 0) for number in range(7)] == [(5,), (), (7,), (5,), (), (7,), (5,)]
    assert by_message.of(BLOCK, 0) == by_message.of(BLOCK % 3, 0)
    by_time = fates(link(delays=DelayTrace(trace, (100, 200, 300)), delay_max_ns=7, duplicates=1.0))
    found = [by_time.of(3, sent_ns) for sent_ns in (-1, 99, 100, 199, 200, 299, 300, 10**9)]
    assert found == [(5, 5), (5, 5), (5, 5), (5, 5), (), (), (7, 7), (7, 7)]


def test_equal_distributions_share_one_table() -> None:
    first, second = (make_table(Gamma(kind="gamma", shape=2.0, scale=0.01)) for _ in range(2))
    assert first is second
    assert isinstance(first, DelayTable)
