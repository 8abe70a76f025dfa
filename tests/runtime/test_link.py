from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from echelon.messages import Channel, Message
from echelon.plan.delay_tables import LOST, Bursts, DelayTrace
from echelon.plan.link_plan import LinkPlan
from echelon.planning.delays import make_table
from echelon.runtime.ages import AgeCounts
from echelon.runtime.fates import Fates, draws, link_key
from echelon.runtime.link import Link
from echelon.scenario.link_tables import Gamma, Pareto
from support.links import PunctualLink

MS = 1_000_000
UNIFORM = LinkPlan(0, 9, Channel.STATE, MS, MS, 3 * MS, 0.1)

plans = st.builds(
    lambda period, low, more, loss: LinkPlan(0, 9, Channel.STATE, period, low, low + more, loss),
    st.integers(1, 50),
    st.integers(0, 300),
    st.integers(0, 300),
    st.sampled_from([0.0, 0.01, 0.3, 0.9, 1.0]),
)
seeds = st.integers(0, 2**63 - 1)


def made(plan: LinkPlan = UNIFORM, seed: int = 1, source: str = "g1/r1", receiver: str = "g1") -> PunctualLink:
    """Returns a new link."""
    return PunctualLink(plan, seed, source, receiver)


GOLDEN_KEY = 0xA54F99E2172065D1A4B24D84B60969A8
GOLDEN_DRAWS = [
    [0.4133349546964553, 0.7555039193782993],
    [0.7796618443557397, 0.31212420504275995],
    [0.9162167284838577, 0.5660631910544993],
]
GOLDEN_LATER = [0.2549977228036212, 0.5193998400166336]
GOLDEN_FATES = [2511008, 1624248, 2132126, 1630968, 1058166, 1422432, 2854210, None, 1832839, 1989853, 2875716, 2179673]
GOLDEN_FAR = 2986681


def test_golden_keys_and_draws():
    """Golden numbers, so that a change of the generator, of the key or of the order of draws is noticed."""
    assert link_key(1, "g1/r1", "g1", Channel.STATE) == GOLDEN_KEY
    assert draws(GOLDEN_KEY, 0)[:3].tolist() == GOLDEN_DRAWS
    assert draws(GOLDEN_KEY, 7)[511].tolist() == GOLDEN_LATER
    link = made(replace(UNIFORM, loss=0.2))
    assert [link.fate(number) for number in range(12)] == GOLDEN_FATES
    assert link.fate(10**12) == GOLDEN_FAR


def test_draws_are_philox_4x64_at_the_messages_counter():
    key = link_key(3, "a", "b", Channel.COMMAND)
    words = np.random.Philox(key=key).random_raw(3 * 1024) >> np.uint64(11)
    assert np.array_equal(np.concatenate([draws(key, block) for block in range(3)]).ravel(), words * 2.0**-53)


@pytest.mark.slow
@given(plans, seeds, st.permutations(range(0, 1300, 13)))
def test_a_fate_does_not_depend_on_earlier_calls(plan, seed, numbers):
    in_order = made(plan, seed)
    expected = {number: in_order.fate(number) for number in sorted(numbers)}
    shuffled = made(plan, seed)
    assert {number: shuffled.fate(number) for number in numbers} == expected
    assert all(made(plan, seed).fate(number) == expected[number] for number in numbers[:3])


@given(plans, seeds)
def test_calls_of_fate_do_not_change_the_newest(plan, seed):
    quiet, asked = made(plan, seed), made(plan, seed)
    for tick in range(60):
        time_ns = tick * plan.period_ns
        assert quiet.newest(time_ns) == asked.newest(time_ns)
        asked.fate((tick * 7919) % 5000)
    assert quiet.counts() == asked.counts()


def modelled(plan: LinkPlan, seed: int, time_ns: int) -> tuple[int, int, int, int, int]:
    """Returns newest, sent, delivered, lost and in flight at an instant, counted from the fates of all messages."""
    link, newest, delivered, lost, flying = made(plan, seed), -1, 0, 0, 0
    sent = time_ns // plan.period_ns + 1
    for number in range(sent):
        delay = link.fate(number)
        if delay is None:
            lost += 1
        elif number * plan.period_ns + delay <= time_ns:
            delivered += 1
            newest = max(newest, number)
        else:
            flying += 1
    return newest, sent, delivered, lost, flying


