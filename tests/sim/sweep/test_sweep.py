"""Whole sweeps: the same tables with any workers, after any interruption; refusals; the boundary that a search finds."""

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import echelon
from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.errors import UserError
from echelon.messages import Channel
from echelon.sim.sweep.folder import resumed
from echelon.sim.sweep.journal import NAME as JOURNAL
from echelon.sim.sweep.preparing import Request, prepare
from echelon.sim.sweep.study import Sweep
from echelon.sim.sweep.sweep import run
from echelon.sim.sweep.values import parse_vary
from support.points import Array
from support.runs import ROOT, SCENARIOS, plan_of

UP: dict[str, Any] = {"links": [{"name": "up", "channel": "state", "loss": 0.1}], "claims": []}
TABLES = ("runs.csv", "points.csv")
QUICK = ("--set", 'links=[{name="up",channel="state",loss=0.1}]', "--set", "claims=[]", "--set", "duration=2")


def tables(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in TABLES}


def sweep_command(*arguments: str | Path, before: str = "") -> subprocess.CompletedProcess[str]:
    """Runs `echelon sweep` in a process of its own, after some lines of Python."""
    code = f"import sys\n{before}\nfrom echelon.cli import main\nsys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "sweep", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=ROOT)


def kill_after(tasks: int, torn: bool) -> str:
    """Returns Python that kills its process, as kill -9 does, when so many tasks are in the journal, and possibly half a
    line."""
    return f"""
import os, signal
from echelon.sim.sweep import journal
add, count = journal.Journal.add, 0
def counted(self, task, rows):
    global count
    add(self, task, rows)
    count += 1
    if count == {tasks}:
        os.write(self._descriptor, b'{{"task":"[0.2] 1+1","ro'[:{20 if torn else 0}])
        os.kill(os.getpid(), signal.SIGKILL)
journal.Journal.add = counted
"""


@pytest.mark.parametrize("engine", ["batch", "inprocess"])
def test_tables_are_the_same_bytes_with_one_worker_and_with_two(engine: Any, tmp_path: Path) -> None:
    changes = UP | {"duration": 1.0}
    for workers in (1, 2):
        echelon.sweep(
            "lab", changes, vary={"links.up.loss": [0.0, 0.3], "law.lead": [0.5, 0.0]}, seeds=3, engine=engine,
            workers=workers, out=tmp_path / str(workers), quiet=True,
        )  # fmt: skip
    assert tables(tmp_path / "1") == tables(tmp_path / "2")
    runs = echelon.open_sweep(tmp_path / "1").runs
    assert list(zip(runs["point"], runs["seed"], strict=True)) == [(p, s) for p in range(4) for s in (1, 2, 3)]


@pytest.mark.parametrize("torn", [False, True])
def test_after_kill_9_a_sweep_goes_on_and_nothing_is_lost_or_doubled(torn: bool, tmp_path: Path) -> None:
    asked = ("lab", *QUICK, "--vary", "links.up.loss=0:0.4:0.1", "--seeds", "4", "--quiet")
    assert sweep_command(*asked, "--out", tmp_path / "whole").returncode == 0
    killed = sweep_command(*asked, "--out", tmp_path / "cut", before=kill_after(2, torn))
    assert killed.returncode == -signal.SIGKILL
    before = (tmp_path / "cut" / JOURNAL).read_bytes()
    assert before.count(b"\n") == 2
    assert before.endswith(b"\n") is not torn
    assert not (tmp_path / "cut" / "runs.csv").exists()
    resumed = sweep_command("--resume", tmp_path / "cut", "--quiet")
    assert resumed.returncode == 0, resumed.stderr
    assert tables(tmp_path / "cut") == tables(tmp_path / "whole")
    after = (tmp_path / "cut" / JOURNAL).read_bytes()
    names = [json.loads(line)["task"] for line in after.splitlines()]
    assert len(set(names)) == len(names) == 5
    assert after.startswith(before[: before.rindex(b"\n") + 1])


def test_a_killed_search_goes_on_to_the_same_boundary(tmp_path: Path) -> None:
    asked = ("lab", *QUICK, "--find", "links.up.loss=0:1:0.05", "--seeds", "3", "--share", "0.5", "--quiet")
    assert sweep_command(*asked, "--out", tmp_path / "whole").returncode == 0
    assert sweep_command(*asked, "--out", tmp_path / "cut", before=kill_after(10, True)).returncode < 0
    assert sweep_command(*asked, "--out", tmp_path / "cut").returncode == 0  # the same command resumes, too
    assert tables(tmp_path / "cut") == tables(tmp_path / "whole")
    assert (tmp_path / "cut" / "find.json").read_bytes() == (tmp_path / "whole" / "find.json").read_bytes()


