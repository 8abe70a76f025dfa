"""The tables of a run are the same as CSV, Parquet and data frames; every float is read back exactly."""

import csv
import json
import sys
from collections.abc import Sequence

import numpy as np
import pytest
from pyarrow import parquet

import echelon
from echelon.bridge.can.canlog import EPOCH_NS
from echelon.bridge.protocols.frame import Frame
from echelon.controller.transformation import Transformation
from echelon.errors import UsageError
from echelon.messages import STATE_FIELDS
from echelon.runtime.link import LinkCounts
from echelon.sim.export import export_csv, export_parquet
from echelon.sim.finished_run import Run
from echelon.sim.results.block_series import block_series
from echelon.sim.results.frames import frames_table
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Trace
from support.synthetic import FIELD, decaying, link_counts, run_facts


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
    assert header == ",".join(("t", "robot", *STATE_FIELDS, "x_desired", "y_desired"))
    times_ns, states = run.trace.common()
    assert [(round(float(row["t"]) * 1e9), row["robot"]) for row in found] == [
        (time_ns, robot.name) for time_ns in times_ns.tolist() for robot in run.plan.robots
    ]
    for field in STATE_FIELDS:
        read = np.array([float(row[field]) for row in found]).reshape(states.shape[:2])
        np.testing.assert_array_equal(read, states[:, :, FIELD[field]])


def test_desired_places_make_the_desired_formation(run, folder):
    """The transformation of the desired places gives the desired shapes and the desired centroid."""
    found, (times_ns, _) = rows(folder / "robots.csv"), run.trace.common()
    places = np.array([(float(row["x_desired"]), float(row["y_desired"])) for row in found])
    places = places.reshape(len(times_ns), -1, 2)
    blocks, transformation = block_series(run.trace), Transformation(run.plan)
    wanted = np.concatenate([series.desired for series in blocks.series], axis=1).reshape(places.shape)
    np.testing.assert_allclose(transformation.forward(places), wanted, atol=1e-12)
    np.testing.assert_allclose(places.mean(axis=1), wanted[:, -1], atol=1e-12)
    assert np.ptp(places[:, 0], axis=0).max() > 0  # the centroid moves


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
        for column in ("value", "desired", "error", "rate", "error_rate"):
            assert float(row[column]) == getattr(series, column)[instant, at]


