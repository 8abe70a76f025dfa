"""sim.replay.difference: the first place at which two runs part, over the time and the members that both have."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.errors import UsageError
from echelon.messages import NULL, Channel, Message
from echelon.sim.recorded_runs import diff_runs, open_recorded
from echelon.sim.replay.difference import RunDifference, difference
from echelon.sim.replay.value_names import value_names
from echelon.sim.results.recorded import Recorded
from support.recordings import planted, record

SMALL = """
name = "small"
robot = { mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }
law = { epsilon = [0.5, 0.5] }
trajectory = { kind = "line", velocity = [0.3, 0.0] }
formation.shape = { kind = "line", spacing = 3.0 }
formation.groups.a.shape = { kind = "line", spacing = 1.0 }
formation.groups.a.robots = { a1 = { start = [0, 1] }, a2 = { start = [1, 1] } }
formation.groups.b.shape = { kind = "line", spacing = 1.0 }
formation.groups.b.robots = { b1 = { start = [0, -1] }, b2 = { start = [0, -3] } }
"""


@pytest.fixture
def small(tmp_path: Path) -> str:
    """A scenario whose groups are lines, so that robots can be added."""
    (tmp_path / "small.toml").write_text(SMALL)
    return str(tmp_path / "small.toml")


def differing(first: Path, second: Path, tolerance: float = 0.0) -> RunDifference:
    """Compares two runs; checks that the other way round it is the same."""
    found, other = diff_runs(first, second, tolerance), diff_runs(second, first, tolerance)
    assert (found.equal, found.until) == (other.equal, other.until)
    assert (found.first_difference is None) == (other.first_difference is None)
    if found.first_difference is not None and other.first_difference is not None and not found.first_difference.lacking:
        assert (found.first_difference.time, found.first_difference.member, found.first_difference.value) == (
            other.first_difference.time,
            other.first_difference.member,
            other.first_difference.value,
        )
        assert (found.first_difference.first, found.first_difference.second) == (
            other.first_difference.second,
            other.first_difference.first,
        )
    assert (found.only_first, found.only_second) == (other.only_second, other.only_first)
    return found


def test_the_same_run_twice_is_equal(tmp_path: Path) -> None:
    found = differing(record(tmp_path / "a", "lab"), record(tmp_path / "b", "lab"))
    assert found.equal
    assert (found.until, found.scenario, found.remarks) == (0.4, {}, ())
    assert len(found.channels) == 9 + 3 + 3 + 1
    assert str(found).endswith("equal: over this time both runs say the same")


def test_one_changed_value_is_named(tmp_path: Path) -> None:
    run = record(tmp_path / "a", "lab")
    changed = record(tmp_path / "b", "lab", alter=planted(3, Channel.STATE, 11, 4, 1e-9))
    found = differing(run, changed)
    assert found.first_difference is not None
    assert found.first_difference.second == pytest.approx((found.first_difference.first or 0.0) + 1e-9, abs=1e-15)
    assert (
        found.first_difference.time,
        found.first_difference.member,
        found.first_difference.channel,
        found.first_difference.value,
    ) == (
        0.11,
        "g2/r4",
        Channel.STATE,
        "theta",
    )
    assert [channel.member for channel in found.channels if not channel.is_equal] == ["g2/r4"]
    assert str(found).splitlines()[-1].startswith("the runs part at t = 0.11 s: g2/r4, state number 11, theta: A ")
    first, second = found.first_difference.first, found.first_difference.second
    assert f"{first:.6g}" == f"{second:.6g}"
    (line,) = (line for line in str(found).splitlines() if "g2/r4" in line and "#11" in line)
    texts = line.split("theta: ", 1)[1].split("  ")[0].split(", ")
    assert texts[0] != texts[1]  # as many digits as it takes
    assert line.endswith(" 1e-09 rad, theta, t = 0.11 s")
    assert differing(run, changed, 2e-9).equal


def test_a_changed_law_is_first_seen_with_the_coordinator(tmp_path: Path) -> None:
    found = differing(record(tmp_path / "a", "lab"), record(tmp_path / "b", "lab", "law.lead=0.0", "seed=2"))
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member) == (0.0, "coordinator")
    assert set(found.scenario) == {"seed", "law.lead"}
    assert found.scenario["law.lead"] == ("0.5", "0.0")
    assert "  law.lead: A 0.5, B 0.0" in str(found).splitlines()


def test_runs_of_different_lengths_are_compared_over_the_shorter(tmp_path: Path) -> None:
    found = differing(record(tmp_path / "a", "lab"), record(tmp_path / "b", "lab", "duration=0.25"))
    assert found.equal
    assert found.until == 0.25
    assert {channel.compared for channel in found.channels} == {26}
    assert f"{tmp_path / 'b'} ends at t = 0.25 s, {tmp_path / 'a'} at 0.4 s" in found.remarks


def test_members_of_one_run_alone_are_named(small: str, tmp_path: Path) -> None:
    run = record(tmp_path / "a", small)
    more = record(tmp_path / "b", small, "formation.groups.b.robots.b3={start=[0,-5]}")
    found = differing(run, more)
    assert not found.equal
    assert (found.only_first, found.only_second) == ((), ("b/b3 state",))
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member) == (0.0, "b")  # its centroid is another
    assert "  only B has b/b3 state" in str(found).splitlines()
    states = {channel.member: channel for channel in found.channels if channel.channel is Channel.STATE}
    assert states["a/a1"].compared == 41


def test_a_message_that_one_run_lacks_is_a_difference(tmp_path: Path) -> None:
    def silent(message: Message) -> Message:
        null = (message.channel, message.sequence) == (Channel.REFERENCE, 9)
        return message._replace(values=NULL) if null else message

    found = differing(record(tmp_path / "a", "lab"), record(tmp_path / "b", "lab", alter=silent))
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member, found.first_difference.lacking) == (
        0.09,
        "coordinator",
        "second",
    )
    assert str(found).endswith("the runs part at t = 0.09 s: coordinator, reference number 9: A only, none B")


def test_on_a_wall_clock_a_message_that_one_run_lacks_is_none(tmp_path: Path) -> None:
    def drop(message: Message) -> Message | None:
        return None if message.source == 4 and message.sequence > 20 else message

    wall = {"engine": "processes", "clock": "wall"}
    found = differing(record(tmp_path / "a", "lab"), record(tmp_path / "b", "lab", alter=drop, metadata=wall))
    assert found.equal
    assert found.until == 0.4
    assert found.scenario == {"run: engine": ("inprocess", "processes"), "run: clock": ("virtual", "wall")}


def test_where_periods_differ_messages_belong_together_by_time(tmp_path: Path) -> None:
    lead = "law.lead=0.0"  # with a lead the law depends on the period
    coarse = record(tmp_path / "b", "lab", lead, "periods.acceleration=0.02")
    found = differing(record(tmp_path / "a", "lab", lead), coarse)
    assert {channel.compared for channel in found.channels} == {21}
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member, found.first_difference.lacking) == (
        0.02,
        "g1/r1",
        "",
    )
    assert any(remark.startswith("where periods differ") for remark in found.remarks)


def test_runs_without_a_common_member_are_refused(small: str, tmp_path: Path) -> None:
    a = record(tmp_path / "a", small)

    def silent(message: Message) -> Message:
        return message._replace(values=NULL) if message.channel is Channel.REFERENCE else message

    with pytest.raises(UsageError, match="have no member of the same path"):
        diff_runs(a, record(tmp_path / "b", "lab", alter=silent), 0.0)


def test_of_many_members_those_without_a_difference_share_a_line(tmp_path: Path) -> None:
    quick = "duration=0.02"
    changed = record(tmp_path / "b", "three_levels", quick, alter=planted(5, Channel.STATE, 1, 0, 0.5))
    text = str(differing(record(tmp_path / "a", "three_levels", quick), changed)).splitlines()
    states = [line.split() for line in text if " state " in line][:2]
    assert [row[:5] for row in states] == [
        ["26", "members", "state", str(26 * 3), str(26 * 3)],
        ["west/g2/r6", "state", "3", "2", "t"],
    ]
    assert len(text) == 1 + 1 + 2 + 3 + 1  # heading, table with states, group states, references and commands, sentence


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A run with all channels: on the closed torque path, with avoidance."""
    folder = tmp_path_factory.mktemp("drives")
    return open_recorded(record(folder, "drives", "duration=0.1", "avoidance.enabled=true"))


