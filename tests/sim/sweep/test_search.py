"""The search for the largest value that holds."""

from collections.abc import Callable
from math import log2

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.errors import UsageError
from echelon.sim.sweep.search import ALL, COARSE, By, Found, Judged, Judgements, Search, judgements

Judge = Callable[[float], Judged]


def searched(text: str, share: Judge, moment: Judge | None = None) -> tuple[dict[By, Found], int]:
    """Returns what a search finds by each judgement, and how many values it tried."""
    search = Search.parse(text)
    going = search.run()
    known: dict[int, Judgements] = {}
    asked = next(going)
    while True:
        assert not set(asked) & set(known), "a value is tried twice"
        for number in asked:
            value = float(search.value(number))
            known[number] = judgements(share(value), (moment or share)(value))
        try:
            asked = going.send({number: known[number] for number in asked})
        except StopIteration as end:
            bounds = end.value
            break
    return {by: search.found(by, known, bounds[by], {}) for by in ALL}, len(known)


def by_share(text: str, share: Judge) -> Found:
    return searched(text, share)[0]["share"]


def exact(holds: Callable[[float], bool]) -> Judge:
    return lambda value: Judged(holds(value), True)


@given(st.integers(0, 1000))
def test_a_boundary_is_found_to_the_step(edge: int) -> None:
    every, tried = searched("a=0:1:0.001", exact(lambda value: value <= edge / 1000 + 1e-12))
    found = every["share"]
    assert found.value == pytest.approx(edge / 1000)
    assert found.fails == (None if edge == 1000 else pytest.approx((edge + 1) / 1000))
    assert (found.low, found.high) == (found.value, found.fails)
    assert {(one.value, one.fails) for one in every.values()} == {(found.value, found.fails)}
    assert not found.again
    assert tried <= COARSE + 1 + log2(1000 / COARSE) + 1


def test_both_judgements_have_boundaries_of_their_own() -> None:
    found, _ = searched("a=0:1:0.01", exact(lambda value: value < 0.705), exact(lambda value: value < 0.555))
    assert (found["share"].value, found["share"].fails) == (0.7, 0.71)
    assert (found["second moment"].value, found["second moment"].fails) == (0.55, 0.56)


@pytest.mark.parametrize(
    ("share", "moment", "limited_by", "text"),
    [
        (0.705, 0.555, ("second moment",), "a: holds up to 0.55, fails at 0.56 by second moment"),
        (0.555, 0.705, ("share",), "a: holds up to 0.55, fails at 0.56 by share"),
        (0.555, 0.555, ("share", "second moment"), "a: holds up to 0.55, fails at 0.56 by share and second moment"),
        (0, 0.555, ("share",), "a: fails even at 0 by share"),
        (2, 2, (), "a: all values hold, up to 1; give a larger range"),
    ],
)
def test_what_holds_by_both_ends_at_the_smaller_boundary_and_says_which_it_is(
    share: float, moment: float, limited_by: tuple[By, ...], text: str
) -> None:
    every, tried = searched("a=0:1:0.01", exact(lambda value: value < share), exact(lambda value: value < moment))
    found = every["both"]
    assert found.limited_by == limited_by
    assert found.text == text
    one, other = (searched("a=0:1:0.01", exact(lambda v, end=end: v < end))[1] for end in (share, moment))
    assert tried <= one + other  # nothing is tried for `both` alone


@pytest.mark.parametrize(
    ("share", "moment", "both"),
    [
        (Judged(True, True), Judged(True, False), Judged(True, False)),
        (Judged(True, True), Judged(True, True), Judged(True, True)),
        (Judged(True, True), Judged(False, False), Judged(False, False)),
        (Judged(True, False), Judged(False, True), Judged(False, True)),
        (Judged(False, False), Judged(False, True), Judged(False, True)),
        (Judged(False, False), Judged(False, False), Judged(False, False)),
    ],
)
def test_a_point_surely_holds_if_both_judgements_are_sure_and_surely_fails_if_one_is(
    share: Judged, moment: Judged, both: Judged
) -> None:
    for one, other in ((share, moment), (moment, share)):
        assert judgements(one, other) == {"both": both, "share": one, "second moment": other}


def test_all_or_nothing_holds() -> None:
    always = by_share("a=0:1:0.1", exact(lambda value: True))
    assert (always.value, always.fails, always.high) == (1.0, None, None)
    assert "give a larger range" in always.text
    never = by_share("a=0:1:0.1", exact(lambda value: False))
    assert (never.value, never.fails, never.low) == (None, 0.0, None)
    assert "fails even at 0" in never.text


def test_what_holds_again_above_the_boundary_is_said() -> None:
    found = by_share("a=0:1:0.01", exact(lambda value: value < 0.3 or value > 0.8))
    assert found.value == pytest.approx(0.29)
    assert found.again == (0.88, 1.0)
    assert "not monotone: holds again at 0.88, 1" in found.text


def test_what_is_not_sure_widens_the_interval() -> None:
    def judge(value: float) -> Judged:
        return Judged(value < 0.5, not 0.3 < value < 0.7)

    found = by_share("a=0:1:0.01", judge)
    assert (found.value, found.fails) == (0.49, 0.5)
    assert found.low is not None
    assert found.low <= 0.3
    assert found.high is not None
    assert found.high >= 0.7
    assert "surely up to" in found.text
    nothing = by_share("a=0:1:0.01", lambda value: Judged(value < 0.5, False))
    assert (nothing.low, nothing.high) == (None, None)
    assert "nowhere for sure" in nothing.text


def test_noise_at_the_boundary_is_no_violation() -> None:
    """A value that holds above one that fails, neither of them surely, says nothing about monotony."""

    def judge(value: float) -> Judged:
        return Judged(value < 0.5 or 0.6 < value < 0.7, value < 0.4 or value > 0.8)

    assert not by_share("a=0:1:0.01", judge).again


def test_a_range_without_a_step_gets_one() -> None:
    search = Search.parse("a=0:0.5")
    assert search.span.steps == 256
    assert search.value(256) == 0.5


@pytest.mark.parametrize("text", ["a", "a=1", "a=1,2", "a=1:0:0.1", "a=0:1:0", "seed=0:9:1", "=0:1"])
def test_a_mistake_is_one_line(text: str) -> None:
    with pytest.raises(UsageError) as refused:
        Search.parse(text)
    (line,) = refused.value.lines
    assert line.startswith(f"--find {text}")