@given(plans, seeds, st.lists(st.integers(0, 400), min_size=1, max_size=12))
def test_newest_and_counts_are_those_of_the_model_at_every_instant(plan, seed, instants):
    link = made(plan, seed)
    for time_ns in sorted(instants):
        newest = link.newest(time_ns)
        counts = link.counts()
        found = newest, counts.sent, counts.delivered, counts.lost, counts.in_flight
        assert found == modelled(plan, seed, time_ns)
        assert counts.sent == counts.delivered + counts.lost + counts.in_flight
        assert link.newest(time_ns) == newest  # a second call changes nothing


@given(plans, seeds, st.integers(0, 100), st.integers(0, 400))
def test_arrived_is_fate_and_time(plan, seed, number, time_ns):
    delay = made(plan, seed).fate(number)
    arrived = delay is not None and number * plan.period_ns + delay <= time_ns
    assert made(plan, seed).arrived(number, time_ns) == arrived


@pytest.mark.parametrize(
    ("delay", "ticks"), [(0, 0), (1, 1), (MS - 1, 1), (MS, 1), (MS + 1, 2), (7 * MS, 7), (7 * MS + 1, 8)]
)
def test_a_message_is_used_at_the_first_tick_at_or_after_its_arrival(delay, ticks):
    link = made(LinkPlan(0, 9, Channel.STATE, MS, delay, delay))
    assert [link.newest(tick * MS) for tick in range(20)] == [max(tick - ticks, -1) for tick in range(20)]


def test_a_message_that_is_overtaken_arrives_but_changes_nothing():
    plan = replace(UNIFORM, delay_min_ns=0, delay_max_ns=20 * MS, loss=0.0)
    link = made(plan)
    arrivals = sorted((number * MS + (link.fate(number) or 0), number) for number in range(200))
    in_use = []
    for at, (time_ns, _) in enumerate(arrivals[:100]):
        in_use.append(link.newest(time_ns))
        assert link.counts().delivered == at + 1
    assert in_use == sorted(in_use)
    assert len(set(in_use)) < len(in_use)


@given(plans, seeds)
def test_an_ideal_link_agrees_with_a_link_without_delay_and_loss(plan, seed):
    ideal = made(replace(plan, delay_min_ns=0, delay_max_ns=0, loss=0.0), seed)
    for time_ns in range(0, 5 * plan.period_ns, max(1, plan.period_ns // 3)):
        newest = ideal.newest(time_ns)
        assert newest == time_ns // plan.period_ns
        counts = ideal.counts()
        assert (counts.sent, counts.delivered, counts.lost, counts.in_flight) == (newest + 1, newest + 1, 0, 0)


@given(plans, seeds, st.booleans(), st.integers(-1000, 0))
def test_a_link_that_begins_before_the_run_does_the_same_earlier(plan, seed, ideal, first_ns):
    if ideal:
        plan = replace(plan, delay_min_ns=0, delay_max_ns=0, loss=0.0)
    link, early = made(plan, seed), made(replace(plan, first_ns=first_ns), seed)
    for time_ns in range(0, 400, 7):
        number = early.newest(first_ns + time_ns)
        assert number == link.newest(time_ns)
        assert early.arrived(5, first_ns + time_ns) == link.arrived(5, time_ns)
    assert early.counts() == link.counts()
    assert early.sent_ns(3) == link.sent_ns(3) + first_ns


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.5, 0.9])
def test_losses_are_as_frequent_as_the_scenario_says(loss):
    count = 100_000
    link = made(replace(UNIFORM, loss=loss))
    lost = np.array([link.fate(number) is None for number in range(count)])
    spread = np.sqrt(loss * (1 - loss) / count)
    assert abs(lost.mean() - loss) < 4 * spread
    # Independence in time: losses are as frequent after a loss as otherwise.
    assert abs(lost[1:][lost[:-1]].mean() - loss) < 4 * np.sqrt(loss * (1 - loss) / lost.sum())


