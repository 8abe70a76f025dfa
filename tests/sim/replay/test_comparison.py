"""sim.replay.comparison: which messages belong together, which values are equal, what differs first and most."""

from math import inf, nan

import numpy as np
import pytest

from echelon.messages import Channel
from echelon.sim.replay.comparison import ChannelComparison, Difference, compare, earliest
from echelon.sim.results.recorded import Series
from support.runs import plan_of

PLAN = plan_of("lab")
NAMES = ("a", "b")


def series(*rows: tuple[int, float, float], source: int = 0, period_ns: int = 10) -> Series:
    """Returns messages from their sequence numbers and values."""
    sequences = np.array([row[0] for row in rows], np.int64)
    values = np.array([row[1:] for row in rows], float).reshape(-1, 2)
    return Series(source, Channel.STATE, sequences, sequences * period_ns, values)


def compared(first: Series, second: Series, tolerance: float = 0.0, **options: bool) -> ChannelComparison:
    """Compares two series whose values have the same names."""
    return compare(PLAN, (first, NAMES), (second, NAMES), tolerance=tolerance, **options)


def test_the_first_value_of_the_first_message_that_differs() -> None:
    found = compared(series((0, 1, 2), (1, 1, 2), (2, 1, 2)), series((0, 1, 2), (1, 1, 5), (2, 9, 2)))
    assert (found.compared, found.equal, found.only_first, found.only_second) == (3, 1, 0, 0)
    assert found.first_difference == Difference(10, 1, "g1/r1", Channel.STATE, "b", 2.0, 5.0)
    assert found.largest == Difference(20, 2, "g1/r1", Channel.STATE, "a", 1.0, 9.0)
    assert not found.is_equal


def test_what_differs_by_the_tolerance_is_equal_and_still_told() -> None:
    first, second = series((0, 1.0, 2.0)), series((0, 1.25, 2.0))
    assert compared(first, second, 0.25).is_equal
    assert compared(first, second, 0.25).largest == Difference(0, 0, "g1/r1", Channel.STATE, "a", 1.0, 1.25)
    assert not compared(first, second, 0.2499).is_equal


def test_the_largest_difference_is_of_a_square_of_a_torque_only_if_all_else_is_the_same() -> None:
    names = ("x", "tau_right_square")
    first = series((0, 1.0, 2.0), (1, 1.0, 2.0))
    both = compare(PLAN, (first, names), (series((0, 1.0, 900.0), (1, 1.5, 2.0)), names), tolerance=0.0)
    assert both.largest == Difference(10, 1, "g1/r1", Channel.STATE, "x", 1.0, 1.5)
    assert both.first_difference == Difference(0, 0, "g1/r1", Channel.STATE, "tau_right_square", 2.0, 900.0)
    alone = compare(PLAN, (first, names), (series((0, 1.0, 900.0), (1, 1.0, 2.0)), names), tolerance=0.0)
    assert alone.largest == both.first_difference


@pytest.mark.parametrize(
    ("one", "other", "equal"),
    [(nan, nan, True), (inf, inf, True), (0.0, -0.0, True), (nan, 1.0, False), (inf, -inf, False), (1.0, inf, False)],
)
def test_numbers_that_are_not_finite(one: float, other: float, equal: bool) -> None:
    found = compared(series((0, one, 2.0)), series((0, other, 2.0)), tolerance=1e300)
    assert found.is_equal == equal
    assert (found.largest is None) == equal


def test_a_message_that_one_lacks_is_a_difference() -> None:
    both, fewer = series((0, 1, 2), (1, 1, 2), (2, 1, 2)), series((0, 1, 2), (2, 1, 2))
    for found, lacking in ((compared(both, fewer), "second"), (compared(fewer, both), "first")):
        assert (found.compared, found.equal, found.only_first + found.only_second) == (2, 2, 1)
        assert found.first_difference is not None
        assert (found.first_difference.time_ns, found.first_difference.lacking) == (10, lacking)
    assert compared(both, fewer, complete=False).is_equal


def test_messages_of_other_periods_belong_together_by_time() -> None:
    fine, coarse = series((0, 0, 0), (1, 1, 1), (2, 2, 2)), series((0, 0, 0), (1, 2, 2), period_ns=20)
    found = compared(fine, coarse, by_time=True, complete=False)
    assert (found.compared, found.equal, found.is_equal) == (2, 2, True)
    assert not compared(fine, coarse).is_equal


def test_values_belong_together_by_name() -> None:
    found = compare(PLAN, (series((0, 1, 2)), ("a", "b")), (series((0, 2, 7)), ("b", "c")), tolerance=0.0)
    assert (found.compared, found.equal, found.first_difference) == (1, 1, None)
    assert found.unshared == ("a", "c")
    assert not found.is_equal


def test_of_one_instant_the_earliest_turn_is_first() -> None:
    def differing(member: str, channel: Channel, time_ns: int = 0) -> ChannelComparison:
        difference = Difference(time_ns, 0, member, channel, "x", 0.0, 1.0)
        return ChannelComparison(member, channel, 1, 0, 0, 0, difference, difference, ())

    later_on = [
        differing("g3/r9", Channel.STATE),
        differing("g1", Channel.GROUP_STATE),
        differing("coordinator", Channel.REFERENCE),
        differing("g1", Channel.COMMAND),
        differing("g1/r1", Channel.TORQUE),
    ]
    for at, expected in enumerate(later_on):
        assert earliest(PLAN, reversed(later_on[at:])) == expected.first_difference
    early = differing("g1/r1", Channel.TORQUE, -1)
    assert earliest(PLAN, [*later_on, early]) == early.first_difference
    assert earliest(PLAN, []) is None
    # States go up the tree, references down.
    states, references = (
        [differing(name, channel) for name in ("west/g1", "west", "coordinator")]
        for channel in (Channel.GROUP_STATE, Channel.REFERENCE)
    )
    for rows in (states[:2], references[:0:-1]):
        assert earliest(plan_of("three_levels"), rows) == rows[0].first_difference
        assert earliest(plan_of("three_levels"), reversed(rows)) == rows[0].first_difference
