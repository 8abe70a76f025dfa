"""Summaries against closed forms: exponential decay, straight passes, counted periods."""

import json
from math import exp, log, sqrt

import numpy as np
import pytest

from echelon.bridge.referee_reports import FindingReport, RefereeReport
from echelon.bridge.reports import BusEvent, BusReport, ScheduledEvent
from echelon.sim.results.block_series import block_series
from echelon.sim.results.can_lines import can_lines, finding_text
from echelon.sim.results.distances import distances
from echelon.sim.results.records import Summary
from echelon.sim.results.rendering import json_text, read_summary, write_summary
from echelon.sim.results.summary import summarise, summary_text
from echelon.sim.results.tables import PARTS
from echelon.sim.results.trace import Trace
from support.synthetic import (
    DECAY,
    FIELD,
    at_places,
    can_report,
    decaying,
    link_counts,
    of_states,
    run_facts,
    with_states,
)

NO_CLAIMS = "claims=[]"
ALL_CHECKS = "health.off=[]"
MS = 1_000_000


def record_of(trace: Trace) -> Summary:
    return summarise(trace, [], None, run_facts())


def strict(summary: Summary) -> dict:
    """Returns a summary as a strict reader of JSON gets it."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(json_text(summary), parse_constant=refuse)


def summary_of(trace: Trace) -> dict:
    return strict(record_of(trace))


@pytest.fixture(scope="module")
def run():
    return decaying()


@pytest.fixture(scope="module")
def record(run) -> Summary:
    return summarise(run.trace, link_counts(run.plan), can_report(), run_facts())


@pytest.fixture(scope="module")
def summary(record) -> dict:
    return strict(record)


def test_settling_is_the_first_instant_inside_the_band(run, summary):
    for row in summary["blocks"]:
        for key, fraction in (("settling_2", 0.02), ("settling_5", 0.05)):
            exact = DECAY[row["layer"]] * log(1 / fraction)
            assert 0 <= row[key] - exact < 0.001, (row["name"], key)


def test_integrals_have_their_closed_forms(run, summary):
    end = 12.0
    for row in summary["blocks"]:
        decay, norm = DECAY[row["layer"]], float(np.linalg.norm(run.start[row["name"]]))
        left = exp(-end / decay)
        tolerance = 5 * (0.001 / decay) ** 2  # the trapezoidal rule's error
        assert row["ise"] == pytest.approx(norm**2 * decay / 2 * (1 - left**2), rel=tolerance)
        assert row["iae"] == pytest.approx(norm * decay * (1 - left), rel=tolerance)
        assert row["itae"] == pytest.approx(norm * decay**2 * (1 - (1 + end / decay) * left), rel=tolerance)
        assert row["residual"] == pytest.approx(norm * left, abs=1e-12)
        assert (row["peak_error"], row["peak_time"]) == (pytest.approx(norm), 0.0)


def test_layers_are_separated_by_the_ratio_of_their_decays(summary):
    assert [(row["faster"], row["slower"]) for row in summary["separation"]] == [
        ("intra", "inter"),
        ("inter", "centroid"),
    ]
    for row in summary["separation"]:
        assert row["sigma_ratio"] == pytest.approx(10)
        assert row["rate_ratio"] == pytest.approx(10, rel=1e-6)
        assert row["rate_fit"] == pytest.approx(1, abs=1e-9)
        assert row["settling_2_ratio"] == pytest.approx(10, rel=0.02)
        assert row["settling_5_ratio"] == pytest.approx(10, rel=0.02)


def test_scales_of_their_own_are_compared_one_by_one():
    run = decaying(["duration=2.0", 'law.time_scales="multi"', "law.epsilon=[0.5, 0.5, 0.5, 0.5]", NO_CLAIMS])
    rows = summary_of(run.trace)["separation"]
    assert [row["faster"] for row in rows] == ["g1", "g2", "g3", "inter"]
    assert rows[0]["settling_5_ratio"] == 1.0
    assert rows[-1]["settling_5_ratio"] is None  # the centroid does not settle in 2 s


@pytest.mark.parametrize(("duration", "told"), [(9.5, True), (8.5, False), (0.5, False)])
def test_no_decay_rates_are_compared_in_a_run_that_is_too_short_for_its_blocks(duration, told):
    """The centroid's dwell time is 3 s, and a third of the run must be as long."""
    record = record_of(decaying([f"duration={duration}", NO_CLAIMS]).trace)
    row = record.separation[-1]
    assert (row.slower, row.rate_ratio is not None, row.rate_fit is not None) == ("centroid", told, told)
    assert ("centroid over inter: – times as slow" in summary_text(record)) is not told