@pytest.mark.parametrize(("loss", "expected"), [(0.0, 0), (1.0, 5000)])
def test_loss_zero_and_one_are_exact(loss, expected):
    link = made(replace(UNIFORM, loss=loss))
    assert sum(link.fate(number) is None for number in range(5000)) == expected


def test_delays_are_uniform_between_their_bounds_and_independent_of_losses():
    plan = replace(UNIFORM, loss=0.5)
    link, count = made(plan), 50_000
    delays = np.array([delay for number in range(count) if (delay := link.fate(number)) is not None])
    assert delays.min() >= MS
    assert delays.max() <= 3 * MS
    fractions = np.sort((delays - MS) / (2 * MS))
    steps = np.arange(1, fractions.size + 1) / fractions.size
    assert np.abs(fractions - steps).max() < 1.95 / np.sqrt(fractions.size)  # Kolmogorov-Smirnov, 0.1 %


def test_bounds_of_the_delay_are_reached_to_the_nanosecond():
    link = made(replace(UNIFORM, delay_min_ns=5, delay_max_ns=7, loss=0.0))
    assert {link.fate(number) for number in range(200)} == {5, 6, 7}


OTHERS = [
    made(seed=2),
    made(source="g1/r2"),
    made(receiver="g2"),
    made(replace(UNIFORM, channel=Channel.COMMAND)),
    made(source="g1", receiver="g1/r1"),
]


