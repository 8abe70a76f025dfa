import random
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.messages import NULL, Channel, Message
from echelon.plan.delay_tables import ClockPlan
from echelon.plan.plan import LinkPlan
from echelon.role import Input, Stage
from echelon.runtime.link import Link
from echelon.runtime.mailbox import SLACK, Mailbox
from echelon.runtime.turns import Turn

PERIOD = 10
RECEIVER = 9


def mailbox_of(links: Sequence[LinkPlan], seed: int = 1, stages: Sequence[Stage] | None = None) -> Mailbox:
    """Returns the mailbox of a role whose stages each have all links as inputs."""
    inputs = tuple(Input(link.source, link.channel) for link in links)
    stages = stages or [Stage(Turn.ACT, PERIOD, inputs, lambda time_ns, heard: ())]
    plan: Any = SimpleNamespace(
        all_roles=[SimpleNamespace(name=f"m{index}") for index in range(RECEIVER + 1)],
        seed=seed,
        links_into=lambda receiver: tuple(links) if receiver == RECEIVER else (),
    )
    role: Any = SimpleNamespace(index=RECEIVER, stages=tuple(stages))
    return Mailbox(role, plan)


def message_of(link: LinkPlan, number: int, silent: int = 0) -> Message:
    """Returns message `number` of a link; the first `silent` ones are null messages."""
    values = NULL if number < silent else np.array([float(link.source), float(number)])
    return Message(link.channel, link.source, number, number * link.period_ns, values)


def number_in_use(link: LinkPlan, seed: int, time_ns: int) -> int:
    """Returns the number of the newest message that is not lost and has arrived, by looking at all messages."""
    model = Link(link, seed, f"m{link.source}", f"m{RECEIVER}")
    sent = range(time_ns // link.period_ns + 1)
    return max((number for number in sent if model.arrived(number, time_ns)), default=-1)


links_strategy = st.lists(
    st.tuples(
        st.sampled_from([1, 2, 3]), st.integers(0, 60), st.integers(0, 60), st.sampled_from([0.0, 0.3, 0.9, 1.0])
    ),
    min_size=1,
    max_size=4,
).map(
    lambda rows: [
        LinkPlan(source, RECEIVER, Channel.STATE, PERIOD * factor, low, low + more, loss)
        for source, (factor, low, more, loss) in enumerate(rows)
    ]
)
seeds = st.integers(0, 1000)
TICKS = 25


@pytest.mark.slow
@given(links_strategy, seeds, st.integers(0, 3), st.randoms(use_true_random=False))
def test_a_stage_gets_the_same_messages_in_any_order_of_arrival(links, seed, silent, shuffle):
    """Messages come in any order, as late as possible or long before they are used, some twice."""
    mailbox = mailbox_of(links, seed)
    on_the_way = [message_of(link, number, silent) for link in links for number in range(TICKS)]
    on_the_way += shuffle.sample(on_the_way, 5)
    shuffle.shuffle(on_the_way)
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        while missing := mailbox.missing(0, time_ns):
            for _ in range(shuffle.randint(1, 4)):
                if on_the_way:
                    mailbox.deliver(on_the_way.pop())
            for link in missing:
                assert number_in_use(link.plan, seed, time_ns) >= 0
        for link, message in zip(links, mailbox.take(0, time_ns), strict=True):
            expected = number_in_use(link, seed, time_ns)
            if expected < silent:
                assert message is None
            else:
                assert message is not None
                assert (message.source, message.sequence) == (link.source, expected)
    assert mailbox.unexpected == 0


@given(links_strategy, seeds)
def test_what_is_missing_is_exactly_the_message_in_use(links, seed):
    mailbox = mailbox_of(links, seed)
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        for link in links:
            wanted = number_in_use(link, seed, time_ns)
            waits = {waiting.plan.source for waiting in mailbox.missing(0, time_ns)}
            before = number_in_use(link, seed, time_ns - PERIOD) if time_ns else -1
            assert (link.source in waits) == (wanted > before)
            if wanted > before:
                mailbox.deliver(message_of(link, wanted))
        assert mailbox.missing(0, time_ns) == []
        mailbox.take(0, time_ns)


@given(links_strategy, seeds, st.randoms(use_true_random=False))
def test_on_a_wall_clock_the_newest_that_came_is_used(links, seed, luck):
    """Some messages come late, some never.  In use is the newest that has come and has arrived by the rules of the link."""
    mailbox = mailbox_of(links, seed)
    comes = {
        (link.source, number): number * link.period_ns + luck.choice([0, 0, 0, PERIOD, 5 * PERIOD, 10**9])
        for link in links
        for number in range(TICKS)
    }
    used = dict.fromkeys(range(len(links)), -1)
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        arriving = [
            message_of(link, number)
            for link in links
            for number in range(TICKS)
            if comes[link.source, number] == time_ns
        ]
        luck.shuffle(arriving)
        for message in arriving:
            mailbox.deliver(message)
        for link, message in zip(links, mailbox.take(0, time_ns), strict=True):
            model = Link(link, seed, f"m{link.source}", f"m{RECEIVER}")
            came = [n for n in range(TICKS) if comes[link.source, n] <= time_ns and model.arrived(n, time_ns)]
            used[link.source] = max([used[link.source], *came])
            assert (message.sequence if message is not None else -1) == used[link.source]


def test_a_late_message_is_used_while_a_newer_one_is_missing():
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD)
    mailbox = mailbox_of([link])
    mailbox.deliver(message_of(link, 0))
    for time_ns in (0, PERIOD, 2 * PERIOD):
        mailbox.take(0, time_ns)
    mailbox.deliver(message_of(link, 1))  # number 2 should be in use since the last instant, but has not come
    (heard,) = mailbox.take(0, 2 * PERIOD)
    assert heard is not None
    assert heard.sequence == 1


