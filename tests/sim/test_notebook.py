"""Functions for notebooks: they give the same runs as the command, as named arrays; and a simulation can be stepped."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import echelon
from echelon.messages import STATE_FIELDS
from echelon.scenario.toml_text import toml_value
from echelon.sim.results.rendering import json_text
from support.runs import ROOT, SCENARIOS, plan_of, summary_of, trace_of
from support.runs import echelon as command

SHORT = {"duration": 0.5, "claims": []}
IN_PROCESS = ("--engine", "inprocess", "--quiet", "--no-report", "--set", "duration=0.5", "--set", "claims=[]")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> echelon.Run:
    folder = tmp_path_factory.mktemp("lab")
    return echelon.run("lab", SHORT, engine="inprocess", out=folder, quiet=True)


def test_it_is_the_run_of_the_command(lab: echelon.Run, tmp_path: Path) -> None:
    command("run", "lab", *IN_PROCESS, "--out", tmp_path)
    assert summary_of(tmp_path)["trace_digest"] == lab.trace_digest == trace_of(plan_of("lab", "duration=0.5")).digest()
    assert lab.folder is not None
    assert (lab.folder / "run.mcap").stat().st_size == (tmp_path / "run.mcap").stat().st_size


def test_from_disk_it_is_the_same(lab: echelon.Run) -> None:
    assert lab.folder is not None
    again = echelon.open_run(lab.folder)
    assert again.summary == lab.summary
    for tables, others in ((lab.robots, again.robots), (lab.blocks, again.blocks)):
        assert list(tables) == list(others)
        for name, table in tables.items():
            np.testing.assert_array_equal(table, others[name])


def test_tables_have_names_and_units(lab: echelon.Run) -> None:
    robot = lab.robots["g1/r1"]
    assert robot.dtype.names == ("t", *STATE_FIELDS, "x_desired", "y_desired")
    assert (robot["t"][0], robot["t"][-1]) == (0.0, 0.5)
    np.testing.assert_array_equal(robot["x"], lab.trace.states[0][:, 0])
    inter = lab.blocks["inter"]
    np.testing.assert_allclose(inter["norm"], np.linalg.norm(inter["error"], axis=1))
    np.testing.assert_allclose(inter["value"] - inter["desired"], inter["error"], atol=1e-15)
    for table in (robot, inter):
        assert all(lab.units[name] for name in table.dtype.names or ())
        with pytest.raises(ValueError, match="read-only"):
            table["t"][0] = 1.0


def test_what_is_not_there_is_named(lab: echelon.Run) -> None:
    for ask, says in (
        (lambda: lab.robots["g1/r99"], "no robot 'g1/r99'; there are g1/r1, g1/r2"),
        (lambda: lab.blocks["interr"], "no block 'interr'; there are g1, g2, g3, inter, centroid"),
        (lambda: lab.figure("errorz"), "no figure 'errorz'; there are trajectories"),
    ):
        with pytest.raises(KeyError) as caught:
            ask()
        assert says in str(caught.value)
    with pytest.raises(AttributeError, match="a run has no 'verdikt'; its summary has format, scenario"):
        lab.verdikt  # noqa: B018
    with pytest.raises(AttributeError, match="module 'echelon' has no attribute 'runn'"):
        echelon.runn  # type: ignore[attr-defined]  # noqa: B018


def test_the_summary_is_in_the_attributes(lab: echelon.Run) -> None:
    assert (lab.verdict.word, lab.holds, lab.ok) == ("HEALTHY", False, True)  # the scenario has no claims
    assert lab.failure is None
    assert (lab.scenario, lab.duration, lab.claims) == ("lab", 0.5, ())
    assert lab.distance.smallest > 0
    assert "blocks" in dir(lab)
    assert repr(lab).startswith("<Run of lab: ")


def test_data_frames(lab: echelon.Run) -> None:
    frames = lab.to_pandas()
    robots, blocks = lab.robots, lab.blocks
    assert frames.robots.loc[(0.25, "g2/r5"), "vx"] == robots["g2/r5"]["vx"][25]
    assert len(frames.robots) == sum(map(len, robots.values()))
    assert frames.blocks.loc[(0.25, "inter", "z2_y"), "error"] == blocks["inter"]["error"][25, 3]
    assert frames.links.loc[("g1/r1", "g1", "state"), "sent"] == lab.links[0].sent


@pytest.mark.parametrize("name", ["trajectories", "blocks", "errors", "distance", "torques"])
def test_figures(lab: echelon.Run, name: str, tmp_path: Path) -> None:
    picture = lab.figure(name)
    assert picture._repr_svg_().startswith("<svg")
    for kind in ("svg", "pdf", "png"):
        picture.save(tmp_path / f"picture.{kind}")
        before = (tmp_path / f"picture.{kind}").read_bytes()
        picture.save(tmp_path / f"picture.{kind}")
        assert (tmp_path / f"picture.{kind}").read_bytes() == before
    assert (tmp_path / "picture.svg").read_text(encoding="utf-8") == picture.svg
    with pytest.raises(ValueError, match="must end in"):
        picture.save(tmp_path / "picture.gif")


@pytest.mark.parametrize(
    "value", [True, 3, 0.1, float("inf"), 'a "b"\n', [1.0, [2.0]], {"a b": {"c": [True]}}, np.float64(0.5), np.eye(2)]
)
def test_any_value_of_toml_can_be_given(value: object) -> None:
    import tomllib

    found = tomllib.loads(f"value = {toml_value(value)}")["value"]
    assert found == (value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value)


def test_scenarios_come_from_names_files_tables_and_what_was_loaded(tmp_path: Path) -> None:
    named = echelon.load("lab", {"law.lead": 0.25, "links": [{"delay": 0.01}]})
    assert (named.plan.lead, named.plan.links[0].delay_max_ns) == (0.25, 10_000_000)
    file = echelon.load(SCENARIOS / "lab.toml", {"law.lead": 0.25})
    table = echelon.load(file.scenario.model_dump(mode="json", exclude_none=True))
    assert file.scenario == table.scenario == echelon.load(file).scenario
    assert echelon.load(file, {"law.lead": 0.5}).scenario == echelon.load("lab").scenario


@pytest.mark.parametrize(
    ("scenario", "changes", "says"),
    [
        ("laab", {}, "laab: no such file, and no shipped scenario; those are "),
        ("lab", {"law.leed": 0.0}, "law.leed: unknown key; did you mean 'lead'?"),
        ("lab", {"law.lead": None}, "None: must be a number, a string, a boolean"),
        ({"name": "t"}, {}, "scenario: duration: missing"),
        ("lab", {"can.virtual_drives": False, "can.path": "closed"}, 'real drives need clock="wall"'),
    ],
)
def test_mistakes_are_user_errors(scenario: object, changes: dict[str, object], says: str, tmp_path: Path) -> None:
    with pytest.raises(echelon.UserError) as caught:
        echelon.run(scenario, changes, quiet=True, out=tmp_path / "run")  # type: ignore[arg-type]
    assert says in str(caught.value)


# Steps


@pytest.mark.parametrize("path", ["mirror", "closed"])
def test_steps_are_the_run(path: str) -> None:
    changes = {"duration": 0.3, "claims": [], "can.path": path}
    simulation = echelon.Simulation("lab", changes)
    assert simulation.t == 0.0
    times = [simulation.t]
    while not simulation.done:
        times.append(simulation.step())
    np.testing.assert_allclose(times, np.arange(31) * 0.01)
    whole = trace_of(plan_of("lab", "duration=0.3", f"can.path={path}"))
    assert simulation.result().trace_digest == whole.digest()
    with pytest.raises(echelon.UserError, match="the simulation is over at"):
        simulation.step()
    simulation.reset()
    assert simulation.run_until(0.1) == pytest.approx(0.1)
    assert not simulation.done


@pytest.mark.parametrize("path", ["mirror", "closed"])
def test_overwritten_commands_are_what_a_robot_does(path: str) -> None:
    """A robot at rest follows an acceleration along its heading that replaces its leader's command.  In this period the other
    robots move as without it."""
    changes = {"duration": 0.2, "claims": [], "can.path": path, "robot.torque_rate_limit": float("inf")}
    meddled, left = echelon.Simulation("lab", changes), echelon.Simulation("lab", changes)
    meddled.commands[0] = 0.2, 0.0
    assert left.commands[0].tolist() != [0.2, 0.0]
    for simulation in (meddled, left):
        simulation.step()
    assert (meddled.states["ax"][0], meddled.states["ay"][0]) == (0.2, 0.0)
    assert meddled.states["x"][0] != left.states["x"][0]
    np.testing.assert_array_equal(meddled.states[1:], left.states[1:])


def test_no_command_is_no_torque() -> None:
    simulation = echelon.Simulation("lab", {"duration": 0.1, "claims": [], "robot.torque_rate_limit": float("inf")})
    simulation.commands[:] = np.nan
    simulation.step()
    assert not simulation.states["tau_right"].any()
    assert not simulation.states["v"].any()


@pytest.mark.parametrize("wrong", [(np.nan, 0.0), (0.0, np.nan), (np.inf, 0.0), (np.nan, -np.inf)])
def test_half_a_command_is_a_mistake(wrong: tuple[float, float]) -> None:
    simulation = echelon.Simulation("lab", {"duration": 0.1, "claims": []})
    simulation.commands[4] = wrong
    with pytest.raises(echelon.UserError, match=r"commands\[4\] = \[.*\], of g2/r5: must be two finite numbers"):
        simulation.step()
    simulation.commands[4] = 0.1, 0.0  # nothing has moved, and it goes on
    assert simulation.t == 0.0
    assert simulation.step() == pytest.approx(0.01)


class Mine(echelon.Law):
    def nu(self, block, t, e, e_dot, feed_forward, state):  # type: ignore[no-untyped-def]
        return feed_forward


@pytest.mark.parametrize("use", [Mine, Mine()])
def test_a_class_is_not_a_value_of_a_scenario(use: object) -> None:
    for scenario, changes in (("lab", {"law.use": use}), ("lab", {"law": {"use": use}}), ({"law": {"use": use}}, None)):
        with pytest.raises(echelon.UserError, match=r"Mine: .* write it into a file .* and give 'my_laws\.py:Mine'$"):
            echelon.load(scenario, changes)  # type: ignore[arg-type]


def test_mistakes_in_python_name_pythons_arguments(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text("mine")
    for says, call in (
        (
            f"out {tmp_path}: scenario.toml exists",
            lambda: echelon.run("lab", out=tmp_path, quiet=True, engine="inprocess"),
        ),
        ("lab.toml with law.lead=-1.0: law.lead = -1.0", lambda: echelon.load("lab", {"law.lead": -1.0})),
    ):
        with pytest.raises(echelon.UserError) as caught:
            call()
        assert says in str(caught.value)
        assert "--" not in str(caught.value)


def test_a_bus_of_hardware_must_be_asked_for(tmp_path: Path) -> None:
    options: dict[str, Any] = {"can": "socketcan:lo", "quiet": True}  # lo is a network interface, but no CAN bus
    with pytest.raises(echelon.UserError, match=r"^can socketcan:lo: is hardware, .* give real_bus=True if"):
        echelon.run("lab", {"duration": 0.1}, out=tmp_path / "refused", **options)
    assert not (tmp_path / "refused").exists()
    run = echelon.run("lab", {"duration": 0.1}, out=tmp_path / "asked", real_bus=True, **options)
    assert "cannot open CAN bus socketcan:lo" in (run.failure or "")


def test_errors_and_states_are_those_of_the_instant() -> None:
    simulation = echelon.Simulation("lab", {"duration": 0.2, "claims": []})
    simulation.run_until(0.1)
    run = simulation.result()
    assert simulation.errors == {name: pytest.approx(table["norm"][10]) for name, table in run.blocks.items()}
    assert simulation.states["robot"].tolist() == [robot.name for robot in simulation.plan.robots]
    assert simulation.states["theta"][3] == run.robots["g2/r4"]["theta"][10]


# Scripts, the example notebook, and mistakes


@pytest.mark.parametrize("way", ["file", "standard input"])
def test_a_script_without_a_main_guard_starts_processes(way: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import echelon\n"
        "run = echelon.run('lab', {'duration': 0.2, 'claims': []}, quiet=True)\n"
        "print(run.summary.run.engine, run.trace_digest)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script) if way == "file" else "-"],
        input=script.read_text() if way != "file" else None,
        capture_output=True,
        text=True,
        timeout=600,
        cwd=tmp_path,
    )
    assert done.stderr == ""
    assert done.stdout.split() == ["processes", trace_of(plan_of("lab", "duration=0.2")).digest()]


def test_the_example_notebook_runs(tmp_path: Path) -> None:
    notebook = nbformat.read(ROOT / "examples" / "notebook.ipynb", as_version=4)
    done = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in done.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any("image/svg+xml" in output.get("data", {}) for output in outputs)
    assert len(list((tmp_path / "runs").iterdir())) >= 2


def test_importing_it_is_cheap() -> None:
    code = "import sys, echelon; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", f"import json\n{code}"], capture_output=True, text=True, check=True)
    assert not {"numpy", "zenoh", "can", "pydantic", "matplotlib"} & set(json.loads(done.stdout))


@pytest.mark.parametrize("wrong", [{"engine": "in_process"}, {"clock": "real"}])
def test_an_engine_or_a_clock_that_does_not_exist_is_refused(wrong: dict[str, str], tmp_path: Path) -> None:
    ((name, value),) = wrong.items()
    with pytest.raises(echelon.UserError, match=f"{name} = '{value}': must be "):
        echelon.run("lab", out=tmp_path / "run", quiet=True, **wrong)  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


# What was recorded, judged again


def test_a_run_is_replayed_with_another_law(lab: echelon.Run) -> None:
    assert echelon.replay(lab).equal
    found = echelon.replay(lab, {"law.epsilon": [0.3, 0.6]}, only="coordinator")
    assert not found.equal
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member, found.roles) == (
        0.0,
        "coordinator",
        ("coordinator",),
    )
    other = echelon.load("lab", {**SHORT, "law.epsilon": [0.3, 0.6]})
    assert echelon.replay(str(lab.folder), scenario=other, only=["coordinator"]).channels == found.channels
    assert echelon.replay(lab, {"law.epsilon": [0.3, 0.6]}, only="coordinator", tolerance=1e6).equal


def test_two_runs_are_compared(lab: echelon.Run, tmp_path: Path) -> None:
    changed = echelon.run("lab", SHORT | {"law.lead": 0.0}, engine="inprocess", out=tmp_path, quiet=True)
    assert lab.folder is not None
    assert echelon.diff(lab, lab.folder).equal
    found = echelon.diff(lab, changed)
    assert found.first_difference is not None
    assert (found.first_difference.member, found.first_difference.time) == ("coordinator", 0.0)
    assert found.scenario == {"law.lead": ("0.5", "0.0")}
    assert echelon.diff(lab, changed, tolerance=1e6).equal


def test_what_has_no_folder_was_not_recorded() -> None:
    simulation = echelon.Simulation("lab", SHORT)
    simulation.run_until(0.05)
    with pytest.raises(echelon.UserError, match="this run has no folder, so its messages were not recorded"):
        echelon.replay(simulation.result())


def test_an_analysis_is_that_of_the_command() -> None:
    links = [{"channel": "reference", "delay": 0.06}]
    found = echelon.analyse("drives", {"links": links}, policies=True, runs=0)
    done = command("analyse", "drives", "--set", f"links={toml_value(links)}", "--policies", "--runs", "0", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(json_text(found)) == json.loads(done.stdout)
    assert found.settles
    for changes, runs, why in (
        ({"robot.mass": -1}, 0, "robot.mass"),
        ({}, -1, r"^runs -1: must be from 0 to 100000$"),
    ):
        with pytest.raises(echelon.UserError, match=why):
            echelon.analyse("lab", changes, runs=runs)
    with pytest.raises(echelon.UserError, match=r"^sliding: cannot be analysed; run it instead: .*is not linear"):
        echelon.analyse("sliding")
