"""Names with hyphens: keys, processes and files keep the hyphens; ROS topics and DBC identifiers have underscores."""

import re
from pathlib import Path

import cantools
import pytest

from echelon.planning.loading import ScenarioError
from echelon.sim.parts.loading import load, parse
from echelon.sim.recording.mcap_reader import read_trace, records
from echelon.sim.recording.recorder import frame_topics
from support.runs import echelon, plan_of, summary_of

TEXT = """
name = "circle-two"
duration = 0.2
robot = { mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1, drive = { protocol = "odrive" } }
law = { epsilon = [0.5, 0.5] }
trajectory = { kind = "line", velocity = [0.1, 0.0] }
links = [{ source = "left-ones/*", delay = 0.02 }]
claims = []
[can]
path = "closed"
buses = { can-a = {}, can-b = {} }
[formation]
shape = { kind = "line", spacing = 3.0 }
[formation.groups.left-ones]
shape = { kind = "line", spacing = 1.0 }
robot = { bus = "can-b" }
robots = { r-1 = { start = [0, 1] }, r-2 = { start = [0, 2] } }
[formation.groups.right]
robots = { r-1 = { start = [0, -1] } }
"""


def plain(text: str) -> str:
    """Returns a text with underscores in place of hyphens."""
    return re.sub(r"(?<=[a-z])-(?=[a-z0-9])", "_", text)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_a_run_with_hyphens_in_all_names(engine: str, tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text(TEXT)
    (tmp_path / "plain.toml").write_text(plain(TEXT))
    out = tmp_path / "out"
    done = echelon("run", tmp_path / "x.toml", "--engine", engine, "--quiet", "--no-report", "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    options = ("--engine", "inprocess", "--quiet", "--no-report", "--out", tmp_path / "plain")
    assert echelon("run", tmp_path / "plain.toml", *options).returncode == 0
    plan = load(tmp_path / "x.toml")[1]
    assert [robot.path for robot in plan.robots] == ["left-ones/r-1", "left-ones/r-2", "right/r-1"]
    assert read_trace(out / "run.mcap", plan).digest() == summary_of(tmp_path / "plain")["trace_digest"]
    topics = {record.topic for record in records(out / "run.mcap") if hasattr(record, "topic")}
    assert {"/left_ones/r_1/state", "/left_ones/r_1/odom", "/left_ones/command", "/can/can_b/frames"} <= topics
    assert all(re.fullmatch(r"(/[a-z][a-z0-9_]*)+", topic) for topic in topics)
    assert {path.name for path in out.glob("*.dbc")} == {"torque-can-a.dbc", "torque-can-b.dbc"}
    for path in out.glob("*.dbc"):
        assert all(len(name) <= 32 for name in re.findall(r"^BO_ \d+ (\S+):", path.read_text(), re.MULTILINE))
        names = [message.name for message in cantools.database.load_file(path).messages]
        assert all(re.fullmatch(r"[a-zA-Z_]\w*", name) for name in names)
    assert " can-b " in (out / "can.log").read_text()


@pytest.mark.slow
def test_the_default_folder_begins_with_the_name_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text(TEXT)
    done = echelon("run", "x.toml", "--engine", "inprocess", "--quiet", "--no-report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("circle-two-")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("r-2 =", "r_1 ="), "formation.groups.left-ones: 'r_1' must differ from other names by more than hyphens"),
        (("groups.right", "groups.left_ones"), "formation: 'left_ones' must differ from other names by more than"),
        (("can-a =", "can_b ="), "can: buses: 'can-b' must differ from other names by more than hyphens"),
    ],
)
def test_names_that_are_equal_in_topics_are_refused(change: tuple[str, str], says: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        parse(TEXT.replace(*change, 1), "t.toml")
    assert str(caught.value).startswith(f"t.toml: {says}")


def test_topics_keep_names_without_hyphens() -> None:
    assert frame_topics(plan_of("drives")) == ["/can/can0/frames", "/can/can1/frames", "/can/can2/frames"]