def test_a_message_from_the_future_waits_for_its_instant():
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD)
    mailbox = mailbox_of([link])
    mailbox.deliver(message_of(link, 3))
    assert mailbox.take(0, 0) == [None]
    assert mailbox.take(0, 2 * PERIOD) == [None]
    (heard,) = mailbox.take(0, 3 * PERIOD)
    assert heard is not None
    assert heard.sequence == 3


def held_messages(mailbox: Mailbox) -> int:
    """Returns the number of messages that a mailbox holds."""
    return sum(len(slot.newer) + (slot.current is not None) for slot in mailbox._slots.values())


@pytest.mark.parametrize("loss", [0.0, 0.5, 0.99, 1.0])
@pytest.mark.parametrize("delay", [0, 35, 1000])
def test_memory_is_bounded_for_any_loss(loss, delay):
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD, delay, delay + 100, loss)
    mailbox, most = mailbox_of([link]), 0
    for number in range(3000):
        mailbox.deliver(message_of(link, number))
        mailbox.take(0, number * PERIOD)
        most = max(most, held_messages(mailbox))
    assert most <= 2 * ((delay + 100) // PERIOD) + SLACK + 2


def test_memory_is_bounded_when_nothing_in_use_comes():
    """On a wall clock, every third message comes, out of order."""
    links = [LinkPlan(source, RECEIVER, Channel.STATE, PERIOD, 0, 30 * source, 0.1 * source) for source in range(3)]
    mailbox, luck, most = mailbox_of(links), random.Random(1), 0
    for number in range(3000):
        for link in links:
            if luck.random() < 1 / 3:
                mailbox.deliver(message_of(link, max(0, number - luck.randrange(10))))
        mailbox.take(0, number * PERIOD)
        most = max(most, held_messages(mailbox))
    assert most < 3 * (SLACK + 14)


def test_stages_share_an_input():
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD)
    inputs = (Input(0, Channel.STATE),)
    stages = [Stage(Turn.ACT, period, inputs, lambda time_ns, heard: ()) for period in (10, 30)]
    mailbox = mailbox_of([link], stages=stages)
    for tick in range(7):
        mailbox.deliver(message_of(link, tick))
        for number, stage in enumerate(stages):
            if tick * PERIOD % stage.period_ns == 0:
                assert mailbox.missing(number, tick * PERIOD) == []
                (heard,) = mailbox.take(number, tick * PERIOD)
                assert heard is not None
                assert heard.sequence == tick