def test_ctrl_c_leaves_the_finished_rows_and_says_how_to_go_on(tmp_path: Path) -> None:
    interrupt = kill_after(3, False).replace("SIGKILL", "SIGINT")
    # a shell starts what it runs in the background with SIGINT ignored
    interrupt += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    asked = (
        "lab",
        *QUICK,
        "--vary",
        "links.up.loss=0:0.4:0.01",
        "--workers",
        "1",
        "--quiet",
        "--out",
        tmp_path / "some",
    )
    done = sweep_command(*asked, before=interrupt)
    assert done.returncode == 3
    line = done.stderr.splitlines()[-1]
    assert line.endswith(f"go on with: echelon sweep --resume {tmp_path / 'some'}")
    assert "interrupted; " in line
    assert " of 41 runs are kept" in line
    some = echelon.open_sweep(tmp_path / "some")
    assert 3 <= len(some.runs) < 41
    whole = resume(tmp_path / "some")
    rows = [whole.runs["point"].tolist().index(point) for point in some.runs["point"]]
    for name, column in some.runs.columns.items():
        assert column.tolist() == whole.runs[name][rows].tolist() or column.dtype == float


def resume(folder: Path) -> Sweep:
    return run(prepare(resumed(folder)), folder)


def test_a_finished_sweep_makes_no_run_again(tmp_path: Path) -> None:
    one = echelon.sweep("lab", UP | {"duration": 1.0}, seeds=3, out=tmp_path, quiet=True)
    before = (tmp_path / JOURNAL).read_bytes()
    again = echelon.sweep("lab", UP | {"duration": 1.0}, seeds=3, out=tmp_path, quiet=True)
    assert (tmp_path / JOURNAL).read_bytes() == before
    assert again.runs["ise.inter"].tolist() == one.runs["ise.inter"].tolist()


@pytest.mark.parametrize(
    ("changes", "options", "what"),
    [
        ({}, {"seeds": 4}, "seeds"),
        ({}, {"vary": {"law.lead": [0.0]}}, "keys, points"),
        ({}, {"engine": "inprocess"}, "engine"),
        ({"law.lead": 0.4}, {}, "hash"),
    ],
)
def test_another_design_in_the_folder_is_refused(
    changes: dict[str, Any], options: dict[str, Any], what: str, tmp_path: Path
) -> None:
    changes = UP | {"duration": 0.1} | changes
    echelon.sweep("lab", UP | {"duration": 0.1}, seeds=3, out=tmp_path, quiet=True)
    with pytest.raises(UserError) as refused:
        echelon.sweep("lab", changes, **{"seeds": 3, "out": tmp_path, "quiet": True, **options})
    (line,) = refused.value.lines
    assert "holds another sweep" in line
    assert what in line


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text("mine")
    with pytest.raises(UserError, match=r"runs\.csv is there"):
        echelon.sweep("lab", {"duration": 0.1}, out=tmp_path, quiet=True)
    assert (tmp_path / "runs.csv").read_text() == "mine"
    with pytest.raises(UserError, match="must be a folder"):
        echelon.sweep("lab", {"duration": 0.1}, out=tmp_path / "runs.csv", quiet=True)
    with pytest.raises(UserError, match="not the folder of a sweep"):
        echelon.open_sweep(tmp_path)


DEADLY = """
import os, signal
from multiprocessing import parent_process
from pathlib import Path
import numpy as np
from echelon import Law

class Deadly(Law):
    flag: str = ""

    def nu(self, block, t, e, e_dot, feed_forward, state):
        if parent_process() is not None and (not self.flag or not Path(self.flag).exists()):
            if self.flag:
                Path(self.flag).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return feed_forward - e_dot / block.sigma - e / block.sigma**2
"""


FLOORS = {"health.floor": [0.001, 0.002, 0.003]}


def deadly(folder: Path, parameters: str) -> str:
    """Returns the text of a scenario whose law kills its worker."""
    (folder / "deadly.py").write_text(DEADLY)
    text = (SCENARIOS / "lab.toml").read_text().split("[law]")
    kept = text[1].partition("[avoidance]")[2]
    law = f'use = "deadly.py:Deadly"\nepsilon = [0.5, 0.5]\nparameters = {{ {parameters} }}\n'
    path = folder / "deadly.toml"
    path.write_text(f"{text[0]}[law]\n{law}\n[avoidance]{kept}")
    return str(path)


def test_a_worker_that_dies_costs_only_time(tmp_path: Path) -> None:
    flag = tmp_path / "died"
    scenario = deadly(tmp_path, f'flag = "{flag}"')
    changes = {"duration": 0.1, "claims": []}
    found = echelon.sweep(scenario, changes, vary=FLOORS, seeds=2, workers=2, quiet=True)
    assert flag.exists()
    assert found.engine == "inprocess"
    expected = echelon.sweep(scenario, changes, vary=FLOORS, seeds=2, workers=1, quiet=True)
    assert len(found.runs) == 6
    assert found.runs["ise.inter"].tolist() == expected.runs["ise.inter"].tolist()


