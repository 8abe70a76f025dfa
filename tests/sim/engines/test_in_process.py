"""Whole runs in one process, compared with continuous time, with the paper's claims, and with each other."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from echelon.controller.laws.central import CentralLaw
from echelon.messages import STATE_FIELDS
from echelon.plan.plan import Array, Plan
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import load
from echelon.sim.results.block_series import block_series
from echelon.sim.results.distances import distances
from echelon.sim.results.trace import Trace, TraceBuilder
from support.growth import radius_of
from support.synthetic import PAPER, claims_of

FIELD = {name: at for at, name in enumerate(STATE_FIELDS)}
UNTIL = 2.0
"""End of the comparison of the paper's run with continuous time [s]"""


def run(overrides: Sequence[str] = (), path: Path = PAPER) -> Trace:
    _, plan = load(path, overrides)
    builder = TraceBuilder(plan)
    Engine(plan, builder.add).run()
    return builder.build()


def late(delay: float) -> str:
    return f'links=[{{source="**", receiver="*", channel="state", delay={delay}}}]'


def continuous(plan: Plan, instants: Array) -> Array:
    """Returns positions (T, N, 2) under the continuous law with ideal torque.

    The state of a robot is x, y, θ, v, ω.  p̈ = a means v̇ = e_v · a + d ω² and ω̇ = (e_n · a - v ω)/d
    (docs/architecture.md, 2.1)."""
    central = CentralLaw(replace(plan, lead=0.0))
    d = np.array([robot.offset for robot in plan.robots])
    count = len(plan.robots)

    def rates(t: float, state: Array) -> Array:
        x, y, theta, v, omega = state.reshape(5, count)
        c, s = np.cos(theta), np.sin(theta)
        velocity = np.stack([v * c - d * omega * s, v * s + d * omega * c], axis=1)
        a = central(t, np.stack([x, y], axis=1), velocity)
        v_dot = c * a[:, 0] + s * a[:, 1] + d * omega**2
        omega_dot = (c * a[:, 1] - s * a[:, 0] - v * omega) / d
        return np.concatenate([velocity[:, 0], velocity[:, 1], omega, v_dot, omega_dot])

    start = np.zeros((5, count))
    start[:2] = np.array([robot.start for robot in plan.robots]).T
    start[2] = [robot.heading for robot in plan.robots]
    solution = solve_ivp(
        rates, (0, instants[-1]), start.ravel(), method="DOP853", t_eval=instants, rtol=1e-8, atol=1e-8
    )
    assert solution.success
    return solution.y.T.reshape(-1, 5, count)[:, :2].transpose(0, 2, 1)


@pytest.fixture(scope="module")
def paper() -> Trace:
    return run(["avoidance.enabled=false"])


@pytest.fixture(scope="module")
def reference() -> tuple[Array, Array]:
    """Instants [s], every 0.5 ms, and positions in continuous time, (T, N, 2)."""
    _, plan = load(PAPER, ["avoidance.enabled=false"])
    instants = np.arange(0, round(UNTIL / 0.0005) + 1) * 0.0005
    return instants, continuous(plan, instants)


def off(trace: Trace, reference: tuple[Array, Array], since: float) -> float:
    """Returns the largest distance of a robot from its position in continuous time, from `since` [s] on [m]."""
    instants, positions = reference
    times_ns, states = trace.common()
    rows = [row for row, t in enumerate((times_ns * 1e-9).tolist()) if since - 1e-9 <= t <= UNTIL + 1e-9]
    expected = positions[np.round(times_ns[rows] * 1e-9 / 0.0005).astype(int)]
    np.testing.assert_allclose(instants[np.round(times_ns[rows] * 1e-9 / 0.0005).astype(int)], times_ns[rows] * 1e-9)
    difference = states[rows][:, :, [FIELD["x"], FIELD["y"]]] - expected
    return float(np.hypot(difference[..., 0], difference[..., 1]).max())


def test_run_is_the_solution_in_continuous_time(paper, reference):
    assert off(paper, reference, 0.05) < 0.2
    assert off(paper, reference, 0.1) < 0.06
    assert off(paper, reference, 0.05) < 0.04  # the error that remains with `lead`


def test_without_lead_the_hold_costs_what_its_period_is(reference):
    """The error of the hold is of first order: half the period gives half the distance from continuous time."""
    periods = ("periods={acceleration=0.001, torque=0.0001}", "periods={acceleration=0.0005, torque=0.00005}")
    coarse, fine = (run(["avoidance.enabled=false", "duration=0.2", "law.lead=0.0", period]) for period in periods)
    for since in (0.05, 0.1):
        assert 1.7 < off(coarse, reference, since) / off(fine, reference, since) < 2.3
    assert 0.1 < off(coarse, reference, 0.05) < 0.3


