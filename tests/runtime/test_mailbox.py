import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.messages import NULL, Channel, Message
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.delay_tables import ClockPlan
from echelon.plan.link_plan import LinkPlan
from echelon.role import Acts, Input, Stage
from echelon.runtime.arrivals import RECORD
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.turns import Turn
from echelon.runtime.wall_mailbox import WallMailbox
from support.links import PunctualLink

PERIOD = 10
RECEIVER = 9


@dataclass(frozen=True)
class _Plan:
    """As much of a plan as a mailbox needs."""

    links: tuple[LinkPlan, ...]
    seed: int
    duration_ns: int = NEVER_NS
    all_roles: tuple[Any, ...] = tuple(SimpleNamespace(name=f"m{index}") for index in range(RECEIVER + 1))

    def links_into(self, receiver: int) -> tuple[LinkPlan, ...]:
        return self.links if receiver == RECEIVER else ()


def mailbox_of(
    links: Sequence[LinkPlan],
    seed: int = 1,
    stages: Sequence[Stage] | None = None,
    *,
    kind: Callable[..., Any] = Mailbox,
    acts: Acts = Acts.IN_TURN,
    duration_ns: int = NEVER_NS,
) -> Any:
    """Returns the mailbox of a role whose stages each have all links as inputs."""
    inputs = tuple(Input(link.source, link.channel) for link in links)
    stages = stages or [Stage(Turn.ACT, PERIOD, inputs, lambda time_ns, heard: (), acts=acts)]
    plan: Any = _Plan(tuple(links), seed, duration_ns)
    role: Any = SimpleNamespace(index=RECEIVER, stages=tuple(stages))
    return kind(role, plan)


def message_of(link: LinkPlan, number: int, silent: int = 0) -> Message:
    """Returns message `number` of a link; the first `silent` ones are null messages."""
    values = NULL if number < silent else np.array([float(link.source), float(number)])
    return Message(link.channel, link.source, number, number * link.period_ns, values)


def number_in_use(link: LinkPlan, seed: int, time_ns: int) -> int:
    """Returns the number of the newest message that is not lost and has arrived, by looking at all messages."""
    model = PunctualLink(link, seed, f"m{link.source}", f"m{RECEIVER}")
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


@pytest.mark.slow
@given(links_strategy, seeds)
def test_what_is_missing_are_the_messages_that_have_arrived(links, seed):
    """A link waits while it lacks a message that has arrived by now; those on their way it does not wait for."""
    mailbox = mailbox_of(links, seed)
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        for link in links:
            model = PunctualLink(link, seed, f"m{link.source}", f"m{RECEIVER}")
            new = [n for n in range(TICKS) if model.arrived(n, time_ns) and not model.arrived(n, time_ns - PERIOD)]
            new = [n for n in new if n > number_in_use(link, seed, time_ns - PERIOD)] if time_ns else new
            for number in new:
                assert link.source in {waiting.plan.source for waiting in mailbox.missing(0, time_ns)}
                mailbox.deliver(message_of(link, number))
            assert link.source not in {waiting.plan.source for waiting in mailbox.missing(0, time_ns)}
        assert mailbox.missing(0, time_ns) == []
        mailbox.take(0, time_ns)


@pytest.mark.slow
@given(links_strategy, seeds, st.randoms(use_true_random=False))
def test_on_a_wall_clock_the_newest_that_came_is_used(links, seed, luck):
    """Some messages come late, some never.  In use is the newest that has come and has arrived by the rules of the link."""
    mailbox = mailbox_of(links, seed, kind=WallMailbox)
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
            mailbox.receive(message, time_ns)
        for link, message in zip(links, mailbox.take(0, time_ns), strict=True):
            model = PunctualLink(link, seed, f"m{link.source}", f"m{RECEIVER}")
            came = [n for n in range(TICKS) if comes[link.source, n] <= time_ns and model.arrived(n, time_ns)]
            used[link.source] = max([used[link.source], *came])
            assert (message.sequence if message is not None else -1) == used[link.source]


def test_a_late_message_is_used_while_a_newer_one_is_missing():
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD)
    mailbox = mailbox_of([link], kind=WallMailbox)
    mailbox.receive(message_of(link, 0), 0)
    for time_ns in (0, PERIOD, 2 * PERIOD):
        mailbox.take(0, time_ns)
    mailbox.receive(message_of(link, 1), 2 * PERIOD)  # number 2 should have come, but has not
    (heard,) = mailbox.take(0, 2 * PERIOD)
    assert heard is not None
    assert heard.sequence == 1


