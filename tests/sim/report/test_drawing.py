"""How figures look: their time axes, words beside curves, and dashes and marks besides colours."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from echelon.bridge.protocols.registry import protocol_of
from echelon.cli.new_scenario import scenario_text, sizes
from echelon.sim.parts.loading import parse
from echelon.sim.report.axes import PEAKS, TAUS, TorqueScale, distance_time, torque_time
from echelon.sim.report.comparison import WIDTH, Compared, comparison, longest
from echelon.sim.report.drawing import GROUPS, RUNS, Look
from echelon.sim.report.figures import FIGURES, errors, picture
from echelon.sim.report.time_axis import TimeAxis
from echelon.sim.report.torque_steps import steps_text
from echelon.sim.results.block_series import block_series
from echelon.sim.results.distances import distances
from echelon.sim.results.trace import Trace
from support.runs import plan_of, trace_of
from support.synthetic import decaying


@pytest.fixture(scope="module")
def lab() -> Trace:
    return trace_of(plan_of("lab"))


def test_time_is_logarithmic_only_where_blocks_answer_on_scales_far_apart(lab: Trace) -> None:
    paper = plan_of("paper")
    times_ns = np.arange(0, 12_000_000_001, 1_000_000)
    assert TimeAxis.of(paper, times_ns) == TimeAxis(True, 0.001, 12.0, 12.0)
    assert not TimeAxis.of(paper, times_ns[:200]).log  # it ends before the scales part
    assert TimeAxis.of(lab.plan, lab.times_ns[0]) == TimeAxis(False, 0.01, 40.0, 40.0)


def test_figures_of_torque_and_distance_end_when_all_is_calm(lab: Trace) -> None:
    time, limit = torque_time(lab), TorqueScale.of([lab]).limit
    taus = np.stack([states[:, TAUS] for states in lab.states])
    assert time.last < 10 < time.end == 40
    later = lab.times_ns[0] / 1e9 > time.last
    assert np.abs(taus[:, later]).max() < 0.02 * limit < np.abs(taus[:, lab.times_ns[0] / 1e9 > time.last / 2]).max()
    near = distances(lab)
    ends = distance_time(near, lab.plan).last
    assert ends < 10
    assert np.ptp(near.smallest[near.times_ns / 1e9 > ends]) < 0.04 * near.smallest[-1]
    shown, _ = time.thin(lab.times_ns[0], lab.states[0][:, 0])
    assert shown[-1] == time.last


def test_the_closest_encounter_is_always_in_the_figure(lab: Trace) -> None:
    near = distances(lab)
    assert near.closest is not None
    for t in (0, 3, 12, 39):
        moved = replace(near, closest=replace(near.closest, time_ns=t * 1_000_000_000))
        for time in (
            distance_time(moved, lab.plan),
            longest([distance_time(moved, lab.plan), TimeAxis(False, 0.01, 9, 9)]),
        ):
            assert time.shows(t), (t, time)


def readme_scenario() -> str:
    """Returns `my.toml` of the README."""
    text = (Path(__file__).parents[3] / "README.md").read_text(encoding="utf-8")
    return text.split("```toml\n", 1)[1].split("```", 1)[0]


SCENARIOS = {groups: scenario_text("my", sizes(groups), None) for groups in ("1x1", "1x2", "2x3", "2,3,5")}


@pytest.mark.slow
@pytest.mark.parametrize("text", [*SCENARIOS.values(), readme_scenario()], ids=[*SCENARIOS, "README"])
def test_no_figure_of_a_first_run_gives_a_warning(text: str) -> None:
    """matplotlib warns if what is drawn outside the axes leaves no room for the axes."""
    trace = trace_of(parse(text, "my.toml")[1])
    blocks, near = block_series(trace), distances(trace)
    alone = [picture(name, trace, blocks, width) for name in FIGURES for width in (WIDTH, WIDTH / 2)]
    compared = [one for one, _ in comparison([Compared(name, trace, blocks, near) for name in "ab"]).values()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all("</svg>" in one.svg for one in [*alone, *compared])


def test_a_run_that_never_calms_is_shown_whole() -> None:
    time = TimeAxis(False, 0.01, 40.0, 40.0)
    assert time.until(39.0) == time.until(0.0) == time.until(20.0) == time
    assert time.until(3.9).last == 5.0
    assert TimeAxis(True, 0.01, 40.0, 40.0).until(3.9).last == 40.0
    assert longest([time.until(3.9), TimeAxis(False, 0.01, 9.0, 9.0)]) == TimeAxis(False, 0.01, 9.0, 40.0)


def test_torque_is_logarithmic_only_where_peaks_dwarf_the_rest(lab: Trace) -> None:
    peaked = [states.copy() for states in lab.states]
    peaked[0][3, TAUS[0]] = peaked[0][3, PEAKS[0]] = 1e4
    assert TorqueScale.of([Trace(lab.plan, lab.times_ns, tuple(peaked))]).linear is not None
    steady = tuple(np.full_like(states, 0.5) for states in lab.states)
    assert TorqueScale.of([Trace(lab.plan, lab.times_ns, steady)]).linear is None


@pytest.mark.parametrize("of", [Look.of_group, Look.of_run])
def test_colour_is_not_the_only_cue(of) -> None:
    looks = [of(number) for number in range(len(GROUPS))]
    assert len(GROUPS) == len(RUNS)
    for kind in ("colour", "dashes", "mark"):
        assert len({getattr(look, kind) for look in looks}) == len(looks)


def test_figures_explain_their_lines_and_marks(lab: Trace) -> None:
    words = {
        "trajectories": {"desired centroid", "centroid", "start", "end"},
        "blocks": {"g1", "g2", "g3", "inter", "centroid", "x", "y", "desired"},
        "errors": {"g1", "g2", "g3", "inter", "centroid", "settled to 5 %", "to 2 %"},
        "torques": {"right wheel, in the group's colour", "left wheel"},
    }
    blocks = block_series(lab)
    for name, texts in words.items():
        figure = Figure()
        picture(name, lab, blocks, 11.5).draw(figure)
        legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
        assert {text.get_text() for legend in legends if legend is not None for text in legend.get_texts()} == texts, (
            name
        )


def test_the_curves_of_a_comparison_have_the_marks_of_its_legend(lab: Trace) -> None:
    runs = [Compared(name, lab, block_series(lab), distances(lab)) for name in "ab"]
    for name, (drawing, _) in comparison(runs).items():
        figure = Figure()
        drawing.draw(figure)
        (legend,) = figure.legends
        marks = {line.get_marker() for line in legend.get_lines()}
        assert len(marks) == 2
        for axes in figure.axes:
            assert not axes.lines or marks <= {line.get_marker() for line in axes.lines}, name


@pytest.mark.parametrize("width", [11.5, 5.6])
def test_words_of_claims_are_above_the_curves_and_apart(width: float) -> None:
    claims = ", ".join(f"{{block='{block}', settled_by={by}}}" for block, by in (
        ("g1", 0.9), ("g2", 1.0), ("g3", 1.05), ("inter", 1.1), ("centroid", 3.0),
    ))  # fmt: skip
    run = decaying(["duration=3.0", f"claims=[{claims}]"])
    figure = Figure(figsize=(width, 3.5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    errors(block_series(run.trace), run.plan, width).draw(figure)
    canvas.draw()
    (axes,) = figure.axes
    boxes = [text.get_window_extent() for text in axes.texts]
    assert [text.get_text() for text in axes.texts][-1] == "centroid by 3 s"
    assert len(boxes) == 5
    assert all(box.y0 >= axes.bbox.y1 for box in boxes)
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height for box in boxes)
    assert not any(one.overlaps(other) for at, one in enumerate(boxes) for other in boxes[:at])


def test_torques_that_step_by_the_resolution_of_their_frames_are_told() -> None:
    plan = plan_of("drives")
    times_ns = tuple(np.arange(0, 1_000_000_000, 10_000_000) for _ in plan.robots)
    still = [np.zeros((100, 20)) for _ in plan.robots]
    assert steps_text(Trace(plan, times_ns, tuple(still))) == ""
    for robot in plan.robots:
        step = protocol_of(robot).resolution(robot.drive)
        still[robot.index][::2, TAUS[1]] = step
    text = steps_text(Trace(plan, times_ns, tuple(still)))
    assert text.startswith(
        "The frames of g1/r1, g1/r2, g1/r3, g3/r7, g3/r8, and 1 more carry torque in steps of 0.001 N m"
    )
    assert "g2/r4" not in text  # floating point
    mirrored = plan_of("lab")
    assert steps_text(Trace(mirrored, times_ns, tuple(still))) == ""
