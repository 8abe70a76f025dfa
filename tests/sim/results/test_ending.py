"""How errors end: closed forms for what is made, and real runs with delays for lags and instabilities."""

import re
from math import sqrt

import numpy as np
import pytest

from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.transformation import Transformation
from echelon.messages import Channel
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import parse
from echelon.sim.results.block_series import block_series
from echelon.sim.results.ending import SMALL, endings
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import TraceBuilder
from support.runs import plan_of
from support.synthetic import of_errors, run_facts

MOVING = """
name = "moving"
duration = 20.0
robot = { mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }
law = { epsilon = [0.5, 0.5], lead = 0.5 }
trajectory = { kind = "line", velocity = [0.3, 0.0] }
formation.shape = { kind = "line", spacing = 3.0 }
formation.groups.a.shape = { kind = "triangle", side = 1.0 }
formation.groups.a.robots = { a1 = { start = [0, 1.5] }, a2 = { start = [1, 1.5] }, a3 = { start = [0, 2.5] } }
formation.groups.b.shape = { kind = "line", spacing = 1.0 }
formation.groups.b.robots = { b1 = { start = [0, -1] }, b2 = { start = [0, -3] } }
"""
SPEED = 0.3


def run_of(plan):
    """Returns the trace and the counts of links of a plan run in this process."""
    builder = TraceBuilder(plan)
    engine = Engine(plan, builder.add)
    engine.run()
    return builder.build(), engine.link_counts()


def moving(*overrides):
    plan = parse(MOVING, "moving.toml", list(overrides))[1]
    trace, links = run_of(plan)
    blocks = block_series(trace)
    names = [block.name for block in plan.blocks]
    return trace, blocks, dict(zip(names, endings(plan, blocks, links), strict=True))


@pytest.mark.parametrize("delay", [0.02, 0.05])
def test_a_delay_of_all_links_leaves_the_centroid_ahead_by_what_it_moves_in_two_of_them(delay):
    """A robot's state is one delay old at its leader, and two delays old in the group's state at the coordinator."""
    _, blocks, ended = moving("law.reference='now'", f"links=[{{delay={delay}}}]")
    assert blocks.series[-1].norm[-1] == pytest.approx(SPEED * 2 * delay, abs=0.4 * np.exp(-0.5 * 20))  # σ 1 s
    assert ended["centroid"].kind == "steady lag"
    assert f"velocity × delay is {SPEED * 2 * delay:.3g} m" in ended["centroid"].text
    assert {ended[name].kind for name in ("a", "b", "inter")} <= {"at rest", "falls"}


def test_a_robot_that_is_heard_of_late_stands_ahead_by_its_own_delay_and_every_block_that_it_is_part_of_says_so():
    """The law makes the positions that it knows equal to the desired ones, m_i = p_i - v τ_i = d_i, so p_i = d_i + v τ_i."""
    late = 0.1
    trace, blocks, ended = moving("law.reference='now'", f"links=[{{source='a/a1', channel='state', delay={late}}}]")
    ahead = np.zeros((len(trace.plan.robots), 2))
    ahead[0] = SPEED * late, 0.0
    shift = Transformation(trace.plan).forward(ahead).reshape(-1)
    for series in blocks.series:
        at = slice(series.block.offset, series.block.offset + series.block.size)
        np.testing.assert_allclose(series.error[-1], shift[at], atol=2e-4)
        name = series.block.name
        if name == "b":
            assert ended[name].kind in ("at rest", "falls")
        else:
            assert ended[name].kind == "steady lag", name
            said = re.search(r"velocity × delay is (\S+) m", ended[name].text)
            assert said is not None
            assert float(said[1]) == pytest.approx(np.linalg.norm(shift[at]), rel=5e-3)


def test_without_delays_of_the_reference_there_is_no_lag():
    """States are compared with the reference of their own time."""
    _, blocks, ended = moving("links=[{delay=0.05}]")
    assert blocks.series[-1].norm[-1] < 1e-3 * SPEED * 2 * 0.05
    assert {one.kind for one in ended.values()} <= {"at rest", "falls"}


def test_a_lag_is_no_growth_and_nothing_fails():
    trace, links = run_of(parse(MOVING, "moving.toml", ["law.reference='now'", "links=[{delay=0.05}]"])[1])
    verdict = summarise(trace, links, None, run_facts()).verdict
    assert verdict.word == "HEALTHY", verdict.reasons


@pytest.mark.slow
@pytest.mark.parametrize("beyond", [0, 4])
def test_runs_grow_where_the_analysis_of_the_sampled_loop_says_so_and_only_there(beyond):
    plan = plan_of("lab", "claims=[]")
    ticks = largest_extra_delay(plan, Channel.STATE).ticks + beyond
    delayed = plan_of("lab", "claims=[]", f"links=[{{channel='state', delay={ticks * plan.root.period_ns / 1e9}}}]")
    trace, links = run_of(delayed)
    summary = summarise(trace, links, None, run_facts())
    growth = [check for check in summary.verdict.checks if check.name == "growth"]
    assert [check.outcome for check in growth] == ["failed"] * len(growth) if beyond else ["passed"]
    grown = {row.name for row in summary.blocks if row.ending == "grows"}
    assert bool(grown) is bool(beyond)
    assert all("oscillates with growing amplitude" in row.remark for row in summary.blocks if row.name in grown)