def test_links_are_one_row_each(run, folder):
    found = rows(folder / "links.csv")
    assert len(found) == len(run.plan.links)
    first = run.plan.links[0]
    assert found[0] == {
        "source": run.plan.formation[first.source].name, "receiver": run.plan.formation[first.receiver].name,
        "channel": first.channel.name.lower(), "sent": "10", "delivered": "7", "lost": "2", "in_flight": "1",
        "duplicates": "4", "used": "9", "held": "3", "age_mean": "0.00250000025",
        "age_p50": "0.002", "age_p95": "0.004", "age_p99": "0.005", "age_max": "0.006",
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


# Frames and torques, of a real run on a closed torque path


@pytest.fixture(scope="module")
def closed(tmp_path_factory) -> Run:
    folder = tmp_path_factory.mktemp("closed")
    return echelon.run("drives", {"duration": 0.5, "claims": []}, engine="inprocess", out=folder, quiet=True)


@pytest.fixture(scope="module")
def tables(closed, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    assert [path.name for path in export_csv(closed, folder)] == [f"{name}.csv" for name in closed.tables]
    return {name: rows(folder / f"{name}.csv") for name in closed.tables}


def test_torques_are_wanted_then_commanded_then_reported(closed, tables):
    found = tables["torques"]
    assert list(found[0]) == ["t", "robot", "wheel", "wanted", "commanded", "reported"]
    assert len(found) == 51 * 9 * 2
    keys = [(float(row["t"]), row["robot"], row["wheel"]) for row in found]
    names = [robot.name for robot in closed.plan.robots]
    assert keys == [(at / 100, name, wheel) for at in range(51) for name in names for wheel in ("right", "left")]
    protocols = {robot.name: robot.drive.protocol.use for robot in closed.plan.robots}
    steps = {"native": 0.001, "odrive": 1e-7, "cia402": closed.plan.robots[-1].drive.motor.rated_torque / 1000}
    assert set(protocols.values()) == set(steps)
    for robot, states in closed.robots.items():
        for wheel in ("right", "left"):
            mine = [row for row in found if (row["robot"], row["wheel"]) == (robot, wheel)]
            wanted, commanded, reported = (
                np.array([float(row[way]) for row in mine]) for way in ("wanted", "commanded", "reported")
            )
            # in the first 0.5 s no limit acts: the torques on the bus are the wanted ones, rounded to the protocol's resolution
            np.testing.assert_allclose(commanded, wanted, atol=0.51 * steps[protocols[robot]])
            # a drive reports the torque that acted in the period before
            np.testing.assert_allclose(reported[1:], states[f"tau_{wheel}"][1:], atol=1e-12)
            assert np.abs(wanted).max() > 0.001


def test_frames_are_those_of_the_log_decoded(closed, tables):
    found, log = tables["frames"], (closed.folder / "can.log").read_text().splitlines()
    assert list(found[0]) == ["t", "bus", "identifier", "name", "data", "signals"]
    assert len(found) == len(log)
    for row, line in zip(found, log, strict=True):
        stamp, bus, frame = line.split()
        assert row["bus"] == bus
        assert f"{row['identifier'][2:]}#{row['data']}" == frame.rstrip("012345678") if "R" in frame else frame
        assert float(row["t"]) == pytest.approx(float(stamp[1:-1]) - EPOCH_NS / 1e9, abs=1e-6)
    assert found[0]["t"].startswith("-")  # drives are brought up before run time 0
    torque = next(row for row in found if row["name"] == "g2_r4_right_Set_Input_Torque" and float(row["t"]) >= 0)
    commanded = next(row for row in tables["torques"] if (row["robot"], row["wheel"]) == ("g2/r4", "right"))
    assert json.loads(torque["signals"])["Input_Torque"] == float(commanded["commanded"])


def test_frames_that_say_nothing_known_have_no_signals(closed):
    odd = [
        (0, 0, Frame(0x7FF, b"\1\2")),
        (1, 0, Frame(0x100, b"")),
        (2, 1, Frame(0x02E, b"\0\0\xc0\x7f")),
        (3, 0, Frame(0x100, b"", True)),
    ]
    columns = frames_table(closed.plan, odd).columns
    assert columns["name"][0] == ""
    assert columns["signals"][[0, 1, 3]].tolist() == ["{}"] * 3
    assert columns["data"].tolist() == ["0102", "", "0000C07F", "R"]
    assert None in json.loads(columns["signals"][2]).values()  # NaN
    assert len(frames_table(closed.plan, [])) == 0


def test_a_run_without_frames_has_no_such_tables(run):
    assert list(finished(run.trace).tables) == ["robots", "blocks", "links"]


def test_csv_parquet_and_data_frames_agree(closed, tables, tmp_path):
    files = export_parquet(closed, tmp_path / "new")
    assert [path.name for path in files] == [f"{name}.parquet" for name in closed.tables]
    frames = closed.to_pandas()
    for name, table in closed.tables.items():
        read = parquet.read_table(tmp_path / "new" / f"{name}.parquet")
        assert read.column_names == list(table.columns) == list(tables[name][0])
        units = {field.name: field.metadata[b"unit"].decode() for field in read.schema if field.metadata}
        assert units == table.units
        numbers = {column for column, values in table.columns.items() if values.dtype != object}
        assert numbers == set(units)
        frame = getattr(frames, name).reset_index()
        for column, values in table.columns.items():
            from_csv = [row[column] for row in tables[name]]
            if column in numbers:
                np.testing.assert_array_equal(np.array(from_csv, dtype=float), values)
            else:
                assert from_csv == values.tolist()
            assert read[column].to_pandas().equals(frame[column])
            np.testing.assert_array_equal(frame[column].to_numpy(), values)


def test_without_pyarrow_one_line_says_what_to_do(closed, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match="--parquet needs pyarrow, which is not installed: pip install pyarrow"):
        export_parquet(closed, tmp_path / "new")
    assert not list(tmp_path.iterdir())
