"""The row of a run is the same whichever engine makes the run; its verdict is that of the run itself."""

from dataclasses import replace
from functools import cache
from math import isfinite
from pathlib import Path

import numpy as np
import pytest

from echelon.sim.launch import Launch, launch
from echelon.sim.parts.loading import load
from echelon.sim.sweep.columns import measures
from echelon.sim.sweep.rows import Rows, blocks_of, channels_of
from echelon.sim.sweep.work import EngineName, Task, runs_in_task, work
from support.runs import SCENARIOS

LATE = 'links=[{source="**", receiver="**", loss=0.1, delay={min=0.01, max=0.05}}]'
UNSTABLE = "duration=30", "claims=[]", 'links=[{channel="group_state", delay=0.9}]'
UNLIMITED = (
    "avoidance={enabled=false, avoidance_radius=0.001, sensing_radius=0.002}", "robot.torque_limit=1e9",
    "robot.torque_rate_limit=1e9", "robot.wheel_speed_limit=1e9",
)  # fmt: skip
"""What grows stays smooth then, so that rounding is not magnified much"""
CASES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "holds": (("lab", "duration=25"), "HOLDS", ""),
    "nothing is claimed": (("lab", "duration=25", "claims=[]"), "HEALTHY", ""),
    "late and lossy": (("lab", "duration=25", LATE), "HOLDS", ""),
    "grows": (
        ("lab", *UNLIMITED, *UNSTABLE), "FAILS", "growth inter",
    ),
    "grows too little to be judged": (
        ("lab", *UNLIMITED, *UNSTABLE, "health.floor=100.0"), "HEALTHY", "",
    ),
    "the check of growth is off": (
        ("lab", *UNLIMITED, *UNSTABLE, 'health.off=["growth", "end"]'), "HEALTHY", "",
    ),
    "a steady lag": (
        ("lab", "duration=40", "claims=[]", 'links=[{channel="state", delay=0.1}]', 'law.reference="now"'), "HEALTHY", "",
    ),
    "the run is too short for its claims": (("lab", "duration=4"), "FAILS", "claim"),
    "a claim fails": (("lab", "duration=25", "law.epsilon=[0.8, 0.9]"), "FAILS", "claim"),
    "is lost": (("paper", "duration=2", 'links=[{source="**", receiver="**", delay=0.02}]'), "FAILS", "finite"),
    "robots meet": (
        ("lab", "duration=6", "claims=[]", "formation.groups.g1.robots.r1.start=[0.3,1.2]", "avoidance.enabled=false"),
        "FAILS", "distance",
    ),
    "limits act": (
        ("lab", "duration=6", "claims=[]", "robot.torque_limit=0.05", "health.saturation=0.001"), "FAILS", "saturation",
    ),
    "nothing arrives": (("lab", "duration=6", "claims=[]", 'links=[{channel="state", loss=1.0}]'), "FAILS", "messages"),
    "different periods": (
        ("three_levels", "duration=4", "claims=[]", "formation.period=0.04", "formation.groups.west.period=0.02"),
        "HEALTHY", "",
    ),
}  # fmt: skip


@cache
def rows_of(case: str, engine: EngineName) -> Rows:
    (name, *overrides), _, _ = CASES[case]
    scenario, plan = load(SCENARIOS / f"{name}.toml", overrides)
    return work(Task(case, plan, (plan.seed, plan.seed + 1), engine, scenario))


@pytest.mark.parametrize("case", CASES)
def test_the_batch_engine_gives_the_row_of_a_single_run(case: str) -> None:
    batch, single = rows_of(case, "batch"), rows_of(case, "inprocess")
    assert list(batch) == list(single)
    for name in ("verdict", "holds", "reason", "violations"):
        assert batch[name] == single[name], name
    lost = case == "is lost"  # its numbers are of any size
    for name in set(batch) - {"verdict", "reason"}:
        if name.startswith("decay_rate."):
            continue
        if name.startswith("growth.") and not min(single[name.replace("growth", "amplitude_before")]) > 1e-6:
            continue  # the ratio of two roundings
        found, expected = np.array(batch[name], dtype=float), np.array(single[name], dtype=float)
        if name.startswith(("age_p50.", "age_p95.")) and np.isnan(found).all():
            continue  # percentiles that the batch engine does not count
        assert (np.isnan(found) == np.isnan(expected)).all(), name
        if not lost:
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("case", CASES)
def test_the_verdict_is_what_the_case_is_for(case: str) -> None:
    _, word, reason = CASES[case]
    rows = rows_of(case, "batch")
    assert rows["verdict"] == [word, word]
    assert all(reason in text for text in rows["reason"])
    assert all(bool(text) == (word == "FAILS") for text in rows["reason"])


def test_rows_have_the_columns_of_the_tables() -> None:
    _, plan = load(SCENARIOS / "lab.toml")
    names = [column.name for column in measures(blocks_of(plan), channels_of(plan))]
    assert list(rows_of("holds", "batch")) == names


ENDS = {
    "at its end": ("lab", "duration=2", LATE),
    "at its end, far beyond its reach": ("lab", "law.epsilon=[0.02,0.02]", "duration=10"),
    "beyond all bounds": ("paper", "links=[{channel='state', delay=0.007}]", "duration=2"),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", ENDS)
def test_a_run_that_ends_somewhere_has_the_same_row_with_all_engines(where: str, tmp_path: Path) -> None:
    name, *changes = ENDS[where]
    scenario, plan = load(SCENARIOS / f"{name}.toml", [*changes, "claims=[]"])
    one, other, third = (work(Task("", plan, (5,), engine, scenario)) for engine in ("processes", "inprocess", "batch"))
    if where == "beyond all bounds":  # as processes, whoever gets such a state refuses it
        assert one["reason"] == [f"{other['reason'][0]}; refused"]
        one["reason"] = other["reason"]
    assert str(one) == str(other)  # NaN is equal to NaN then
    assert [*one["lost_at"], *one["holds"]] == pytest.approx([*third["lost_at"], *third["holds"]], nan_ok=True)
    assert isfinite(one["lost_at"][0]) == (where == "beyond all bounds")
    if where == "at its end, far beyond its reach":
        options = Launch(engine="inprocess", out=tmp_path, can="none", report=False, quiet=True)
        stopped = launch(scenario, plan, options).run.stopped
        assert stopped is not None
        assert "has diverged" in stopped


def test_a_row_depends_on_its_own_seed_alone() -> None:
    scenario, plan = load(SCENARIOS / "lab.toml", ["duration=3", LATE])
    both = work(Task("", plan, (7, 8), "batch", scenario))
    alone = work(Task("", replace(plan, seed=99), (8,), "batch", scenario))
    assert str({name: values[1:] for name, values in both.items()}) == str(alone)


def test_a_task_takes_about_as_long_whatever_the_plan() -> None:
    _, short = load(SCENARIOS / "lab.toml", ["duration=1"])
    _, long = load(SCENARIOS / "lab.toml", ["duration=1000"])
    assert runs_in_task(short, "batch") > 50 * runs_in_task(long, "batch") >= 50
    assert runs_in_task(long, "processes") == 1