def wall_acts(mailbox: WallMailbox, time_ns: int) -> list[tuple[int, list[int | None]]]:
    """Returns when the only stage acts that is due at `time_ns`, and the numbers of the messages that it uses, once all that
    comes in its period has come."""
    return [
        (at_ns - time_ns, [None if message is None else message.sequence for message in heard])
        for at_ns, heard in mailbox.acts_with_all(0, time_ns, time_ns + PERIOD - 1)
    ]


@pytest.mark.parametrize(
    ("acts", "expected"),
    [
        (Acts.WHEN_HEARD, [(6, [0, 0])]),
        (Acts.ON_ARRIVAL, [(0, [None, None]), (2, [0, None]), (6, [0, 0])]),
        (Acts.AT_INSTANT, [(0, [None, None])]),
        (Acts.IN_TURN, [(0, [0, 0])]),  # it waits for both, and its instant stays
    ],
)
def test_on_a_wall_clock_a_stage_acts_in_the_instant_of_arrival(acts, expected):
    links = [LinkPlan(source, RECEIVER, Channel.STATE, PERIOD) for source in range(2)]
    mailbox = mailbox_of(links, kind=WallMailbox, acts=acts)
    mailbox.receive(message_of(links[0], 0), 2)
    mailbox.receive(message_of(links[1], 0), 6)
    assert wall_acts(mailbox, 0) == expected


def test_a_late_act_uses_what_has_come_and_was_sent_by_its_instant():
    """The process gets to the act of the first period, which ends at 9, after messages 0 to 2 have come.  They were sent at 0,
    10 and 20."""
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD)
    mailbox = mailbox_of([link], kind=partial(WallMailbox, noted=True), acts=Acts.WHEN_HEARD)
    ready_ns, missed = mailbox.ready(0, 0, PERIOD)
    assert (ready_ns, missed) == (PERIOD - 1, True)
    for number, came_ns in enumerate((25, 26, 27)):
        mailbox.receive(message_of(link, number), came_ns)
    mailbox.hasten(0, ready_ns)
    (heard,) = mailbox.hear(0, ready_ns)
    assert heard is not None
    assert heard.sequence == 0
    mailbox.hasten(0, 2 * PERIOD - 1)
    assert wall_acts(mailbox, PERIOD) == [(PERIOD - 1, [1])]
    assert list(RECORD.iter_unpack(mailbox.arrivals)) == [
        (0, 0, 0, 25), (0, 1, 10, 26), (0, 2, 20, 27), (0, 0, 0, 9), (0, 1, 10, 19),
    ]  # fmt: skip


def test_the_delay_of_a_link_is_not_hastened():
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD, 30, 30)
    mailbox = mailbox_of([link], kind=partial(WallMailbox, noted=True), acts=Acts.WHEN_HEARD)
    mailbox.receive(message_of(link, 0), 5)
    mailbox.receive(message_of(link, 1), 70)
    for instant, arrives in ((29, [30, 70]), (35, [30, 70]), (45, [30, 70, 45])):
        mailbox.hasten(0, instant)
        assert [arrived for *_, arrived in RECORD.iter_unpack(mailbox.arrivals)] == arrives


def test_arrivals_are_noted_once_and_only_of_messages_that_are_not_lost():
    links = [LinkPlan(0, RECEIVER, Channel.STATE, PERIOD, loss=1.0), LinkPlan(1, RECEIVER, Channel.STATE, PERIOD)]
    mailbox = mailbox_of(links, kind=partial(WallMailbox, noted=True))
    for link in links:
        for time_ns in (3, 4):
            mailbox.receive(message_of(link, 0), time_ns)
    assert list(RECORD.iter_unpack(mailbox.arrivals)) == [(1, 0, 0, 3)]
    silent = mailbox_of(links, kind=WallMailbox)
    silent.receive(message_of(links[1], 0), 3)
    assert silent.arrivals is None


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
        mailbox.acts(0, number * PERIOD)
        most = max(most, held_messages(mailbox))
    assert most <= (delay + 100) // PERIOD + 3


def test_memory_is_bounded_when_nothing_in_use_comes():
    """On a wall clock, every third message comes, out of order."""
    links = [LinkPlan(source, RECEIVER, Channel.STATE, PERIOD, 0, 30 * source, 0.1 * source) for source in range(3)]
    mailbox, luck, most = mailbox_of(links, kind=WallMailbox), random.Random(1), 0
    for number in range(3000):
        for link in links:
            if luck.random() < 1 / 3:
                mailbox.receive(message_of(link, max(0, number - luck.randrange(10))), number * PERIOD)
        mailbox.take(0, number * PERIOD)
        most = max(most, held_messages(mailbox))
    assert most < 3 * 20


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


