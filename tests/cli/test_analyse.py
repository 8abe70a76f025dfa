"""`echelon analyse`: its results for a scenario's links agree with runs; what it refuses.  Warnings of `echelon validate`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from echelon.cli.analyse_text import lines_of
from echelon.cli.new_scenario import scenario_text, sizes
from echelon.controller.prediction.policy_effects import policy_effect
from echelon.messages import Channel
from echelon.sim.engines.in_process import Engine
from echelon.sim.forecast.analysing import analysis_of
from echelon.sim.forecast.estimating import Estimates, mean_integrals
from echelon.sim.forecast.motion import asked_of
from echelon.sim.forecast.own_links import OwnLinks
from echelon.sim.parts.loading import parse
from echelon.sim.results.block_series import block_series
from echelon.sim.results.rendering import analysis_schema, json_text
from echelon.sim.results.trace import TraceBuilder
from support.runs import echelon
from support.schemas import strict

FOUR = """\
name = "four"
duration = 20.0
[robot]
mass = 4.0
inertia = 0.12
wheel_radius = 0.05
arm = 0.15
offset = 0.1
[formation.groups.g1]
shape = { kind = "polygon", side = 1.0 }
[formation.groups.g1.robots]
a = { start = [0.0, 0.0] }
b = { start = [1.2, 0.0] }
c = { start = [1.0, 1.3] }
d = { start = [-0.1, 0.8] }
[trajectory]
kind = "line"
velocity = [0.2, 0.0]
"""


def last_errors(text: str, *overrides: str) -> list[float]:
    """Returns the largest error of any block in each quarter of a run in this process [m]; NaN if a state is not finite."""
    _, plan = parse(text, "t.toml", overrides)
    builder = TraceBuilder(plan)
    with np.errstate(all="ignore"):
        Engine(plan, builder.add).run()
        norms = np.max([series.norm for series in block_series(builder.build()).series], axis=0)
    return [float(part.max()) for part in np.array_split(norms, 4)]


def by_name(facts: dict[str, Any]) -> dict[str, Any]:
    """Returns the rows of the table by their names."""
    return {row["name"]: row for row in facts["table"]}


def test_the_table_has_a_row_for_each_layer_and_channel_and_what_it_assumes() -> None:
    lines = echelon("analyse", "lab").stdout.splitlines()
    assert lines[2].startswith("  assumed: robots follow the desired accelerations exactly, no limit acts")
    at = next(number for number, line in enumerate(lines) if line.split()[:3] == ["layer", "channel", "delay"])
    rows = [line.split() for line in lines[at + 1 : at + 5]]
    assert [row[:4] for row in rows] == [
        ["intra", "state", "352.923", "ms"],
        ["intra", "command", "352.923", "ms"],
        ["inter", "group_state", "708.484", "ms"],
        ["inter", "reference", "708.484", "ms"],
    ]
    assert [row[-1] for row in rows] == ["g3", "g3", "inter", "inter"]
    assert any(line.split()[:2] == ["centroid", "centroid"] and "16.62 s" in line for line in lines)


def test_robots_and_groups_are_rows_where_they_are_asked_for() -> None:
    rows = by_name(json.loads(echelon("analyse", "lab", "--members", "--json").stdout))
    assert len(rows["g1/r1 state"]["like"]) == 9
    assert rows["g1, to its members"]["links"] == 6
    assert rows["g1, to its members"]["delay"]["seconds"] == pytest.approx(0.17646, rel=1e-3)


def test_figures_are_files_with_their_command(tmp_path: Path) -> None:
    done = echelon("analyse", "lab", "--figures", tmp_path, "--format", "svg", "--format", "pdf")
    names = ["delays", "delays-epsilon", "eigenvalues"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        f"{name}.{kind}" for name in names for kind in ("svg", "pdf")
    )
    assert all("echelon analyse lab" in (tmp_path / f"{name}.svg").read_text(encoding="utf-8") for name in names)
    assert str(tmp_path / "delays.pdf") in done.stdout
    assert echelon("analyse", "lab", "--format", "pdf").returncode == 2


def test_the_first_line_says_of_which_channels_and_periods_it_speaks() -> None:
    first, *rest = echelon("analyse", "multi").stdout.splitlines()
    assert first == (
        "multi: channels state, group_state, reference and command; accelerations every 2 ms, torques every 1 ms"
    )
    assert rest[0] == "  delays of the scenario's links: none; no link loses messages"


def test_analyse_puts_the_boundary_of_the_paper_between_six_and_seven_milliseconds() -> None:
    done = echelon("analyse", "paper", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["settles"]
    rows = by_name(facts)
    assert (
        rows["intra state"]["delay"]
        == rows["state"]["delay"]
        == {
            "seconds": pytest.approx(0.0068483, rel=1e-3),
            "ticks": 6,
            "tick": pytest.approx(0.001),
            "ends": "unstable",
            "tried": False,
            "limits": ["g1", "g2", "g3"],
        }
    )
    assert list(facts["delays"]) == ["state", "group_state", "reference", "command"]
    assert rows["intra state"]["loss"]["share"] == pytest.approx(0.8335, abs=1e-3)
    margins = [block["delay_margin"] for block in facts["blocks"] if block["names"][0] in ("g1", "inter", "centroid")]
    assert margins == pytest.approx([0.0071117, 0.071117, 0.71117], rel=1e-4)
    first = facts["epsilon"][0]
    assert first["bound_by_norms"] < first["bound"] == pytest.approx(0.02786, rel=1e-3)
    assert first["bound"] < first["exact"] == pytest.approx(0.31214, rel=1e-4)
    assert facts["coupling"] == {"exact": pytest.approx(3.3368, rel=1e-4), "sampled": pytest.approx(3.337, rel=1e-3)}
    assert [one.message for one in Draft202012Validator(strict(analysis_schema())).iter_errors(facts)] == []


def test_an_epsilon_that_no_coupling_limits_may_be_any() -> None:
    coupling = 'law.coupling=[{block="inter",onto="centroid",value=0.3},{block="centroid",onto="inter",value=0.3}]'
    done = echelon("analyse", "paper", "--set", coupling)
    first, second = (line.split() for line in done.stdout.splitlines() if line.split()[:1] in (["ε1"], ["ε2"]))
    assert float(first[6]) == pytest.approx(0.3096, rel=1e-3)
    assert second[4:] == ["any"] * 4


def test_delays_of_links_are_taken_and_what_is_said_is_what_happens() -> None:
    """With a delay of 0.2 s on every link neither prediction nor run settles; with half of that both do."""
    text = scenario_text("new", sizes("2x3"), None)
    for delay, settles in ((0.2, False), (0.1, True)):
        rule = f"links=[{{delay={delay}}}]"
        done = echelon("analyse", "-", "--set", rule, "--json", typed=text)
        facts = json.loads(done.stdout)
        assert (done.returncode, facts["settles"]) == (0 if settles else 1, settles)
        assert facts["delays"] == {channel: [delay] for channel in ("state", "group_state", "reference", "command")}
        assert bool(facts["table"]) == settles
        ends = last_errors(
            text,
            rule,
            "claims=[]",
            "duration=20.0",
            "avoidance.enabled=false",
            "robot.torque_limit=inf",
            "robot.torque_rate_limit=inf",
            "robot.wheel_speed_limit=inf",
        )
        assert (ends[-1] < 0.1 * ends[0]) == settles, ends
    lines = echelon("analyse", "-", "--set", "links=[{delay=0.2}]", typed=text).stdout.splitlines()
    assert "state 200 ms, group_state 200 ms, reference 200 ms, command 200 ms" in lines[1]
    assert "does not settle; errors grow e-fold in" in lines[3]
    assert not any("later messages may be" in line for line in lines)


def test_the_lab_bears_a_tenth_of_a_second_on_every_link() -> None:
    facts = json.loads(echelon("analyse", "lab", "--set", "links=[{delay=0.1}]", "--json").stdout)
    assert facts["settles"]
    assert facts["centroid_age"] == 0  # states are compared with the reference of their own time
    assert by_name(facts)["command"]["delay"]["seconds"] == pytest.approx(0.15292, rel=1e-3)


def analysed(rules: str, *overrides: str, policies: bool = False) -> dict[str, Any]:
    """Returns what `echelon analyse --json` says of `FOUR` with these rules for its links; it fits the schema."""
    scenario, plan = parse(FOUR, "t.toml", (f"links=[{rules}]", *overrides))
    law = scenario.law
    found = analysis_of(plan, law.time_scales, law.epsilon, asked_of(plan), policies=policies, runs=16)
    facts: dict[str, Any] = json.loads(json_text(found))
    assert [one.message for one in Draft202012Validator(strict(analysis_schema())).iter_errors(facts)] == []
    assert "\n".join(lines_of(found, ())).startswith("four: channels ")
    return facts


def test_a_scenario_with_lossy_links_is_judged_in_the_mean_square_and_its_cost_is_that_of_runs() -> None:
    facts = analysed('{channel="state", loss=0.3}')
    assert facts["losses"] == {"state": [0.3]}
    verdict = facts["verdict"]
    assert (verdict["method"], verdict["settles"], verdict["why"]) == ("exact", True, "")
    assert verdict["typical_rate"] == pytest.approx(verdict["rate"], rel=0.1)
    assert facts["cost"]["method"] == "exact"
    assert sum(each["share"] for each in facts["cost"]["blocks"]) == pytest.approx(1)
    _, plan = parse(FOUR, "t.toml", ('links=[{channel="state", loss=0.3}]',))
    means, errors, total, error = mean_integrals(Estimates(plan, 256).of(plan))
    assert facts["cost"]["total"] == pytest.approx(total, rel=1e-3, abs=4 * error)
    by_block = {block["block"]: block["value"] for block in facts["cost"]["blocks"]}
    for block, mean, spread in zip(plan.blocks, means, errors, strict=True):
        assert by_block.get(block.name, 0.0) == pytest.approx(mean, rel=1e-3, abs=4 * spread)
    (state,) = (row for row in facts["table"] if row["name"] == "intra state")
    runs = state["delay_by_runs"]  # a loss of 30 % takes some of the delay that is borne without
    assert runs["value"] <= state["delay"]["seconds"] < 1.3 * runs["value"]
    assert facts["calm"] == "without losses"


def test_delays_that_vary_on_several_links_are_estimated_with_an_interval_and_it_is_said_why() -> None:
    facts = analysed('{channel="state", delay={min=0.0, max=0.05}}')
    verdict = facts["verdict"]
    assert (verdict["method"], verdict["settles"], verdict["runs"]) == ("estimated", True, 16)
    assert "delays that vary are computed on one link" in verdict["why"]
    assert verdict["rate_low"] <= verdict["rate"] <= verdict["rate_high"]
    assert (facts["cost"]["method"], facts["cost"]["runs"]) == ("estimated", 16)
    assert facts["delays"]["state"] == [0.0, 0.05]
    assert facts["calm"] == "delays that vary at their mean"
    alone = analysed('{source="g1/a", delay={min=0.0, max=0.05}}', 'timing="time_driven"')
    assert alone["verdict"]["method"] == "exact"


def test_predict_bears_at_least_five_times_the_delay_that_hold_bears() -> None:
    driven = ('timing="time_driven"', "periods.acceleration=0.05", "periods.torque=0.05")
    plan = parse(FOUR, "t.toml", driven)[1]
    hold, predict = (policy_effect(plan, Channel.STATE, policy, 60) for policy in ("hold", "predict"))
    assert hold.delay is not None
    assert predict.delay is not None
    assert predict.delay >= 5 * hold.delay
    for policy, delay, settles in (("hold", hold.delay + 0.05, False), ("predict", 5 * hold.delay, True)):
        rule = f'links=[{{channel="state", delay={delay:g}, policy="{policy}"}}]'
        for timing in driven[:1], ():  # exactly, and by a run of event-driven nodes
            late = parse(FOUR, "t.toml", (rule, *timing, *driven[1:], "duration=40"))[1]
            found = OwnLinks(late, Estimates(late, 8)).verdict()
            assert found.settles == settles
            assert found.method == ("exact" if timing or policy == "hold" else "estimated")


def test_what_each_policy_buys_is_a_table() -> None:
    facts = analysed("", "periods.acceleration=0.05", "periods.torque=0.05", policies=True)
    effects = {(one["channel"], one["policy"]): one for one in facts["effects"]}
    assert [key for key, one in effects.items() if one["own"]] == [
        (channel, "hold") for channel in ("state", "group_state", "reference", "command")
    ]
    assert effects["state", "predict"]["delay"] >= 5 * effects["state", "hold"]["delay"]
    assert effects["command", "zero"]["loss"]["share"] > effects["command", "hold"]["loss"]["share"]


def test_blackouts_are_told_by_block_exactly_or_by_runs() -> None:
    event = 'events=[{kind="blackout", channel="state", at=10.0, duration=1.0}]'
    for rules, method in (("", "exact"), ('{channel="state", loss=0.1}', "estimated")):
        (found,) = analysed(rules, event)["blackouts"]
        assert (found["channels"], found["links"], found["at"], found["duration"]) == (["state"], 4, 10.0, 1.0)
        assert found["method"] == method
        assert {each["block"] for each in found["blocks"]} == {"g1", "centroid"}
        assert bool(found["why"]) == (method == "estimated")


def test_without_runs_it_is_said_why_nothing_is_known() -> None:
    rule = 'links=[{channel="state", delay={min=0.0, max=0.05}}]'
    done = echelon("analyse", "-", "--set", rule, "--runs", "0", typed=FOUR)
    assert (done.returncode, done.stdout) == (2, "")
    assert "nor can it be estimated: no runs are asked for (--runs 0)" in done.stderr
    assert echelon("analyse", "-", "--runs", "-1", typed=FOUR).returncode == 2


def test_a_law_that_is_not_linear_is_refused_in_a_line() -> None:
    done = echelon("analyse", "sliding")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line == (
        "echelon: sliding: cannot be analysed; run it instead: law.use = 'terminal_sliding': is not linear, "
        "and what is computed here holds for linear laws"
    )


def test_messages_older_than_their_timeout_are_named() -> None:
    done = echelon("analyse", "drives", "--set", 'links=[{channel="state", delay=0.15}]')
    assert done.returncode == 2
    assert "state from g1/r1 to g1 is older than its timeout of 0.1 s when it would be used" in done.stderr


def test_delays_too_long_to_compute_with_are_judged_by_a_run() -> None:
    facts = analysed("{delay=100.0}")
    assert "delays of up to 100 s are too long to compute with" in facts["verdict"]["why"]
    assert not facts["settles"]
    assert any("what follows from the linear run: delays of up to 100 s" in each for each in facts["not_computed"])


def test_margins_of_matrix_gains_are_those_of_the_worst_direction() -> None:
    gains = 'law.gains=[{block="centroid", k1=[[1.0, 0.0], [0.0, 9.0]], k2=[[1.0, 0.0], [0.0, 3.0]]}]'
    facts = json.loads(echelon("analyse", "lab", "--set", gains, "--json").stdout)
    assert facts["blocks"][-1]["names"] == ["centroid"]
    assert facts["blocks"][-1]["delay_margin"] == pytest.approx(0.71117 / 3, rel=1e-4)
    assert len(facts["blocks"][-1]["poles"]) == 4


def test_a_torque_loop_that_loses_robots_is_said_and_is_exit_code_1() -> None:
    done = echelon("analyse", "paper", "--set", "periods.torque=0.001")
    assert done.returncode == 1
    assert "but periods.torque = 0.001: the torque loop of g3/r9" in done.stdout
    assert "later messages may be" not in done.stdout


# Warnings of `validate`


def test_defaults_give_a_tame_run(tmp_path: Path) -> None:
    (tmp_path / "four.toml").write_text(FOUR)
    assert echelon("validate", "four.toml", "--strict", cwd=tmp_path).returncode == 0
    ends = last_errors(FOUR)
    assert ends[-1] < 1e-3 < ends[0]


def test_warnings_are_a_line_each_and_a_mistake_only_where_that_is_wanted() -> None:
    options = ("--set", "law.epsilon=[0.1,0.1]")
    done = echelon("validate", "-", *options, typed=FOUR)
    assert done.returncode == 0
    warnings = [line for line in done.stdout.splitlines() if line.startswith("  warning  ")]
    assert [line.split(":")[0].split()[1] for line in warnings] == ["law.epsilon", "periods.torque"]
    assert not np.isfinite(last_errors(FOUR, "law.epsilon=[0.1,0.1]", "duration=0.1")[-1])
    strict = echelon("validate", "-", "--strict", "--json", *options, typed=FOUR)
    assert strict.returncode == 2
    assert [f"  warning  {line}" for line in json.loads(strict.stdout)["warnings"]] == warnings