def test_claims_that_hold_make_a_verdict_that_holds(summary):
    assert [claim["outcome"] for claim in summary["claims"]] == ["passed"] * 3
    assert summary["claims"][0]["blocks"].keys() == {"g1", "g2", "g3"}
    assert summary["verdict"]["word"] == "HOLDS"
    assert not {check["outcome"] for check in summary["verdict"]["checks"]} & {"failed"}
    assert summary["simulated"] == 12.0
    assert summary["largest_gap"] == 0.001


def test_a_claim_is_held_against_its_slowest_block_and_its_own_band():
    late = summary_of(decaying(['claims=[{block="*", settled_by=6.0}, {block="inter", settled_by=6.0}]']).trace)
    assert [claim["outcome"] for claim in late["claims"]] == ["passed", "passed"]
    early = record_of(
        decaying(['claims=[{block="*", settled_by=5.9}, {block="g2", settled_by=0.06, band=0.02}]']).trace
    )
    assert [claim.outcome for claim in early.claims] == ["failed", "failed"]
    assert early.claims[0].measured == early.claims[0].blocks["centroid"] == 5.992
    assert early.verdict.fails
    just = record_of(decaying(['claims=[{block="*", settled_by=5.992}]']).trace)
    assert just.verdict.word == "HOLDS"
    assert "centroid took 5.992 s" in early.verdict.reasons[0]


def test_a_claim_beyond_the_end_of_the_run_is_not_tested_and_so_the_verdict_fails():
    record = record_of(decaying(["duration=0.5"]).trace)
    assert [claim.outcome for claim in record.claims] == ["passed", "not tested", "not tested"]
    assert record.verdict.word == "FAILS"
    assert "claim: inter within 5 % by 1 s: the run ended at 0.5 s" in record.verdict.reasons


def test_a_claim_is_not_tested_where_the_run_ends_before_the_dwell_time_is_over():
    record = record_of(decaying(['claims=[{block="centroid", settled_by=6.0}]', "duration=7.0"]).trace)
    assert [claim.outcome for claim in record.claims] == ["not tested"]
    assert "for 1.008 s; it must stay for 3 s" in record.verdict.reasons[0]


def test_nothing_claimed_is_no_claim_that_holds():
    record = record_of(decaying([NO_CLAIMS]).trace)
    assert record.verdict.word == "HEALTHY"
    assert record.verdict.sentence.startswith("HEALTHY: nothing was claimed; ")
    assert "not tested: messages: the messages of the links were not counted" in str(record.verdict)


def passing(offset: float, speed: float, steps: int, period_ns: int = 100 * MS) -> Trace:
    """Robot 0 passes robot 1, which stands in the origin, along x; the middle of its way is its closest point."""
    along = (np.arange(steps) - (steps - 1) / 2) * speed * period_ns / 1e9
    moving = np.stack([along, np.full(steps, offset)], axis=1)
    return at_places(np.stack([moving, np.zeros((steps, 2))], axis=1), [NO_CLAIMS], period_ns)


def test_a_pass_between_two_instants_is_seen():
    near = distances(passing(offset=0.3, speed=20.0, steps=2))
    assert near.closest.pair == (0, 1)
    assert near.closest.distance == pytest.approx(0.3)
    assert near.closest.time_ns == 50 * MS
    assert near.smallest == pytest.approx([0.3, sqrt(1 + 0.09)])
    (violation,) = near.violations
    half = sqrt(0.5**2 - 0.3**2) / 20.0  # r_a is 0.5 m
    assert violation.first_ns == pytest.approx(50 * MS - half * 1e9, abs=1)
    assert violation.last_ns == pytest.approx(50 * MS + half * 1e9, abs=1)
    assert violation.smallest == pytest.approx(0.3)


@pytest.mark.parametrize("steps", [2, 3, 10, 81])
def test_a_violation_is_one_interval_however_many_instants_it_spans(steps):
    near = distances(passing(offset=0.3, speed=40.0 / (steps - 1), steps=steps))
    (violation,) = near.violations
    assert (violation.last_ns - violation.first_ns) / 1e9 * 40.0 / (steps - 1) == pytest.approx(0.8, rel=1e-6)
    assert violation.smallest == pytest.approx(0.3, rel=1e-12)


