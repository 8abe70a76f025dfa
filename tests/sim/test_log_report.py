"""The report on the buses from can.log: what a bridge reports of the same run, as far as the log shows it."""

from pathlib import Path

import pytest

from echelon.bridge.referee.log import read_run_log
from echelon.sim.log_report import report_of_log
from echelon.sim.parts.loading import load
from support.runs import echelon, summary_of

SETS = ("duration=0.5", "claims=[]")


def logged(folder: Path, path: str) -> Path:
    """Makes a run; returns its folder."""
    words = [word for each in (*SETS, f"can.path={path}") for word in ("--set", each)]
    done = echelon(
        "run", "lab", *words, "--can", "virtual", "--engine", "inprocess", "--quiet", "--no-report", "--out", folder
    )
    assert done.returncode in (0, 1), done.stderr
    return folder


@pytest.mark.parametrize("path", ["closed", "mirror"])
def test_it_is_the_report_of_the_bridge_as_far_as_the_log_goes(path: str, tmp_path: Path) -> None:
    folder = logged(tmp_path / "run", path)
    can = summary_of(folder)["can"]
    _, plan = load(folder / "scenario.toml")
    found = report_of_log(plan, folder / "can.log", "virtual")
    for name in ("path", "timing", "torque_scale", "log_start", "scheduled"):
        assert getattr(found, name) == (can[name] if name != "scheduled" else tuple(can[name])), name
    assert list(found.fit) == can["fit"]
    assert found.frames == len(list(read_run_log(folder / "can.log", plan)))
    assert found.frames - can["frames"] == (9 if path == "mirror" else 0)  # the frames of the stop
    assert found.load_mean == pytest.approx(can["load_mean"], rel=0.05)
    assert (found.sent, found.failed, found.dropped, found.log_lost, found.wheels_stopped) == (None,) * 5
    assert not found.robots
    on_wall = report_of_log(plan, folder / "can.log", "wall")  # a bus that is not paced takes its own time
    assert on_wall.timing == ("ideal" if path == "closed" else None)


@pytest.mark.parametrize("rest", ["(1000000000.500000) can0 10", "", "x" * 10_000])
def test_a_line_that_was_not_finished_is_removed_and_whole_ones_are_kept(rest: str, tmp_path: Path) -> None:
    folder = logged(tmp_path / "run", "mirror")
    _, plan = load(folder / "scenario.toml")
    log = folder / "can.log"
    content = log.read_bytes()
    whole = report_of_log(plan, log, "virtual")
    log.write_bytes(content + rest.encode())
    assert report_of_log(plan, log, "virtual") == whole
    assert log.read_bytes().startswith(content)
    assert len(rest) > 4096 or log.read_bytes() == content
    log.write_bytes(content[:20])  # the first line was not finished
    assert report_of_log(plan, log, "virtual").frames == 0
