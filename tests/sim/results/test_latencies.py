"""sim.results.latencies: numbers of latencies made by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

from echelon.plan.plan import Plan
from echelon.sim.recording.arrivals import read_arrivals
from echelon.sim.results.latencies import Latencies
from support.arrivals import Row, write_arrivals
from support.runs import plan_of

MS = 1_000_000


def latencies_of(plan: Plan, folder: Path, rows: list[Row]) -> Latencies:
    """Returns the latencies of arrivals; all members ended in order."""
    ended = [(one.index, plan.duration_ns + 1) for one in plan.formation]
    return Latencies.of("run", read_arrivals(write_arrivals(folder, rows, ended), plan))


@pytest.fixture(scope="module")
def plan() -> Plan:
    """lab, with eleven messages on each link."""
    return plan_of("lab", "duration=0.1")


def test_latencies_of_a_link(plan: Plan, tmp_path: Path) -> None:
    """Numbers 2 and 4 are lost, 8 to 10 are on their way at the end."""
    took = {0: 1, 1: 2, 3: 10, 5: 1, 6: 1, 7: 3}
    found = latencies_of(plan, tmp_path, [(0, n, 10 * n * MS, (10 * n + ms) * MS) for n, ms in took.items()])
    link = found.links[0]
    assert (link.source, link.receiver, link.channel) == ("g1", "g1/r1", "command")
    assert (link.sent, link.delivered, link.lost, link.in_flight) == (11, 6, 2, 3)
    assert link.sent == link.delivered + link.lost + link.in_flight
    assert link.latency_mean == pytest.approx(0.003)
    assert (link.latency_p50, link.latency_p95, link.latency_max) == (0.001, 0.01, 0.01)
    assert link.jitter == pytest.approx((1 + 8 + 9 + 0 + 2) / 5 / 1000)


def test_a_link_on_which_nothing_arrived_has_no_latencies(plan: Plan, tmp_path: Path) -> None:
    found = latencies_of(plan, tmp_path, [(0, 0, 0, 5)])
    link = found.links[1]
    assert (link.sent, link.delivered, link.lost, link.in_flight) == (11, 0, 0, 11)
    assert link.latency_mean is link.latency_p99 is link.jitter is None
    assert found.links[0].jitter == 0.0


def test_percentiles_are_latencies_that_a_share_does_not_exceed(plan: Plan, tmp_path: Path) -> None:
    plan = plan_of("lab", "duration=9.99")
    luck = np.random.default_rng(1)
    took = luck.integers(0, 10 * MS, 1000)
    link = latencies_of(
        plan, tmp_path, [(0, n, 10 * n * MS, 10 * n * MS + int(ns)) for n, ns in enumerate(took)]
    ).links[0]
    for share, value in ((0.5, link.latency_p50), (0.95, link.latency_p95), (0.99, link.latency_p99)):
        assert value == np.sort(took)[round(share * 1000) - 1] / 1e9


@pytest.mark.slow
def test_tables_and_json(plan: Plan, tmp_path: Path) -> None:
    found = latencies_of(plan, tmp_path, [(0, 0, 0, 5 * MS), (0, 1, 10 * MS, 12 * MS), (2, 1, 11 * MS, 12 * MS)])
    table = found.table
    assert (len(table), table.keys) == (len(plan.links), ("source", "receiver", "channel"))
    assert table.units["latency_p95"] == table.units["jitter"] == "s"
    assert np.isnan(table.columns["latency_max"][1])
    assert table.to_pandas().loc[("g1", "g1/r1", "command"), "sent"] == 11
    messages = found.messages
    assert messages.columns["receiver"].tolist() == ["g1/r1", "g1/r1", "g1/r3"]
    assert messages.columns["number"].tolist() == [0, 1, 1]
    assert messages.columns["t"].tolist() == [0.0, 0.01, 0.011]
    assert messages.columns["latency"] == pytest.approx([0.005, 0.002, 0.001])
    facts = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert facts["links"][0]["latency_max"] == 0.005
    assert facts["links"][1]["jitter"] is None


def test_the_table_in_a_terminal(plan: Plan, tmp_path: Path) -> None:
    lines = str(latencies_of(plan, tmp_path, [(0, 0, 0, 5 * MS), (1, 0, 0, MS)])).splitlines()
    assert lines[0] == "run: one-way latencies of 24 links [ms]"
    assert lines[2].split() == ["g1", "→", "g1/r1", "command", "11", "0", "10", *["5.000"] * 4, "0.000"]
    assert lines[4].split() == ["g1", "→", "g1/r3", "command", "11", "0", "11", *["–"] * 5]
    assert lines[26].split() == ["9", "links", "command", "99", "0", "97", "1.000", *["5.000"] * 3, "0.000"]
    assert len(lines) == 2 + 24 + 4


def test_many_links_share_a_line_for_each_channel(tmp_path: Path) -> None:
    robots = ", ".join(f"r{n} = {{ start = [{n}.0, 0.0] }}" for n in range(40))
    formation = f'formation={{shape={{kind="line",spacing=1.0}},robots={{{robots}}}}}'
    plan = plan_of("lab", "duration=0.1", formation, "claims=[]", "law.epsilon=[0.5]")
    lines = str(latencies_of(plan, tmp_path, [(0, 0, 0, MS)])).splitlines()
    assert lines[1] == "  a line for each channel; --json has all links"
    assert [line.split()[:3] for line in lines[3:]] == [["40", "links", "command"], ["40", "links", "state"]]