def test_a_run_at_which_workers_die_again_and_again_ends_the_sweep(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="workers died 3 times at"):
        echelon.sweep(deadly(tmp_path, ""), {"duration": 0.1, "claims": []}, workers=2, quiet=True)


def near_formation(generator: np.random.Generator) -> dict[str, Any]:
    """Returns changes of lab with which its robots start in their places, but for a millimetre."""
    places: Array = desired_starts()
    starts = places + generator.normal(0, 1e-3, places.shape)
    names = [robot.name.split("/") for robot in plan_of("lab").robots]
    return {
        f"formation.groups.{group}.robots.{robot}.start": start.tolist()
        for (group, robot), start in zip(names, starts, strict=True)
    }


def desired_starts() -> Array:
    from echelon.controller.trajectory import make_trajectory
    from echelon.controller.transformation import Transformation

    plan = plan_of("lab")
    transformation = Transformation(plan)
    z = np.vstack([transformation.desired_shape.reshape(-1, 2), make_trajectory(plan.trajectory).at(0.0)[0]])
    return np.asarray(transformation.inverse @ z)


@pytest.mark.parametrize("channel", ["state", "group_state"])
def test_near_the_formation_a_search_finds_the_predicted_delay(channel: str) -> None:
    predicted = largest_extra_delay(plan_of("lab"), Channel[channel.upper()]).seconds
    assert predicted is not None
    changes = near_formation(np.random.default_rng(1)) | {
        "claims": [], "links": [{"name": "up", "channel": channel}], "health.floor": 1e-9, "duration": 120.0,
    }  # fmt: skip
    span = f"{predicted - 0.03:.3f}:{predicted + 0.03:.3f}:0.001"
    found = echelon.sweep("lab", changes, find={"links.up.delay": span}, quiet=True)
    assert [each.value for each in found.find] == [pytest.approx(predicted, rel=0.01)] * 3
    assert found.runs["seed"].tolist() == [1] * len(found.runs)  # nothing is random, so one run at a point says all


def test_a_limit_cycle_does_not_hold_though_it_grows_no_more(tmp_path: Path) -> None:
    changes = {
        "claims": [], "duration": 30.0, "law.epsilon": [0.3, 0.3], "avoidance.enabled": False,
        "robot.torque_limit": 1e6, "robot.torque_rate_limit": 1e9, "robot.wheel_speed_limit": 1e6, "robot.envelope": {},
        "links": [{"name": "up", "channel": "state"}],
    }  # fmt: skip
    found = echelon.sweep("lab", changes, find={"links.up.delay": "0:0.4:0.05"}, out=tmp_path, quiet=True)
    both, by_share, by_moment = found.find
    assert (both.value, both.fails, both.limited_by) == (0.1, 0.15, ("share",))
    assert both.text == "links.up.delay: holds up to 0.1, fails at 0.15 by share"
    assert (by_share.value, by_share.fails) == (0.1, 0.15)
    assert by_moment.value is not None
    assert by_moment.value > 0.1
    assert echelon.open_sweep(tmp_path).find == found.find


@pytest.mark.parametrize(("seeds", "sure"), [(2, 0.0), (34, 0.0), (35, 0.2)])
def test_a_share_is_sure_with_enough_runs_or_where_nothing_is_random(seeds: int, sure: float) -> None:
    changes = UP | {"duration": 25.0, "health.off": ["saturation"]}
    found = echelon.sweep("lab", changes, find={"links.up.loss": "0:0.2:0.1"}, seeds=seeds, quiet=True)
    by_share = found.find[1]
    assert (by_share.by, by_share.value, by_share.fails) == ("share", 0.2, None)
    assert by_share.low == sure


def test_a_search_beside_a_varied_key_has_a_boundary_for_each_value() -> None:
    changes = UP | {"duration": 20.0}
    found = echelon.sweep(
        "lab",
        changes,
        vary={"links.up.loss": [0.0, 0.01]},
        find={"links.up.delay": "0:0.4:0.05"},
        share=0.5,
        seeds=4,
        quiet=True,
    )
    assert [(dict(each.at), each.by) for each in found.find] == [
        ({"links.up.loss": loss}, by) for loss in (0.0, 0.01) for by in ("both", "share", "second moment")
    ]
    assert found.keys == ("links.up.loss", "links.up.delay")
    order = list(zip(found.points["links.up.loss"], found.points["links.up.delay"], strict=True))
    assert order == sorted(order)
    assert found.points["point"].tolist() == list(range(len(order)))