def test_leaving_and_coming_back_are_two_violations_even_in_adjacent_segments():
    x = np.array([2.0, -2.0, 2.0])
    places = np.stack([np.stack([x, np.full(3, 0.3)], axis=1), np.zeros((3, 2))], axis=1)
    near = distances(at_places(places, [NO_CLAIMS]))
    assert len(near.violations) == 2
    assert near.violations[0].last_ns < MS < near.violations[1].first_ns


def test_the_radius_itself_is_a_violation_and_what_begins_or_ends_inside_has_its_ends():
    places = np.array([[[0.5, 0.0], [0.0, 0.0]]] * 3)
    (violation,) = distances(at_places(places, [NO_CLAIMS])).violations
    assert (violation.first_ns, violation.last_ns, violation.smallest) == (0, 2 * MS, 0.5)
    places[:, 0, 0] = np.nextafter(0.5, 1)
    assert distances(at_places(places, [NO_CLAIMS])).violations == ()


def test_a_single_instant_has_distances():
    near = distances(at_places(np.array([[[0.4, 0.0], [0.0, 0.0]]]), [NO_CLAIMS]))
    assert near.smallest.tolist() == [0.4]
    assert [(v.first_ns, v.last_ns) for v in near.violations] == [(0, 0)]


def test_closest_approach_agrees_with_dense_interpolation():
    generator = np.random.default_rng(7)
    places = generator.normal(scale=3.0, size=(30, 4, 2)).cumsum(axis=0)
    near = distances(at_places(places, [NO_CLAIMS]))
    share = np.linspace(0, 1, 2001)[:, None, None, None]
    dense = places[:-1] + share * (places[1:] - places[:-1])
    gaps = np.linalg.norm(dense[:, :, :, None] - dense[:, :, None], axis=-1)
    gaps[:, :, *np.tril_indices(4)] = np.inf
    brute = gaps.min(axis=(0, 2, 3))
    assert (near.smallest[:-1] <= brute + 1e-12).all()
    np.testing.assert_allclose(near.smallest[:-1], brute, atol=0.02)
    assert near.closest.distance == near.smallest.min()
    radius = 0.5
    inside = {(i, j) for i in range(4) for j in range(i + 1, 4) if gaps[:, :, i, j].min() <= radius}
    assert {violation.pair for violation in near.violations} >= inside