@given(st.data(), st.sampled_from([1e-9, -1.0, np.nan, np.inf]))
def test_wherever_a_value_is_changed_it_is_found(drives: Recorded, data: st.DataObject, change: float) -> None:
    key = data.draw(st.sampled_from(sorted(drives.series)))
    series = drives.series[key]
    row, column = (data.draw(st.integers(0, size - 1)) for size in series.values.shape)
    values = series.values.copy()
    values[row, column] += change
    changed = replace(drives, series={**drives.series, key: replace(series, values=values)})
    found = difference(drives, changed, ("a", "b"), {}, 0.0)
    first = found.first_difference
    assert first is not None
    source, channel = key
    assert (first.member, first.channel) == (drives.plan.all_roles[source].name, channel)
    assert (first.time_ns, first.sequence) == (series.times_ns[row], series.sequences[row])
    assert first.value == value_names(drives.plan, source, channel)[column]
    assert first.first == series.values[row, column]
    assert first.second == values[row, column] or np.isnan(change)
    assert sum(each.compared - each.equal for each in found.channels) == 1
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["equal"] is False


@pytest.mark.parametrize("tolerance", [-1e-9, float("nan")])
def test_a_tolerance_is_finite_and_not_negative(tolerance: float, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"must be 0 or more, and finite"):
        diff_runs(tmp_path, tmp_path, tolerance)
