"""Parts from files: they are found and checked, their text travels to other processes, and errors name them."""

import json
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

import echelon.planning.loading
from echelon.agents.plant import make_step, state_at
from echelon.controller.trajectory import make_trajectory
from echelon.errors import PartRunError
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import REGISTRY, load
from support.runs import SCENARIOS

SPIRAL = """
from math import cos, sin
import numpy as np
from echelon.controller.trajectory import Trajectory

class Spiral(Trajectory):
    rate: float = 0.2

    def at(self, t):
        w, c, s = self.rate, cos(self.rate * t), sin(self.rate * t)
        return np.array([[t * c, t * s], [c - w * t * s, s + w * t * c],
                         [-2 * w * s - w * w * t * c, 2 * w * c - w * w * t * s]])
"""
PLANT = """
import echelon.planning.loading
from echelon.agents.plant import Plant, paper_step

class Sticky(Plant):
    share: float = 1.0

    def step(self, robot, state, tau_right, tau_left, h):
        return paper_step(robot)(state, self.share * tau_right, self.share * tau_left, h)
"""
USE_SPIRAL = 'trajectory={use="my_paths.py:Spiral",parameters={rate=0.3}}'
USE_PLANT = 'robot.model={use="my_plants.py:Sticky",parameters={share=0.5}}'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Returns a user's folder with a scenario, parts, and files with the names of installed modules."""
    (tmp_path / "mine.toml").write_text((SCENARIOS / "lab.toml").read_text())
    (tmp_path / "my_paths.py").write_text(SPIRAL)
    (tmp_path / "my_plants.py").write_text(PLANT)
    for name in ("numpy", "math", "controller", "echelon", "pydantic"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')")
    return tmp_path


RICH = """
from enum import Enum
from typing import Annotated
from pydantic import Field, field_validator
from echelon import Trajectory
from echelon.parameters import Limits, Positive

class Turn(Enum):
    LEFT = "left"
    RIGHT = "right"

class Rich(Trajectory):
    turn: Turn = Turn.LEFT
    sides: list[float] = [1.0, 2.0]
    scale: Positive = 1.0
    share: Annotated[float, Field(lt=1)] = 0.5
    width: float = Field(2.0, ge=0)
    name: Annotated[str, Limits(max_length=3)] = "abc"

    @field_validator("width")
    @classmethod
    def _even(cls, width):
        if width % 2:
            raise ValueError("must be even")
        return width

    def __post_init__(self):
        if self.scale < self.share:
            raise ValueError(f"scale = {self.scale:g} must be at least share = {self.share:g}")

    def at(self, t):
        return [[0, 0]] * 3
"""


def untried(folder: Path, *overrides: str) -> Plan:
    """Returns a plan without a trial of its parts (echelon.sim.parts.probe)."""
    return echelon.planning.loading.load(folder / "mine.toml", overrides, REGISTRY)[1]


def refused(folder: Path, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load(folder / "mine.toml", overrides)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def test_a_trajectory_from_a_file_is_followed(folder: Path) -> None:
    _, plan = load(folder / "mine.toml", [USE_SPIRAL])
    assert plan.trajectory.parameters == {"rate": 0.3}
    assert plan.trajectory.source is not None
    assert plan.trajectory.source.text == SPIRAL
    z = make_trajectory(plan.trajectory).at(2.0)
    np.testing.assert_allclose(z[0], 2 * np.array([np.cos(0.6), np.sin(0.6)]))
    assert str(folder) not in sys.path


def test_a_plant_from_a_file_moves_robots(folder: Path) -> None:
    _, plan = load(folder / "mine.toml", [USE_PLANT, "duration=0.05"])
    _, plain = load(folder / "mine.toml", ["duration=0.05"])
    start = state_at(0, 0, 0, 0, 0)
    assert make_step(plan.robots[0])(start, 2.0, 1.0, 0.1) == make_step(plain.robots[0])(start, 1.0, 0.5, 0.1)
    Engine(plan).run()


def test_a_pickled_plan_holds_the_text_of_its_files(folder: Path) -> None:
    _, plan = load(folder / "mine.toml", [USE_SPIRAL, USE_PLANT])
    data = pickle.dumps(plan)
    for name in [name for name in sys.modules if name.startswith("echelon_part_")]:
        del sys.modules[name]
    (folder / "my_paths.py").unlink()
    again = pickle.loads(data)
    assert again.trajectory == plan.trajectory
    assert type(again.trajectory.made) is not type(plan.trajectory.made)
    np.testing.assert_array_equal(again.trajectory.made.at(1.5), plan.trajectory.made.at(1.5))
    assert again.robots[3].model.made.share == 0.5


def rich(**parameters: object) -> str:
    given = ",".join(f"{key}={json.dumps(value)}" for key, value in parameters.items())
    return f"trajectory={{use='rich.py:Rich',parameters={{{given}}}}}"


def test_parameters_may_have_any_type_that_pydantic_checks_and_travel_as_they_are(folder: Path) -> None:
    (folder / "rich.py").write_text(RICH)
    one = untried(folder, rich()).trajectory
    two = untried(folder, rich(turn="right", sides=[3], scale=4.0, width=6.0)).trajectory
    assert (one.made.sides, one.made.width, one.parameters["turn"]) == ([1.0, 2.0], 2.0, "left")
    assert two.parameters == {
        "turn": "right", "sides": [3.0], "scale": 4.0, "share": 0.5, "width": 6.0, "name": "abc"
    }  # fmt: skip
    assert one.made.sides is not untried(folder, rich()).trajectory.made.sides  # its own list
    again = pickle.loads(pickle.dumps(two))
    assert again == two
    assert vars(again.made) == vars(two.made)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        (rich(scale=-1.0), "trajectory.parameters.scale = -1.0: must be greater than 0"),
        (rich(scale=True), "trajectory.parameters.scale = true: must be a number"),
        (rich(share=1.0), "trajectory.parameters.share = 1.0: must be less than 1"),
        (rich(width=3.0), "trajectory.parameters.width: must be even"),
        (rich(scale=0.25), "trajectory.parameters: scale = 0.25 must be at least share = 0.5"),
        (rich(turn="up"), "trajectory.parameters.turn = 'up': must be 'left' or 'right'"),
        (rich(name="abcd"), "trajectory.parameters.name = 'abcd': "),
    ],
)
def test_parameters_are_checked_by_their_types_and_by_the_class(folder: Path, override: str, says: str) -> None:
    (folder / "rich.py").write_text(RICH)
    with pytest.raises(ScenarioError) as caught:
        untried(folder, override)
    assert says in str(caught.value)


