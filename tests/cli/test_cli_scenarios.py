"""Commands about scenarios: sources of scenarios, shipped scenarios, new scenarios, the schema of their keys, DBCs."""

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import cantools
import pytest
from jsonschema import Draft202012Validator

from echelon.bridge.timing.fit import plan_fit
from echelon.cli.new_scenario import scenario_text, sizes
from echelon.planning.loading import effective_toml
from echelon.scenario.schema import reference_page, scenario_schema
from echelon.scenario.tables import Scenario
from echelon.shipped import shipped
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import REGISTRY, parse
from echelon.sim.results.rendering import summary_schema
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import TraceBuilder
from support.runs import ROOT, echelon, summary_of
from support.synthetic import run_facts

LAB = shipped()["lab"].read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short run in one process."""
    folder = tmp_path_factory.mktemp("runs") / "short"
    options = ("--set", "duration=0.3", "--set", "claims=[]", "--engine", "inprocess", "--quiet", "--no-report")
    done = echelon("run", "lab", *options, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


# Sources of scenarios


def test_a_scenario_comes_from_standard_input() -> None:
    done = echelon("validate", "-", "--set", "duration=2.0", "--json", typed=LAB)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["duration"] == 2.0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = 3\n", "echelon: standard input: name = 3: must be a string"),
        ("", "echelon: standard input: empty; a scenario needs name, duration, formation, trajectory"),
        ("name", "echelon: standard input: not TOML: "),
    ],
)
def test_mistakes_in_standard_input_are_called_that(text: str, says: str) -> None:
    done = echelon("validate", "-", typed=text)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(says)


def test_a_run_from_standard_input(tmp_path: Path) -> None:
    options = ("--set", "duration=0.1", "--set", "claims=[]", "--quiet", "--no-report", "--json", "--can", "none")
    done = echelon("run", "-", *options, "--out", tmp_path / "out", typed=LAB)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["scenario"] == "lab"


def test_the_folder_of_a_run_stands_for_its_scenario(folder: Path, tmp_path: Path) -> None:
    done = echelon("run", folder, "--engine", "inprocess", "--quiet", "--no-report", "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    assert summary_of(tmp_path / "again")["trace_digest"] == summary_of(folder)["trace_digest"]
    assert json.loads(echelon("validate", folder, "--json").stdout)["duration"] == 0.3
    assert json.loads(echelon("analyse", folder, "--json").stdout)["scenario"] == "lab"
    assert echelon("dbc", folder).stdout == (folder / "torque.dbc").read_text()
    drives = echelon("drives", folder, "--can", "none")
    assert "drives need a bus that other processes can use" in drives.stderr


def test_a_run_may_go_into_the_folder_that_it_comes_from(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    done = echelon("run", ".", "--engine", "inprocess", "--quiet", "--no-report", "--out", ".", cwd=copy)
    assert done.returncode == 0, done.stderr
    assert summary_of(copy)["trace_digest"] == summary_of(folder)["trace_digest"]


def test_a_folder_that_is_no_run_does_not_hide_a_shipped_scenario(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "mine").mkdir()
    assert echelon("validate", "lab", cwd=tmp_path).returncode == 0
    done = echelon("validate", "mine", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "echelon: mine/scenario.toml: No such file or directory\n"


def test_all_mistakes_are_told_and_it_is_exit_code_2(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text(LAB.replace("duration = 40.0", "duration = -1").replace("mass = 4.0", "maas = 4"))
    done = echelon("validate", "x.toml", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines() == [
        "echelon: x.toml: duration = -1: must be greater than 0",
        "  robot.maas: unknown key; did you mean 'mass'?",
    ]


# Shipped scenarios


def test_scenarios_are_listed_with_what_they_show() -> None:
    rows = json.loads(echelon("scenarios", "--json").stdout)
    assert [row["name"] for row in rows] == sorted(path.stem for path in (ROOT / "deploy" / "scenarios").glob("*.toml"))
    for row in rows:
        assert tomllib.loads(Path(row["path"]).read_text())["description"] == row["description"]
    lines = echelon("scenarios").stdout.splitlines()
    assert [line.split()[0] for line in lines] == [row["name"] for row in rows]
    assert all(line.endswith(row["description"]) for line, row in zip(lines, rows, strict=True))


# New scenarios


def verdict(text: str) -> dict[str, Any]:
    """Runs a scenario in this process; returns its summary."""
    _, plan = parse(text, "t.toml")
    builder = TraceBuilder(plan)
    engine = Engine(plan, builder.add)
    engine.run()
    return summarise(builder.build(), engine.link_counts(), None, run_facts())


@pytest.mark.parametrize("drive", [None, "native", "odrive", "cia402"])
@pytest.mark.parametrize("groups", ["1x1", "1x2", "2x3", "2,3,5"])
def test_a_new_scenario_is_tame_and_holds(groups: str, drive: str | None) -> None:
    text = scenario_text("new-one", sizes(groups), drive)
    scenario, plan = parse(text, "t.toml")
    assert scenario.name == "new-one"
    assert tuple(len(group.robots) for group in scenario.formation.groups.values()) == sizes(groups)
    assert (plan.can.path, {robot.drive.protocol.use for robot in plan.robots}) == (
        "closed" if drive else "mirror",
        {drive or "native"},
    )
    assert all(fit.fits for fit in plan_fit(plan))
    summary = verdict(text)
    assert summary.verdict.word == "HOLDS", summary.verdict
    assert summary.claims
    assert all(row.saturation_share == 0 for row in summary.torque)


@pytest.mark.parametrize("drive", [None, "native", "odrive", "cia402"])
@pytest.mark.parametrize("groups", ["1x127", "9x14", "40,3", "127x1"])
def test_a_new_scenario_of_any_size_fits_its_buses(groups: str, drive: str | None) -> None:
    _, plan = parse(scenario_text("large", sizes(groups), drive), "t.toml")
    assert len(plan.robots) == sum(sizes(groups))
    assert all(fit.fits for fit in plan_fit(plan))


def test_new_writes_a_file_and_replaces_none(tmp_path: Path) -> None:
    done = echelon("new", "my", "--groups", "2x3", "--drive", "odrive", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "my.toml\n"), done.stderr
    text = (tmp_path / "my.toml").read_text()
    assert text == scenario_text("my", (3, 3), "odrive")
    assert echelon("validate", "my.toml", cwd=tmp_path).returncode == 0
    (tmp_path / "my.toml").write_text("mine")
    again = echelon("new", "my", cwd=tmp_path)
    assert again.returncode == 2
    assert again.stderr == "echelon: my.toml: exists already; --force overwrites it\n"
    assert (tmp_path / "my.toml").read_text() == "mine"
    assert echelon("new", "my", "--force", cwd=tmp_path).returncode == 0
    assert (tmp_path / "my.toml").read_text() == scenario_text("my", (3, 3), None)


def test_what_is_new_runs_as_processes(tmp_path: Path) -> None:
    assert echelon("new", "my", "--groups", "2x2", "--drive", "native", cwd=tmp_path).returncode == 0
    done = echelon("run", "my.toml", "--quiet", "--no-report", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads(done.stdout)
    assert (summary["can"]["referee"]["kinds"], summary["verdict"]["word"]) == ({}, "HOLDS")


# Schema of the keys


def tables(schema: dict[str, Any]) -> dict[str, Any]:
    """Returns the schemas of all tables in a schema, by their names."""
    return {"Scenario": schema, **schema["$defs"]}


def test_every_key_says_what_it_is() -> None:
    for name, table in tables(scenario_schema(REGISTRY)).items():
        assert table["description"], name
        assert table["additionalProperties"] is False, name
        for key, value in table["properties"].items():
            assert len(value["description"]) >= 3, f"{name}.{key}"


def test_the_schema_has_exactly_the_keys_that_are_known() -> None:
    schema = json.loads(echelon("schema", "scenario").stdout)
    assert schema == json.loads(json.dumps(scenario_schema(REGISTRY)))
    assert list(schema["properties"]) == list(Scenario.model_fields)
    assert schema["required"] == ["name", "duration", "formation", "trajectory"]
    assert '"null"' not in json.dumps(schema)
    assert ": null" not in json.dumps(schema)
    assert schema["$defs"]["RobotTable"]["properties"]["heading"]["description"].endswith(
        "x axis [rad]; 0 unless given"
    )
    assert "[°]" in schema["$defs"]["Shape"]["properties"]["rotation"]["description"]


JUDGE = Draft202012Validator(scenario_schema(REGISTRY))


@pytest.mark.parametrize("name", shipped())
def test_editors_find_nothing_wrong_with_a_scenario_or_what_a_run_makes_of_it(name: str) -> None:
    Draft202012Validator.check_schema(JUDGE.schema)
    text = shipped()[name].read_text(encoding="utf-8")
    for each in (text, effective_toml(parse(text, "t.toml")[0])):
        assert [error.message for error in JUDGE.iter_errors(tomllib.loads(each))] == []


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("duration = 40.0", "duratoin = 40.0"),
        ("duration = 40.0", "duration = '40'"),
        ("mass = 4.0", "mass = -4.0"),
        ("mass = 4.0", "maas = 4.0"),
        ("r1 = {", "R1 = {"),
        ('kind = "circle"', 'kind = "line"'),
        ("radius = 1.5", "raduis = 1.5"),
        ('time_scales = "three"', 'time_scales = "four"'),
        ("start = [0.0, -1.3]", "start = [0.0]"),
    ],
)
def test_editors_find_what_is_wrong(before: str, after: str) -> None:
    assert before in LAB
    assert list(JUDGE.iter_errors(tomllib.loads(LAB.replace(before, after, 1))))


@pytest.mark.parametrize(
    "written",
    [
        'trajectory = { use = "my.py:Path", parameters = { x = 1 } }',
        'trajectory = { use = "circle", parameters = { radius = 1.0, rate = 0.1 } }',
        'trajectory = { kind = "installed", x = 1 }',
        'robot.model = "my.py:Slipping"',
        'robot.model = "installed"',
        'robot.model = { use = "my.py:Slipping", parameters = { slip = 0.1 } }',
    ],
)
def test_editors_allow_parts_that_others_wrote(written: str) -> None:
    assert [error.message for error in JUDGE.iter_errors(tomllib.loads(LAB) | tomllib.loads(written))] == []


def test_the_schema_of_a_summary_is_there_too() -> None:
    assert json.loads(echelon("schema", "summary").stdout) == summary_schema()
    refused = echelon("schema", "summary", "--markdown")
    assert refused.stderr == "echelon: --markdown: is only for the schema of scenarios, not of summary\n"


def test_the_reference_page_is_up_to_date() -> None:
    page = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    assert page == reference_page(REGISTRY), "make docs"
    assert page == echelon("schema", "scenario", "--markdown").stdout
    for table in tables(scenario_schema(REGISTRY)).values():
        assert all(f"| `{key}` |" in page for key in table["properties"])


# DBC


def test_dbcs_of_all_buses_as_json() -> None:
    found = json.loads(echelon("dbc", "drives", "--json").stdout)
    assert list(found) == ["can0", "can1", "can2"]
    assert all(cantools.database.load_string(text, "dbc").messages for text in found.values())
    assert list(json.loads(echelon("dbc", "drives", "--bus", "can1", "--json").stdout)) == ["can1"]
    refused = echelon("dbc", "drives")
    assert "give --bus can0 or can1 or can2" in refused.stderr
    assert echelon("dbc", "drives", "--bus", "x").stderr == "echelon: --bus x: must be one of can0, can1, can2\n"