@pytest.mark.parametrize("window", [1, 2, 7, 29])
def test_a_trace_in_pieces_gives_the_same(window, monkeypatch):
    generator = np.random.default_rng(3)
    rest = np.repeat(generator.normal(scale=0.3, size=(1, 4, 2)), 4, axis=0)  # violations that last
    places = np.concatenate([generator.normal(scale=0.6, size=(30, 4, 2)), rest, generator.normal(size=(30, 4, 2))])
    places[50, 2] = np.nan
    trace = at_places(places, [NO_CLAIMS])
    near, blocks = distances(trace), block_series(trace)
    monkeypatch.setattr("echelon.sim.results.trace.WINDOW", window)
    in_pieces = distances(trace)
    assert len(near.violations) > 10
    assert any(each.last_ns - each.first_ns > 3 * MS for each in near.violations)
    assert (in_pieces.closest, in_pieces.violations) == (near.closest, near.violations)
    np.testing.assert_array_equal(in_pieces.smallest, near.smallest)
    for one, other in zip(block_series(trace).series, blocks.series, strict=True):
        for name in (*PARTS, "norm"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("window", [1, 2, 100])
def test_where_pieces_meet_a_pair_that_is_just_outside_begins_a_new_violation(window, monkeypatch):
    monkeypatch.setattr("echelon.sim.results.trace.WINDOW", window)
    x = np.array([0.3, 0.3, np.nextafter(0.5, 1), 0.3, 0.3])
    places = np.stack([np.stack([x, np.zeros(5)], axis=1), np.zeros((5, 2))], axis=1)
    found = distances(at_places(places, [NO_CLAIMS])).violations
    assert [(each.first_ns, each.last_ns) for each in found] == [(0, 2 * MS), (2 * MS, 4 * MS)]


@pytest.mark.parametrize("enabled", [True, False])
def test_violations_fail_whether_robots_avoid_each_other_or_not(enabled):
    places = np.zeros((12_001, 2, 2))
    places[:, 0, 0] = np.linspace(-3, 3, 12_001)
    summary = summary_of(at_places(places, [NO_CLAIMS, ALL_CHECKS, f"avoidance.enabled={str(enabled).lower()}"]))
    assert summary["distance"]["pair"] == ["g1/r2", "g1/r1"]
    assert summary["distance"]["smallest"] == pytest.approx(0, abs=1e-12)
    (violation,) = summary["distance"]["violations"]
    assert (violation["first"], violation["last"]) == pytest.approx((5.0, 7.0), abs=1e-8)
    (check,) = (check for check in summary["verdict"]["checks"] if check["name"] in ("avoidance", "distance"))
    assert (check["name"], check["outcome"]) == ("avoidance" if enabled else "distance", "failed")
    assert "1 violation(s) of 0.5 m; g1/r2 and g1/r1 came to" in check["text"]
    assert check["text"].endswith(" m in the one that began at 5 s")  # the closest instant is another one


def test_a_peak_of_torque_has_a_robot_only_where_there_is_torque(run):
    states = [part.copy() for part in run.trace.states]
    assert "  torque   none: all are zero\n" in summary_text(record_of(run.trace))
    states[4][3000, FIELD["tau_left_peak"]] = 9.0
    assert "  torque   peak 9 N m (g2/r5), " in summary_text(record_of(with_states(run.trace, states)))


def test_torques_are_measured_over_the_periods(run):
    states = [part.copy() for part in run.trace.states]
    robot = states[4]
    robot[0, FIELD["tau_right_square"]] = 1e9  # the start has no period behind it
    robot[1:, FIELD["tau_right_square"]] = 16.0
    robot[1:, FIELD["tau_left_square"]] = np.where(np.arange(12_000) % 2, 0.0, 4.0)
    robot[1:, FIELD["tau_right_peak"]] = 5.0
    robot[3000, FIELD["tau_left_peak"]] = 9.0
    robot[500:502, FIELD["saturated"]] = 10  # ten inner periods each: at 0.5 s
    robot[1000, FIELD["saturated"]] = 3  # ends at the first second
    robot[1001, FIELD["saturated"]] = 4
    row = summary_of(with_states(run.trace, states))["torque"][4]
    assert row["robot"] == "g2/r5"
    assert (row["rms_right"], row["rms_left"]) == pytest.approx((4.0, sqrt(2)))
    assert row["rms"] == pytest.approx(3.0)
    assert (row["peak"], row["peak_wheel"], row["peak_time"]) == (9.0, "left", 3.0)
    assert row["saturation_share"] == pytest.approx(27 / 120_000)
    assert row["saturated_after_first_second"] == 4
    assert row["torque_limit"] is None  # there is none


def test_links_and_what_is_passed_in_are_fit_for_json(run, summary):
    first, second = summary["links"][:2]
    assert first["source"] == run.plan.formation[run.plan.links[0].source].name
    assert first["sent"] == first["delivered"] + first["lost"] + first["in_flight"]
    assert (first["age_mean"], first["age_max"]) == (0.00250000025, 0.006)
    assert (first["age_p50"], first["age_p95"], first["age_p99"]) == (0.002, 0.004, 0.005)
    assert first["duplicates"] == 4
    assert second["held"] == 0
    assert (summary["can"]["frames"], summary["can"]["load_mean"], summary["can"]["timing"]) == (12, 0.25, None)
    assert summary["run"]["real_time_factor"] == 2.0
    assert summary["trace_digest"] == run.trace.digest()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["x", "theta", "tau_left_square", "saturated"])
def test_a_state_that_is_not_finite_fails_and_stays_valid_json(run, value, field):
    states = [part.copy() for part in run.trace.states]
    states[2][40:, FIELD[field]] = value
    record = record_of(with_states(run.trace, states))
    summary = strict(record)
    assert summary["verdict"]["word"] == "FAILS"
    assert "finite: g1/r3: a state is not finite from 0.04 s on" in record.verdict.reasons
    assert "not finite" in summary_text(record)