@pytest.mark.parametrize("other", OTHERS)
def test_links_are_independent(other):
    count = 20_000
    one = draws(made()._fates.key, 0)
    assert not np.array_equal(one, draws(other._fates.key, 0))
    blocks = range(count // 512)
    here, there = (np.concatenate([draws(link._fates.key, block) for block in blocks]) for link in (made(), other))
    for column in (0, 1):
        assert abs(np.corrcoef(here[:, column], there[:, column])[0, 1]) < 4 / np.sqrt(count)


@given(st.tuples(seeds, st.sampled_from("abc"), st.sampled_from("abc"), st.sampled_from(Channel)), st.data())
def test_keys_of_different_links_differ(link, data):
    other = data.draw(st.tuples(seeds, st.sampled_from("abc"), st.sampled_from("abc"), st.sampled_from(Channel)))
    assume(other != link)
    assert link_key(*link) != link_key(*other)
    assert 0 <= link_key(*link) < 2**128


kinds = st.sampled_from(
    [
        {},
        {"delays": make_table(Gamma(kind="gamma", shape=0.7, scale=2e-8))},
        {"delays": make_table(Pareto(kind="pareto", min=1e-8, shape=1.1, correlation=0.9))},
        {"delays": DelayTrace((100, LOST, 0, 30), (0, 60, 200, 260))},
        {"loss": 0.3, "bursts": Bursts(0.1, 0.2, 0.0, 1.0)},
        {"loss": 0.3, "bursts": Bursts(0.1, 0.2, 0.0, 1.0), "loss_of_message": True},
        {"blackouts": ((20, 90), (150, 151))},
    ]
)


@given(plans, kinds, st.sampled_from([0.0, 0.4, 1.0]), st.booleans(), seeds, st.lists(st.integers(0, 400), min_size=1))
def test_every_message_is_delivered_lost_or_in_flight_on_every_kind_of_link(
    plain, kind, duplicates, fifo, seed, instants
):
    plan = replace(plain, **kind, duplicates=duplicates, fifo=fifo)
    if plan.delays:
        plan = replace(plan, delay_min_ns=0, delay_max_ns=max(plan.delays.delays_ns))
    link, asked = made(plan, seed), Fates(plan, seed, "g1/r1", "g1")
    for time_ns in sorted(instants):
        newest, counts = link.newest(time_ns), link.counts()
        first, second, lost, before = {}, [], 0, 0
        for number in range(time_ns // plan.period_ns + 1):
            sent_ns = number * plan.period_ns
            arrivals = sorted(sent_ns + delay for delay in asked.of(number, sent_ns))
            if fifo and arrivals:
                arrivals = [max(before, arrival) for arrival in arrivals]
                before = arrivals[0]
            lost += not arrivals
            first |= {number: arrivals[0]} if arrivals else {}
            second += arrivals[1:]
        arrived = [number for number, arrival in first.items() if arrival <= time_ns]
        assert counts.sent == counts.delivered + counts.lost + counts.in_flight == time_ns // plan.period_ns + 1
        assert (counts.delivered, counts.lost, newest) == (len(arrived), lost, max(arrived, default=-1))
        assert counts.duplicates == sum(arrival <= time_ns for arrival in second)
        if fifo:
            assert all(link.arrived(number, time_ns) == (number in arrived) for number in range(counts.sent + 2))


def test_in_order_nothing_is_overtaken():
    plan = replace(UNIFORM, delay_min_ns=0, delay_max_ns=20 * MS, loss=0.1, fifo=True)
    link, delivered = made(plan), 0
    for time_ns in range(0, 300 * MS, MS // 4):
        newest, counts = link.newest(time_ns), link.counts()
        delivered = counts.delivered
        assert delivered == sum(link.fate(number) is not None for number in range(newest + 1))
    assert delivered > 200


def test_percentiles_are_those_of_the_ages():
    rng = np.random.default_rng(3)
    for ages in ([5], [0, 0, 0, 7], list(range(1, 101)), rng.integers(1, 1000, 5000), rng.gamma(2.0, 1e7, 20_000)):
        link = made()
        for age in map(int, ages):
            link.note_use(age + 10, 1, 10)
        counts = link.counts()
        found = counts.age_p50_ns, counts.age_p95_ns, counts.age_p99_ns
        wanted = np.quantile(np.array(ages).astype(int), [0.5, 0.95, 0.99], method="inverted_cdf")
        assert found == pytest.approx(wanted, rel=0 if len(set(ages)) <= 1024 else 0.004)
        assert found[2] <= counts.age_max_ns
    assert made().counts().age_p99_ns == 0


def test_many_different_ages_take_little_memory():
    ages = AgeCounts()
    for age in np.random.default_rng(1).lognormal(16, 2, 100_000):
        ages.note(int(age))
    assert len(ages._counts) < 5000


def test_ages_and_holds():
    link = made(LinkPlan(0, 9, Channel.STATE, MS, MS, MS))
    for time_ns, number in [(1, 0), (2, 1), (3, 1), (4, 1), (5, 4)]:
        link.note_use(time_ns * MS, number, number * MS)
    counts = link.counts()
    assert (counts.used, counts.held) == (5, 2)
    assert counts.age_mean_ns == pytest.approx((1 + 1 + 2 + 3 + 1) / 5 * MS)
    assert counts.age_max_ns == 3 * MS
    assert made().counts().age_mean_ns == 0.0


def test_on_a_link_that_keeps_the_order_a_message_waits_for_those_before_it_whenever_they_come():
    plan = replace(UNIFORM, delay_min_ns=0, delay_max_ns=20 * MS, loss=0.0, fifo=True)
    messages = {
        number: Message(plan.channel, plan.source, number, plan.first_ns + number * plan.period_ns, np.ones(1))
        for number in range(40)
    }
    time_ns, until_ns = plan.first_ns + 39 * plan.period_ns, 10**9
    in_order, in_parts = (Link(plan, 1, "g1/r1", "g1") for _ in range(2))
    assert in_order.take_up(time_ns, until_ns, dict(messages), -1)
    some = {number: message for number, message in messages.items() if number % 3}
    assert not in_parts.take_up(time_ns, until_ns, dict(some), -1)
    assert in_parts.take_up(time_ns, until_ns, dict(messages), -1)
    arrivals = [in_order.arrival(number) for number in messages]
    assert arrivals == sorted(arrivals)
    assert [in_parts.arrival(number) for number in messages] == arrivals
