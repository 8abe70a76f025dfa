"""Figures of an analysis: what policies buy, and delays by runs beside exact ones."""

from pathlib import Path

from matplotlib.figure import Figure

from echelon.sim.report.analysis_figures import _delays, _policies
from echelon.sim.results.links_analysis import DelayResult, EstimateResult, LinksResult, LossResult, PolicyResult

SURE = LossResult(0.9, "unstable", "")


def texts(picture, folder: Path) -> str:
    """Returns the words of a picture."""
    picture.save(folder / "figure.svg")
    figure = Figure()
    picture.draw(figure)
    found = [text.get_text() for axes in figure.axes for text in axes.texts]
    return " | ".join(
        [*found, *(axes.get_xlabel() for axes in figure.axes), *(axes.get_title() for axes in figure.axes)]
    )


def test_each_policy_has_its_delay_and_axes_have_units(tmp_path: Path) -> None:
    effects = [
        PolicyResult("state", "hold", True, 0.35, "unstable", SURE, ""),
        PolicyResult("state", "predict", False, 2.1, "limit", LossResult(None, "not computed", "large"), ""),
    ]
    words = texts(_policies(effects, "echelon analyse lab --policies"), tmp_path)
    assert "350 ms | 2100 ms" in words
    assert "largest delay of the channel [ms]" in words
    assert "largest loss in the mean square [%]" in words


def test_delays_by_runs_are_marked_where_there_are_any(tmp_path: Path) -> None:
    class Found:
        blocks = ()

    for runs in (None, EstimateResult(0.34, 0.33, 0.36, 16)):
        delay = DelayResult(0.353, 35, 0.01, "unstable", False, ("g1",))
        row = LinksResult("class", "intra state", "intra", "state", 9, (), delay, None, runs, None)
        words = texts(_delays(Found, [row], "echelon analyse lab"), tmp_path)  # type: ignore[arg-type]
        assert ("by runs" in words) == (runs is not None)
        figure = Figure()
        _delays(Found, [row], "").draw(figure)  # type: ignore[arg-type]
        assert ("x" in [line.get_marker() for line in figure.axes[0].lines]) == (runs is not None)