def test_claims_of_the_paper_hold(paper):
    rows = {row.block: row for row in claims_of(paper)}
    assert [row.block for row in rows.values()] == ["intra", "inter", "centroid"]
    for row, about in zip(rows.values(), (0.1, 1.0, 10.0), strict=True):
        assert row.outcome == "passed"
        assert about / 3 < row.measured <= about


def test_blocks_settle_one_after_the_other(paper):
    """Largest errors: intra at 0.1 s, inter at 1 s, centroid at 10 s, measured independently (docs/architecture.md, 2.10)."""
    blocks = block_series(paper)
    at = {"intra": (0.1, 0.059), "inter": (1.0, 0.111), "centroid": (10.0, 0.076)}
    for layer, (t, metres) in at.items():
        row = int(np.searchsorted(blocks.times_ns, round(t * 1e9)))
        worst = max(np.abs(series.error[row]).max() for series in blocks.series if series.block.layer == layer)
        assert worst == pytest.approx(metres, rel=0.05)


def test_avoidance_keeps_robots_apart_where_they_would_meet(paper):
    near = distances(paper)
    radius = paper.plan.avoidance.avoidance_radius
    assert near.closest is not None
    assert near.closest.distance < radius
    assert near.violations
    apart = run(["avoidance.enabled=true"])
    kept = distances(apart)
    assert kept.closest is not None
    assert kept.closest.distance > radius
    assert kept.violations == ()
    for row in claims_of(apart):
        assert row.outcome == "passed"


def test_one_seed_is_one_run_and_another_is_not():
    lossy = ["duration=0.3", 'links=[{source="**", receiver="**", loss=0.1, delay={min=0.0, max=0.002}}]']
    first, again, other = (run([*lossy, f"seed={seed}"]).digest() for seed in (1, 1, 2))
    assert first == again != other
    free = [run(["duration=0.05", f"seed={seed}"]).digest() for seed in (1, 2)]
    assert free[0] == free[1]  # links without loss and random delay draw no random numbers
    assert run(["duration=0.05", "law.lead=0.25"]).digest() != free[0]


def intra_peaks(trace: Trace) -> Array:
    """Returns the largest intra error of each 50 ms [m]; NaN where a state is not finite."""
    blocks = block_series(trace)
    norm = np.sqrt(sum(series.norm**2 for series in blocks.series if series.block.layer == "intra"))
    return norm[: len(norm) // 50 * 50].reshape(-1, 50).max(axis=1)


def test_six_milliseconds_of_delay_settle_and_seven_do_not():
    """This agrees with the spectral radius: at 7 ticks the intra error grows by it per tick, until robots cannot follow."""
    settled = intra_peaks(run(["duration=1.2", "avoidance.enabled=false", late(0.006)]))
    assert settled[-1] < 0.01
    unsettled = run(["duration=1.2", "avoidance.enabled=false", late(0.007)])
    peaks = intra_peaks(unsettled)
    assert not np.isfinite(peaks[-1])
    pace = radius_of(unsettled.plan) ** 50
    assert pace > 1
    np.testing.assert_allclose(peaks[3:10] / peaks[2:9], pace, rtol=0.02)


def test_a_delay_between_two_ticks_is_that_of_the_later_where_nodes_are_time_driven():
    """Time-driven nodes act at their own instants; event-driven ones when a message arrives."""
    timed, between, later = "timing='time_driven'", late(0.0055), late(0.006)
    assert run(["duration=0.1", timed, between]).digest() == run(["duration=0.1", timed, later]).digest()
    assert run(["duration=0.1", timed, later]).digest() != run(["duration=0.1", timed, late(0.005)]).digest()
    assert run(["duration=0.1", between]).digest() != run(["duration=0.1", later]).digest()


def test_without_delay_and_loss_the_timing_does_not_matter():
    assert run(["duration=0.05"]).digest() == run(["duration=0.05", "timing='time_driven'"]).digest()


def test_instants_are_all_multiples_of_the_period_to_the_end():
    trace = run(["duration=0.05"])
    np.testing.assert_array_equal(trace.common()[0], np.arange(51) * 1_000_000)
    assert sorted({len(times) for times in trace.times_ns}) == [51]
