"""The load of a run on a wall clock is known before it begins; where it is too much the recording is thinned, never control."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from echelon.sim.parts.loading import parse
from echelon.sim.processes.supervisor import Supervisor
from echelon.sim.wall_load import BUSY, wall_load
from support.runs import echelon, plan_of


def many(groups: int, period: float = 0.01) -> str:
    """Returns a scenario of groups of three robots."""
    lines = [
        f'name = "many"\nduration = {50 * period}\nperiods = {{ acceleration = {period}, torque = {period} }}',
        "robot = { mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }",
        'law = { epsilon = [0.5, 0.5] }\ntrajectory = { kind = "line", velocity = [0.1, 0.0] }',
        'formation.shape = { kind = "line", spacing = 10.0 }',
    ]
    for group in range(groups):
        robots = ", ".join(f"r{3 * group + at} = {{ start = [{10 * group + at}.0, 0.0] }}" for at in range(3))
        lines.append(
            f'[formation.groups.g{group}]\nshape = {{ kind = "line", spacing = 1.0 }}\nrobots = {{ {robots} }}'
        )
    return "\n".join(lines)


def test_the_load_grows_with_robots_and_falls_with_periods_and_processors() -> None:
    nine, many_robots = (wall_load(parse(many(groups), "t.toml")[1], False, 2) for groups in (3, 9))
    assert nine.share < BUSY < many_robots.share
    assert (nine.warning, nine.step, nine.every_ns) == ("", 1, 0)
    assert 9 < nine.most < 27
    assert many_robots.share == pytest.approx(3 * nine.share, rel=0.1)
    assert "too much" not in nine.text
    assert "38 processes take about" in many_robots.warning
    assert many_robots.step > 1
    assert many_robots.every_ns == many_robots.step * 10_000_000
    slow = wall_load(parse(many(9, 0.05), "t.toml")[1], False, 2)
    assert slow.share == pytest.approx(many_robots.share / 5)
    assert wall_load(parse(many(9), "t.toml")[1], False, 8).share == pytest.approx(many_robots.share / 4)
    closed = wall_load(plan_of("lab", "can.path=closed"), True, 2)
    assert closed.share > wall_load(plan_of("lab"), True, 2).share > wall_load(plan_of("lab"), False, 2).share


def test_validate_tells_before_a_run_that_it_is_too_much(tmp_path: Path) -> None:
    scenario = tmp_path / "many.toml"
    scenario.write_text(many(40))
    done = echelon("validate", scenario)
    assert done.returncode == 0
    assert "  on a wall clock 162 processes take about" in done.stdout
    told = json.loads(echelon("validate", scenario, "--json").stdout)["wall_clock"]
    assert told["load"] > BUSY
    assert told["processors"] == len(os.sched_getaffinity(0))
    assert told["robots_that_fit"] < 120
    assert "wall clock" not in echelon("validate", "lab", "--set", "periods.acceleration=0.5").stdout


def test_a_thinned_recording_has_all_robots_at_the_same_instants_and_counts_the_rest(tmp_path: Path) -> None:
    plan = plan_of("lab", "duration=1.0")
    outcome = Supervisor(plan, tmp_path, run="thinned", virtual=False, every_ns=50_000_000).run()
    assert outcome.failure is None
    for times_ns in outcome.trace.times_ns:
        assert (times_ns == np.arange(21) * 50_000_000).all()
    period_ns = plan.robots[0].period_ns
    assert outcome.thinned > 9 * (1_000_000_000 // period_ns - 21)
    runners = [process.runner for process in outcome.processes if process.runner is not None]
    assert outcome.thinned == sum(runner.thinned for runner in runners)  # what is left out costs nobody anything
    of_states = [counts for counts in outcome.links if plan.all_roles[counts.source].role == "robot"]
    assert all(counts.sent >= 1_000_000_000 // period_ns for counts in of_states)  # control has all of them


def test_a_run_that_is_too_much_says_so_and_is_thinned_without_a_finding(tmp_path: Path) -> None:
    out = tmp_path / "run"
    sets = ("--set", "duration=0.2", "--set", "periods.acceleration=0.001", "--set", "periods.torque=0.001")
    done = echelon("run", "lab", *sets, "--clock", "wall", "--can", "none", "--no-report", "--out", out)
    assert "warning: on a wall clock 14 processes take about" in done.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert summary["run"]["recorded_every"] in (0.002, 0.005, 0.01)
    assert summary["run"]["thinned"] > 100
    (check,) = [each for each in summary["verdict"]["checks"] if each["name"] == "recording"]
    assert "thinned by rule" in check["text"] or check["outcome"] == "failed"
    assert "messages left out by rule" in done.stdout


def test_27_robots_are_warned_of_and_recorded_by_rule_and_all_are_controlled(tmp_path: Path) -> None:
    """Also on a machine that is busy: then stages are late and the run fails, but what is recorded and sent is counted."""
    scenario, out = tmp_path / "many.toml", tmp_path / "run"
    scenario.write_text(many(9).replace("duration = 0.5", "duration = 3.0"))
    plan = parse(scenario.read_text(), "many.toml")[1]
    load = wall_load(plan, False)
    done = echelon("run", scenario, "--clock", "wall", "--can", "none", "--no-report", "--keep-going", "--out", out)
    summary = json.loads((out / "summary.json").read_text())
    run = summary["run"]
    assert run["failure"] is None, done.stderr
    assert ("warning: on a wall clock 38 processes take about" in done.stderr) == (load.share > BUSY)
    assert " running " not in done.stderr.partition("warning: ")[0] or load.share <= BUSY  # it comes before the run
    assert run["recorded_every"] == (load.every_ns / 1e9 if load.every_ns else None)
    assert (run["thinned"] > 0) == (load.every_ns > 0)
    assert done.returncode == {"HOLDS": 0, "HEALTHY": 0, "FAILS": 1}[summary["verdict"]["word"]]
    (check,) = [each for each in summary["verdict"]["checks"] if each["name"] == "recording"]
    assert check["outcome"] == "passed", check
    periods = plan.duration_ns // plan.robots[0].period_ns
    sent = [link["sent"] for link in summary["links"] if link["channel"] == "state"]
    assert len(sent) == 27
    assert min(sent) >= periods  # no period was left out, whatever was recorded
