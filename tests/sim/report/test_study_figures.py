"""Figures of studies: chosen by what varied, true to the tables, readable without colour, with texts under the pointer."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from echelon.sim.report.studies.figures import STUDY_FIGURES, save_study_figures, study_figures, write_study_page
from echelon.sim.report.studies.results import Boundary, Key, Predicted, StudyResults
from support.studies import BLOCKS, study

DELAYS = [0.0, 0.1, 0.2, 0.3, 0.4]
DELAY, LOSS = "links.uplink.delay", "links.uplink.loss"
DELAY_WORDS, LOSS_WORDS = "delay of the links uplink [s]", "loss of the links uplink"
LOSSES = [0.0, 0.2, 0.4, 0.6]
POLICIES = ["hold", "predict"]


def drawn(results: StudyResults, name: str) -> Figure:
    figure = Figure(figsize=(11, 5))
    study_figures(results)[name][0].draw(figure)
    return figure


def texts(results: StudyResults, name: str) -> list[str]:
    """Returns the texts that a figure shows under the pointer."""
    root = ElementTree.fromstring(study_figures(results)[name][0].svg)
    return [str(one.text) for one in root.iter() if one.tag.endswith("title")]


@pytest.mark.parametrize(
    ("results", "names"),
    [
        (study({DELAY: DELAYS}), {"shares", "settling", "integrals"}),
        (study({DELAY: DELAYS}, rates=True), {"shares", "settling", "integrals", "rates", "ages"}),
        (study({DELAY: DELAYS, LOSS: LOSSES}), {"map"}),
        (study({DELAY: DELAYS, LOSS: LOSSES}, lambda d, p: d + p < 0.3), {"map", "tolerated"}),
        (study({DELAY: DELAYS, "links.uplink.policy": POLICIES}, lambda d, p: d < 0.2),
         {"shares", "tolerated", "settling", "integrals"}),
        (study({"events.0.duration": [0.5, 1.0, 2.0]}), {"shares", "settling", "integrals", "blackouts"}),
        (study({"links.uplink.policy": POLICIES}), set()),
        (study({}), set()),
        (study({DELAY: DELAYS[:2]}), set()),
    ],
)  # fmt: skip
def test_the_tables_decide_which_figures_there_are(results: StudyResults, names: set[str]) -> None:
    assert set(study_figures(results)) == names


def test_lists_in_which_one_number_varies_are_an_axis_and_other_texts_are_not() -> None:
    def numbers(*texts: str) -> list[float] | None:
        found = Key.of("law.epsilon", texts).numbers
        return None if found is None else found.tolist()

    assert numbers("[0.1, 0.1]", "[0.2, 0.2]") == [0.1, 0.2]
    assert numbers("[0.1, 0.5]", "[0.2, 0.5]") == [0.1, 0.2]
    assert numbers("[0.1, 0.5]", "[0.2, 0.4]") is None
    assert numbers("[0.1]", "[0.1, 0.2]") is None
    assert numbers('"hold"', '"zero"') is None
    assert numbers("true", "false") is None
    assert Key.of("links.0.policy", ['"hold"']).texts == ("hold",)


def test_delays_come_before_other_numbers_as_the_axis() -> None:
    results = study({"law.epsilon.0": [0.1, 0.2, 0.3, 0.4], DELAY: DELAYS})
    assert results.axis is not None
    assert results.second is not None
    assert (results.axis.name, results.second.name) == (DELAY, "law.epsilon.0")
    assert results.axis.label == DELAY_WORDS
    assert results.second.label == "ratio of time scales ε1"


def test_a_boundary_is_the_last_value_up_to_which_all_hold() -> None:
    shares = dict(zip(DELAYS, (1.0, 0.6, 0.4, 0.8, 0.0), strict=True))
    (found,) = study({DELAY: DELAYS}, shares.__getitem__).boundaries()
    assert (found.value, found.fails) == (0.1, 0.2)  # 0.3 holds again, above a value that fails
    assert (found.low, found.high) == (0.0, 0.4)
    (none,) = study({DELAY: DELAYS}, lambda d: 0.0).boundaries()
    assert (none.value, none.fails) == (None, 0.0)
    (all_hold,) = study({DELAY: DELAYS}).boundaries()
    assert (all_hold.value, all_hold.fails) == (0.4, None)


def test_the_map_draws_the_measured_boundary_between_cells_and_the_predicted_one_over_it() -> None:
    losses = LOSSES
    predicted = Predicted(tuple(Boundary({LOSS: f"{loss:g}"}, 0.27 - 0.5 * loss) for loss in losses))
    results = study({DELAY: DELAYS, LOSS: losses}, lambda d, p: float(d + p < 0.35), predicted=predicted)
    (axes, *_) = drawn(results, "map").axes
    assert len(axes.patches) == 20
    edges = [line.get_xydata().tolist() for line in axes.lines if len(line.get_xydata()) == 2]
    assert [[pytest.approx(0.35), pytest.approx(-0.1)], [pytest.approx(0.35), pytest.approx(0.1)]] in edges
    (curve,) = (line for line in axes.lines if len(line.get_xydata()) == 4)
    assert curve.get_xydata().tolist() == [[pytest.approx(0.27 - 0.5 * loss), loss] for loss in losses]
    assert curve.is_dashed()
    assert f"{DELAY_WORDS} = 0.3, {LOSS_WORDS} = 0.2: 0 of 8 runs hold" in texts(results, "map")


def test_lines_have_gaps_where_runs_do_not_settle() -> None:
    results = study({DELAY: DELAYS}, lambda d: float(d < 0.25))
    (axes,) = drawn(results, "settling").axes
    lines = [line for line in axes.lines if len(line.get_xdata()) == len(DELAYS)]
    assert len(lines) == 2 * len(BLOCKS)
    assert all(np.isnan(line.get_ydata()).tolist() == [False, False, False, True, True] for line in lines)
    shown = texts(results, "settling")
    assert sum("centroid to 5 %" in text for text in shown) == 3


def test_the_largest_delays_are_drawn_against_a_second_key_with_predictions_beside() -> None:
    scales = [0.1, 0.2, 0.3, 0.4]
    predicted = Predicted(tuple(Boundary({"law.epsilon": f"{e:g}"}, 0.7 * e) for e in scales))
    results = study({DELAY: DELAYS, "law.epsilon": scales}, lambda d, e: float(d < e), predicted=predicted)
    (axes,) = drawn(results, "tolerated").axes
    measured, guessed = (line.get_xydata().tolist() for line in axes.lines if len(line.get_xydata()) == 4)
    assert measured == [[0.1, 0.0], [0.2, 0.1], [0.3, 0.2], [0.4, 0.3]]
    assert guessed == [[e, pytest.approx(0.7 * e)] for e in scales]
    assert "ratio of time scales ε = 0.2: predicted: 0.14" in texts(results, "tolerated")


def test_what_each_policy_buys_is_a_bar_for_each() -> None:
    found = (
        Boundary({"links.0.policy": "hold"}, 0.35, 0.36, by="both"),
        Boundary({"links.0.policy": "hold"}, 0.6, 0.61, by="second moment"),
        Boundary({"links.0.policy": "predict"}, 2.5, by="both"),
    )
    searched = study({"links.0.policy": POLICIES, DELAY: DELAYS})
    results = replace(searched, found=found, searched=DELAY)
    (axes,) = drawn(results, "tolerated").axes
    assert [round(bar.get_width(), 3) for bar in axes.patches] == [0.35, 2.5]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["policy hold", "policy predict"]
    assert "2.5 or more" in " ".join(text.get_text() for text in axes.texts)
    caption = study_figures(results)["tolerated"][1]
    assert caption.startswith("Largest value with which the wanted share of runs holds and E|e|² does not grow, 8 runs")


def test_rates_and_costs_have_their_predictions_beside_them() -> None:
    count = len(DELAYS)
    predicted = Predicted(
        rates={"g1": np.linspace(1, 0, count)}, costs={"g1": np.arange(1.0, count + 1), "inter": np.full(count, np.nan)}
    )
    results = study({DELAY: DELAYS}, predicted=predicted, rates=True)
    (axes,) = drawn(results, "rates").axes
    dashed = [line for line in axes.lines if line.is_dashed() and len(line.get_xdata()) == count]
    assert [line.get_ydata().tolist() for line in dashed] == [predicted.rates["g1"].tolist()]
    measured = results.points["ise_mean.g1"][2]
    assert f"g1: predicted 3, measured {measured:.4g} ({100 * (measured / 3 - 1):+.2g} %)" in texts(results, "costs")


@pytest.mark.parametrize("name", STUDY_FIGURES)
def test_no_two_lines_of_a_figure_differ_in_colour_alone(name: str) -> None:
    results = study({DELAY: DELAYS, "links.uplink.policy": POLICIES}, lambda d, p: float(d < 0.25), rates=True)
    figures = study_figures(results)
    if name not in figures:
        pytest.skip("another kind of table")
    for axes in drawn(results, name).axes:
        looks = [
            (line.get_color(), line.get_linestyle(), line.get_marker(), line.get_markerfacecolor())
            for line in axes.lines
            if len(line.get_xdata()) == len(DELAYS)
        ]
        seconds = [look[1:] for look in looks]
        assert len(set(looks)) == len(set(seconds))


@pytest.mark.slow
def test_captions_say_what_made_the_figure_and_files_have_them_beside(tmp_path) -> None:
    results = study({DELAY: DELAYS}, rates=True)
    files = save_study_figures(results, tmp_path / "new", ["svg", "pdf"])
    names = list(study_figures(results))
    assert [path.name for path in files] == [f"{name}.{kind}" for name in names for kind in ("svg", "pdf")] + [
        "captions.md"
    ]
    captions = files[-1].read_text(encoding="utf-8")
    assert captions.count(results.command) == len(names)
    assert all(path.stat().st_size > 1000 for path in files[:-1])
    again = save_study_figures(results, tmp_path / "again", ["pdf"])
    assert again[0].read_bytes() == (tmp_path / "new" / again[0].name).read_bytes()


@pytest.mark.slow
def test_the_page_is_one_file_with_texts_under_the_pointer(tmp_path) -> None:
    predicted = Predicted((Boundary({}, 0.25),))
    results = study({DELAY: DELAYS}, lambda d: float(d < 0.25), predicted=predicted)
    path = tmp_path / "page.html"
    write_study_page(results, path, "duration = 3")
    text = path.read_text(encoding="utf-8")
    assert "http" not in re.sub(r'xmlns(:xlink)?="[^"]*"', "", text)
    assert "<script" not in text
    assert "a &amp; &lt;b&gt;" in text
    assert f"<title>{DELAY_WORDS} = 0.3: 0 of 8 runs hold</title>" in text
    assert "<td class=n>0.2</td><td class=n>0.3</td><td class=n>0.25</td>" in text