def test_messages_of_no_link_are_counted():
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD)
    mailbox = mailbox_of([link])
    mailbox.deliver(Message(Channel.COMMAND, 0, 0, 0, np.ones(1)))
    mailbox.deliver(Message(Channel.STATE, 5, 0, 0, np.ones(1)))
    assert mailbox.unexpected == 2
    assert held_messages(mailbox) == 0


@given(links_strategy, seeds)
def test_counts(links, seed):
    mailbox = mailbox_of(links, seed)
    ages: dict[int, list[int]] = {link.source: [] for link in links}
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        for link in links:
            mailbox.deliver(message_of(link, time_ns // PERIOD))
        for message in mailbox.take(0, time_ns):
            if message is not None:
                ages[message.source].append(time_ns - message.time_ns)
    for link, counts in zip(links, mailbox.counts(), strict=True):
        assert counts.sent == (TICKS - 1) * PERIOD // link.period_ns + 1
        assert counts.sent == counts.delivered + counts.lost + counts.in_flight
        assert counts.used == len(ages[link.source])
        assert counts.age_max_ns == max(ages[link.source], default=0)
        assert counts.age_mean_ns == pytest.approx(np.mean(ages[link.source]) if counts.used else 0.0)


def heard_at(link: LinkPlan, sent: Sequence[int], ticks: int) -> list[list[float] | None]:
    """Returns what a stage hears at each tick, if only the messages with the numbers `sent` come."""
    mailbox = mailbox_of([link])
    found: list[list[float] | None] = []
    for number in range(ticks):
        if number in sent:
            mailbox.deliver(message_of(link, number))
        (heard,) = mailbox.take(0, number * PERIOD)
        found.append(None if heard is None else heard.values.tolist())
    return found


def test_a_message_that_is_too_old_counts_as_nothing_or_as_zeros():
    link = LinkPlan(3, RECEIVER, Channel.COMMAND, PERIOD, timeout_ns=PERIOD, policy="hold_then_stop")
    comes, old, zeros = [3.0, 1.0], None, [0.0, 0.0]
    assert heard_at(link, [1, 5], 7) == [None, comes, comes, old, old, [3.0, 5.0], [3.0, 5.0]]
    zero = replace(link, policy="zero")
    assert heard_at(zero, [1, 5], 7) == [None, comes, comes, zeros, zeros, [3.0, 5.0], [3.0, 5.0]]


def test_zeros_are_no_use_of_a_message():
    link = LinkPlan(3, RECEIVER, Channel.COMMAND, PERIOD, timeout_ns=PERIOD, policy="zero")
    mailbox = mailbox_of([link])
    mailbox.deliver(message_of(link, 0))
    for tick in range(10):
        mailbox.take(0, tick * PERIOD)
    (counts,) = mailbox.counts()
    assert (counts.used, counts.age_max_ns) == (2, PERIOD)


def test_timeouts_are_read_off_the_clocks():
    """A receiver whose clock is ahead takes messages for older than they are; with such a source they seem younger."""
    link = LinkPlan(3, RECEIVER, Channel.STATE, PERIOD, timeout_ns=3 * PERIOD, policy="hold_then_stop")
    for source, receiver, ticks in [
        (ClockPlan(), ClockPlan(), 4),
        (ClockPlan(), ClockPlan(2 * PERIOD), 2),
        (ClockPlan(2 * PERIOD), ClockPlan(), 6),
        (ClockPlan(2 * PERIOD), ClockPlan(2 * PERIOD), 4),
        (ClockPlan(), ClockPlan(0, 1.0), 2),
    ]:
        plan = replace(link, source_clock=source, receiver_clock=receiver)
        assert sum(heard is not None for heard in heard_at(plan, [0], 10)) == ticks