@given(links_strategy, seeds)
def test_counts(links, seed):
    mailbox = mailbox_of(links, seed)
    ages: dict[int, list[int]] = {link.source: [] for link in links}
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        for link in links:
            mailbox.deliver(message_of(link, time_ns // PERIOD))
        for message in mailbox.acts(0, time_ns)[0][1]:
            if message is not None:
                ages[message.source].append(time_ns - message.time_ns)
    for link, counts in zip(links, mailbox.counts(), strict=True):
        assert counts.sent == (TICKS - 1) * PERIOD // link.period_ns + 1
        assert counts.sent == counts.delivered + counts.lost + counts.in_flight
        assert counts.used == len(ages[link.source])
        assert counts.age_max_ns == max(ages[link.source], default=0)
        assert counts.age_mean_ns == pytest.approx(np.mean(ages[link.source]) if counts.used else 0.0)


# Event-driven stages


def act_of(mailbox: Any, time_ns: int) -> tuple[int, list[int | None]]:
    """Returns when the only stage acts that is due at `time_ns`, and the numbers of the messages that it uses."""
    ((at_ns, heard),) = mailbox.acts(0, time_ns)
    return at_ns, [None if message is None else message.sequence for message in heard]


def run_of(
    links: Sequence[LinkPlan], periods: int, acts: Acts = Acts.WHEN_HEARD
) -> list[list[tuple[int, list[int | None]]]]:
    """Returns the acts of a stage in its first periods, with all messages sent when they are due: when after the beginning of
    the period, and which messages it uses."""
    mailbox, found = mailbox_of(links, acts=acts), []
    for n in range(periods):
        time_ns = n * PERIOD
        for link in links:
            if time_ns % link.period_ns == 0:
                mailbox.deliver(message_of(link, time_ns // link.period_ns))
        assert mailbox.missing(0, time_ns) == []
        found.append(
            [
                (at_ns - time_ns, [None if message is None else message.sequence for message in heard])
                for at_ns, heard in mailbox.acts(0, time_ns)
            ]
        )
    return found


def delayed(source: int, delay_ns: int, factor: int = 1, **further: Any) -> LinkPlan:
    """Returns a link with a constant delay, and a multiple of the period."""
    return LinkPlan(source, RECEIVER, Channel.STATE, factor * PERIOD, delay_ns, delay_ns, **further)


def test_an_event_driven_stage_acts_when_the_last_of_its_inputs_has_come():
    assert run_of([delayed(0, 3), delayed(1, 7), delayed(2, 0)], 3) == [[(7, [n, n, n])] for n in range(3)]


@pytest.mark.parametrize(("delay", "after", "old"), [(10, 0, 1), (13, 3, 1), (15, 5, 1), (29, 9, 2), (30, 0, 3)])
def test_a_delay_above_the_period_shifts_acts_into_later_periods(delay, after, old):
    """Before anything has arrived the stage acts at the end of its period, with nothing."""
    found = run_of([delayed(0, delay)], 6)
    assert found[:old] == [[(9, [None])]] * old
    assert found[old:] == [[(after, [n - old])] for n in range(old, 6)]


def test_time_driven_stages_act_at_the_beginning_of_their_periods():
    assert run_of([delayed(0, 3), delayed(1, 0)], 3, Acts.AT_INSTANT) == [
        [(0, [None, 0])],
        [(0, [0, 1])],
        [(0, [1, 2])],
    ]


def test_what_is_not_due_is_not_waited_for():
    """The input of every third period is waited for in the periods in which it is due, and not in between."""
    found = run_of([delayed(0, 4, factor=3), delayed(1, 2)], 6)
    assert found == [[(4, [0, 0])], [(2, [0, 1])], [(2, [0, 2])], [(4, [1, 3])], [(2, [1, 4])], [(2, [1, 5])]]


def test_a_lost_message_is_waited_for_to_the_end_of_the_period():
    link = delayed(0, 0, loss=0.5)
    lost = [PunctualLink(link, 1, "m0", f"m{RECEIVER}").fate(n) is None for n in range(40)]
    assert any(lost)
    newest = None
    for n, ((act,),) in enumerate(zip(run_of([link], 40), strict=True)):
        newest = newest if lost[n] else n
        assert act == (9 if lost[n] else 0, [newest])


def test_a_robot_acts_at_the_beginning_and_at_each_arrival_of_something_newer():
    found = run_of([delayed(0, 4)], 3, Acts.ON_ARRIVAL)
    assert found == [[(0, [None]), (4, [0])], [(0, [0]), (4, [1])], [(0, [1]), (4, [2])]]


def test_a_robot_stops_when_what_it_uses_becomes_too_old():
    """Age 6 is still young enough; at 4 + 7 after the message was sent it is too old."""
    found = run_of([delayed(0, 4, timeout_ns=6)], 3, Acts.ON_ARRIVAL)
    assert found == [
        [(0, [None]), (4, [0]), (7, [None])],
        [(0, [None]), (4, [1]), (7, [None])],
        [(0, [None]), (4, [2]), (7, [None])],
    ]


def test_a_message_that_is_overtaken_starts_no_act():
    """Delays from 0 to 30: each act of a robot uses a newer message than the one before it, in the order of arrivals."""
    link = LinkPlan(0, RECEIVER, Channel.STATE, PERIOD, 0, 3 * PERIOD)
    model = PunctualLink(link, 1, "m0", f"m{RECEIVER}")
    arrivals = sorted((n * PERIOD + (model.fate(n) or 0), n) for n in range(60))
    newest, expected = -1, {}
    for arrival, n in arrivals:  # of those that arrive at one instant, the newest counts
        if n > newest:
            newest = expected[arrival] = n
    found = [
        (period * PERIOD + after, number)
        for period, acts in enumerate(run_of([link], 60, Acts.ON_ARRIVAL))
        for after, (number,) in acts
    ]
    changes = [act for before, act in zip([(-1, None), *found], found, strict=False) if act[1] != before[1]]
    assert [act for act in changes if act[1] is not None] == [one for one in expected.items() if one[0] < 60 * PERIOD]


def test_an_input_that_comes_after_the_period_does_not_make_others_come_sooner():
    links = [delayed(0, 8, punctual=False), delayed(1, 3, punctual=False)]
    mailbox = mailbox_of(links, acts=Acts.WHEN_HEARD)
    for link in links:  # both are sent at the end of the period, and arrive in the next one
        mailbox.deliver(message_of(link, 0)._replace(time_ns=PERIOD - 1))
    assert act_of(mailbox, 0) == (PERIOD - 1, [None, None])


def test_nothing_acts_after_the_end_of_the_run():
    """At the end nobody waits for what arrives later: a lockstep would wait for messages that are never sent."""
    for acts in (Acts.WHEN_HEARD, Acts.ON_ARRIVAL):
        mailbox = mailbox_of([delayed(0, 4)], acts=acts, duration_ns=2 * PERIOD)
        for n in range(2):
            mailbox.deliver(message_of(delayed(0, 4), n))
            mailbox.acts(0, n * PERIOD)
        assert mailbox.missing(0, 2 * PERIOD) == []  # message 2 has not come
        assert act_of(mailbox, 2 * PERIOD) == (2 * PERIOD, [1])


def test_messages_of_a_late_sender_arrive_their_delay_after_they_were_sent():
    link = replace(delayed(0, 3), punctual=False)
    mailbox = mailbox_of([link], acts=Acts.WHEN_HEARD)
    mailbox.deliver(message_of(link, 0)._replace(time_ns=4))
    assert act_of(mailbox, 0) == (7, [0])
    mailbox.deliver(message_of(link, 1)._replace(time_ns=PERIOD + 9))
    assert act_of(mailbox, PERIOD) == (PERIOD + 9, [0])  # it arrives in the next period
    mailbox.deliver(message_of(link, 2)._replace(time_ns=2 * PERIOD))
    assert act_of(mailbox, 2 * PERIOD) == (2 * PERIOD + 2, [1])


@given(links_strategy, seeds, st.randoms(use_true_random=False))
def test_event_driven_acts_do_not_depend_on_the_order_of_arrival(links, seed, shuffle):
    """Messages as early as possible, against messages in any order and as late as possible."""
    early = mailbox_of(links, seed, acts=Acts.WHEN_HEARD)
    late = mailbox_of(links, seed, acts=Acts.WHEN_HEARD)
    on_the_way = [message_of(link, number) for link in links for number in range(TICKS)]
    for message in on_the_way:
        early.deliver(message)
    shuffle.shuffle(on_the_way)
    for time_ns in range(0, TICKS * PERIOD, PERIOD):
        assert early.missing(0, time_ns) == []
        while late.missing(0, time_ns):
            late.deliver(on_the_way.pop())
        expected = act_of(early, time_ns)
        assert act_of(late, time_ns) == expected
        assert time_ns <= expected[0] < time_ns + PERIOD


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
