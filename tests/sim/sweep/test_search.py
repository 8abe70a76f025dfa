"""The search for the largest value that holds."""

from collections.abc import Callable
from math import log2

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.errors import UsageError
from echelon.sim.sweep.search import COARSE, Found, Judged, Search

Judge = Callable[[float], Judged]


def searched(text: str, share: Judge, moment: Judge | None = None) -> tuple[Found, Found, int]:
    """Returns what a search finds, by share and by second moment, and how many values it tried."""
    search = Search.parse(text)
    going = search.run()
    known = {}
    asked = next(going)
    while True:
        assert not set(asked) & set(known), "a value is tried twice"
        for number in asked:
            value = float(search.value(number))
            known[number] = {"share": share(value), "second moment": (moment or share)(value)}
        try:
            asked = going.send({number: known[number] for number in asked})
        except StopIteration as end:
            bounds = end.value
            break
    one, other = (search.found(by, known, bounds[by], {}) for by in ("share", "second moment"))
    return one, other, len(known)


def exact(holds: Callable[[float], bool]) -> Judge:
    return lambda value: Judged(holds(value), True)


@given(st.integers(0, 1000))
def test_a_boundary_is_found_to_the_step(edge: int) -> None:
    found, other, tried = searched("a=0:1:0.001", exact(lambda value: value <= edge / 1000 + 1e-12))
    assert found.value == pytest.approx(edge / 1000)
    assert found.fails == (None if edge == 1000 else pytest.approx((edge + 1) / 1000))
    assert (found.low, found.high) == (found.value, found.fails)
    assert (other.value, other.fails) == (found.value, found.fails)
    assert not found.again
    assert tried <= COARSE + 1 + log2(1000 / COARSE) + 1


def test_both_judgements_have_boundaries_of_their_own() -> None:
    by_share, by_moment, _ = searched(
        "a=0:1:0.01", exact(lambda value: value < 0.705), exact(lambda value: value < 0.555)
    )
    assert (by_share.value, by_share.fails) == (0.7, 0.71)
    assert (by_moment.value, by_moment.fails) == (0.55, 0.56)


def test_all_or_nothing_holds() -> None:
    always, _, _ = searched("a=0:1:0.1", exact(lambda value: True))
    assert (always.value, always.fails, always.high) == (1.0, None, None)
    assert "give a larger range" in always.text
    never, _, _ = searched("a=0:1:0.1", exact(lambda value: False))
    assert (never.value, never.fails, never.low) == (None, 0.0, None)
    assert "fails even at 0" in never.text


def test_what_holds_again_above_the_boundary_is_said() -> None:
    found, _, _ = searched("a=0:1:0.01", exact(lambda value: value < 0.3 or value > 0.8))
    assert found.value == pytest.approx(0.29)
    assert found.again == (0.88, 1.0)
    assert "not monotone: holds again at 0.88, 1" in found.text


def test_what_is_not_sure_widens_the_interval() -> None:
    def judge(value: float) -> Judged:
        return Judged(value < 0.5, not 0.3 < value < 0.7)

    found, _, _ = searched("a=0:1:0.01", judge)
    assert (found.value, found.fails) == (0.49, 0.5)
    assert found.low is not None
    assert found.low <= 0.3
    assert found.high is not None
    assert found.high >= 0.7
    assert "surely up to" in found.text
    nothing, _, _ = searched("a=0:1:0.01", lambda value: Judged(value < 0.5, False))
    assert (nothing.low, nothing.high) == (None, None)
    assert "nowhere for sure" in nothing.text


def test_noise_at_the_boundary_is_no_violation() -> None:
    """A value that holds above one that fails, neither of them surely, says nothing about monotony."""

    def judge(value: float) -> Judged:
        return Judged(value < 0.5 or 0.6 < value < 0.7, value < 0.4 or value > 0.8)

    assert not searched("a=0:1:0.01", judge)[0].again


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