def test_points_say_what_their_runs_do() -> None:
    found = echelon.sweep("lab", UP | {"duration": 4.0}, vary={"links.up.loss": [0.0, 0.5]}, seeds=5, quiet=True)
    runs, points = found.runs.to_pandas(), found.points.to_pandas().set_index("links.up.loss")
    for loss, some in runs.groupby("links.up.loss"):
        point = points.loc[loss]
        assert point["runs"] == 5
        assert point["holds"] == some["holds"].sum()
        assert point["ise.inter"] == pytest.approx(some["ise.inter"].median())
        assert point["ise_mean.inter"] == pytest.approx(some["ise.inter"].mean())
        squares = [(some[f"amplitude_{when}.inter"] ** 2).sum() for when in ("last", "before")]
        assert point["moment_growth.inter"] == pytest.approx(squares[0] / squares[1])
        assert some["loss.state"].mean() == pytest.approx(float(str(loss)), abs=0.05)
    assert len(set(runs[runs["links.up.loss"] == 0.5]["ise.inter"])) == 5
    assert found.runs.units["ise.inter"] == "m² s"


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    made = echelon.sweep(
        "lab", UP | {"duration": 1.0}, vary={"law.epsilon": [[0.5, 0.5], [0.4, 0.5]], "law.lead": [0.0, 0.5]}, seeds=2,
        out=tmp_path, quiet=True,
    )  # fmt: skip
    read = echelon.open_sweep(tmp_path)
    assert (read.keys, read.seeds, read.engine, read.design) == (made.keys, made.seeds, made.engine, made.design)
    for one, other in ((made.runs, read.runs), (made.points, read.points)):
        assert list(one.columns) == list(other.columns)
        assert one.units == other.units
        for name, column in one.columns.items():
            assert str(column.tolist()) == str(other[name].tolist()), name
    parquet = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "runs.parquet")
    assert parquet.column_names == list(made.runs.columns)
    assert parquet["law.epsilon"].to_pylist() == made.runs["law.epsilon"].tolist()
    assert parquet["age_p95.state"].null_count == np.isnan(made.runs["age_p95.state"]).sum()


def test_a_dataset_has_an_axis_for_each_key() -> None:
    pytest.importorskip("xarray")
    found = echelon.sweep(
        "lab",
        UP | {"duration": 1.0},
        vary={"links.up.loss": [0.0, 0.2, 0.4], "law.lead": [0.0, 0.5]},
        seeds=2,
        quiet=True,
    )
    data = found.to_xarray()
    assert dict(data.sizes) == {"links.up.loss": 3, "law.lead": 2, "seed": 2}
    runs = found.runs.to_pandas()
    picked = runs[(runs["links.up.loss"] == 0.4) & (runs["law.lead"] == 0.5) & (runs["seed"] == 2)]["ise.inter"]
    assert float(data["ise.inter"].sel({"links.up.loss": 0.4, "law.lead": 0.5, "seed": 2})) == float(picked.iloc[0])
    zipped = echelon.sweep(
        "lab",
        UP | {"duration": 1.0},
        vary={"links.up.loss": [0.0, 0.2], "law.lead": [0.0, 0.5]},
        design="zip",
        quiet=True,
    )
    assert dict(zipped.to_xarray().sizes) == {"point": 2, "seed": 1}


def test_the_engine_is_batch_where_it_can() -> None:
    from echelon.sim.sweep.origin import Origin

    def prepared(name: str, *overrides: str) -> tuple[str, Sequence[str]]:
        origin = Origin.of_file(SCENARIOS / f"{name}.toml", overrides)
        found = prepare(Request(origin=origin, varied=(parse_vary("law.lead=0,0.1"),)))
        return found.engine, found.notes

    assert prepared("lab")[0] == "batch"
    engine, notes = prepared("drives", "duration=1")
    assert engine == "inprocess"
    assert any("closed" in note for note in notes)


def test_on_dask_the_rows_are_the_same(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    changes, vary = UP | {"duration": 1.0}, {"links.up.loss": [0.0, 0.3, 0.5]}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        for engine in ("batch", "inprocess"):
            for name, workers in (("dask", cluster.scheduler_address), ("here", 1)):
                echelon.sweep(
                    "lab", changes, vary=vary, seeds=2, engine=engine, workers=workers, out=tmp_path / engine / name,
                    quiet=True,
                )  # fmt: skip
            assert tables(tmp_path / engine / "dask") == tables(tmp_path / engine / "here")


def test_a_worker_on_dask_that_dies_costs_only_time(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    flag = tmp_path / "died"
    scenario = deadly(tmp_path, f'flag = "{flag}"')
    changes = {"duration": 0.1, "claims": []}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        found = echelon.sweep(scenario, changes, vary=FLOORS, workers=cluster.scheduler_address, quiet=True)
    assert flag.exists()
    assert len(found.runs) == 3
