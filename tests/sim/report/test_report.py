"""The report: complete, self-contained, well-formed, and safe with runs that went wrong."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from echelon.bridge.referee_reports import FindingReport, RefereeReport
from echelon.bridge.reports import (
    BusEvent,
    BusReport,
    DriveReport,
    DrivesReport,
    IdentifierReport,
    ScheduledEvent,
    WheelsReport,
)
from echelon.planning.loading import effective_toml
from echelon.sim.report.page import table
from echelon.sim.report.report import write_report
from echelon.sim.report.run_for_report import RunForReport
from echelon.sim.report.thinning import COLUMNS, thin
from echelon.sim.results.summary import summarise
from echelon.sim.results.tables import AGE_KEYS
from echelon.sim.results.trace import Trace
from echelon.sim.results.verdict import count
from support.synthetic import FIELD, PERIOD_NS, Run, can_report, decaying, link_counts, run_facts

FIGURES, COMPARED = 5, 4
NAME = "one & <b>only</b>"
CAN = can_report(frames=1234, load_mean=0.5, robots={"g1/r1": WheelsReport("native", 1234, {}, 1.0, clipped=7)})
FRAMES = ({"id": "0x101", "torque": "<1.5>"}, {"id": "0x102", "torque": "2.5"})


class Page(HTMLParser):
    """Reads a page and checks that every tag that is opened is closed in order."""

    EMPTY = frozenset({"meta", "br", "path", "use", "rect"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, key, value or "") for key, value in attrs]

    def handle_endtag(self, tag):
        if tag not in self.EMPTY:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def for_report(run: Run, name: str, trace: Trace | None = None) -> RunForReport:
    trace = trace or run.trace
    summary = summarise(trace, link_counts(run.plan), CAN, run_facts())
    return RunForReport(name, trace, summary, effective_toml(run.scenario), FRAMES)


def rendered(runs, path) -> Page:
    write_report(runs, path)
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def run() -> Run:
    return decaying(["duration=3.0", "claims=[{block='intra', settled_by=0.1}, {block='centroid', settled_by=1.0}]"])


@pytest.fixture(scope="module")
def written(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report([for_report(run, NAME)], path)
    return path


@pytest.fixture(scope="module")
def single(written) -> Page:
    return Page(written.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def both(run, tmp_path_factory) -> Page:
    other = decaying(["duration=1.0", "avoidance.enabled=true"])
    path = tmp_path_factory.mktemp("report") / "report.html"
    return rendered([for_report(run, "left"), for_report(other, "right")], path)


def test_the_page_needs_nothing_but_itself(single):
    assert not {"script", "link", "img", "iframe", "object"} & set(single.tags)
    for tag, key, value in single.attributes:
        assert key not in ("src", "onload", "onclick")
        if key in ("href", "xlink:href"):
            assert value.startswith("#"), tag
        elif not key.startswith("xmlns"):
            assert "//" not in value


@pytest.mark.slow
def test_ids_are_unique_or_repeat_the_same_thing(both):
    ids = {value for _, key, value in both.attributes if key == "id"}
    used = {value[1:] for _, key, value in both.attributes if key.endswith("href")}
    used |= set(re.findall(r"url\(#([^)]+)\)", " ".join(value for *_, value in both.attributes)))
    assert used == ids


@pytest.mark.slow
def test_every_figure_has_words_for_those_who_do_not_see_it(single, both):
    for page, figures in ((single, FIGURES), (both, 2 * FIGURES + COMPARED)):
        labels = [value for tag, key, value in page.attributes if (tag, key) == ("svg", "aria-label")]
        assert page.tags.count("svg") == len(labels) == figures
        assert all(len(label) > 20 for label in labels)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [6.0, 0.01])
def test_the_caption_of_distances_says_what_the_table_below_says(radius, tmp_path):
    made = decaying(["duration=1.0", f"avoidance={{enabled=false, avoidance_radius={radius}, sensing_radius=7.0}}"])
    one = for_report(made, "near")
    pairs = {violation.pair for violation in one.summary.distance.violations}
    assert bool(pairs) is (radius == 6.0)
    text = rendered([one], tmp_path / "report.html").text
    said = {
        True: f"not enabled: {count(len(pairs), 'pair')} came closer than 6 m.",
        False: "robots keep this distance by chance.",
    }
    assert [words in text for words in said.values()] == [bool(pairs), not pairs]


def test_verdict_claims_and_numbers_are_on_the_page(single):
    text = single.text
    assert "FAILS — one & <b>only</b>: 1 reason" in text
    assert "claim: centroid within 5 % by 1 s" in text
    assert "intra within 5 % 0.1 s 0.06 s passed" in text
    assert re.search(r"centroid within 5 % 1 s \S+ (failed|not tested)", text)
    assert "loaded to 50 %," in text
    assert "In 7 frames a torque did not fit" in text
    assert "g1/r2 → g1" in text


def test_the_bus_its_drives_and_the_referee_are_on_the_page(run, tmp_path):
    identifiers = {
        "100": IdentifierReport(5, 1, 2, 1e-3, 2e-3, 3e-3),
        "101": IdentifierReport(5, 1, 2, 1e-3, 2e-3, None),
    }
    events = (BusEvent(2.5, 1, "g1/r1", "bus-off"),)
    can = can_report(
        path="closed",
        scheduled=(ScheduledEvent(2.0, 4.0, "estop", ("g1/r1", "g1/r2")),),
        buses=(BusReport("can0", 500_000, 0.25, events=events, identifiers=identifiers),),
        robots={"g1/r1": WheelsReport("odrive", 5, {"rise limit": 3}, 1.5, enabled=False, fault="right: hot")},
        drives=DrivesReport({"g1/r1": DriveReport({}, 0, 71.25)}, {}),
        referee=RefereeReport(
            11, 0, {"gap": 1}, (FindingReport(1.5, "can0", "100", "gap", "<late>", "g1/r1"),), {}, until=3.5, later=4
        ),
    )
    one = for_report(run, "bus")
    text = rendered([replace(one, summary=replace(one.summary, can=can))], tmp_path / "report.html").text
    assert "loaded to 25 %," in text
    assert "became zero before the bus: 3 times rise limit" in text
    assert "100 5 1 2 1 2 3 101 5 1 2 1 2 –" in text
    assert "g1/r1 odrive 5 1.5 0 0 0 0 False right: hot 3 rise limit 71.25" in text
    assert "Frames up to 3.5 s, where the run was stopped: 11. Found: 1 gap." in text
    assert "The run was stopped at 3.5 s; can.log and the numbers of the buses include 4 later frames" in text
    assert "1.5 can0 100 g1/r1 gap <late>" in text
    assert "2 scheduled g1/r1, g1/r2 estop, until 4 s 2.5 can0 g1/r1 bus-off" in text


def test_a_row_may_be_called_as_an_outcome_is():
    assert '<td>failed</td><td class="mark fails">failed</td>' in table(
        ["", ""], [["failed", "failed"]], numeric_from=2
    )


def test_text_is_escaped(single):
    assert NAME in single.text
    assert "<1.5>" in single.text
    assert single.tags.count("b") == 1  # the verdict's own


def test_the_effective_scenario_stands_at_the_end(run, single):
    scenario = " ".join(effective_toml(run.scenario).split())
    assert single.text.endswith(scenario)


@pytest.mark.slow
def test_a_comparison_shows_the_papers_figures_with_the_runs_they_belong_to(both):
    text = both.text
    without, avoiding = (
        text.index("without avoidance (the paper's Fig. 2)"),
        text.index("with avoidance (the paper's Fig. 3)"),
    )
    assert without < avoiding
    assert "measured, left" in text
    assert "measured, right" in text
    assert both.text.count("Effective scenario") == 1


@pytest.mark.slow
def test_a_comparison_says_what_differs_and_takes_nothing_of_the_first_run_for_all(both):
    assert "9 robots · 4 nodes · 3 s, 1 s · trace" in both.text
    (rows,) = re.findall("What differs .* key left right (.*?) What was measured", both.text)
    assert rows == (
        'duration 3.0 1.0 avoidance.enabled false true claims.1.block "centroid" "inter" claims.2.block – "centroid" '
        "claims.2.settled_by – 10.0 claims.2.band – 0.05"
    )


@pytest.mark.slow
def test_a_comparison_sets_what_was_measured_side_by_side(both):
    (rows,) = re.findall("What was measured .*? left right (.*?) Compared", both.text)
    for measure in ("verdict", "settling to 2 % of g1", "∫|e|² dt of centroid", "smallest distance of two robots"):
        assert measure in rows
    assert "g2" in rows


@pytest.mark.slow
def test_figures_of_the_paper_are_named_under_the_papers_scenario_alone(run, single, tmp_path):
    assert "the paper's Fig. 2" in single.text
    assert "The paper's Fig. 4" in single.text
    one = for_report(run, "mine")
    mine = replace(one, summary=replace(one.summary, scenario="mine"))
    assert "paper's" not in rendered([mine], tmp_path / "report.html").text


@pytest.mark.slow
def test_long_tables_are_folded(run, tmp_path):
    def page(count):
        identifiers = {f"{number:03x}": IdentifierReport(5, 0, 0, 1e-3, 2e-3, 3e-3) for number in range(count)}
        one = for_report(run, "bus")
        can = can_report(buses=(BusReport("can0", 500_000, 0.25, identifiers=identifiers),))
        return rendered([replace(one, summary=replace(one.summary, can=can))], tmp_path / "report.html")

    many, few = page(163), page(12)
    assert "163 identifiers identifier frames" in many.text
    assert "0a2 5 0 0" in many.text
    assert many.tags.count("details") == few.tags.count("details") + 1
    assert "12 identifiers" not in few.text


def test_ticks_keep_their_digits(single):
    assert "0.001" in single.words
    assert "0.00" not in single.words


@pytest.mark.slow
def test_a_report_is_the_same_every_time_and_small(run, written, tmp_path):
    write_report([for_report(run, NAME)], tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == written.read_bytes()
    assert written.stat().st_size < 1_000_000


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_runs_that_went_wrong_are_drawn_as_far_as_they_go(run, tmp_path):
    broken = [part[:400].copy() for part in run.trace.states]
    times = tuple(part[:400] for part in run.trace.times_ns)
    broken[0][30:] = np.nan
    broken[5][50:, FIELD["x"]] = 1e200
    broken[6][60:] = np.inf
    diverged = Trace(run.plan, times, tuple(broken))
    hopeless = Trace(run.plan, times, tuple(np.full_like(part, np.nan) for part in broken))
    one_robot = [slice(None)] + [slice(0)] * (len(times) - 1)
    alone = Trace(
        run.plan, *(tuple(part[at] for part, at in zip(parts, one_robot, strict=True)) for parts in (times, broken))
    )
    first = Trace(run.plan, tuple(part[:1] for part in times), tuple(part[:1] for part in run.trace.states))
    shown = [
        for_report(run, name, trace) for name, trace in zip("abcd", (diverged, hopeless, alone, first), strict=True)
    ]
    page = rendered(shown, tmp_path / "report.html")
    assert page.tags.count("svg") == 4 * FIGURES + COMPARED
    assert page.text.count("FAILS —") == 4


@pytest.mark.slow
def test_a_link_over_which_nothing_was_used_has_no_ages(run, tmp_path):
    one = for_report(run, "run")
    unused = replace(one.summary.links[0], used=0, **dict.fromkeys(AGE_KEYS))
    page = rendered([replace(one, summary=replace(one.summary, links=(unused,)))], tmp_path / "report.html")
    counts = f"{unused.sent} {unused.lost} {unused.in_flight} {unused.duplicates} {unused.held}"
    assert f"{unused.source} → {unused.receiver} {unused.channel} {counts} – – – – –" in page.text


def test_a_report_needs_a_run(tmp_path):
    with pytest.raises(ValueError, match="at least one run"):
        write_report([], tmp_path / "report.html")


@pytest.mark.parametrize("log", [True, False])
def test_thinned_lines_keep_their_extremes(log):
    times_ns = np.arange(100_000) * PERIOD_NS
    values = np.sin(times_ns / 1e9)
    values[12_345], values[54_321] = 7.0, -5.0
    t, y = thin(times_ns, values, log)
    assert len(t) < 4 * COLUMNS
    assert (y.max(), y.min()) == (7.0, -5.0)
    assert t[y.argmax()] == 12.345
    assert (np.diff(t) > 0).all()
    assert (t[0], t[-1]) == (0.001 if log else 0.0, 99.999)
