"""A run's folder keeps the files of users' parts, so that its scenario can be run again from there, with the same digest."""

import hashlib
import shutil
import tomllib
from pathlib import Path

import pytest
from mcap.reader import make_reader

from echelon.planning.loading import effective_toml
from echelon.sim.kept_parts import keep_parts
from echelon.sim.parts.loading import load, parse
from echelon.sim.recording.mcap_reader import read_metadata, recover
from support.runs import SCENARIOS, echelon, summary_of

LAW = """
from echelon.controller.laws import Law

class Spring(Law):
    uses = {"gains"}
    stiffness: float = 1.0

    def nu(self, block, t, e, e_dot, feed_forward, state):
        return feed_forward - self.stiffness * block.K_1 @ e - block.K_2 @ e_dot
"""
PLANT = """
from echelon.agents.plant import Plant, paper_step

class Weak(Plant):
    share: float = 0.9

    def step(self, robot, state, tau_right, tau_left, h):
        return paper_step(robot)(state, self.share * tau_right, self.share * tau_left, h)
"""
OTHER_PLANT = PLANT.replace("0.9", "0.8").replace("Weak", "Weaker")
USE = (
    'law={use="../shared/parts.py:Spring",epsilon=[0.5,0.5],gains=[{k1=0.25,k2=0.5}]}',
    'robot.model={use="parts.py:Weak"}',
    'formation.groups.g2.robot.model={use="my/parts.py:Weaker",parameters={share=0.7}}',
)
"""Three files with the same name"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project whose parts lie in three folders."""
    folder = tmp_path / "project"
    for name, text in (("../shared/parts.py", LAW), ("parts.py", PLANT), ("my/parts.py", OTHER_PLANT)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    shutil.copy(SCENARIOS / "lab.toml", folder / "mine.toml")
    return folder


def run(scenario: Path, out: Path, *overrides: str, engine: str = "inprocess") -> str:
    """Runs a scenario; returns the digest of its trace."""
    sets = [argument for override in overrides for argument in ("--set", override)]
    done = echelon("run", scenario, *sets, "--engine", engine, "--quiet", "--no-report", "--out", out)
    assert done.returncode in (0, 1), done.stderr
    digest: str = summary_of(out)["trace_digest"]
    return digest


@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_a_runs_folder_runs_again_to_the_same_digest(folder: Path, tmp_path: Path, engine: str) -> None:
    out = tmp_path / "out" / "run"
    digest = run(folder / "mine.toml", out, *USE, "duration=0.5", engine=engine)
    shutil.rmtree(folder)
    shutil.rmtree(tmp_path / "shared")
    moved = out.rename(tmp_path / "moved")
    again = tmp_path / "again"
    assert run(moved / "scenario.toml", again) == digest
    assert (again / "scenario.toml").read_text() == (moved / "scenario.toml").read_text()
    assert {path.name for path in moved.glob("*.py")} == {"parts.py", "parts-2.py", "parts-3.py"}
    # The moved folder can still be read.
    assert echelon("report", moved).returncode == 0
    assert echelon("export", moved, "--csv", tmp_path / "csv").returncode == 0
    assert len((tmp_path / "csv" / "robots.csv").read_text().splitlines()) > 9 * 50


def test_summary_and_recording_name_the_files_and_their_hashes(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    run(folder / "mine.toml", out, *USE, "duration=0.1")
    texts = {"parts.py": PLANT, "parts-2.py": OTHER_PLANT, "parts-3.py": LAW}
    hashes = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    assert {name: (out / name).read_text() for name in texts} == texts
    assert {(part["use"], part["file"], part["sha256"]) for part in summary_of(out)["parts"]} == {
        ("parts.py:Weak", "parts.py", hashes["parts.py"]),
        ("parts-2.py:Weaker", "parts-2.py", hashes["parts-2.py"]),
        ("parts-3.py:Spring", "parts-3.py", hashes["parts-3.py"]),
    }
    metadata = read_metadata(out / "run.mcap")
    assert {name: metadata[f"sha256 of {name}"] for name in texts} == hashes
    recover(out / "run.mcap", tmp_path / "mended.mcap")
    for recording in (out / "run.mcap", tmp_path / "mended.mcap"):
        with recording.open("rb") as file:
            attached = {one.name: one for one in make_reader(file).iter_attachments()}
        assert {name: attached[name].data.decode() for name in texts} == texts
        assert attached["parts.py"].media_type == "text/x-python"
        assert attached["scenario.toml"].data.decode() == (out / "scenario.toml").read_text()


def test_nothing_of_a_user_is_overwritten(folder: Path) -> None:
    """A run into the project's own folder: a file with the same text is used; for other files another name is chosen."""
    before = {path: path.read_bytes() for path in folder.rglob("*.py")}
    scenario, _ = load(folder / "mine.toml", USE)
    kept = keep_parts(scenario, folder)
    assert {path: path.read_bytes() for path in before} == before
    assert sorted(kept.names.values()) == ["parts-2.py", "parts-3.py", "parts.py"]
    again = keep_parts(scenario, folder)
    assert again == kept
    assert sorted(path.name for path in folder.glob("*.py")) == ["parts-2.py", "parts-3.py", "parts.py"]


def test_lines_end_as_they_did(folder: Path) -> None:
    """The noted hash is that of the file's bytes."""
    (folder / "parts.py").write_bytes(PLANT.replace("\n", "\r\n").encode())
    scenario, plan = load(folder / "mine.toml", ['robot.model="parts.py:Weak"'])
    assert plan.robots[0].model.made.share == 0.9
    (folder / "out").mkdir()
    (result,) = keep_parts(scenario, folder / "out").results
    assert (folder / "out" / "parts.py").read_bytes() == (folder / "parts.py").read_bytes()
    assert result.sha256 == hashlib.sha256((folder / "parts.py").read_bytes()).hexdigest()


def test_a_trace_of_delays_is_kept_and_the_run_runs_again_there(folder: Path, tmp_path: Path) -> None:
    """The trace is called as a file of the run; so it gets another name."""
    text = "delay\r\n0.02\r\nlost\r\n0.01\r\n"
    (folder / "can.log").write_bytes(text.encode())
    rule = 'links=[{channel="state",delay={kind="trace",file="can.log"}}]'
    out, again = tmp_path / "run", tmp_path / "again"
    digest = run(folder / "mine.toml", out, "duration=0.5", "claims=[]", rule)
    (folder / "can.log").unlink()
    assert (out / "can-2.log").read_bytes() == text.encode()
    assert tomllib.loads((out / "scenario.toml").read_text())["links"][0]["delay"]["file"] == "can-2.log"
    assert run(out / "scenario.toml", again) == digest
    assert read_metadata(out / "run.mcap")["sha256 of can-2.log"] == hashlib.sha256(text.encode()).hexdigest()
    with (out / "run.mcap").open("rb") as file:
        (attached,) = [one for one in make_reader(file).iter_attachments() if one.name == "can-2.log"]
    assert (attached.data.decode(), attached.media_type) == (text, "text/plain")


def test_scenarios_of_own_parts_keep_nothing(tmp_path: Path) -> None:
    scenario, _ = load(SCENARIOS / "integral.toml")
    kept = keep_parts(scenario, tmp_path)
    assert (kept.names, kept.results, kept.files, kept.metadata) == ({}, (), {}, {})
    assert list(tmp_path.iterdir()) == []
    assert parse(effective_toml(scenario, kept.names), "t.toml")[0] == scenario
