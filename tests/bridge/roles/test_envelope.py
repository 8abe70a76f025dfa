"""The envelope: every limit at its boundary, and a comparison with a slow gate that keeps all torques it ever sent.

Each check takes the module as an argument, so that it can also run with mutants (test_envelope_mutations.py)."""

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from echelon.bridge.roles import envelope
from echelon.plan.can_plan import EnvelopePlan
from support.envelope_checks import CHECKS, FREE, INF, MS, WINDOW, SlowGate, sent, step


@pytest.mark.parametrize("check", CHECKS)
def test_envelope(check: Callable[[ModuleType], None]) -> None:
    check(envelope)


eighths = st.integers(-40, 40).map(lambda n: n / 8)
limits = st.one_of(st.just(INF), st.integers(0, 40).map(lambda n: n / 8))


class Gates(RuleBasedStateMachine):
    """Gives any commands at any times to both gates; their results must be equal."""

    @initialize(plan=st.builds(EnvelopePlan, limits, limits, limits, limits, st.integers(0, 5)), now=st.integers())
    def build(self, plan: EnvelopePlan, now: int) -> None:
        self.gate, self.slow, self.now = envelope.Envelope(plan), SlowGate(plan), now

    gaps = st.one_of(st.integers(-2, 5), st.sampled_from([MS, WINDOW // 2, WINDOW - 1, WINDOW, WINDOW + 1]))

    @rule(gap=gaps, age=st.one_of(st.just(0), st.integers(-2, 7)), right=eighths, left=eighths)
    def command(self, gap: int, age: int, right: float, left: float) -> None:
        self.now += gap
        step(self.gate, self.slow, self.now, age, (right, left))

    @rule(gap=gaps, right=st.integers(-3, 3), left=st.integers(-3, 3))
    def near_the_last(self, gap: int, right: int, left: int) -> None:
        self.now += gap
        before = self.slow.history[-1][1:] if self.slow.history else (Fraction(0), Fraction(0))
        step(self.gate, self.slow, self.now, 0, (float(before[0]) + right / 8, float(before[1]) + left / 8))

    @rule(gap=gaps, bad=st.sampled_from([math.nan, INF, -INF]), other=eighths)
    def not_finite(self, gap: int, bad: float, other: float) -> None:
        self.now += gap
        assert not step(self.gate, self.slow, self.now, 0, (other, bad))

    @rule(gap=gaps)
    def stop(self, gap: int) -> None:
        self.now += gap
        self.gate.stop(self.now)
        self.slow.stop(self.now)


TestGates = Gates.TestCase


@given(st.floats(0, 1e6), st.floats(0, 1e6))
def test_what_is_computed_to_be_at_a_limit_passes(start: float, limit: float) -> None:
    gate = envelope.Envelope(replace(FREE, rise_limit=max(start, limit), fall_limit=limit))
    assert sent(gate, 0, start, -start) == ""
    top = start + max(start, limit)
    assert sent(gate, 1, top, -top) == ""
    assert sent(gate, 2, top - limit, -(top - limit)) == ""
