"""Large arrays and tables are in files without a name; what is in them is the same as in memory."""

import multiprocessing
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from echelon import large_arrays
from echelon.large_arrays import Rows, RowsInFile, large_empty

WIDTH = 5


@pytest.fixture(params=[1, 700, 1 << 30], ids=["in a file", "in a file later", "in memory"])
def large(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Says how many bytes are large, and that a few rows are a block."""
    monkeypatch.setattr(large_arrays, "LARGE", request.param)
    monkeypatch.setattr(large_arrays, "BLOCK", 4 * 8 * WIDTH)
    return int(request.param)


def filled(counts: tuple[int, ...], capacities: tuple[int, ...]) -> tuple[Rows, list[tuple[np.ndarray, np.ndarray]]]:
    """Returns rows of random numbers from several sources, added in turn, and what was added of each source."""
    random = np.random.default_rng(7)
    rows = Rows(capacities, WIDTH)
    added = [
        (np.cumsum(random.integers(1, 10**12, size=count)), random.normal(size=(count, WIDTH))) for count in counts
    ]
    for number in range(max(counts)):
        for source, (times, values) in enumerate(added):
            if number < len(times):
                rows.add(source, int(times[number]), values[number].tobytes())
    return rows, added


def test_rows_are_what_was_added(large: int) -> None:
    rows, added = filled((30, 0, 17, 1), (30, 4, 60, 1))
    times, values, in_file = rows.build()
    assert (in_file is not None) == (large < 1000)
    assert [len(each) for each in times] == [30, 0, 17, 1]
    for source, (of_times, of_values) in enumerate(added):
        assert np.array_equal(times[source], of_times)
        assert np.array_equal(values[source], of_values)
    rows.add(1, 5, np.ones(WIDTH).tobytes())
    assert len(times[1]) == 0
    assert rows.build()[0][1].tolist() == [5]


@pytest.mark.usefixtures("large")
def test_the_last_rows_are_known_at_any_time() -> None:
    rows = Rows((40, 40), WIDTH)
    assert rows.last() is None
    rows.add(0, 1, np.full(WIDTH, 1.0).tobytes())
    assert rows.last() is None
    for number in range(40):
        rows.add(1, 100 + number, np.full(WIDTH, float(number)).tobytes())
        assert rows.last() == [
            (1, np.full(WIDTH, 1.0).tobytes()),
            (100 + number, np.full(WIDTH, float(number)).tobytes()),
        ]


@pytest.mark.usefixtures("large")
def test_rows_beyond_the_capacity_are_counted_and_spoil_nothing() -> None:
    rows, added = filled((12, 30), (12, 12))
    assert rows.surplus == 18
    times, values, _ = rows.build()
    assert np.array_equal(times[1], added[1][0][:12])
    assert np.array_equal(values[0], added[0][1])
    assert np.array_equal(values[1], added[1][1][:12])


def _read(connection: "multiprocessing.connection.Connection", in_file: RowsInFile) -> None:
    times, values = in_file.read()
    connection.send((times, values))


def test_another_process_reads_them_while_this_one_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", 1)
    rows, added = filled((9, 20), (9, 20))
    *_, in_file = rows.build()
    assert in_file is not None
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_read, args=(there, in_file))
    process.start()
    times, values = here.recv()
    process.join()
    assert np.array_equal(times[1], added[1][0])
    assert np.array_equal(values[0], added[0][1])


def test_a_full_disk_ends_the_table_and_keeps_what_was_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", 1)
    monkeypatch.setattr(large_arrays, "BLOCK", 1)
    capacity = 100
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    rows = Rows((capacity,), WIDTH)
    rows.add(0, 0, np.zeros(WIDTH).tobytes())
    resource.setrlimit(resource.RLIMIT_FSIZE, (8 * capacity + 8 * WIDTH * 40, hard))
    try:
        for number in range(1, capacity):
            rows.add(0, number, np.full(WIDTH, float(number)).tobytes())
        assert rows.failure is not None
        assert "File too large" in rows.failure
        times, values, _ = rows.build()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert times[0].tolist() == list(range(40))
    assert values[0][:, 0].tolist() == list(range(40))


def test_without_room_for_the_file_all_stays_in_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", 1)
    monkeypatch.setattr(large_arrays, "_unnamed", lambda: (tmp_path / "missing" / "file").open("wb"))
    rows, added = filled((9, 20), (9, 20))
    times, values, in_file = rows.build()
    assert in_file is None
    assert np.array_equal(times[1], added[1][0])
    assert np.array_equal(values[1], added[1][1])
    assert large_empty((3, 4)).shape == (3, 4)


@pytest.mark.usefixtures("large")
def test_large_arrays_are_arrays_and_leave_no_file_behind(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    open_before = os.listdir("/proc/self/fd")
    one, other = large_empty((40, 3)), large_empty(70, np.int64)
    one[:], other[:] = 1.5, np.arange(70)
    assert one.sum() == 180
    assert other.sum() == 2415
    assert other.dtype == np.int64
    assert not list(tmp_path.iterdir())
    del one, other
    assert len(os.listdir("/proc/self/fd")) == len(open_before)