def test_an_inherited_parameter_needs_its_type_again(folder: Path) -> None:
    (folder / "my_paths.py").write_text(SPIRAL + "\n\nclass Fast(Spiral):\n    rate = 0.9\n")
    assert "my_paths.py: rate needs a type: rate: float = 0.9" in refused(folder, 'trajectory={use="my_paths.py:Fast"}')


def test_a_type_that_pydantic_does_not_know_is_one_line(folder: Path) -> None:
    (folder / "my_paths.py").write_text(SPIRAL.replace("rate: float = 0.2", "rate: np.ndarray = 0.2"))
    assert "my_paths.py:Spiral: Pydantic" in refused(folder, USE_SPIRAL)


def test_files_of_one_name_in_two_folders_are_different_modules(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = tmp_path_factory.mktemp("other")
    (other / "mine.toml").write_text((folder / "mine.toml").read_text())
    (other / "my_paths.py").write_text(SPIRAL.replace("t * c, t * s]", "2 * t * c, t * s]"))
    one, two = (untried(place, USE_SPIRAL).trajectory.made.at(1.0) for place in (folder, other))
    assert two[0, 0] == 2 * one[0, 0]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ('trajectory={use="none.py:Spiral"}', "trajectory.use = 'none.py:Spiral': "),
        ('trajectory={use="none.py:Spiral"}', "No such file or directory"),
        ('trajectory={use="my_paths.py:Spirale"}', "my_paths.py has no class Spirale; it has Spiral"),
        ('trajectory={use="my_plants.py:Sticky"}', "must be a class derived from echelon.Trajectory"),
        ('trajectory={use="my_paths.py:cos"}', "must be a class derived from"),
        ('trajectory={use="spiral"}', "must be one of 'line', 'circle', 'sine', 'waypoints', or 'file.py:Class'"),
        ("trajectory={use=3}", "trajectory.use = 3: must be one of"),
        ('trajectory={use="circle",parameters=3}', "trajectory.parameters = 3: must be a table"),
        ('trajectory={use="circle",radius=1}', "trajectory.radius: unknown key; known here: parameters, use"),
        ('trajectory={use="my_paths.py:Spiral",parameters={rat=1}}', "parameters.rat: unknown key; did you mean 'rate'?"),
        ('trajectory={use="my_paths.py:Spiral",parameters={rate="x"}}', "trajectory.parameters.rate = 'x': must be a number"),
        ("robot.model=my_plants.py:Stick", "robot.model = 'my_plants.py:Stick': my_plants.py has no class Stick"),
        ("robot.model={parameters={}}", "robot.model.use: missing; must be one of 'paper'"),
        ("robot.model={share=1}", "robot.model.share: unknown key"),
        ("formation.groups.g1.robot.model={use='my_plants.py:Sticky',parameters={share=[]}}",
         "formation.groups.g1.robot.model.parameters.share = []: must be a number"),
    ],
)  # fmt: skip
def test_mistakes_name_key_value_and_what_is_allowed(folder: Path, override: str, says: str) -> None:
    assert says in refused(folder, override)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("class Spiral(:\n", "my_paths.py, line 1: invalid syntax"),
        ("import nowhere_at_all\n", "my_paths.py: ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("1 / 0\n", "my_paths.py: ZeroDivisionError: division by zero"),
        ("raise SystemExit(0)\n", "my_paths.py: SystemExit: 0"),
        (
            "from echelon.controller.trajectory import Trajectory\nclass Spiral(Trajectory): pass\n",
            "lacks the method at",
        ),
        (
            SPIRAL.replace("rate: float", "rates: float"),
            "trajectory.parameters.rate: unknown key; did you mean 'rates'?",
        ),
        (SPIRAL.replace("rate: float = 0.2", "rate = 0.2"), "my_paths.py: rate needs a type: rate: float = 0.2"),
        (SPIRAL.replace("rate: float = 0.2", "rate = np.pi * 1j"), "my_paths.py: rate needs a type: rate: complex = "),
        (
            SPIRAL.replace("rate: float = 0.2", "rate = np.zeros(1)"),
            "my_paths.py: rate needs a type: rate: … = array([0.])",
        ),
        ("\0", "source code string cannot contain null bytes"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line(folder: Path, text: str, says: str) -> None:
    (folder / "my_paths.py").write_text(text)
    assert says in refused(folder, USE_SPIRAL)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("raise KeyError('w')", "my_paths.py, line 10: Spiral: at(1) raised KeyError: 'w'"),
        ("return np.zeros((3, 3))", "my_paths.py:Spiral: at(1) has the shape (3, 3), not (3, 2)"),
        ("return np.full((3, 2), np.nan)", "my_paths.py:Spiral: at(1) is not finite"),
        ("return None", "my_paths.py:Spiral: at(1)"),
    ],
)
def test_a_trajectory_that_fails_in_a_run_is_named(folder: Path, line: str, says: str) -> None:
    (folder / "my_paths.py").write_text(SPIRAL.replace("w, c, s = ", f"{line}; w, c, s = "))
    trajectory = make_trajectory(untried(folder, USE_SPIRAL).trajectory)
    with pytest.raises(PartRunError) as caught:
        trajectory.at(1.0)
    assert str(caught.value).startswith(says)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("self.share = 3", "step sets self.share: a part's attributes do not change; a law keeps numbers in `state`"),
        ("self.other = 3", "step sets self.other: a part's attributes do not change; a law keeps numbers in `state`"),
        ("raise KeyError('w')", "step raised KeyError: 'w'"),
        ("return None", "step must return a RobotState (state_at), not None"),
        ("return state._replace(v=float('inf'))", "step is not finite: RobotState("),
    ],
)
def test_a_plant_that_fails_in_a_run_is_named(folder: Path, line: str, says: str) -> None:
    (folder / "my_plants.py").write_text(PLANT.replace("return paper_step", f"{line}; return paper_step"))
    step = make_step(untried(folder, USE_PLANT).robots[0])
    with pytest.raises(PartRunError) as caught:
        step(state_at(0, 0, 0, 0, 0), 0.0, 0.0, 0.1)
    where = "my_plants.py, line 9: Sticky" if "raised" in says or "sets" in says else "my_plants.py:Sticky"
    assert str(caught.value).startswith(f"{where} of g1/r1: {says}")