def ended_as(error, duration=24.0, overrides=()):
    """Returns the ending of a block whose error is `error` (T,) times a fixed direction; the errors of other blocks are
    zero."""
    plan = plan_of("lab", "claims=[]", f"duration={duration}", *overrides)

    def motion(block, seconds):
        zero = np.zeros((len(seconds), block.size))
        if block.name != "inter":
            return zero, zero
        unit = np.ones(block.size) / sqrt(block.size)
        e = error(seconds)
        return e[:, None] * unit, np.gradient(e, seconds)[:, None] * unit

    blocks = block_series(of_errors(plan, motion))
    names = [block.name for block in plan.blocks]
    return endings(plan, blocks, [])[names.index("inter")]


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (lambda t: 0 * t, "at rest", "is at rest"),
        (lambda t: 0.5 * np.exp(-0.3 * t), "falls", "still falls, to"),
        (lambda t: 0.01 * np.exp(0.2 * t), "grows", "diverges: "),
        (lambda t: 0.01 * np.exp(0.2 * t) * np.cos(2 * t), "grows", "oscillates with growing amplitude: "),
        (lambda t: 0.3 * np.cos(2 * t), "oscillates", "keeps oscillating at about"),
        (lambda t: 0.3 + 0 * t, "steady error", "keeps a steady error of 0.3 m"),
        (lambda t: 0.3 * t, "grows", "diverges: "),
        (lambda t: np.where(t > 1, np.nan, 1.0), "not finite", "is not finite"),
    ],
)
def test_every_ending_has_its_name_and_its_words(error, kind, words):
    with np.errstate(all="ignore"):
        ending = ended_as(error)
    assert ending.kind == kind, ending
    assert ending.text.startswith(words)
    assert ending.spared == ""


PHASES = np.linspace(0, 2 * np.pi, 12, endpoint=False)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (lambda t, phase: 0.3 * np.cos(2 * t) * (1 + 0.8 * np.cos(0.8 * t + phase)), "keeps oscillating at about"),
        (lambda t, phase: 0.23 + 0.14 * np.cos(0.9 * t + phase), "goes up and down between 0.09"),
        (lambda t, phase: 0.3 * np.cos(0.9 * t + phase), "keeps oscillating at about"),
    ],
    ids=["beat", "offset", "limit cycle"],
)
def test_what_goes_up_and_down_in_the_last_third_does_not_fall_whatever_its_phase(error, words, phase):
    ending = ended_as(lambda t: error(t, phase))
    if ending.kind != "grows":
        assert ending.kind == "oscillates", ending
        assert ending.text.startswith(words)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("rate", [0.05, 0.3])
def test_a_decay_with_a_ripple_falls(rate, phase):
    falling = ended_as(lambda t: 0.5 * np.exp(-rate * t) * (1 + 0.1 * np.cos(5 * t + phase)))
    swinging = ended_as(lambda t: 0.5 * np.exp(-rate * t) * np.cos(3 * t + phase))
    assert (falling.kind, swinging.kind) == ("falls", "falls"), (falling, swinging)


def test_growth_is_the_ratio_of_the_last_two_sixths():
    """For the error e^(ct) the ratio is e^(cT/6)."""
    # The last sixth has one instant more than the others, of 400 in all.
    assert ended_as(lambda t: 0.01 * np.exp(0.2 * t)).growth == pytest.approx(np.exp(0.2 * 24 / 6), rel=1 / 400)


@pytest.mark.parametrize(("duration", "kind"), [(8.9, "too short"), (9.1, "falls")])
def test_a_run_of_three_dwell_times_is_long_enough_to_tell(duration, kind):
    ending = ended_as(lambda t: 0.5 * np.exp(-0.3 * t), duration)
    assert ending.kind == kind
    if kind == "too short":
        assert ending.text == "cannot be judged: a third of the run is shorter than its dwell time, 3 s"


def test_the_bound_of_growth_is_the_scenarios():
    def creeping(t):
        return 0.3 * np.exp(0.02 * t)  # 8.3 % in a sixth of 24 s

    assert ended_as(creeping).kind == "grows"
    assert ended_as(creeping, overrides=["health.growth=1.1"]).kind != "grows"


def test_an_error_within_the_floor_is_not_judged():
    ending = ended_as(lambda t: 1e-4 + 1e-4 * np.exp(0.05 * t))
    assert ending.kind != "grows"
    assert ending.spared == "it is within 0.001 m, which is not judged"
    assert ended_as(lambda t: 1e-4 + 1e-4 * np.exp(0.05 * t), overrides=["health.floor=1e-5"]).kind == "grows"


def test_a_small_error_may_move_to_another_value_and_tremble_but_not_grow_on():
    def beginning(t):
        return np.exp(-2 * t)  # an error of one at first

    level = 0.2 * SMALL
    moved = ended_as(lambda t: beginning(t) + np.interp(t, [20, 22], [level, 1.5 * level]))
    assert moved.spared == "it is within 5 % of what it began with, 0.0505 m, and did not grow before that"
    creeping = ended_as(lambda t: beginning(t) + level * np.exp(0.015 * t))
    assert creeping.spared.endswith("and would be for another run of this length")
    growing = ended_as(lambda t: beginning(t) + 1e-4 * np.exp(0.2 * t))
    assert growing.kind == "grows"
    assert growing.level < SMALL  # still small, but it grows
