"""The command `echelon sweep`: its output, and mistakes, each one line before any run."""

import json
import os
import shlex
from pathlib import Path

import pytest

from support.runs import echelon

LOSSY = ("--set", 'links=[{name="up",channel="state",loss=0.1}]', "--set", "claims=[]", "--set", "duration=1")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "give a scenario, or the folder of a sweep with --resume"),
        ("nowhere", "nowhere: no such file, and no shipped scenario"),
        ("lab --seeds 0", "--seeds 0: must be a number of runs"),
        ("lab --seeds x", "argument --seeds: 'x': must be a whole number"),
        ("lab --vary law.lead=1:0:0.1", "--vary law.lead=1:0:0.1: the range must go up"),
        ("lab --vary law.lead=0:1:0", "the step must be more than 0"),
        ("lab --vary law.lead=0:1:0.1:1", "must be a range a:b:step of numbers"),
        ("lab --vary law.lead=0:1", "give a step (0:1:step), or --random N or --sobol N"),
        ("lab --vary law.lead=0,0", "0 is there twice"),
        ("lab --vary law.laed=0,1", "with --vary law.laed=0: law.laed: unknown key"),
        ("lab --vary law.lead=0,7", "with --vary law.lead=7: law.lead = 7: must be at most 1"),
        ("lab --vary links.up.delay=0,1", "with --vary links.up.delay=0"),
        ("lab --set law.laed=1", "with --set law.laed=1: law.laed: unknown key"),
        ("lab --vary seed=1,2", "seed cannot be varied; seeds have an option of their own"),
        ("lab --vary law.lead=0,1 --vary duration=1,2,3 --zip", "there are 2 of law.lead, 3 of duration"),
        ("lab --vary law.lead=0,1 --vary law.lead=0,1", "law.lead: is varied twice"),
        ("lab --vary law.lead=0:1 --sobol 10", "--sobol 10: must be a power of two, such as 8 or 16"),
        ("lab --vary law.lead=0:1 --sobol 8 --random 8", "--random and --sobol: only one design"),
        ("lab --random 8", "--random: needs a key to vary"),
        ("lab --find law.lead", "must be KEY=lo:hi:step"),
        ("lab --find law.lead=0:2:0.5", "with --find law.lead=2.0: law.lead = 2.0: must be at most 1"),
        ("lab --find law.lead=0:1:0.1 --vary law.lead=0,1", "--find law.lead: is varied, too"),
        ("lab --share 0.5", "--share: is for a search; give --find too"),
        ("lab --find law.lead=0:1:0.1 --share 2", "--share 2: must be more than 0 and at most 1"),
        ("lab --workers 0", "--workers '0': must be a number of workers"),
        ("lab --workers host:1", "--workers 'host:1': must be a number of workers, or the address of a dask scheduler"),
        ("drives --engine batch", "can.path = 'closed'"),
        ("lab --set links=[{channel=\"state\",delay=0.5}]", "is unstable (spectral radius 1.0"),
        ("lab --set periods.torque=1.0 --set periods.acceleration=1.0", "before any value is varied; --allow-unstable"),
        ("lab --resume nowhere", "--resume nowhere: takes scenario, values and seeds from that folder"),
        ("--resume nowhere --share 0.5", "beside it only --workers, --quiet and --json can be given"),
        ("--resume nowhere --engine batch --quiet", "beside it only --workers"),
        ("--resume nowhere --seeds 0", "beside it only --workers"),
        ("--resume nowhere --workers 1 --quiet --json", "nowhere: is not the folder of a sweep"),
        ("--resume nowhere", "nowhere: is not the folder of a sweep, there is no sweep.json"),
        ("lab --set links=[{channel=\"state\",delay={kind=\"trace\",file=\"bad.csv\"}}]", "bad.csv"),
        ("lab --out file", "--out file: is a file, and must be a folder"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_before_any_run(arguments: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("0.01\n-0.02\nabc\n")
    (tmp_path / "file").write_text("")
    done = echelon("sweep", *shlex.split(arguments, posix=False), cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stdout == ""
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("note: ")]
    assert said in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.csv", "file"]


def test_an_unstable_scenario_can_be_swept_if_that_is_meant(tmp_path: Path) -> None:
    arguments = ("lab", "--set", 'links=[{channel="state",delay=0.5}]', "--set", "duration=1", "--out", tmp_path / "on")
    assert echelon("sweep", *arguments).returncode == 2
    assert echelon("sweep", *arguments, "--allow-unstable").returncode == 0


def test_json_has_the_points_and_what_was_found(tmp_path: Path) -> None:
    done = echelon(
        "sweep",
        "lab",
        *LOSSY,
        "--find",
        "links.up.loss=0:1:0.25",
        "--seeds",
        "2",
        "--json",
        "--quiet",
        "--out",
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["points"][0]["links.up.loss"] == 0.0
    assert {each["by"] for each in found["find"]} == {"both", "share", "second moment"}
    assert "with 2 seeds" not in done.stderr
    assert "can be shown with 35 seeds or more" in done.stderr


def test_the_summary_has_a_line_for_each_point(tmp_path: Path) -> None:
    done = echelon("sweep", "-", *LOSSY, "--vary", "links.up.loss=0:0.2:0.1", "--seeds", "3", "--out", tmp_path / "a",
                   typed=echelon_text())  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, *rows, last = done.stdout.splitlines()
    assert first == "lab: 9 runs at 3 points, engine batch"
    assert [row.split("  ")[1] for row in rows] == [f"links.up.loss = {loss}" for loss in ("0", "0.1", "0.2")]
    assert last.split() == ["folder", str(tmp_path / "a")]
    again = echelon("sweep", "--resume", tmp_path / "a", cwd=tmp_path)
    assert again.stdout == done.stdout


def echelon_text() -> str:
    from support.runs import SCENARIOS

    return (SCENARIOS / "lab.toml").read_text(encoding="utf-8")


def test_without_out_there_is_a_new_folder_in_runs(tmp_path: Path) -> None:
    done = echelon("sweep", "lab", "--set", "duration=0.1", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("lab-sweep-")
    assert {"runs.csv", "points.csv", "sweep.json", "scenario.toml", "journal.jsonl"} <= set(os.listdir(folder))


def test_a_cluster_that_does_not_answer_is_a_mistake(tmp_path: Path) -> None:
    done = echelon("sweep", "lab", "--set", "duration=0.1", "--workers", "tcp://127.0.0.1:9", "--out", tmp_path / "a")
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]
    assert "--workers tcp://127.0.0.1:9: " in line
    assert "needs dask.distributed" in line or "no dask scheduler answers" in line
