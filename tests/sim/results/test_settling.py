"""Settling times and decay rates against closed forms: the free response of ë = -k1/σ² e - k2/σ ė.

With α = k2/2σ and ω² = k1/σ² - α², from rest, e(t) = e0 e^(-αt) (cos ωt + α/ω sin ωt), ė(t) = -e0 k1/(σ² ω) e^(-αt) sin ωt.
"""

from math import exp, pi, sin, sqrt

import numpy as np
import pytest

from echelon.sim.results.block_series import block_series
from echelon.sim.results.rates import amplitude, decay
from echelon.sim.results.settling import dwell_ns, entered_ns, settle, start_error
from echelon.sim.results.trace import Trace
from support.runs import plan_of, trace_of
from support.synthetic import of_errors

MS = 1_000_000
PERIOD_NS = 10 * MS
E0 = 0.4


def modes(block):
    """Returns α and ω [1/s] of a block."""
    k1, k2 = float(block.k1[0, 0]), float(block.k2[0, 0])
    alpha = k2 / (2 * block.sigma)
    return alpha, sqrt(k1 / block.sigma**2 - alpha**2)


def free(block, seconds):
    """The free response of a block from rest: its error and the rate of the error, each (T, size)."""
    alpha, omega = modes(block)
    fall, unit = np.exp(-alpha * seconds), np.ones(block.size) / sqrt(block.size)
    error = E0 * fall * (np.cos(omega * seconds) + alpha / omega * np.sin(omega * seconds))
    rate = -E0 * (alpha**2 + omega**2) / omega * fall * np.sin(omega * seconds)
    return error[:, None] * unit, rate[:, None] * unit


def last_outside(block, fraction):
    """Returns the last time [s] at which |e| of the free response is outside a band, on a grid finer than any period of a
    run."""
    t = np.arange(0, 30 * block.sigma, 1e-4 * block.sigma)
    alpha, omega = modes(block)
    e = np.exp(-alpha * t) * (np.cos(omega * t) + alpha / omega * np.sin(omega * t))
    return float(t[np.abs(e) > fraction][-1])


@pytest.fixture(scope="module")
def lab():
    return plan_of("lab", "claims=[]")


@pytest.fixture(scope="module")
def answer(lab) -> Trace:
    return of_errors(lab, free)


def cut(trace: Trace, end_s: float) -> Trace:
    keep = [times <= round(end_s * 1e9) for times in trace.times_ns]
    times, states = (
        tuple(part[kept] for part, kept in zip(parts, keep, strict=True)) for parts in (trace.times_ns, trace.states)
    )
    return Trace(trace.plan, times, states)


def settled_s(trace: Trace, fraction: float, dwell: float | None = None) -> dict[str, float | None]:
    blocks = block_series(trace)
    found = {
        one.block.name: settle(trace.plan, one, blocks.times_ns, fraction, dwell).settled_ns for one in blocks.series
    }
    return {name: None if time_ns is None else time_ns / 1e9 for name, time_ns in found.items()}


@pytest.mark.parametrize("fraction", [0.02, 0.05])
def test_settling_times_are_those_of_the_closed_form(lab, answer, fraction):
    times = settled_s(answer, fraction)
    for block in lab.blocks:
        exact = last_outside(block, fraction)
        assert 0 <= times[block.name] - exact <= PERIOD_NS / 1e9 + 1e-4 * block.sigma, block.name


@pytest.mark.slow
def test_no_run_that_is_cut_off_settles_before_its_time(lab, answer):
    """An oscillating error passes through its band; a run that ends there has not settled."""
    whole = settled_s(answer, 0.05)
    told = 0
    for end_s in np.arange(0.05, 20.0, 0.05):
        for name, time in settled_s(cut(answer, end_s), 0.05).items():
            assert time in (None, whole[name]), (name, end_s)
            told += time is not None
    assert told > 500