@pytest.mark.filterwarnings("error")
def test_a_run_that_explodes_but_stays_finite_fails_its_claims(run):
    _, states = run.trace.common()
    states = states * np.exp(np.linspace(0, 700, len(states)))[:, None, None]
    assert np.isfinite(states).all()
    record = record_of(of_states(run.plan, run.trace.times_ns[0], states))
    summary = strict(record)
    assert [claim["outcome"] for claim in summary["claims"]] == ["failed"] * 3
    assert [claim["measured"] for claim in summary["claims"]] == [None] * 3
    assert summary["blocks"][0]["ise"] is None
    assert "did not settle" in summary_text(record)


def test_a_run_that_ended_early_fails(run):
    cut = [len(times) for times in run.trace.times_ns]
    assert shortened(run.trace, [length - 1 for length in cut]).verdict.word == "HOLDS"  # without its last instant
    for lengths, words in (
        ([length - 2 for length in cut], "every robot ended early"),
        ([cut[0] - 5000, *cut[1:]], "g1/r2 at 7 s of 12 s"),
        ([*cut[:-1], 0], "g3/r9 before it began"),
        ([0] * len(cut), "every robot ended early, the first g1/r2 before it began"),
    ):
        record = shortened(run.trace, lengths)
        assert record.verdict.fails
        assert words in " ".join(record.verdict.reasons)
        assert "FAILS" in summary_text(record)


def shortened(trace: Trace, lengths: list[int]) -> Summary:
    pairs = zip(trace.times_ns, trace.states, lengths, strict=True)
    times, states = zip(*((times[:n], states[:n]) for times, states, n in pairs), strict=True)
    return record_of(Trace(trace.plan, times, states))


def test_what_is_written_reads_back_as_the_same_record(record, tmp_path):
    write_summary(record, tmp_path / "summary.json")
    assert read_summary(tmp_path / "summary.json") == record


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda text: text[:100], "Invalid JSON"),
        (lambda text: "", "Invalid JSON"),
        (lambda text: "[]", "Input should be an object"),
        (lambda text: text.replace('"seed": 1', '"seed": "one"'), "seed: "),
        (lambda text: text.replace('"word"', '"ward"', 1), "verdict.word: Field required"),
    ],
)
def test_a_damaged_summary_is_one_line(record, tmp_path, change, says):
    path = tmp_path / "summary.json"
    path.write_text(change(json_text(record)), encoding="utf-8")
    with pytest.raises(ValueError, match="is no summary that can be read") as caught:
        read_summary(path)
    assert says in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_the_text_says_what_matters(record, summary):
    text = summary_text(record)
    assert text.startswith("paper: HOLDS")
    for words in ("intra within 5 % by 0.1 s: g1 as the last at 0.06 s", "2 lost", "0.006 s", "2 times real time"):
        assert words in text
    assert summary["trace_digest"] in text


def test_what_was_on_schedule_and_who_went_bus_off_is_told():
    buses = (
        BusReport("can0", 500_000, 0.1, lost=3, destroyed=2, events=(BusEvent(2.5, 0, "bridge", "bus-off"),)),
        BusReport("can1", 500_000, 0.1, lost=1, events=(BusEvent(2.6, 0, "bridge", "recovered"),)),
    )
    scheduled = (ScheduledEvent(2.0, None, "estop", ("g1/r1",)),)
    finding = FindingReport(2.5, "can0", "100", "gap", "late", "g1/r1")
    referee = RefereeReport(7, 0, {"gap": 1}, (finding,), {})
    can = can_report(frames=7, path="closed", buses=buses, scheduled=scheduled, referee=referee)
    lines = [" ".join(line.split()) for line in can_lines(can)]
    assert lines[0].startswith("CAN 7 frames, 4 lost, 2 destroyed and sent again")
    assert lines[1:3] == ["events 2 s estop", "bus-off bridge at 2.5 s"]
    assert finding_text(referee) == "1 finding(s) on the bus, the first at 2.5 s, can0 100 g1/r1 gap: late"


@pytest.mark.parametrize(("until", "later"), [(None, 0), (0.5, 0), (0.5, 3)])
def test_frames_after_the_stop_of_a_run_are_told_where_there_are_some(until, later):
    referee = RefereeReport(4, 0, {}, (), {}, until=until, later=later)
    *_, last = can_lines(can_report(frames=7, referee=referee))
    up_to = "" if until is None else " up to 0.5 s, where the run was stopped"
    told = "can.log and the numbers of the buses include 3 later frames, which are not judged"
    judged = f"  referee  4 frames{up_to}: nothing wrong"
    assert last == (f"  stop     the run was stopped at 0.5 s; {told}" if later else judged)
