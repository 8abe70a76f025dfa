"""CSV files: every float reads back as the float it was, rows stand in their order."""

import csv
from collections.abc import Sequence

import numpy as np
import pytest
from synthetic import FIELD, decaying, link_counts, run_facts

from echelon.link import LinkCounts
from echelon.sim.export import ROBOT_FIELDS, export_csv
from echelon.sim.results.blocks import block_series
from echelon.sim.results.run import Run
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Trace


def finished(trace: Trace, links: Sequence[LinkCounts] = ()) -> Run:
    return Run(trace, summarise(trace, links, None, run_facts()))


@pytest.fixture(scope="module")
def run():
    made = decaying(["duration=0.05"])
    generator = np.random.default_rng(3)
    for states in made.trace.states:
        states += generator.normal(size=states.shape) * 10.0 ** generator.integers(-12, 12, states.shape)
    return made


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "new" / "csv"
    export_csv(finished(run.trace, link_counts(run.plan)), path)
    return path


def rows(path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_robots_read_back_exactly(run, folder):
    found = rows(folder / "robots.csv")
    header = (folder / "robots.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header == "t,robot,x,y,theta,v,omega,ax,ay,tau_right,tau_left"
    times_ns, states = run.trace.common()
    assert [(round(float(row["t"]) * 1e9), row["robot"]) for row in found] == [
        (time_ns, robot.name) for time_ns in times_ns.tolist() for robot in run.plan.robots
    ]
    for field in ROBOT_FIELDS:
        read = np.array([float(row[field]) for row in found]).reshape(states.shape[:2])
        np.testing.assert_array_equal(read, states[:, :, FIELD[field]])


def test_blocks_read_back_exactly(run, folder):
    found = rows(folder / "blocks.csv")
    blocks = block_series(run.trace)
    names = [(series.block.name, at) for series in blocks.series for at in range(series.block.size)]
    assert len(found) == len(names) * len(blocks.times_ns)
    assert [row["component"] for row in found[: len(names)]][-4:] == ["z2_x", "z2_y", "x", "y"]
    by_name = {series.block.name: series for series in blocks.series}
    for number, row in enumerate(found):
        instant, (name, at) = number // len(names), names[number % len(names)]
        assert (row["block"], float(row["t"])) == (name, blocks.seconds[instant])
        series = by_name[name]
        for column in ("value", "desired", "error", "rate"):
            assert float(row[column]) == getattr(series, column)[instant, at]


def test_links_are_one_row_each(run, folder):
    found = rows(folder / "links.csv")
    assert len(found) == len(run.plan.links)
    first = run.plan.links[0]
    assert found[0] == {
        "source": run.plan.formation[first.source].name, "receiver": run.plan.formation[first.receiver].name,
        "channel": first.channel.name.lower(), "sent": "10", "delivered": "7", "lost": "2", "in_flight": "1",
        "used": "9", "held": "3", "age_mean": "0.00250000025", "age_max": "0.006",
    }  # fmt: skip


def test_robots_of_different_length_keep_all_their_states_in_order_of_time(run, tmp_path):
    trace = run.trace
    short = Trace(
        trace.plan, (trace.times_ns[0][10:20], *trace.times_ns[1:]), (trace.states[0][10:20], *trace.states[1:])
    )
    export_csv(finished(short), tmp_path)
    found = rows(tmp_path / "robots.csv")
    assert len(found) == sum(len(times) for times in short.times_ns)
    times = [float(row["t"]) for row in found]
    assert times == sorted(times)
    assert sum(row["robot"] == "g1/r2" for row in found) == 10
    assert len(rows(tmp_path / "blocks.csv")) == 10 * 18
    assert (tmp_path / "links.csv").read_text(encoding="utf-8").count("\n") == 1


def test_what_is_not_finite_is_written_as_it_is(run, tmp_path):
    states = [part.copy() for part in run.trace.states]
    states[0][1, FIELD["x"]], states[0][2, FIELD["x"]] = np.nan, -np.inf
    export_csv(finished(Trace(run.plan, run.trace.times_ns, tuple(states))), tmp_path)
    found = [row["x"] for row in rows(tmp_path / "robots.csv") if row["robot"] == "g1/r2"]
    assert found[1:3] == ["nan", "-inf"]