def test_lab_cut_at_1_21_s_has_not_settled_and_without_a_dwell_time_it_seems_to_have(lab):
    trace = trace_of(plan_of("lab", "duration=1.21", "claims=[]"))
    assert settled_s(trace, 0.05)["g1"] is None
    assert settled_s(trace, 0.05, dwell=0.0)["g1"] == pytest.approx(1.14, abs=0.02)
    whole = settled_s(trace_of(plan_of("lab", "duration=6", "claims=[]")), 0.05)
    assert whole["g1"] == pytest.approx(last_outside(lab.blocks[0], 0.05), abs=0.03)
    assert whole["g1"] == pytest.approx(2.65, abs=0.03)


def test_the_dwell_time_is_nearly_half_a_period_of_the_blocks_own_oscillation(lab):
    for block in lab.blocks:
        half_s = pi / modes(block)[1]
        assert 0.8 * half_s < dwell_ns(block, None) / 1e9 < half_s
        assert dwell_ns(block, 2.0) == pytest.approx(2e9 * block.sigma)


def test_a_centroid_that_must_catch_up_starts_with_its_peak():
    """At rest in its place, while the reference moves off at v: e(0) = 0, ė(0) = -v, e = -v/ω e^(-αt) sin ωt, largest where
    tan ωt = ω/α."""
    plan = plan_of("lab", "claims=[]")
    block, v = plan.blocks[-1], 0.3
    alpha, omega = modes(block)

    def moving_off(block, seconds):
        error, rate = np.zeros((len(seconds), block.size)), np.zeros((len(seconds), block.size))
        if block.node is None:
            fall = np.exp(-alpha * seconds)
            error[:, 0] = -v / omega * fall * np.sin(omega * seconds)
            rate[:, 0] = -v * fall * (np.cos(omega * seconds) - alpha / omega * np.sin(omega * seconds))
        return error, rate

    blocks = block_series(of_errors(plan, moving_off))
    at = np.arctan(omega / alpha) / omega
    assert start_error(blocks.series[-1], blocks.times_ns) == pytest.approx(
        v / omega * exp(-alpha * at) * sin(omega * at), rel=1e-4
    )
    shape = settle(plan, blocks.series[0], blocks.times_ns, 0.05)
    assert (shape.band, shape.settled_ns) == (
        plan.health.floor,
        0,
    )  # it starts with an error within the floor, and stays there


@pytest.mark.parametrize(
    ("norm", "entered"),
    [
        ([1.0, 0.04, 0.04], MS),
        ([1.0, 0.05, 0.05], MS),  # on the band is inside
        ([1.0, 0.04, 0.06, 0.04], 3 * MS),  # it leaves once more
        ([1.0, 0.04, 0.06], None),
        ([0.0, 0.0], 0),
        ([1.0, np.nan, 0.0], None),
        ([np.inf, 0.0], None),
        ([], None),
    ],
)
def test_a_band_is_entered_after_the_last_instant_outside(norm, entered):
    assert entered_ns(np.arange(len(norm)) * MS, np.array(norm), 0.05) == entered


def test_the_amplitude_of_the_free_answer_has_no_ripple_and_its_rate_is_alpha(lab, answer):
    blocks = block_series(answer)
    for one in blocks.series:
        alpha, omega = modes(one.block)
        sizes = amplitude(one)
        np.testing.assert_allclose(
            sizes, E0 * sqrt(1 + (alpha / omega) ** 2) * np.exp(-alpha * blocks.seconds), rtol=1e-6, atol=1e-9
        )
        fit = decay(blocks.times_ns, sizes, float(sizes[-1]))
        assert fit.rate == pytest.approx(alpha, rel=1e-6)
        assert fit.r_squared == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("rate", [0.3, 2.0])
def test_a_growing_amplitude_has_a_negative_rate(rate):
    times_ns = np.arange(500) * PERIOD_NS
    fit = decay(times_ns, 1e-3 * np.exp(rate * times_ns / 1e9), 1.0)
    assert fit.rate == pytest.approx(-rate)


@pytest.mark.parametrize("amplitudes", [[], [1.0] * 7, [1.0, np.nan] * 20, [0.0] * 30])
def test_where_there_is_nothing_to_fit_there_is_no_rate(amplitudes):
    assert decay(np.arange(len(amplitudes)) * PERIOD_NS, np.array(amplitudes), 0.0) is None
